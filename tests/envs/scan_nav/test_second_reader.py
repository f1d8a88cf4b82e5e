"""Our readers against trimesh's, on what it writes and reads right; and what a scan may ask of memory."""

import io
import tracemalloc

import numpy as np
import pytest
import trimesh
from gltf_inputs import FLOOR, UV, Gltf
from PIL import Image
from scan_inputs import empty_cache, house, write, y_up  # noqa: F401

from sb3_abisim.envs.scan_nav import build, files
from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.mesh import load_mesh


def triangles(scene):
    """All corners in the scene's axes, each face beginning with its least corner, in order."""
    corners = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        corners.append(trimesh.transform_points(scene.geometry[name].vertices, matrix)[scene.geometry[name].faces])
    return ordered(np.concatenate(corners))


def ordered(corners):
    corners = corners.round(3) + 0.0  # no -0
    first = np.lexsort(np.moveaxis(corners, -1, 0)[::-1], axis=1)[:, :1]
    turned = np.take_along_axis(corners, ((first + np.arange(3)) % 3)[..., None], axis=1)
    flat = turned.reshape(len(turned), 9)
    return flat[np.lexsort(flat.T[::-1])]


def placed(rng):
    """Parts at the ends of chains of turned, mirrored and stretched nodes."""
    scene = trimesh.Scene()
    for k in range(6):
        matrix = trimesh.transformations.random_rotation_matrix(rng.random(3))
        matrix[:3, :3] *= rng.uniform(0.5, 2) * (-1 if k % 2 else 1)
        matrix[:3, 3] = rng.uniform(-3, 3, 3)
        mesh = trimesh.creation.icosphere(subdivisions=1)
        mesh.apply_transform(trimesh.transformations.scale_matrix(2, (0, 0, 0)))
        scene.add_geometry(mesh, f"part{k}", f"part{k}", None if k < 3 else f"part{k - 3}", matrix)
    scene.add_geometry(trimesh.creation.box((30, 30, 0.1)))
    return scene


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj", ".ply"])
@pytest.mark.filterwarnings("ignore:.* have no color")
def test_geometry_is_what_trimesh_reads(tmp_path, suffix):
    for name, scene in (("house", house(False)), ("parts", placed(np.random.default_rng(0)))):
        (tmp_path / name).mkdir()
        path = write(scene, tmp_path / name / f"scan{suffix}")
        ours = load_mesh(path, "z")
        theirs = triangles(trimesh.load_scene(path, process=False))
        if name == "parts" and suffix in (".glb", ".gltf"):
            # trimesh leaves faces of mirrored nodes turned inside out.
            assert np.allclose(np.sort(ours.corners().ravel()), np.sort(theirs.ravel()), atol=2e-3)
        else:
            assert np.allclose(ordered(ours.corners()), theirs, atol=2e-3)


def test_an_axis_up_is_y_as_trimesh_turns_it(tmp_path):
    path = write(y_up(house(False)), tmp_path / "house.glb")
    turned = trimesh.load_scene(path, process=False)
    turned.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    assert np.allclose(ordered(load_mesh(path).corners()), triangles(turned), atol=2e-3)


# What a scan may ask of memory.


def bomb(side):
    """A PNG file of one color, a few thousand bytes."""
    file = io.BytesIO()
    Image.new("1", (side, side)).save(file, "PNG")
    return file.getvalue()


def with_image(data):
    gltf = Gltf()
    image = gltf.add("images", bufferView=gltf.view(data), mimeType="image/png")
    texture = {"index": gltf.add("textures", source=image)}
    gltf.node(gltf.primitive(FLOOR, {"pbrMetallicRoughness": {"baseColorTexture": texture}}, uv=UV))
    return gltf


def test_an_image_is_refused_by_its_header(tmp_path):
    path = with_image(bomb(9000)).save(tmp_path / "bomb.glb")
    tracemalloc.start()
    with pytest.raises(SceneError, match=r"bomb.glb: the texture image 0 has 9000 x 9000 pixels; export it again"):
        load_mesh(path)
    assert tracemalloc.get_traced_memory()[1] < 20_000_000
    tracemalloc.stop()


def test_images_together_are_bounded_by_the_bytes_that_hold_them(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "FREE_IMAGE_PIXELS", 1_000_000)
    path = with_image(bomb(1200)).save(tmp_path / "bomb.glb")
    with pytest.raises(SceneError, match=r"its textures declare 1440000 pixels in \d+ bytes, more than 1\d+; export"):
        load_mesh(path)


