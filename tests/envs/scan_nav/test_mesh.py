"""Materials, textures and colors of scans that trimesh has written, and what is refused of them."""

import copy
import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image
from scan_inputs import checkers, empty_cache, floor, write  # noqa: F401

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.mesh import load_mesh


def edited(path, edit, binary=None):
    """Change a GLB file's JSON part, and its binary part if there is a function for it."""
    data = path.read_bytes()
    n_json = struct.unpack("<I", data[12:16])[0]
    header = json.loads(data[20 : 20 + n_json])
    rest = bytearray(data[20 + n_json :])
    edit(header)
    if binary is not None:
        binary(header, rest)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + bytes(rest)
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body)
    return path


def color_texture(header):
    return header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]


def require(name):
    return lambda header: header.update(extensionsRequired=[name], extensionsUsed=[name])


def moved(**transform):
    return lambda header: color_texture(header).update(extensions={"KHR_texture_transform": transform})


def glossy(**diffuse):
    """The older kind of material, from which trimesh makes the newer one."""

    def edit(header):
        texture = header["materials"][0].pop("pbrMetallicRoughness")["baseColorTexture"]
        values = {"diffuseTexture": {**texture, **diffuse}, "specularFactor": [0, 0, 0]}
        header["materials"][0]["extensions"] = {"KHR_materials_pbrSpecularGlossiness": values}

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (require("ACME_spheres"), "uses the glTF extension ACME_spheres, which is not supported; export it without"),
        (lambda header: header.update(extensionsUsed=["ACME_spheres"]), "uses the glTF extension ACME_spheres"),
        (lambda header: header["nodes"][0].update(extensions={"ACME_x": {}}), "uses the glTF extension ACME_x"),
        (require("EXT_meshopt_compression"), r"meshopt compression \(undo it: `npx @gltf-transform/cli copy"),
        (moved(rotation=0.5), "turned by KHR_texture_transform"),
        (lambda header: header["meshes"][0]["primitives"][0].update(material=7), "refers to materials 7, of which it"),
        (lambda header: header["asset"].update(version="1.0"), "is of glTF version 1.0, not 2.0"),
        (lambda header: header["asset"].update(minVersion="2.1"), "not 2.0"),
        (lambda header: header["materials"][0].update(alphaMode="ADD"), "alphaMode is 'ADD'"),
    ],
)
def test_refuses_what_would_be_shown_wrongly(tmp_path, edit, message):
    path = edited(write(trimesh.Scene([floor()]), tmp_path / "floor.glb"), edit)
    with pytest.raises(SceneError, match=message) as error:
        load_mesh(path)
    assert "floor.glb" in str(error.value)


@pytest.mark.parametrize("edit", [require("KHR_materials_unlit"), moved(offset=[0, 0], scale=[1, 1])])
def test_takes_extensions_that_change_nothing(tmp_path, edit):
    path = write(trimesh.Scene([floor()]), tmp_path / "floor.glb")
    (before,) = load_mesh(path).surfaces
    (after,) = load_mesh(edited(path, edit)).surfaces
    assert np.array_equal(before.texture, after.texture)


def damage_image(header, rest):
    view = header["bufferViews"][header["images"][0]["bufferView"]]
    start = 8 + view.get("byteOffset", 0)
    assert rest[start + 1 : start + 4] == b"PNG"
    rest[start : start + 8] = bytes(8)


@pytest.mark.parametrize(
    ("edit", "binary", "message"),
    [
        (lambda header: None, damage_image, "the texture image 0 cannot be decoded; export it again with PNG"),
        (glossy(), damage_image, "the texture image 0 cannot be decoded; export it again with PNG"),
        (
            lambda header: header.update(textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}]),
            None,
            r"a texture in no form that can be decoded \(KHR_texture_basisu\); export it with PNG or JPEG",
        ),
    ],
    ids=["damaged", "glossy", "basisu"],
)
def test_refuses_textures_that_cannot_be_decoded(tmp_path, edit, binary, message):
    path = edited(write(trimesh.Scene([floor()]), tmp_path / "floor.glb"), edit, binary)
    with pytest.raises(SceneError, match=rf"floor.glb.* {message}"):
        load_mesh(path)


def test_another_form_of_a_texture_beside_an_ordinary_one_is_passed_over(tmp_path):
    path = write(trimesh.Scene([floor()]), tmp_path / "floor.glb")
    (before,) = load_mesh(path).surfaces
    other = {"KHR_texture_basisu": {"source": 7}}
    edited(path, lambda header: header["textures"][0].update(extensions=other))
    (after,) = load_mesh(path).surfaces
    assert np.array_equal(before.texture, after.texture)


def test_refuses_textures_that_pillow_finds_too_large(tmp_path, monkeypatch):
    path = write(trimesh.Scene([floor()]), tmp_path / "floor.glb")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 64 * 64 // 2 - 1)
    with pytest.raises(SceneError, match=r"image 0 cannot be decoded; .* at most 8192 x 8192 pixels"):
        load_mesh(path)


