"""Maps of scans: what is seen from above, where one can walk, and what is refused."""

import json
import struct
import time
import tracemalloc

import numpy as np
import pytest
import trimesh
from PIL import Image
from scan_inputs import HEIGHT, TABLE, WALLS, box, floor, house, own_cache, write, y_up  # noqa: F401

from sb3_abisim.common.paths import cache_folder
from sb3_abisim.envs.scan_nav import map as scan_map
from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap, find_floors
from sb3_abisim.envs.scan_nav.mesh import load_mesh


def at(scan, x, y):
    """Row and column of a point."""
    return int((scan.origin[1] - y) / scan.meters_per_pixel), int((x - scan.origin[0]) / scan.meters_per_pixel)


@pytest.fixture(scope="module")
def house_file(tmp_path_factory):
    return write(y_up(house()), tmp_path_factory.mktemp("house") / "house.glb")


@pytest.fixture
def scan(house_file):
    return ScanMap.from_mesh(house_file)


# What is seen.


def test_the_orthophoto_shows_what_is_below_the_cut(scan):
    assert scan.orthophoto[at(scan, 1.2, 0.9)].tolist() == [200, 160, 20], "the table"
    assert scan.height[at(scan, 1.2, 0.9)] == pytest.approx(0.75, abs=1e-5)
    # A wall and a wardrobe are solid: their own tops, not the floor inside them.
    assert scan.height[at(scan, 2.5, 1.0)] == pytest.approx(HEIGHT, abs=1e-5)
    assert scan.orthophoto[at(scan, 2.5, 1.0)].tolist() == [90, 90, 90]
    assert scan.height[at(scan, 4.5, 0.3)] == pytest.approx(2.2, abs=1e-5)
    # The ceiling is seen from below only.
    assert scan.height[at(scan, 3.5, 3.5)] == pytest.approx(0.0, abs=1e-5)


def test_textures_are_the_right_way_round(scan):
    # The green corner of the texture is the floor's north-western one.
    assert scan.orthophoto[at(scan, 0.2, 3.8)].tolist() == [30, 200, 30]
    # Squares are 62.5 x 50 cm; red where column + row of the texture is odd.
    for x, y in ((0.9, 3.8), (0.3, 3.3), (3.44, 3.75), (4.7, 3.75), (3.44, 2.3)):
        column, row = int(x / 0.625), int((4 - y) / 0.5)
        expected = [220, 40, 40] if (column + row) % 2 else [40, 40, 220]
        assert scan.orthophoto[at(scan, x, y)].tolist() == expected


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj", ".ply"])
@pytest.mark.parametrize("textured", [True, False])
def test_formats_agree(tmp_path, suffix, textured):
    if suffix == ".ply" and textured:
        pytest.skip("trimesh writes no textures into PLY")
    # trimesh writes either textures or vertex colors into one OBJ file.
    scene = trimesh.Scene([floor()]) if suffix == ".obj" and textured else house(textured)
    reference = ScanMap.from_mesh(write(scene, tmp_path / "reference.glb"), up="z")
    other = ScanMap.from_mesh(write(scene, tmp_path / f"scan{suffix}"), up="z")
    # OBJ holds decimal numbers.
    assert (other.walkable != reference.walkable).mean() < 0.005
    assert np.allclose(other.height, reference.height, atol=1e-4, equal_nan=True)
    assert np.abs(other.orthophoto.astype(int) - reference.orthophoto).max() <= 1


def test_vertex_colors_are_interpolated(tmp_path):
    scan = ScanMap.from_mesh(write(trimesh.Scene([floor(False)]), tmp_path / "floor.ply"))
    # In the south-eastern triangle the color is red * (1 - x/5) + green * (x/5 - y/4) + blue * y/4.
    x, y = 3.01, 0.99
    expected = 255 * np.array([1 - x / 5, x / 5 - y / 4, y / 4])
    assert np.abs(scan.orthophoto[at(scan, x, y)] - expected).max() <= 2


