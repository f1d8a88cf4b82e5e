"""PLY files in text and binary, with colors and textures under their usual names."""

import struct

import numpy as np
import pytest
from PIL import Image
from scan_inputs import empty_cache, empty_room  # noqa: F401

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.mesh import load_mesh

# Two squares side by side, of two triangles each.
POINTS = [(0, 0), (3, 0), (3, 5), (0, 5), (3, 0), (6, 0), (6, 5), (3, 5)]
FACES = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
RED, GREEN = (200, 40, 40), (40, 200, 40)
COLORS = [RED] * 4 + [GREEN] * 4
UV = [(0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9)] * 2
WEDGES = [(6, *(x for k in face for x in UV[k])) for face in FACES]
RGB = ("uchar red", "uchar green", "uchar blue")


def ply(path, vertices=((),) * 8, faces=((),) * 4, of_vertices=(), of_faces=(), comments=(), more=""):
    lines = ["ply", "format ascii 1.0", *(f"comment {comment}" for comment in comments), "element vertex 8"]
    lines += [f"property {name}" for name in ("float x", "float y", "float z", *of_vertices)]
    lines += ["element face 4", "property list uchar int vertex_indices", *(f"property {name}" for name in of_faces)]
    lines += [*([more] if more else []), "end_header"]
    lines += [" ".join(map(str, (x, y, 0, *rest))) for (x, y), rest in zip(POINTS, vertices, strict=True)]
    lines += [" ".join(map(str, (3, *face, *rest))) for face, rest in zip(FACES, faces, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return path


def halves(path):
    photo = ScanMap.from_mesh(path, cache=False).orthophoto
    return tuple(photo[125, 60].tolist()), tuple(photo[125, 240].tolist())


def typed(kind):
    return tuple(name.replace("uchar", kind) for name in RGB)


@pytest.mark.parametrize(
    ("colors", "names"),
    [
        (COLORS, RGB),
        ([[k / 255 for k in color] for color in COLORS], typed("float")),
        ([[float(k) for k in color] for color in COLORS], typed("double")),
        ([[k * 257 for k in color] for color in COLORS], typed("ushort")),
        (COLORS, typed("int")),
        (COLORS, ("uchar r", "uchar g", "uchar b")),
        (COLORS, ("uchar diffuse_red", "uchar diffuse_green", "uchar diffuse_blue")),
        ([(*color, 0) for color in COLORS], (*RGB, "uchar alpha")),
        ([(*uv, *color) for uv, color in zip(UV, COLORS, strict=True)], ("float s", "float t", *RGB)),
    ],
    ids=["uchar", "float", "double", "ushort", "int", "r", "diffuse", "alpha", "blender"],
)
def test_colors_of_vertices(tmp_path, colors, names):
    assert halves(ply(tmp_path / "a.ply", colors, of_vertices=names)) == (RED, GREEN)


def test_dark_colors_as_integers_are_no_fractions(tmp_path):
    assert halves(ply(tmp_path / "a.ply", [(1, 0, 1)] * 8, of_vertices=typed("int")))[0] == (1, 0, 1)


OF_FACES = [COLORS[face[0]] for face in FACES]


@pytest.mark.parametrize("white", [(), RGB])
def test_colors_of_faces_are_shown_also_beside_white_vertices(tmp_path, white):
    path = ply(tmp_path / "a.ply", [(255,) * 3 if white else ()] * 8, OF_FACES, white, RGB)
    assert halves(path) == (RED, GREEN)


def test_colors_of_vertices_beside_faces_of_one_color(tmp_path):
    path = ply(tmp_path / "a.ply", COLORS, [(128,) * 3] * 4, RGB, RGB)
    assert halves(path) == (RED, GREEN)


def test_different_colors_on_vertices_and_on_faces_are_refused(tmp_path):
    with pytest.raises(SceneError, match="on its vertices and on its faces, and which are meant is not known"):
        load_mesh(ply(tmp_path / "a.ply", COLORS, OF_FACES, RGB, RGB))


@pytest.fixture(name="folder")
def folder_with_textures(tmp_path):
    for name, color in (("red.png", RED), ("my green.png", GREEN)):
        Image.new("RGB", (8, 8), color).save(tmp_path / name)
    return tmp_path


TEXTURES = ("TextureFile red.png", "TextureFile my green.png")


@pytest.mark.parametrize("order", [1, -1])
def test_several_textures(folder, order):
    numbered = [(*wedge, i // 2) for i, wedge in enumerate(WEDGES)]
    names = ("list uchar float texcoord", "int texnumber")
    path = ply(folder / "a.ply", faces=numbered, of_faces=names, comments=TEXTURES[::order])
    assert halves(path) == (RED, GREEN)[::order]


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_one_texture_with_coordinates_of_vertices(folder, names):
    path = ply(folder / "a.ply", UV, of_vertices=[f"float {name}" for name in names], comments=TEXTURES[:1])
    (surface,) = load_mesh(path).surfaces
    assert np.allclose(surface.coordinates[0], UV[:3]) and halves(path) == (RED, RED)


@pytest.mark.parametrize(
    ("of_vertices", "of_faces", "message"),
    [
        (("uchar s", "uchar t"), (), "of the type uint8, and their unit is not known; export them as floats"),
        ((), ("list uchar int texcoord",), "of the type int32, and their unit is not known"),
        ((), ("list uchar float texcoord", "float texnumber"), "texnumber is not whole"),
    ],
)
def test_whole_numbers_for_fractions_and_the_opposite_are_refused(folder, of_vertices, of_faces, message):
    uv = [(255, 0)] * 8 if of_vertices else [()] * 8
    faces = [()] * 4 if not of_faces else [(6, 1, 0, 0, 1, 1, 1, *([0.5] * (len(of_faces) - 1)))] * 4
    path = ply(folder / "a.ply", uv, faces, of_vertices, of_faces, ["TextureFile red.png"])
    with pytest.raises(SceneError, match=message):
        load_mesh(path)


def test_faces_without_a_texture_keep_their_colors(folder):
    numbered = [(*wedge, -1 if i < 2 else 1) for i, wedge in enumerate(WEDGES)]
    names = ("list uchar float texcoord", "int texnumber")
    path = ply(folder / "a.ply", [(1, 2, 3)] * 8, numbered, RGB, names, TEXTURES)
    assert halves(path) == ((1, 2, 3), GREEN)


def test_coordinates_without_a_texture_leave_the_colors(tmp_path):
    path = ply(tmp_path / "a.ply", COLORS, WEDGES, RGB, ("list uchar float texcoord",))
    assert halves(path) == (RED, GREEN)


def test_a_lost_texture_is_a_warning_and_gray(folder):
    path = ply(folder / "a.ply", UV, of_vertices=("float s", "float t"), comments=("TextureFile gone.png",))
    with pytest.warns(UserWarning, match=r"refers to gone\.png, which is not there"):
        (surface,) = load_mesh(path).surfaces
    assert (surface.coordinates == 160).all()


def test_a_scan_without_colors_says_what_else_it_has(tmp_path):
    path = ply(tmp_path / "a.ply", [(1, 2, 3)] * 8, of_vertices=("float ambient_red", "float hue", "float nx"))
    with pytest.warns(UserWarning, match=r"no color .* \(it has ambient_red, hue, whose meaning is not known\)"):
        load_mesh(path)


def binary(order, lengths=(3, 3, 4), extra=b""):
    """A floor of two triangles and a quadrangle, in binary."""
    kind = "little" if order == "<" else "big"
    corners = {3: iter([(0, 1, 2), (0, 2, 3)]), 4: iter([(4, 5, 6, 7)])}
    data = (
        f"ply\nformat binary_{kind}_endian 1.0\nelement vertex 8\nproperty double x\nproperty float y\n"
        "property float z\nproperty ushort red\nproperty ushort green\nproperty ushort blue\n"
        f"element face {len(lengths)}\nproperty list uchar uint vertex_index\nproperty short flags\nend_header\n"
    ).encode()
    for x, y in POINTS:
        data += struct.pack(f"{order}dffHHH", x, y, 0, 51400, 10280, 10280)
    for n in lengths:
        data += struct.pack(f"{order}B{n}Ih", n, *next(corners[n]), 7)
    return data + extra


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_files_with_lists_of_several_lengths(tmp_path, order):
    (tmp_path / "a.ply").write_bytes(binary(order))
    mesh = load_mesh(tmp_path / "a.ply")
    assert len(mesh.faces) == 4 and mesh.vertices.max(axis=0).tolist() == [6, 5, 0]
    assert (mesh.surfaces[0].coordinates == RED).all()


def swap(old, new):
    return lambda text: text.replace(old, new)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (swap("element face 4", "element face 3"), "holds more than its header declares"),
        (swap("element face 4", "element face 5"), "is truncated"),
        (swap("element vertex 8", "element vertex 9999999999"), "declares 9999999999 vertices, more than"),
        (swap("3 4 5 6", "3 4 5 8"), "a corner that is not there, of 8 vertices"),
        (swap("3 4 5 6", "3 4 5 -1"), "a corner that is not there"),
        (swap("3 4 5 6", "3 4 5 x"), "what is not a number"),
        (swap("3 4 5 6", "-2 4 5 6"), "has a list of -2 numbers"),
        (swap("property float x\n", "property half x\n"), "'property half x' in its header, which is not PLY 1.0"),
        (swap("property float x\n", "property float w\n"), "vertices without x"),
        (swap("format ascii 1.0\n", ""), "which is not PLY 1.0"),
        (swap("end_header", "element tristrips 1\nproperty list int int vertex_indices\nend_header"), "truncated"),
        (swap("property uchar red", "property char red"), "too large for its type"),
        (swap("uchar green", "float green"), "colors of vertices of several types"),
        (swap("3 4 5 6", "3 4 5 0_6"), "what is not a number"),
    ],
)
def test_what_is_not_known_to_be_read_right_is_refused(tmp_path, edit, message):
    path = ply(tmp_path / "a.ply", COLORS, of_vertices=RGB)
    path.write_text(edit(path.read_text()))
    with pytest.raises(SceneError, match=rf"a\.ply.*{message}"):
        load_mesh(path)


def test_other_elements_are_refused_by_name(tmp_path):
    more = "element tristrips 1\nproperty list int int vertex_indices"
    path = ply(tmp_path / "a.ply", COLORS, of_vertices=RGB, more=more)
    path.write_text(path.read_text() + "3 0 1 2\n")
    with pytest.raises(SceneError, match="has the element 'tristrips', which is not supported; export it again"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (binary("<")[:-3], "is truncated"),
        (binary("<", extra=b"\1\2"), "holds more than its header declares"),
        (binary("<", (3, 3))[:-20], "is truncated"),
        (binary("<").replace(b"list uchar uint", b"list float uint"), "a number that is not whole|truncated"),
    ],
)
def test_damaged_binary_files_are_refused(tmp_path, data, message):
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(SceneError, match=message):
        load_mesh(tmp_path / "a.ply")