def two_parts(second):
    """Edit a file so that it has a second part, which is like the first but for the texture and ``second``."""

    def edit(header):
        header["meshes"].append(copy.deepcopy(header["meshes"][0]))
        header["materials"].append(copy.deepcopy(header["materials"][0]))
        header["materials"][1]["pbrMetallicRoughness"]["baseColorTexture"]["index"] = 1
        header["textures"].append({"source": 1})
        header["images"].append({"uri": "data:image/png;base64,AAAA", "mimeType": "image/png"})
        header["meshes"][1]["primitives"][0].update(material=1, **second)
        header["nodes"].append({"mesh": 1})
        header["scenes"][0]["nodes"].append(len(header["nodes"]) - 1)

    return edit


def test_one_texture_of_two_that_cannot_be_decoded(tmp_path):
    path = write(trimesh.Scene([floor()]), tmp_path / "floor.glb")
    edited(path, two_parts({}))
    with pytest.raises(SceneError, match="the texture image 1 cannot be decoded"):
        load_mesh(path)

    def without_coordinates(header):
        header["meshes"][0]["primitives"][0]["attributes"].pop("TEXCOORD_0")

    edited(path, without_coordinates)
    with pytest.raises(SceneError, match="the texture image 1 cannot be decoded"):
        load_mesh(path)


def test_lines_need_no_texture(tmp_path):
    path = edited(write(trimesh.Scene([floor()]), tmp_path / "floor.glb"), two_parts({"mode": 1}))
    (surface,) = load_mesh(path).surfaces
    assert surface.texture is not None


def test_parts_without_any_color_are_a_warning(tmp_path):
    bare = trimesh.Trimesh(floor().vertices, floor().faces, process=False)
    for name in ("bare.ply", "bare.glb", "bare.obj"):
        path = write(trimesh.Scene([bare]), tmp_path / name)
        with pytest.warns(UserWarning, match=rf"{name}: 1 of 1 parts have no color and are shown gray"):
            (surface,) = load_mesh(path).surfaces
        assert (surface.coordinates == 160).all()


def obj(path, color="", coordinates=False, material="Kd 0 1 0", before_faces=""):
    """A floor of 5 m x 4 m as an OBJ file with a material."""
    corner = "/{0}" if coordinates else ""
    lines = ["mtllib floor.mtl", *(f"v {x} {y} 0 {color}".rstrip() for x, y in ((0, 0), (5, 0), (5, 4), (0, 4)))]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"] * coordinates
    lines += [before_faces, "usemtl paint"]
    lines += ["f " + " ".join(str(i) + corner.format(i) for i in face) for face in ((1, 2, 3), (1, 3, 4))]
    path.write_text("\n".join(lines) + "\n")
    (path.parent / "floor.mtl").write_text(f"newmtl paint\n{material}\n")
    return path


@pytest.mark.parametrize("coordinates", [False, True])
def test_obj_keeps_the_colors_of_vertices_beside_a_material(tmp_path, coordinates):
    (surface,) = load_mesh(obj(tmp_path / "floor.obj", "1 0.2 0", coordinates)).surfaces
    assert (surface.coordinates == (255, 51, 0)).all()


def test_obj_prefers_a_texture_to_the_colors_of_vertices(tmp_path):
    checkers().save(tmp_path / "floor.png")
    (surface,) = load_mesh(obj(tmp_path / "floor.obj", "1 0.2 0", True, "map_Kd floor.png")).surfaces
    assert np.array_equal(surface.texture, np.asarray(checkers()))


@pytest.mark.parametrize("color", ["", "1 0.2 0"])
def test_obj_without_its_texture_is_one_warning_and_gray(tmp_path, color):
    path = obj(tmp_path / "floor.obj", color, True, "map_Kd lost.png")
    with pytest.warns(UserWarning) as warned:
        (surface,) = load_mesh(path).surfaces
    assert [str(warning.message).split(",")[0] for warning in warned] == [f"{path} refers to lost.png"]
    assert (surface.coordinates == 160).all()


def test_a_lost_texture_is_that_of_one_part(tmp_path):
    """The other half of the floor keeps its color."""
    path = obj(tmp_path / "floor.obj", "", True, "map_Kd lost.png\nnewmtl red\nKd 1 0 0")
    path.write_text(path.read_text().replace("f 1/1 3/3 4/4", "usemtl red\nf 1/1 3/3 4/4"))
    with pytest.warns(UserWarning, match="refers to lost.png") as warned:
        surfaces = load_mesh(path).surfaces
    assert len(warned) == 1
    assert sorted(tuple(surface.coordinates[0, 0]) for surface in surfaces) == [(160, 160, 160), (255, 0, 0)]