def test_a_material_without_a_texture_shows_its_vertex_colors(tmp_path):
    plain, colored = floor(False), floor(False)
    colors = plain.visual.vertex_colors.copy()
    material = trimesh.visual.material.PBRMaterial(name="as Blender writes it")
    colored.visual = trimesh.visual.TextureVisuals(uv=np.zeros((4, 2)), material=material)
    colored.visual.vertex_attributes["color"] = colors
    there, here = (
        ScanMap.from_mesh(write(trimesh.Scene([mesh]), tmp_path / f"{name}.glb"))
        for name, mesh in (("plain", plain), ("colored", colored))
    )
    assert there.orthophoto.std() > 20 and np.array_equal(there.orthophoto, here.orthophoto)


@pytest.mark.parametrize("turn", [y_up, lambda scene: scene])
def test_the_upward_axis_is_found(tmp_path, turn, scan):
    path = write(turn(house()), tmp_path / "scan.glb")
    assert np.array_equal(ScanMap.from_mesh(path).walkable, scan.walkable)


def test_a_mirrored_part_is_not_turned_inside_out(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(floor(), transform=np.diag([-1.0, 1, 1, 1]))
    scan = ScanMap.from_mesh(write(scene, tmp_path / "mirrored.glb"))
    assert np.isfinite(scan.height[:-1, :-1]).mean() > 0.97
    assert scan.orthophoto[at(scan, -0.2, 3.8)].tolist() == [30, 200, 30]


def test_a_thin_two_sided_ceiling_is_no_solid(tmp_path):
    lid = box(0, 0, 5, 4, HEIGHT, HEIGHT + 0.0001, (9, 9, 9))
    scan = ScanMap.from_mesh(write(trimesh.Scene([house(), lid]), tmp_path / "lid.glb"))
    assert scan.height[at(scan, 3.5, 3.5)] == pytest.approx(0.0, abs=1e-5)


# Where one can walk.


def test_walkable_keeps_the_agents_radius(scan):
    """Against the distances to the house's plan, known by hand."""
    rows, columns = np.indices(scan.walkable.shape)
    x = scan.origin[0] + (columns + 0.5) * scan.meters_per_pixel
    y = scan.origin[1] - (rows + 0.5) * scan.meters_per_pixel
    distance = np.full(scan.walkable.shape, np.inf)
    for x0, y0, x1, y1 in [*WALLS, TABLE, (4, 0, 5, 0.6)]:
        away = np.hypot(np.maximum(np.maximum(x0 - x, x - x1), 0), np.maximum(np.maximum(y0 - y, y - y1), 0))
        distance = np.minimum(distance, away)
    inside = (x > 0) & (x < 5) & (y > 0) & (y < 4)
    assert scan.walkable[inside & (distance > 0.1 + 0.04)].all()
    assert not scan.walkable[~inside | (distance < 0.1 - 0.02)].any()


def test_walls_without_thickness_stop_the_agent(tmp_path):
    sheet = trimesh.Trimesh([(2.5, 0, 0), (2.5, 4, 0), (2.5, 4, 2), (2.5, 0, 2)], [(0, 1, 2), (0, 2, 3)], process=False)
    sheet.visual.vertex_colors = (9, 9, 9, 255)
    scan = ScanMap.from_mesh(write(trimesh.Scene([floor(), sheet]), tmp_path / "sheet.glb"), up="z")
    _, column = at(scan, 2.5, 2)
    assert not scan.walkable[:, column - 3 : column + 3].any()
    # One of the two halves is left.
    assert scan.walkable.sum() * 0.02**2 == pytest.approx(2.4 * 3.8, rel=0.05)


def test_thresholds_and_lamps_stop_nobody(tmp_path):
    parts = [floor(), box(2, 0, 2.1, 4, 0, 0.15, (1, 1, 1)), box(3, 0, 3.1, 4, 1.6, 1.7, (1, 1, 1))]
    scan = ScanMap.from_mesh(write(trimesh.Scene(parts), tmp_path / "low.glb"))
    assert scan.walkable.sum() * 0.02**2 == pytest.approx(4.8 * 3.8, rel=0.03)
    stopped = ScanMap.from_mesh(tmp_path / "low.glb", max_climb=0.1)
    assert stopped.walkable.sum() < 0.7 * scan.walkable.sum()


def storeys():
    upper = house()
    upper.apply_translation((0, 0, 2.8))
    upper.geometry[next(iter(upper.geometry))].invert()
    upper.geometry[next(iter(upper.geometry))].invert()
    return trimesh.Scene([house(), upper])


def test_floors(tmp_path):
    path = write(storeys(), tmp_path / "two.glb")
    floors = find_floors(load_mesh(path, "z").corners())
    assert floors == pytest.approx([0.0, 2.8], abs=1e-6)
    lower, upper = (ScanMap.from_mesh(path, up="z", floor=k) for k in (0, 1))
    assert upper.settings["floor_height"] == pytest.approx(2.8)
    assert lower.walkable.sum() == pytest.approx(upper.walkable.sum(), rel=0.02)
    with pytest.raises(SceneError, match=r"two.glb has no floor 2: there are 2, at heights 0.00 m, 2.80 m"):
        ScanMap.from_mesh(path, up="z", floor=2)


# Files.


def test_npz_round_trip(scan, tmp_path):
    scan.save(tmp_path / "map.npz")
    again = ScanMap.load(tmp_path / "map.npz")
    assert again.content_hash == scan.content_hash and again.settings == scan.settings and again.origin == scan.origin


def test_damage_anywhere_in_a_map_is_one_kind_of_error(scan, tmp_path):
    scan.save(tmp_path / "map.npz")
    whole = (tmp_path / "map.npz").read_bytes()
    generator, refused = np.random.default_rng(0), 0
    for _ in range(300):
        place, length = int(generator.integers(len(whole))), int(generator.integers(1, 200))
        noise = generator.bytes(length) if generator.random() < 0.5 else bytes(length)
        (tmp_path / "bad.npz").write_bytes((whole[:place] + noise + whole[place + length :])[: len(whole)])
        try:
            ScanMap.load(tmp_path / "bad.npz")
        except SceneError as error:
            refused += "bad.npz" in str(error)
    assert refused > 200


def test_the_cache_is_used_and_notices_changes(tmp_path, monkeypatch):
    path = write(trimesh.Scene([floor()]), tmp_path / "scan.obj")
    first = ScanMap.from_mesh(path)
    calls = []
    build = scan_map.build_map
    monkeypatch.setattr(scan_map, "build_map", lambda *args: calls.append(args) or build(*args))
    assert ScanMap.from_mesh(path).content_hash == first.content_hash and not calls
    ScanMap.from_mesh(path, meters_per_pixel=0.03)
    assert len(calls) == 1, "other settings, another map"
    image = next(file for file in tmp_path.iterdir() if file.suffix == ".png")
    Image.new("RGB", (8, 8), (1, 2, 3)).save(image)
    assert ScanMap.from_mesh(path).content_hash != first.content_hash and len(calls) == 2, "another texture"
    for kept in cache_folder("scans").iterdir():
        kept.write_bytes(b"damaged")
    ScanMap.from_mesh(path)
    assert len(calls) == 3


def glb_with(**header):
    data = json.dumps({"asset": {"version": "2.0"}, **header}).encode()
    data += b" " * (-len(data) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(data), len(data), b"JSON") + data


def cloud(path):
    trimesh.PointCloud(np.random.default_rng(0).random((50, 3)) * 4).export(path)


BROKEN = {
    "lfs.glb": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
    "empty.glb": (b"", "is empty"),
    "text.glb": (b"<html>not found, but long enough to be a header</html>", "not a binary glTF"),
    "bad.gltf": (b"{", "cannot be read"),
    "bad.ply": (b"ply\nformat ascii 1.0\nelement vertex 5\n", "cannot be read"),
    "scan.fbx": (b"x", r"suffix must be one of \.glb"),
    "draco.glb": (glb_with(extensionsRequired=["KHR_draco_mesh_compression"]), "Draco.*gltf-transform"),
    "ktx.glb": (glb_with(extensionsRequired=["KHR_texture_basisu"]), "KTX2.*gltf-transform"),
    "nothing.glb": (glb_with(), "empty|cannot be read"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_refuses_broken_files(tmp_path, name):
    content, message = BROKEN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=message) as error:
        ScanMap.from_mesh(tmp_path / name)
    assert name in str(error.value)


def test_refuses_missing_truncated_and_pointless_files(tmp_path, house_file):
    with pytest.raises(SceneError, match=r"there is no scan file .*absent\.glb"):
        ScanMap.from_mesh(tmp_path / "absent.glb")
    (tmp_path / "half.glb").write_bytes(house_file.read_bytes()[:5000])
    with pytest.raises(SceneError, match=r"half.glb is truncated: it has 5000 of \d+ bytes"):
        ScanMap.from_mesh(tmp_path / "half.glb")
    cloud(tmp_path / "cloud.ply")
    with pytest.raises(SceneError, match=r"cloud.ply is a point cloud"):
        ScanMap.from_mesh(tmp_path / "cloud.ply")


def bent(vertex):
    mesh = floor(False)
    mesh.vertices[0] = vertex
    return trimesh.Scene([mesh])


def scaled(factor):
    scene = house()
    scene.apply_scale(factor)
    return scene


def tilted():
    scene = house()
    scene.apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 1, 0)))
    return scene


