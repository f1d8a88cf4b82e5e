"""glTF: each form in which a file may hold triangles and colors is read right, or refused by name."""

import base64
import json

import numpy as np
import pytest
from gltf_inputs import CORNERS, FLOOR, GREEN, TABLE, UV, Gltf
from scan_inputs import empty_cache  # noqa: F401

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.mesh import load_mesh

NARROW = FLOOR * np.float32([0.5, 1, 1])


def area(mesh, height=None):
    """Of the faces that look up, at a height if one is given."""
    corners = mesh.corners()
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    at = np.ones(len(corners), bool) if height is None else abs(corners[..., 2] - height).max(axis=1) < 1e-5
    return float(normals[at & (normals > 0)].sum())


# Geometry.


def sparse(gltf):
    """The eastern corners are moved from x = 3 to x = 6."""
    primitive = gltf.primitive(NARROW)
    indices, values = gltf.view(np.array([1, 2], np.uint16).tobytes()), gltf.view(FLOOR[[1, 2]].tobytes())
    gltf.header["accessors"][primitive["attributes"]["POSITION"]]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": indices, "componentType": 5123},
        "values": {"bufferView": values},
    }
    gltf.node(primitive)


def sparse_alone(gltf):
    sparse(gltf)
    accessor = gltf.header["accessors"][0]
    view = accessor.pop("bufferView")
    accessor["sparse"] = {
        "count": 4,
        "indices": {"bufferView": gltf.view(bytes([0, 1, 2, 3])), "componentType": 5121},
        "values": {"bufferView": view},
    }
    gltf.header["nodes"][0]["scale"] = [2, 1, 1]


def fan(gltf):
    gltf.node(gltf.primitive() | {"mode": 6, "indices": gltf.accessor(np.arange(4, dtype=np.uint8))})


def strip(gltf):
    gltf.node(gltf.primitive() | {"mode": 5, "indices": gltf.accessor(np.array([0, 1, 3, 2], np.uint32))})


def without_indices(gltf):
    primitive = gltf.primitive(FLOOR[CORNERS])
    primitive.pop("indices")
    gltf.node(primitive)


def interleaved(gltf):
    rows = np.concatenate([FLOOR, np.full((4, 2), 9, np.float32)], axis=1)
    primitive = gltf.primitive()
    accessor = gltf.header["accessors"][primitive["attributes"]["POSITION"]]
    accessor["bufferView"] = gltf.view(rows.tobytes(), byteStride=20)
    gltf.node(primitive)


def quantized(gltf):
    gltf.header["extensionsRequired"] = ["KHR_mesh_quantization"]
    primitive = gltf.primitive((FLOOR * 100).astype(np.int16))
    gltf.node(primitive, scale=[0.01, 0.01, 0.01])


def quantized_to_fractions(gltf):
    gltf.header["extensionsRequired"] = ["KHR_mesh_quantization"]
    primitive = gltf.primitive()
    primitive["attributes"]["POSITION"] = gltf.accessor(np.rint(FLOOR / 6 * 65535).astype(np.uint16), normalized=True)
    gltf.node(primitive, scale=[6, 6, 6])


def instanced(gltf):
    gltf.header["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    places = {
        "TRANSLATION": gltf.accessor(np.array([[0, 0, 0], [6, 0, 5]], np.float32)),
        "ROTATION": gltf.accessor(np.array([[0, 0, 0, 1], [0, 1, 0, 0]], np.float32)),  # half a turn about y
        "SCALE": gltf.accessor(np.array([[2, 1, 1], [2, 1, 1]], np.float32)),
    }
    quarter = FLOOR * np.float32([0.25, 1, 1])
    gltf.node(gltf.primitive(quarter), extensions={"EXT_mesh_gpu_instancing": {"attributes": places}})


def morphed(gltf):
    target = {"POSITION": gltf.accessor(NARROW * np.float32([2, 0, 0]))}
    gltf.node(gltf.primitive(NARROW, targets=[target]), mesh={"weights": [0.5]})