def test_a_lost_normal_map_takes_no_color(tmp_path):
    path = write(trimesh.Scene([floor()]), tmp_path / "scan.gltf")
    header = json.loads(path.read_text())
    header["images"] = [{"uri": "bumps.png"}]
    header["materials"] = [{"normalTexture": {"index": 0}, "pbrMetallicRoughness": {"baseColorFactor": [0, 1, 0, 1]}}]
    path.write_text(json.dumps(header))
    (surface,) = load_mesh(path).surfaces
    assert (surface.coordinates == (0, 255, 0)).all()


@pytest.mark.parametrize("place", ["lost.png", "textures/lost.png"])
def test_a_texture_that_is_put_in_place_is_noticed(tmp_path, place):
    path = obj(tmp_path / "floor.obj", "", True, "map_Kd textures/lost.png")
    with pytest.warns(UserWarning, match=r"refers to lost\.png, which is not there"):
        before = ScanMap.from_mesh(path)
    with pytest.warns(UserWarning, match=r"refers to lost\.png, which is not there"):
        assert ScanMap.from_mesh(path).content_hash == before.content_hash
    (tmp_path / place).parent.mkdir(exist_ok=True)
    checkers().save(tmp_path / place)
    assert ScanMap.from_mesh(path).content_hash != before.content_hash


def test_obj_with_colors_of_vertices_needs_no_material(tmp_path):
    path = obj(tmp_path / "floor.obj", "1 0.2 0")
    (tmp_path / "floor.mtl").unlink()
    (surface,) = load_mesh(path).surfaces
    assert (surface.coordinates == (255, 51, 0)).all()


@pytest.mark.parametrize("before_faces", ["", "# 4 vertices\n"])  # 3ds Max: a line that looks like three colors
def test_obj_keeps_the_color_of_a_material(tmp_path, before_faces):
    (surface,) = load_mesh(obj(tmp_path / "floor.obj", before_faces=before_faces)).surfaces
    assert (surface.coordinates == (0, 255, 0)).all()


@pytest.mark.parametrize("coordinates", [False, True])
@pytest.mark.parametrize("material", ["Ns 10", "Kd 0 1 0\n\nnewmtl other"], ids=["no color", "unused"])
def test_obj_whose_material_has_no_color_is_a_warning(tmp_path, coordinates, material):
    path = obj(tmp_path / "floor.obj", "", coordinates, material)
    if "other" in material:
        path.write_text(path.read_text().replace("usemtl paint", "usemtl nothing"))
    with pytest.warns(UserWarning, match=r"floor.obj: 1 of 1 parts have no color and are shown gray"):
        (surface,) = load_mesh(path).surfaces
    assert surface.texture is None and (surface.coordinates == 160).all()


@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_refuses_a_texture_beside_the_scan_that_cannot_be_decoded(tmp_path, suffix):
    path = obj(tmp_path / "floor.obj", "", True, "map_Kd floor.png")
    if suffix == "ply":
        path = write(trimesh.Scene([floor()]), tmp_path / "floor.ply")
        path.write_bytes(path.read_bytes().replace(b"comment", b"comment TextureFile floor.png\ncomment", 1))
    checkers().save(tmp_path / "floor.png")
    (surface,) = load_mesh(path).surfaces
    assert np.array_equal(surface.texture, np.asarray(checkers()))
    (tmp_path / "floor.png").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(SceneError, match=rf"floor\.{suffix}: the texture floor\.png cannot be decoded; export"):
        load_mesh(path)


def test_ply_with_coordinates_and_no_texture_is_a_warning(tmp_path):
    path = write(trimesh.Scene([floor()]), tmp_path / "floor.ply")
    with pytest.warns(UserWarning, match=r"floor.ply: 1 of 1 parts have no color and are shown gray"):
        (surface,) = load_mesh(path).surfaces
    assert surface.texture is None and (surface.coordinates == 160).all()


def test_a_texture_beside_a_gltf_file_that_is_lost_is_a_warning(tmp_path):
    path = write(trimesh.Scene([floor()]), tmp_path / "scan.gltf")
    header = json.loads(path.read_text())
    header["images"] = [{"uri": "lost.png"}]
    path.write_text(json.dumps(header))
    with pytest.warns(UserWarning, match=r"scan.gltf refers to lost\.png, which is not there"):
        (surface,) = load_mesh(path).surfaces
    assert surface.texture is None


def test_a_part_without_coordinates_needs_no_texture(tmp_path):
    path = edited(
        write(trimesh.Scene([floor()]), tmp_path / "floor.glb"),
        lambda header: header["meshes"][0]["primitives"][0]["attributes"].pop("TEXCOORD_0"),
        damage_image,
    )
    with pytest.warns(UserWarning, match="1 of 1 parts have no color"):
        (surface,) = load_mesh(path).surfaces
    assert surface.texture is None