SHAPES = {
    "nan.ply": (lambda: bent((np.nan, 0, 0)), {}, "not finite"),
    "millimeters.glb": (lambda: scaled(1000), {}, "units"),
    "tiny.glb": (lambda: scaled(0.1), {}, r"0\.54 m wide, not between 1 and 200 m; its units"),
    "doll.glb": (lambda: scaled(0.2), {}, "no floor: its largest horizontal level has"),
    "cube.glb": (lambda: trimesh.Scene([box(0, 0, 3, 3, 0, 3, (1, 1, 1))]), {}, r"could stand.*up='y' or up='z'"),
    "tilted.glb": (tilted, {}, "no floor: its largest horizontal level"),
    "fine.glb": (house, {"meters_per_pixel": 0.0005}, r"larger than 64 million; raise meters_per_pixel from 0.0005 to"),
    "narrow.glb": (lambda: trimesh.Scene([floor(size=(0.3, 9))]), {}, r"only 0\.\d+ m2 .* can be walked on"),
}


@pytest.mark.parametrize("name", SHAPES)
def test_refuses_shapes(tmp_path, name):
    make, settings, message = SHAPES[name]
    path = write(make(), tmp_path / name)
    with pytest.raises(SceneError, match=message) as error:
        ScanMap.from_mesh(path, **settings)
    assert name in str(error.value)


