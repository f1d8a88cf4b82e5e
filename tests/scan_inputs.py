"""What the tests of scans share: a small house, made with trimesh alone, and files of it."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from sb3_abisim.envs.scan_nav.map import ScanMap

# Inner size of the house, z up: x from 0 to 5, y from 0 to 4. A wall 10 cm thick at x = 2.5 with a door in the north.
WALLS = [(-0.2, -0.2, 0, 4.2), (5, -0.2, 5.2, 4.2), (0, -0.2, 5, 0), (0, 4, 5, 4.2), (2.45, 0, 2.55, 2.6)]
TABLE = (0.8, 0.6, 1.6, 1.2)
HEIGHT = 2.5


def box(x0, y0, x1, y1, z0, z1, color):
    mesh = trimesh.creation.box(bounds=[(x0, y0, z0), (x1, y1, z1)])
    mesh.visual.vertex_colors = (*color, 255)
    return mesh


def checkers():
    """Red and blue squares of 8 x 8 pixels, and one green corner (at the left of the first row)."""
    y, x = np.mgrid[:64, :64]
    checked = np.where(((x // 8 + y // 8) % 2)[..., None], (220, 40, 40), (40, 40, 220)).astype(np.uint8)
    checked[:8, :8] = (30, 200, 30)
    return Image.fromarray(checked)


def floor(textured=True, size=(5, 4), image=None):
    points = np.array([(0, 0, 0), (size[0], 0, 0), (size[0], size[1], 0), (0, size[1], 0)], dtype=float)
    mesh = trimesh.Trimesh(points, [(0, 1, 2), (0, 2, 3)], process=False)
    if textured:
        uv = [(0, 0), (1, 0), (1, 1), (0, 1)]
        image = image or checkers()
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
        mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    else:
        mesh.visual.vertex_colors = [(255, 0, 0, 255), (0, 255, 0, 255), (0, 0, 255, 255), (255, 255, 255, 255)]
    return mesh


def house(textured=True):
    """Floor, walls, a table, a wardrobe higher than the cut, and a ceiling that is seen from below only."""
    parts = [floor(textured)]
    parts += [box(*wall, 0, HEIGHT, (90, 90, 90)) for wall in WALLS]
    parts.append(box(*TABLE, 0.7, 0.75, (200, 160, 20)))
    parts.append(box(4, 0, 5, 0.6, 0, 2.2, (20, 160, 200)))
    ceiling = floor(False)
    # A wall that ended in the very plane of the ceiling would be seen as hollow.
    ceiling.apply_translation((0, 0, HEIGHT + 0.01))
    ceiling.invert()
    return trimesh.Scene([*parts, ceiling])


def y_up(scene):
    """z up to y up, glTF's convention."""
    scene = scene.copy()
    scene.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return scene


def write(scene, path: Path):
    """Export the scene; a PLY file holds one mesh."""
    if path.suffix == ".ply":
        scene.to_mesh().export(path)
    elif path.suffix == ".gltf":
        for name, data in scene.export(file_type="gltf").items():
            (path.parent / ("scan.gltf" if name == "model.gltf" else name)).write_bytes(data)
    else:
        scene.export(path)
    return path


@pytest.fixture(autouse=True)
def empty_cache(tmp_path_factory, monkeypatch):
    """Import it where a test must not see maps of earlier runs."""
    monkeypatch.setenv("SB3_ABISIM_CACHE", str(tmp_path_factory.mktemp("scans")))


def empty_room(width=8.0, depth=6.0, walls=()):
    """A map by hand: 5 cm pixels, walkable but for ``walls`` (slices of rows and columns)."""
    shape = round(depth / 0.05), round(width / 0.05)
    walkable = np.ones(shape, dtype=bool)
    for wall in walls:
        walkable[wall] = False
    colors = np.random.default_rng(0).integers(0, 255, (*shape, 3)).astype(np.uint8)
    return ScanMap(colors, np.where(walkable, 0, 1).astype(np.float32), walkable, 0.05, (0.0, depth), "room")


def pixel(scan, x, y):
    """Row and column of a point of a map."""
    return int((scan.origin[1] - y) / scan.meters_per_pixel), int((x - scan.origin[0]) / scan.meters_per_pixel)


@pytest.fixture(name="house_file", scope="module")
def file_of_the_house(tmp_path_factory):
    return write(y_up(house()), tmp_path_factory.mktemp("house") / "house.glb")


@pytest.fixture(name="scan")
def map_of_the_house(house_file):
    return ScanMap.from_mesh(house_file)


@pytest.fixture(name="room", scope="module")
def map_of_a_room():
    return empty_room()


def start_at(env, start, goal, heading=0.0):
    """Begin an episode with everything given."""
    return env.reset(seed=0, options={"goal": goal, "start": start, "heading": heading})