def morphed_by_its_node(gltf):
    morphed(gltf)
    gltf.header["meshes"][0]["weights"] = [0.0]
    gltf.header["nodes"][0]["weights"] = [0.5]


def nested(gltf):
    """The matrix of a parent, and translation, rotation and scale of its child."""
    child = gltf.node(
        gltf.primitive(FLOOR - np.float32([6, 0, 0])), root=False, translation=[3, 0, 0], scale=[0.5, 1, 1]
    )
    matrix = np.diag([2.0, 1, 1, 1])
    gltf.node(children=[child], matrix=matrix.T.ravel().tolist())


def no_scene(gltf):
    gltf.node(gltf.primitive())
    del gltf.header["scene"], gltf.header["scenes"]


WHOLE = [
    sparse, sparse_alone, fan, strip, without_indices, interleaved, quantized, quantized_to_fractions, instanced,
    morphed, morphed_by_its_node, nested, no_scene,
]  # fmt: skip


@pytest.mark.parametrize("make", WHOLE, ids=lambda make: make.__name__)
@pytest.mark.filterwarnings("ignore:.* have no color")
def test_every_form_of_geometry_is_the_whole_floor(tmp_path, make):
    gltf = Gltf()
    make(gltf)
    mesh = load_mesh(gltf.save(tmp_path / "floor.glb"))
    assert np.allclose(mesh.vertices.min(axis=0), (0, -5, 0), atol=1e-4)
    assert np.allclose(mesh.vertices.max(axis=0), (6, 0, 0), atol=1e-4)
    assert area(mesh) == pytest.approx(30, rel=1e-4), "each part once, with its front up"


def test_a_gltf_file_with_its_data_in_itself_or_beside_it(tmp_path):
    gltf = Gltf()
    gltf.node(gltf.primitive(material=GREEN))
    header = {**gltf.header, "buffers": [{"byteLength": len(gltf.data), "uri": "a%20b.bin"}]}
    (tmp_path / "a b.bin").write_bytes(gltf.data)
    (tmp_path / "beside.gltf").write_text(json.dumps(header))
    text = "data:application/octet-stream;base64," + base64.b64encode(gltf.data).decode().replace("A", "%41")
    header["buffers"][0]["uri"] = text
    (tmp_path / "inside.gltf").write_text(json.dumps(header))
    for name in ("beside", "inside"):
        assert area(load_mesh(tmp_path / f"{name}.gltf")) == pytest.approx(30)
    header["buffers"][0]["uri"] = "lost.bin"
    (tmp_path / "lost.gltf").write_text(json.dumps(header))
    with pytest.raises(SceneError, match=r"refers to lost.bin, which is not there; put it beside the scan"):
        load_mesh(tmp_path / "lost.gltf")


def skinned(gltf):
    gltf.node(gltf.primitive(), skin=gltf.add("skins", joints=[0]))


def animated(gltf):
    node = gltf.node(gltf.primitive())
    gltf.add("animations", channels=[{"sampler": 0, "target": {"node": node, "path": "translation"}}], samplers=[{}])


def colors_morphed(gltf):
    target = {"COLOR_0": gltf.accessor(np.ones((4, 3), np.float32))}
    gltf.node(gltf.primitive(targets=[target]), mesh={"weights": [1.0]})


def many_targets(gltf):
    """Each copy is morphed anew."""
    target = {"POSITION": gltf.accessor(FLOOR * np.float32(0.001))}
    node = gltf.node(gltf.primitive(targets=[target] * 400), mesh={"weights": [1.0] * 400})
    mesh = gltf.header["nodes"][node]["mesh"]
    for _ in range(300):
        gltf.header["nodes"][gltf.node()]["mesh"] = mesh


def unknown_mode(gltf):
    gltf.node(gltf.primitive(mode=7))


def two_scenes(gltf):
    gltf.node(gltf.primitive())
    gltf.header["scenes"].append({"nodes": []})
    del gltf.header["scene"]