def test_a_missing_texture_is_one_warning_and_gray(tmp_path):
    path = write(trimesh.Scene([floor()]), tmp_path / "scan.obj")
    next(file for file in tmp_path.iterdir() if file.suffix == ".png").unlink()
    with pytest.warns(UserWarning, match=r"scan.obj refers to \S+\.png, which is not there") as warned:
        scan = ScanMap.from_mesh(path)
    assert len(warned) == 1
    assert scan.orthophoto[at(scan, 3.5, 3.5)].tolist() == [160, 160, 160]
    with pytest.warns(UserWarning, match=r"scan.obj refers to \S+\.png, which is not there"):
        ScanMap.from_mesh(path)  # from the cache


@pytest.mark.parametrize("line", ["/home/me/scans/{}", "..\\{}", "textures/{}", "my%20{}", "a%20b/{}"])
def test_textures_under_another_machines_path(tmp_path, line, scan):
    path = write(trimesh.Scene([floor()]), tmp_path / "scan.obj")
    (material,) = tmp_path.glob("*.mtl")
    (picture,) = tmp_path.glob("*.png")
    name = f"my {picture.name}" if line.startswith("my") else picture.name
    name = f"a b/{name}" if line.startswith("a%20b") else name
    (tmp_path / "a b").mkdir()
    picture.rename(tmp_path / name)
    material.write_text(material.read_text().replace(picture.name, line.format(picture.name)))
    textured = ScanMap.from_mesh(path)
    assert textured.orthophoto[at(textured, 0.2, 3.8)].tolist() == [30, 200, 30]
    # The cache knows the file that was read.
    Image.new("RGB", (64, 64), (1, 2, 3)).save(tmp_path / name)
    assert ScanMap.from_mesh(path).orthophoto[at(textured, 0.2, 3.8)].tolist() == [1, 2, 3]


