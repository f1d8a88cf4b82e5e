"""Maps made of meshes: what is seen from above, where one can walk, and which shapes are refused."""

import time
import tracemalloc

import numpy as np
import pytest
import trimesh
from scan_inputs import (  # noqa: F401
    HEIGHT,
    TABLE,
    WALLS,
    box,
    empty_cache,
    file_of_the_house,
    floor,
    house,
    map_of_the_house,
    pixel,
    write,
    y_up,
)

from sb3_abisim.envs.scan_nav.build import find_floors
from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.mesh import load_mesh

# What is seen.


def test_the_orthophoto_shows_what_is_below_the_cut(scan):
    assert scan.orthophoto[pixel(scan, 1.2, 0.9)].tolist() == [200, 160, 20], "the table"
    assert scan.height[pixel(scan, 1.2, 0.9)] == pytest.approx(0.75, abs=1e-5)
    # A wall and a wardrobe are solid: their own tops, not the floor inside them.
    assert scan.height[pixel(scan, 2.5, 1.0)] == pytest.approx(HEIGHT, abs=1e-5)
    assert scan.orthophoto[pixel(scan, 2.5, 1.0)].tolist() == [90, 90, 90]
    assert scan.height[pixel(scan, 4.5, 0.3)] == pytest.approx(2.2, abs=1e-5)
    # The ceiling is seen from below only.
    assert scan.height[pixel(scan, 3.5, 3.5)] == pytest.approx(0.0, abs=1e-5)


def test_textures_are_the_right_way_round(scan):
    # The green corner of the texture is the floor's north-western one.
    assert scan.orthophoto[pixel(scan, 0.2, 3.8)].tolist() == [30, 200, 30]
    # Squares are 62.5 x 50 cm; red where column + row of the texture is odd.
    for x, y in ((0.9, 3.8), (0.3, 3.3), (3.44, 3.75), (4.7, 3.75), (3.44, 2.3)):
        column, row = int(x / 0.625), int((4 - y) / 0.5)
        expected = [220, 40, 40] if (column + row) % 2 else [40, 40, 220]
        assert scan.orthophoto[pixel(scan, x, y)].tolist() == expected


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
    assert np.abs(scan.orthophoto[pixel(scan, x, y)] - expected).max() <= 2


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
    assert scan.orthophoto[pixel(scan, -0.2, 3.8)].tolist() == [30, 200, 30]


def test_a_thin_two_sided_ceiling_is_no_solid(tmp_path):
    lid = box(0, 0, 5, 4, HEIGHT, HEIGHT + 0.0001, (9, 9, 9))
    scan = ScanMap.from_mesh(write(trimesh.Scene([house(), lid]), tmp_path / "lid.glb"))
    assert scan.height[pixel(scan, 3.5, 3.5)] == pytest.approx(0.0, abs=1e-5)


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
    _, column = pixel(scan, 2.5, 2)
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


# What is refused.


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
    "fine.glb": (house, {"meters_per_pixel": 0.0005}, r"larger than 16 million; raise meters_per_pixel from 0.0005 to"),
    "narrow.glb": (lambda: trimesh.Scene([floor(size=(0.3, 9))]), {}, r"only 0\.\d+ m2 .* can be walked on"),
}


@pytest.mark.parametrize("name", SHAPES)
def test_refuses_shapes(tmp_path, name):
    make, settings, message = SHAPES[name]
    path = write(make(), tmp_path / name)
    with pytest.raises(SceneError, match=message) as error:
        ScanMap.from_mesh(path, **settings)
    assert name in str(error.value)


# What it costs.


@pytest.mark.slow
def test_a_large_house_takes_little_time_and_memory(tmp_path):
    """150,000 triangles: under 5 s and 1 GB, all of it NumPy's and trimesh's memory."""
    mesh = house().to_mesh().subdivide_to_size(0.05, max_iter=12)
    mesh.apply_scale((3, 3, 1))
    mesh.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (len(mesh.vertices), 4)).astype(np.uint8)
    assert len(mesh.faces) > 150_000
    mesh.export(tmp_path / "large.ply")
    start = time.process_time()
    ScanMap.from_mesh(tmp_path / "large.ply", cache=False)
    assert time.process_time() - start < 5
    tracemalloc.start()
    ScanMap.from_mesh(tmp_path / "large.ply", cache=False)
    assert tracemalloc.get_traced_memory()[1] < 2**30
    tracemalloc.stop()