def loop(gltf):
    gltf.node(gltf.primitive(), children=[0])


def beyond(gltf):
    gltf.node(gltf.primitive() | {"indices": gltf.accessor(np.array([0, 1, 9], np.uint16))})


def odd(gltf):
    gltf.node(gltf.primitive() | {"indices": gltf.accessor(np.array([0, 1, 2, 3], np.uint16))})


def short(gltf):
    gltf.node(gltf.primitive())
    gltf.header["accessors"][0]["count"] = 5


def many_zeros(gltf):
    gltf.node(gltf.primitive())
    gltf.header["accessors"][0] = {"componentType": 5126, "type": "VEC3", "count": 10**12}


def many_copies(gltf):
    gltf.header["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    places = gltf.accessor(np.zeros((1, 3), np.float32))
    gltf.header["accessors"][places]["count"] = 10**9
    gltf.node(gltf.primitive(), extensions={"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}})


REFUSED = {
    skinned: r"by a skeleton \(skin\), which is not supported; apply the pose",
    animated: "moves its meshes by an animation.*export it without",
    colors_morphed: "morphs COLOR_0, which is not supported",
    many_targets: "declares 100001 morph targets, more than 100000; decimate",
    unknown_mode: "faces of the unknown mode 7",
    two_scenes: "has 2 scenes and does not say which",
    loop: "its node 0 has several parents, or is its own",
    beyond: "a face has the corner 9 of 4 vertices",
    odd: "4 corners are no whole number of triangles",
    short: "an accessor reaches beyond its buffer view; download or export",
    many_zeros: "declares 1000000000000 vertices, more than 24000000; decimate",
    many_copies: "declares 1000000000 instances, more than 100000; decimate",
}


@pytest.mark.parametrize("make", REFUSED, ids=lambda make: make.__name__)
def test_what_is_not_known_to_be_read_right_is_refused(tmp_path, make):
    gltf = Gltf()
    make(gltf)
    with pytest.raises(SceneError, match=rf"floor\.glb .*{REFUSED[make]}"):
        load_mesh(gltf.save(tmp_path / "floor.glb"))


def test_morph_targets_at_rest_and_animated_cameras_change_nothing(tmp_path):
    gltf = Gltf()
    gltf.node(gltf.primitive(material=GREEN, targets=[{"COLOR_0": 0}]), mesh={"weights": [0.0]})
    camera = gltf.node(camera=0)
    gltf.add("animations", channels=[{"sampler": 0, "target": {"node": camera, "path": "rotation"}}], samplers=[{}])
    assert area(load_mesh(gltf.save(tmp_path / "floor.glb"))) == pytest.approx(30)


def test_json_nested_without_end_is_one_sentence(tmp_path):
    (tmp_path / "deep.gltf").write_text('{"asset": ' + "[" * 200_000)
    with pytest.raises(SceneError, match=r"deep\.gltf cannot be read"):
        load_mesh(tmp_path / "deep.gltf")


# Colors.


def shown(gltf, path, row=0.5, column=0.5):
    """The color of the map at a share of its height and width."""
    photo = ScanMap.from_mesh(gltf.save(path), cache=False, allow_implausible=True).orthophoto
    return photo[int(row * photo.shape[0]), int(column * photo.shape[1])].tolist()


@pytest.mark.parametrize("material", [None, {}], ids=["bare", "material"])
@pytest.mark.parametrize("kind", ["float32", "uint8", "uint16"])
@pytest.mark.parametrize("channels", [3, 4])
def test_colors_of_vertices_of_every_type_are_the_same(tmp_path, material, kind, channels):
    largest = 1 if kind == "float32" else np.iinfo(kind).max
    colors = np.tile(np.array([0.5, 0.1, 0.1, 1.0])[:channels], (4, 1)) * largest
    gltf = Gltf()
    gltf.node(gltf.primitive(material=material, colors=gltf.accessor(colors.astype(kind), kind != "float32")))
    assert np.abs(np.array(shown(gltf, tmp_path / "a.glb")) - (127.5, 25.5, 25.5)).max() <= 1


def test_colors_of_vertices_out_of_range_are_refused(tmp_path):
    gltf = Gltf()
    gltf.node(gltf.primitive(colors=gltf.accessor(np.full((4, 3), 90, np.float32))))
    with pytest.raises(SceneError, match="has colors of vertices from 90 to 90, not 0 to 1; rescale them"):
        load_mesh(gltf.save(tmp_path / "a.glb"))


def textured(gltf, pixels=((200, 100, 50),), uv=UV, sampler=None, reference=None, primitive=None, **material):
    texture = gltf.texture([pixels], **(sampler or {}))
    rough = {"baseColorTexture": {"index": texture, **(reference or {})}, **material.pop("rough", {})}
    gltf.node(gltf.primitive(material={"pbrMetallicRoughness": rough, **material}, uv=uv, **(primitive or {})))
    return gltf


def test_colors_of_vertices_multiply_a_texture(tmp_path):
    gltf = Gltf()
    colors = gltf.accessor(np.full((4, 3), 0.2, np.float32))
    assert shown(textured(gltf, primitive={"colors": colors}), tmp_path / "a.glb") == [40, 20, 10]


RED_BLUE = ((250, 0, 0), (0, 0, 250))
# Twice as wide as the texture: the western half shows it, what the eastern half shows is the wrapping.
WIDE = UV * np.float32([2, 1])


@pytest.mark.parametrize(
    ("mode", "third", "fourth"), [(10497, 0, 2), (33071, 2, 2), (33648, 2, 0), (None, 0, 2)], ids=str
)
def test_textures_go_on_as_their_sampler_says(tmp_path, mode, third, fourth):
    gltf = textured(Gltf(), RED_BLUE, WIDE, {} if mode is None else {"wrapS": mode})
    path = tmp_path / "a.glb"
    assert [int(np.argmax(shown(gltf, path, 0.5, x))) for x in (0.12, 0.38, 0.62, 0.88)] == [0, 2, third, fourth]


def test_a_texture_is_moved_and_repeated(tmp_path):
    moved = {"extensions": {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [2, 1]}}}
    gltf = textured(Gltf(), RED_BLUE, reference=moved)
    gltf.header["extensionsUsed"] = ["KHR_texture_transform"]
    path = tmp_path / "a.glb"
    assert [int(np.argmax(shown(gltf, path, 0.5, x))) for x in (0.12, 0.38, 0.62, 0.88)] == [2, 0, 2, 0]


@pytest.mark.parametrize("by_transform", [False, True])
def test_a_texture_has_its_own_set_of_coordinates(tmp_path, by_transform):
    chosen = {"texCoord": 1}
    reference = {"texCoord": 0, "extensions": {"KHR_texture_transform": chosen}} if by_transform else chosen
    gltf = textured(Gltf(), RED_BLUE, UV, reference=reference)
    gltf.header["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"] = gltf.accessor(UV * np.float32([-1, 1]))
    path = tmp_path / "a.glb"
    assert [int(np.argmax(shown(gltf, path, 0.5, x))) for x in (0.25, 0.75)] == [2, 0]


def test_coordinates_of_a_texture_may_be_fractions(tmp_path):
    gltf = textured(Gltf(), RED_BLUE)
    attributes = gltf.header["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_0"] = gltf.accessor((UV * 255).astype(np.uint8), normalized=True)
    path = tmp_path / "a.glb"
    assert [int(np.argmax(shown(gltf, path, 0.5, x))) for x in (0.25, 0.75)] == [0, 2]


@pytest.mark.parametrize("quantized", [False, True])
def test_whole_numbers_as_coordinates_of_a_texture_need_their_extension(tmp_path, quantized):
    gltf = textured(Gltf(), RED_BLUE)
    primitive = gltf.header["meshes"][0]["primitives"][0]
    primitive["attributes"]["TEXCOORD_0"] = gltf.accessor((UV * 100).astype(np.uint16))
    transform = {"extensions": {"KHR_texture_transform": {"scale": [0.01, 0.01]}}}
    gltf.header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] |= transform
    gltf.header["extensionsUsed"] = ["KHR_texture_transform"]
    path = tmp_path / "a.glb"
    if not quantized:
        with pytest.raises(SceneError, match="coordinates of a texture as whole numbers that are not normalized"):
            load_mesh(gltf.save(path))
        return
    gltf.header["extensionsUsed"].append("KHR_mesh_quantization")
    assert [int(np.argmax(shown(gltf, path, 0.5, x))) for x in (0.25, 0.75)] == [0, 2]


@pytest.mark.parametrize("tinted", [False, True])
def test_a_texture_whose_coordinates_are_not_there_is_a_warning_and_gray(tmp_path, tinted):
    gltf = textured(Gltf(), RED_BLUE)
    attributes = gltf.header["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = attributes.pop("TEXCOORD_0")
    if tinted:
        attributes["COLOR_0"] = gltf.accessor(np.tile(np.float32([0, 1, 0]), (4, 1)))
        assert shown(gltf, tmp_path / "a.glb") == [0, 255, 0]
        return
    with pytest.warns(UserWarning, match="1 of 1 parts have no color"):
        assert shown(gltf, tmp_path / "a.glb") == [160, 160, 160]


@pytest.mark.parametrize(
    ("material", "expected"),
    [
        ({"emissiveFactor": [1, 1, 1]}, (200, 100, 50)),
        ({"emissiveFactor": [1, 1, 1], "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}}, (200, 100, 50)),
        ({"pbrMetallicRoughness": {"baseColorFactor": [0, 1, 0, 1]}}, (0, 255, 0)),  # factor 0: nothing shines
    ],
    ids=["alone", "black", "dark"],
)
def test_light_given_off_is_shown_where_it_is_all_there_is(tmp_path, material, expected):
    gltf = Gltf()
    material = {**material, "emissiveTexture": {"index": gltf.texture([[(200, 100, 50)]])}}
    gltf.node(gltf.primitive(material=material, uv=UV))
    assert shown(gltf, tmp_path / "a.glb") == list(expected)


def test_light_given_off_without_a_texture(tmp_path):
    gltf = Gltf()
    black = {"emissiveFactor": [0, 0, 1], "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}}
    gltf.node(gltf.primitive(material=black))
    assert shown(gltf, tmp_path / "a.glb") == [0, 0, 255]


def test_a_color_texture_is_shown_instead_of_light_given_off(tmp_path):
    gltf = Gltf()
    lamp = {"index": gltf.texture([[(1, 2, 3)]])}
    textured(gltf, emissiveTexture=lamp, emissiveFactor=[1, 1, 1])
    assert shown(gltf, tmp_path / "a.glb") == [200, 100, 50]


# What one sees through.


def veiled(material, pixels=None, colors=None):
    """A green floor under a sheet of 3 m x 2 m, 0.5 m above it."""
    gltf = Gltf()
    gltf.node(gltf.primitive(material=GREEN))
    if pixels is not None:
        rough = material.setdefault("pbrMetallicRoughness", {})
        rough["baseColorTexture"] = {"index": gltf.texture([pixels], wrapS=33071)}
    sheet = gltf.primitive(TABLE, material, None if colors is None else gltf.accessor(colors), UV)
    gltf.node(sheet)
    return gltf


def red(alpha, **material):
    return {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, alpha]}, **material}


def walkable_area(gltf, path):
    made = ScanMap.from_mesh(gltf.save(path), cache=False, allow_implausible=True)
    return made, float(made.walkable.sum()) * made.meters_per_pixel**2


@pytest.mark.parametrize(
    ("material", "colors", "there"),
    [
        (red(0.2), None, True),  # opaque: alpha means nothing
        (red(0.2, alphaMode="BLEND"), None, False),
        (red(0.8, alphaMode="BLEND"), None, True),
        (red(0.6, alphaMode="MASK"), None, True),
        (red(0.6, alphaMode="MASK", alphaCutoff=0.7), None, False),
        (red(1, alphaMode="BLEND"), np.full((4, 4), 0.3, np.float32), False),
        (red(1, extensions={"KHR_materials_transmission": {"transmissionFactor": 1}}), None, False),
        (red(1, extensions={"KHR_materials_transmission": {"transmissionFactor": 0.2}}), None, True),
    ],
)
def test_a_transparent_thing_is_no_obstacle_and_is_not_seen(tmp_path, material, colors, there):
    scan, walkable = walkable_area(veiled(material, colors=colors), tmp_path / "a.glb")
    middle = scan.orthophoto[100, 125].tolist()  # 2.5 m to the east, 2 m to the south: on the sheet's edge
    inside = scan.orthophoto[150, 125].tolist()
    assert (middle == [0, 255, 0]) != there or inside != [0, 255, 0]
    assert (inside == [0, 255, 0]) != there
    assert walkable == pytest.approx(5.8 * 4.8 - there * 3.2 * 2.2, rel=0.03)


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
def test_a_texture_may_be_transparent_in_a_part(tmp_path, mode):
    """The eastern half of the sheet is a hole."""
    pixels = [(250, 0, 0, 255)] * 8 + [(250, 0, 0, 0)] * 8
    scan, walkable = walkable_area(veiled({"alphaMode": mode}, pixels), tmp_path / "a.glb")
    assert scan.orthophoto[150, 100].tolist() == [250, 0, 0] and scan.orthophoto[150, 160].tolist() == [0, 255, 0]
    assert walkable == pytest.approx(5.8 * 4.8 - 1.7 * 2.2, rel=0.03)


def test_an_opaque_texture_has_no_holes(tmp_path):
    pixels = [(250, 0, 0, 255)] * 8 + [(250, 0, 0, 0)] * 8
    scan, _ = walkable_area(veiled({}, pixels), tmp_path / "a.glb")
    assert scan.orthophoto[150, 160].tolist() == [250, 0, 0]


def test_the_alpha_of_light_given_off_makes_no_holes(tmp_path):
    gltf = Gltf()
    gltf.node(gltf.primitive(material=GREEN))
    lamp = {"index": gltf.texture([[(250, 0, 0, 0)]])}
    black = {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "alphaMode": "BLEND"}
    gltf.node(gltf.primitive(TABLE, {**black, "emissiveTexture": lamp, "emissiveFactor": [1, 1, 1]}, uv=UV))
    scan, _ = walkable_area(gltf, tmp_path / "a.glb")
    assert scan.orthophoto[150, 125].tolist() == [250, 0, 0]


def test_an_upright_sheet_stops_the_agent_where_it_is_solid(tmp_path):
    """A fence across the room; its western half is a hole."""
    gltf = Gltf()
    gltf.node(gltf.primitive(material=GREEN))
    pixels = [(250, 0, 0, 0)] * 8 + [(250, 0, 0, 255)] * 8
    texture = {"index": gltf.texture([pixels], wrapS=33071)}
    material = {"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorTexture": texture}}
    fence = np.array([[0, 0, 2.5], [6, 0, 2.5], [6, 1, 2.5], [0, 1, 2.5]], np.float32)
    gltf.node(gltf.primitive(fence, material, uv=UV))
    scan, _ = walkable_area(gltf, tmp_path / "a.glb")
    assert scan.walkable[125, 20:130].all() and not scan.walkable[125, 160:].any()


def test_a_transparent_floor_is_no_floor(tmp_path):
    gltf = Gltf()
    gltf.node(gltf.primitive(material=red(0.1, alphaMode="BLEND")))
    with pytest.raises(SceneError, match="is transparent everywhere; make its materials opaque"):
        load_mesh(gltf.save(tmp_path / "a.glb"))