def test_nothing_outside_of_the_scans_folder_is_read(tmp_path):
    (tmp_path / "scan").mkdir()
    path = write(trimesh.Scene([floor()]), tmp_path / "scan" / "scan.obj")
    (material,) = path.parent.glob("*.mtl")
    (picture,) = path.parent.glob("*.png")
    picture.rename(tmp_path / picture.name)
    material.write_text(material.read_text().replace(picture.name, f"../{picture.name}"))
    with pytest.warns(UserWarning, match=r"which is not there \(in the scan's folder\)"):
        ScanMap.from_mesh(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "something"}, "format 'something'"),
        ({"walkable": np.zeros((60, 60), bool)}, "only 0.00 m2"),
        ({"walkable": np.zeros((60, 60))}, "walkable must be bool"),
        ({"height": np.zeros((60, 61), np.float32)}, "height must be float32 of shape"),
        ({"height": np.full((60, 60), np.inf, np.float32)}, "infinite"),
        ({"orthophoto": np.zeros((60, 60), np.uint8)}, "orthophoto must be uint8"),
        ({"meters_per_pixel": -1.0}, "meters_per_pixel"),
        ({"origin": np.array([np.nan, 0])}, "origin"),
        ({"settings": "{"}, "not a scan map"),
    ],
)
def test_refuses_wrong_maps_from_elsewhere(tmp_path, changes, message):
    good = {
        "format": scan_map.FORMAT,
        "orthophoto": np.zeros((60, 60, 3), np.uint8),
        "height": np.zeros((60, 60), np.float32),
        "walkable": np.ones((60, 60), bool),
        "meters_per_pixel": 0.05,
        "origin": np.zeros(2),
        "source": "elsewhere",
        "settings": "{}",
    }
    np.savez(tmp_path / "good.npz", **good)
    assert ScanMap.load(tmp_path / "good.npz").walkable.all()
    np.savez(tmp_path / "map.npz", **(good | changes))
    with pytest.raises(SceneError, match=message):
        ScanMap.load(tmp_path / "map.npz")
    (tmp_path / "map.npz").write_bytes((tmp_path / "good.npz").read_bytes()[:900])
    with pytest.raises(SceneError, match=r"map\.npz is not a scan map"):
        ScanMap.load(tmp_path / "map.npz")
    with pytest.raises(SceneError, match=r"no scan map .*absent"):
        ScanMap.load(tmp_path / "absent.npz")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"meters_per_pixel": 0}, "meters_per_pixel must be a number of meters above 0, got 0"),
        ({"floor": -1}, "floor must be"),
        ({"up": "x"}, "up must be one of"),
        ({"agent_height": 3.0}, "agent_height 3.0 <= cut_height 2.0"),
        ({"color": 1}, "settings of a map are meters_per_pixel"),
    ],
    ids=str,
)
def test_refuses_settings(house_file, settings, message):
    with pytest.raises(ValueError, match=message):
        ScanMap.from_mesh(house_file, **settings)


@pytest.mark.slow
def test_a_large_house_takes_little_time_and_memory(tmp_path):
    """150,000 triangles: under 5 s and 1 GB, all of it NumPy's and trimesh's memory."""
    scene = house()
    mesh = scene.to_mesh().subdivide_to_size(0.05, max_iter=12)
    mesh.apply_scale((3, 3, 1))
    assert len(mesh.faces) > 150_000
    mesh.export(tmp_path / "large.ply")
    start = time.process_time()
    ScanMap.from_mesh(tmp_path / "large.ply", cache=False)
    assert time.process_time() - start < 5
    tracemalloc.start()
    ScanMap.from_mesh(tmp_path / "large.ply", cache=False)
    assert tracemalloc.get_traced_memory()[1] < 2**30
    tracemalloc.stop()