def test_images_that_share_their_bytes_are_granted_pixels_once(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "FREE_IMAGE_PIXELS", 0)
    gltf = Gltf()
    view = gltf.view(data := bomb(600))
    for _ in range(2):
        image = gltf.add("images", bufferView=view, mimeType="image/png")
        texture = {"index": gltf.add("textures", source=image)}
        gltf.node(gltf.primitive(FLOOR, {"pbrMetallicRoughness": {"baseColorTexture": texture}}, uv=UV))
    monkeypatch.setattr(files, "IMAGE_PIXELS_PER_BYTE", 360_000 // len(data) + 1)
    with pytest.raises(SceneError, match=rf"its textures declare 720000 pixels in {len(data)} bytes"):
        load_mesh(gltf.save(tmp_path / "shared.glb"))


def test_a_texture_in_many_shades_is_counted_in_each(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "FREE_IMAGE_PIXELS", 2_000_000)
    monkeypatch.setattr(files, "IMAGE_PIXELS_PER_BYTE", 0)
    gltf = with_image(bomb(600))
    for k in range(5):
        rough = {"baseColorFactor": [0.1 * k, 1, 1, 1], "baseColorTexture": {"index": 0}}
        gltf.node(gltf.primitive(FLOOR, {"pbrMetallicRoughness": rough}, uv=UV))
    with pytest.raises(SceneError, match="its textures declare 2160000 pixels"):
        load_mesh(gltf.save(tmp_path / "shades.glb"))


def test_a_jpeg_of_countless_scans_is_not_decoded(tmp_path):
    file = io.BytesIO()
    Image.new("L", (3000, 3000)).save(file, "JPEG", progressive=True)
    data = file.getvalue()
    last = data.rindex(b"\xff\xda")
    load_mesh(with_image(data).save(tmp_path / "few.glb"))
    path = with_image(data[:-2] + data[last:-2] * 300 + data[-2:]).save(tmp_path / "scans.glb")
    with pytest.raises(SceneError, match=r"the texture image 0 cannot be decoded"):
        load_mesh(path)


def test_files_that_are_looked_for_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_MAX_MISSING", 3)
    (tmp_path / "a.obj").write_text("mtllib 1 2 3 4 5\nv 0 0 0\nv 4 0 0\nv 0 4 0\nf 1 2 3\n")
    with pytest.raises(SceneError, match="refers to over 3 files that are not there"):
        load_mesh(tmp_path / "a.obj")


def test_faces_are_counted_before_they_are_copied(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MAX_FACES", 7)
    gltf = Gltf()
    mesh = gltf.node(gltf.primitive())
    for _ in range(3):
        gltf.node(mesh=None, root=True)
        gltf.header["nodes"][-1]["mesh"] = gltf.header["nodes"][mesh]["mesh"]
    with pytest.raises(SceneError, match="declares 8 faces, more than 7; decimate the scan"):
        load_mesh(gltf.save(tmp_path / "copies.glb"))


def test_faces_on_top_of_one_another_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "FREE_FRAGMENTS", 0)
    sheet = "".join(f"v {x} {y} 0\n" for x, y in ((0, 0), (6, 0), (6, 5), (0, 5)))
    (tmp_path / "sheets.obj").write_text(sheet + "f 1 2 3 4\n" * 250)
    with (
        pytest.warns(UserWarning, match="no color"),
        pytest.raises(SceneError, match=r"its faces cover .* pixels in all, more than .*; raise meters_per_pixel"),
    ):
        ScanMap.from_mesh(tmp_path / "sheets.obj", cache=False)


@pytest.mark.parametrize("error", [MemoryError, RecursionError, KeyError, IndexError, ZeroDivisionError], ids=str)
def test_what_goes_wrong_within_a_reader_is_one_sentence(tmp_path, monkeypatch, error):
    path = write(house(), tmp_path / "house.glb")

    def fail(*args):
        raise error("within")

    monkeypatch.setattr("sb3_abisim.envs.scan_nav.mesh.GltfScene", fail)
    with pytest.raises(SceneError, match=r"house.glb (cannot be read|needs more memory)") as raised:
        load_mesh(path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj", ".ply"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_damage_anywhere_ends_in_one_kind_of_error(tmp_path, suffix):
    """Flipped bytes and cut ends: another scan, or a SceneError that names the file."""
    whole = write(house(suffix != ".ply"), tmp_path / f"scan{suffix}").read_bytes()
    path, rng, refused = tmp_path / f"bad{suffix}", np.random.default_rng(0), 0
    for _ in range(150):
        data = bytearray(whole)
        place = int(rng.integers(len(data)))
        if rng.random() < 0.3:
            del data[place:]
        else:
            length = int(rng.integers(1, 8))
            data[place : place + length] = rng.bytes(length)
        path.write_bytes(data)
        try:
            load_mesh(path)
        except SceneError as error:
            assert f"bad{suffix}" in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 30
