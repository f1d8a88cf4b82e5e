"""What trimesh passes over in silence and would show as something else."""

import json
import struct

import numpy as np
import pytest
import trimesh
from scan_inputs import floor, own_cache, write  # noqa: F401

from sb3_abisim.envs.scan_mesh import SceneError, load_mesh


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


def colour_texture(header):
    return header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]


def require(name):
    return lambda header: header.update(extensionsRequired=[name], extensionsUsed=[name])


def moved(**transform):
    return lambda header: colour_texture(header).update(extensions={"KHR_texture_transform": transform})


def integer_coordinates(header):
    attributes = header["meshes"][0]["primitives"][0]["attributes"]
    header["accessors"][attributes["TEXCOORD_0"]].update(componentType=5123, normalized=True)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (require("KHR_mesh_quantization"), r"quantised vertices \(undo it: `npx @gltf-transform/cli dequantize"),
        (integer_coordinates, "quantised vertices"),
        (require("ACME_spheres"), "needs the glTF extension ACME_spheres, which is not supported; export it without"),
        (moved(scale=[2, 2]), "moved or repeated by KHR_texture_transform"),
        (moved(rotation=0.5), "moved or repeated by KHR_texture_transform"),
        (lambda header: colour_texture(header).update(texCoord=1), "a second set of coordinates"),
        (lambda header: header["meshes"][0]["primitives"][0].update(material=7), "cannot be read"),
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


def damage_picture(header, rest):
    view = header["bufferViews"][header["images"][0]["bufferView"]]
    start = 8 + view.get("byteOffset", 0)
    assert rest[start + 1 : start + 4] == b"PNG"
    rest[start : start + 8] = bytes(8)


@pytest.mark.parametrize(
    ("edit", "binary"),
    [
        (lambda header: None, damage_picture),
        (lambda header: header["images"][0].update(mimeType="image/ktx2"), None),
    ],
    ids=["damaged", "ktx2"],
)
def test_refuses_textures_that_cannot_be_decoded(tmp_path, edit, binary):
    path = edited(write(trimesh.Scene([floor()]), tmp_path / "floor.glb"), edit, binary)
    with pytest.raises(SceneError, match=r"floor.glb: 1 of 1 textures cannot be decoded; export it again with PNG"):
        load_mesh(path)


def test_parts_without_any_colour_are_a_warning(tmp_path):
    bare = trimesh.Trimesh(floor().vertices, floor().faces, process=False)
    path = write(trimesh.Scene([bare]), tmp_path / "bare.ply")
    with pytest.warns(UserWarning, match=r"bare.ply: 1 of 1 parts have no colour and are drawn grey"):
        (surface,) = load_mesh(path).surfaces
    assert (surface.coordinates == 160).all()


def test_obj_keeps_the_colours_of_vertices_beside_a_material(tmp_path):
    path = write(trimesh.Scene([floor(False)]), tmp_path / "floor.obj")
    (plain,) = load_mesh(path).surfaces
    (tmp_path / "floor.mtl").write_text("newmtl grey\nKd 0.5 0.5 0.5\n")
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("f "))
    path.write_text("\n".join(["mtllib floor.mtl", *lines[:first], "usemtl grey", *lines[first:]]) + "\n")
    (coloured,) = load_mesh(path).surfaces
    assert plain.coordinates.std() > 50 and np.array_equal(plain.coordinates, coloured.coordinates)


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
        damage_picture,
    )
    (surface,) = load_mesh(path).surfaces
    assert surface.texture is None
