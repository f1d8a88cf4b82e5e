"""OBJ files and their libraries, as programs write them."""

import numpy as np
import pytest
from PIL import Image
from scan_inputs import empty_cache, empty_room  # noqa: F401

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.mesh import load_mesh

RED, GRAY = (200, 40, 40), (160, 160, 160)
GEOMETRY = "v 0 0 0\nv 6 0 0\nv 6 5 0\nv 0 5 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1 2/2 3/3 4/4\n"
TEXTURED = "mtllib scan.mtl\nusemtl m\n" + GEOMETRY + FACE


@pytest.fixture(name="folder")
def folder_with_textures(tmp_path):
    (tmp_path / "textures").mkdir()
    Image.new("RGB", (8, 8), RED).save(tmp_path / "a.png")
    Image.new("RGB", (8, 8), RED).save(tmp_path / "textures" / "b c.png")
    (tmp_path / "second.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    return tmp_path


def load(folder, text, library=None):
    (folder / "scan.obj").write_text(text)
    if library is not None:
        (folder / "scan.mtl").write_text(library)
    return load_mesh(folder / "scan.obj")


def colors(mesh):
    """The first color of each surface."""
    firsts = [s.coordinates[0, 0] if s.texture is None else s.texture[0, 0] for s in mesh.surfaces]
    return [tuple(np.rint(color).astype(int).tolist()) for color in firsts]


@pytest.mark.parametrize(
    "line",
    [
        "map_Kd a.png", "map_kd A.PNG", 'map_Kd "a.png"', "map_Kd a.png # floor", "map_Kd textures\\b c.png",
        "map_Kd C:\\scan\\textures\\B C.png", "map_Kd ../../scan/textures/b%20c.png", "map_Kd -s 2 2 1 a.png",
        "map_Kd -o .5 0 0 a.png", "map_Kd -clamp on -blendu on -mm 0 1 -imfchan r a.png", "map_Kd -s 3 a.png",
        "Kd 0 0 0\nmap_Kd a.png\nd 1", "map_Kd a.png\nKd 0 0 0\nNs 10\nillum 2\nKa 1 1 1\nmap_bump lost.png",
        "map_Ke a.png", "map_Ka a.png",
    ],
)  # fmt: skip
def test_textures_are_found_as_programs_write_them(folder, line):
    assert colors(load(folder, TEXTURED, f"newmtl m\n{line}\n")) == [RED]


@pytest.mark.parametrize(
    ("text", "library"),
    [
        ("mtllib scan.mtl second.mtl\nusemtl m\n" + GEOMETRY + FACE, "newmtl n\nKd 1 1 1\n"),
        ("mtllib scan.mtl\nmtllib second.mtl\nusemtl m\n" + GEOMETRY + FACE, "newmtl n\nKd 1 1 1\n"),
        ("mtllib scan.mtl\n" + GEOMETRY + FACE, "newmtl m\nmap_Kd a.png\n"),  # MeshLab names no material
        (TEXTURED, "\ufeffnewmtl m\nmap_Kd a.png\n"),
        (TEXTURED.replace("usemtl m", "usemtl  my\tfloor "), "newmtl my  floor\r\nmap_Kd a.png\r\n"),
        ("\ufeff" + TEXTURED.replace("\n", "\r\n"), "newmtl m\nmap_Kd a.png\n"),
        (TEXTURED.replace(FACE, "f 1/1 2/2 \\\n3/3 4/4\n"), "newmtl m\nmap_Kd a.png\n"),
        (TEXTURED.replace(FACE, "f -4/-4 -3/-3 -2/-2 -1/-1 # a floor\n"), "newmtl m\nmap_Kd a.png\n"),
        (TEXTURED.replace(FACE, "f 1/1/ 2/2/ 3/3/ 4/4/\n"), "newmtl m\nmap_Kd a.png\n"),
        ("mtllib SCAN.MTL\nusemtl m\n" + GEOMETRY + FACE, "newmtl m\nmap_Kd a.png\n"),
    ],
    ids=["one line", "two lines", "no usemtl", "mark", "blanks", "dos", "continued", "backwards", "slash", "case"],
)
def test_libraries_and_faces_as_programs_write_them(folder, text, library):
    mesh = load(folder, text, library)
    assert colors(mesh) == [RED] and len(mesh.faces) == 2
    assert np.allclose(mesh.surfaces[0].coordinates[0], [[0, 0], [1, 0], [1, 1]])


def test_a_library_of_a_name_with_blanks(folder):
    (folder / "my scan.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    assert colors(load(folder, TEXTURED.replace("scan.mtl", "my scan.mtl"))) == [RED]


def test_options_move_repeat_and_clamp_a_texture(folder):
    (surface,) = load(folder, TEXTURED, "newmtl m\nmap_Kd -s 2 3 1 -o .5 -clamp on a.png\n").surfaces
    assert np.allclose(surface.coordinates[0], [[0.5, 0], [2.5, 0], [2.5, 3]]) and surface.wrap == ("clamp", "clamp")


def test_a_texture_that_is_lost_behind_a_tab_is_a_warning(folder):
    with pytest.warns(UserWarning, match=r"scan.obj refers to gone.png, which is not there"):
        assert colors(load(folder, TEXTURED, "newmtl\tm\nKd 1 1 1\nmap_Kd gone.png\n")) == [GRAY]


def test_faces_without_coordinates_beside_a_texture_are_gray(folder):
    text = TEXTURED + "v 7 0 0\nv 7 5 0\nf 2 5 6 3\n"
    with pytest.warns(UserWarning, match="1 of 2 parts have no color"):
        assert colors(load(folder, text, "newmtl m\nmap_Kd a.png\n")) == [GRAY, RED]


def vertices(colors, more=""):
    corners = ((0, 0), (6, 0), (6, 5), (0, 5))
    return "".join(f"v {x} {y} 0 {color}\n" for (x, y), color in zip(corners, colors, strict=True)) + more


@pytest.mark.parametrize(
    "color", ["200 40 40", "0.784314 0.156863 0.156863", "51400 10280 10280", "2e2 4e1 40."], ids=str
)
def test_colors_of_vertices_in_any_range(folder, color):
    assert colors(load(folder, vertices([color] * 4, "f 1 2 3 4\n"))) == [RED]


def test_colors_of_a_part_of_the_vertices_stay(folder):
    more = "v 6 0 0\nv 9 0 0\nv 9 5 0\nv 6 5 0\nf 1 2 3 4\nf 5 6 7 8\n"
    (surface,) = load(folder, vertices(["1 0 0"] * 4, more)).surfaces
    shown = {tuple(face[0].tolist()) for face in surface.coordinates}
    assert shown == {(255, 0, 0), GRAY}


def test_a_texture_and_colors_of_vertices_in_one_file(folder):
    """Each material's faces show what they have."""
    text = "mtllib scan.mtl\n" + vertices(["0 1 0"] * 4) + GEOMETRY[32:] + "v 7 0 0\nv 7 5 0\n"
    text += "usemtl m\nf 1/1 2/2 3/3 4/4\nusemtl bare\nf 1 2 3\n"
    assert colors(load(folder, text, "newmtl m\nmap_Kd a.png\n")) == [(0, 255, 0), RED]


@pytest.mark.parametrize(("d", "there"), [("d 0.2", False), ("d 0.9", True), ("Tr 0.1", True), ("d 1\nTr 1", True)])
def test_a_transparent_material_is_not_there(folder, d, there):
    text = TEXTURED + "v 1 1 .5\nv 3 1 .5\nv 3 3 .5\nv 1 3 .5\nusemtl glass\nf 5 6 7 8\n"
    mesh = load(folder, text, f"newmtl m\nmap_Kd a.png\nnewmtl glass\nKd 0 0 1\n{d}\n")
    assert len(mesh.faces) == (4 if there else 2)


def test_a_map_of_transparency_makes_holes(folder):
    veil = np.full((8, 8), 255, np.uint8)
    veil[:, 4:] = 0
    Image.fromarray(veil).save(folder / "veil.png")
    text = TEXTURED.replace(FACE, "f 1/1 2/2 3/3 4/4\n") + "v 0 0 -.01\nv 6 0 -.01\nv 6 5 -.01\nv 0 5 -.01\n"
    load(folder, text + "usemtl n\nf 5 6 7 8\n", "newmtl m\nmap_Kd a.png\nmap_d veil.png\nnewmtl n\nKd 0 1 0\n")
    scan = ScanMap.from_mesh(folder / "scan.obj", cache=False)
    assert scan.orthophoto[125, 75].tolist() == list(RED) and scan.orthophoto[125, 250].tolist() == [0, 255, 0]


def test_a_weight_of_one_and_faces_counted_from_the_end(folder):
    weighted = GEOMETRY.replace("6 5 0", "6 5 0 1") + "f -4/-4 -3/-3 -2/-2 -1/-1\nv 90 90 90\n"
    mesh = load(folder, "mtllib scan.mtl\nusemtl m\n" + weighted, "newmtl m\nmap_Kd a.png\n")
    assert colors(mesh) == [RED] and mesh.vertices.max(axis=0).tolist() == [6, 5, 0]


@pytest.mark.parametrize(
    ("text", "library", "message"),
    [
        (vertices(["1.8 1 1"] * 4, "f 1 2 3 4\n"), None, "neither 0..1 nor 0..255 nor 0..65535; rescale them"),
        (vertices(["-1 1 1"] * 4, "f 1 2 3 4\n"), None, "lie between -1 and 1"),
        (vertices(["1 1 1 1"] * 4, "f 1 2 3 4\n"), None, "has vertices of 7 numbers, not 3 or 4 or 6"),
        (vertices(["a b c"] * 4, "f 1 2 3 4\n"), None, "has vertices that are not numbers"),
        (GEOMETRY + "f 1 2 9\n", None, "a corner that is not there; it has 4 vertices"),
        (GEOMETRY + "f 1 2 0\n", None, "a corner that is not there"),
        (GEOMETRY + "f 1/1 2 3\n", None, None),
        (GEOMETRY + "f 1 2\n", None, "has a face of 2 corners"),
        (GEOMETRY + "f 1 2 x\n", None, "a face that is not whole numbers"),
        (GEOMETRY + "curv2 1 2 3\nf 1 2 3\n", None, "the statement 'curv2', which is not supported"),
        (TEXTURED, "newmtl m\nmap_Kd a.png\nmap_color b.png\n", "the statement 'map_color', which is not known"),
        (TEXTURED, "newmtl m\nKd 200 0 0\n", "the color '200 0 0', which is not in 0..1"),
        (TEXTURED, "newmtl m\nKd spectral x.rfl\n", "which is not three numbers"),
        (TEXTURED, "newmtl m\nTr 1\n", "'Tr 1' without 'd', which programs read in two ways"),
        (TEXTURED, "newmtl m\nmap_Kd -cc on a.png\n", "the texture option '-cc on'"),
        (TEXTURED, "newmtl m\nmap_Kd -t 1 0 0 a.png\n", "turbulence"),
        (TEXTURED, "map_Kd a.png\nnewmtl m\n", "begins with 'map_kd' before its first newmtl"),
        (TEXTURED, "newmtl m\nKd 1 1 1\nnewmtl m\nKd 0 0 0\n", "two materials of the name 'm'"),
        (TEXTURED.replace(FACE, "f 1/1 2/2 3 4\n"), "newmtl m\nmap_Kd a.png\n", "at some of their corners"),
        (TEXTURED, "newmtl m\nmap_Kd a.png\nmap_d gone.png\n", "refers to gone.png, its transparency"),
        (TEXTURED, "newmtl m\nmap_Kd " + "-o 1 " * 1000 + "\n", "statement 'map_kd' of 4999 letters, more than 4096"),
        ("v 0 0 0\0\n", None, "is not a text in UTF-8"),
        (GEOMETRY.replace("6 5 0", "6_0 5 0") + "f 1 2 3 4\n", None, "vertices that are not numbers .a '_' within"),
        (GEOMETRY + "f 1 2 1_0\n", None, "a face that is not whole numbers .a '_' within"),
        (GEOMETRY + "f 1/1/1/1 2/2/1/1 3/3/1/1\n", None, "a corner of more than three"),
        (
            GEOMETRY.replace("6 5 0", "6 5 0 2") + "f 1 2 3 4\n",
            None,
            "a weight other than 1, which programs read in two",
        ),
        (vertices(["1 1 1"] * 4, "v 9 9 9 3\nf 1 2 3 4\n"), None, "a weight other than 1"),
    ],
    ids=lambda value: str(value)[-40:],
)
def test_what_is_not_known_to_be_read_right_is_refused(folder, text, library, message):
    if message is None:
        with pytest.warns(UserWarning, match="no color"):
            load(folder, text, library)
        return
    with pytest.raises(SceneError, match=rf"scan\.obj.*{message}"):
        load(folder, text, library)


def test_two_textures_that_differ_by_case_alone_are_refused(folder):
    Image.new("RGB", (8, 8)).save(folder / "B.png")
    Image.new("RGB", (8, 8)).save(folder / "b.PNG")
    if len(list(folder.glob("[bB].*"))) < 2:
        pytest.skip("this file system does not tell cases of letters apart")
    with pytest.raises(SceneError, match=r"B.png, b.PNG differ by the case of letters alone; rename one"):
        load(folder, TEXTURED, "newmtl m\nmap_Kd b.png\n")
