"""Scans that are upside down, mirrored, inside out, leaning or of another unit are read right or refused by name."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from scan_inputs import empty_cache, floor, write  # noqa: F401

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.mesh import load_mesh
from sb3_abisim.envs.scan_nav.upright import AXES, turned

WIDTH, DEPTH, HEIGHT = 6, 5, 2.6


def quad(*points):
    return trimesh.Trimesh(points, [(0, 1, 2), (0, 2, 3)], process=False)


def level(x0, y0, x1, y1, z):
    return quad((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))


def box(x0, y0, z0, x1, y1, z1):
    return trimesh.creation.box(bounds=[(x0, y0, z0), (x1, y1, z1)])


def sheets(ceiling, furniture=True):
    """As a scanner sees a room: its inner surfaces."""
    parts = [level(0, 0, WIDTH, DEPTH, 0)]
    if furniture:
        parts += [level(4, 3, 5, 4, 0.8), level(0, 0, 2, 1.6, 0.5)]
    around = ((0, 0), (0, DEPTH), (WIDTH, DEPTH), (WIDTH, 0), (0, 0))
    parts += [quad((*a, 0), (*b, 0), (*b, HEIGHT), (*a, HEIGHT)) for a, b in pairwise(around)]
    if ceiling:
        above = level(0, 0, WIDTH, DEPTH, HEIGHT)
        above.invert()
        parts.append(above)
    return trimesh.util.concatenate(parts)


def solids(ceiling):
    """As an architect draws it: everything is a box."""
    parts = [box(-0.2, -0.2, -0.2, WIDTH + 0.2, DEPTH + 0.2, 0), box(0, 0, 0, 2, 1.6, 0.5), box(0, 3, 0, 0.6, 5, 2.1)]
    parts += [box(4, 3, 0.75, 5.4, 4, 0.8)]  # a table on four legs
    parts += [box(x, y, 0, x + 0.05, y + 0.05, 0.75) for x in (4.05, 5.3) for y in (3.05, 3.9)]
    parts += [box(-0.2, -0.2, 0, 0, DEPTH + 0.2, HEIGHT), box(WIDTH, -0.2, 0, WIDTH + 0.2, DEPTH + 0.2, HEIGHT)]
    parts += [box(0, -0.2, 0, WIDTH, 0, HEIGHT), box(0, DEPTH, 0, WIDTH, DEPTH + 0.2, HEIGHT)]
    if ceiling:
        parts.append(box(-0.2, -0.2, HEIGHT, WIDTH + 0.2, DEPTH + 0.2, HEIGHT + 0.2))
    return trimesh.util.concatenate(parts)


def save(path, mesh, points=lambda v: v, faces=lambda f: f):
    vertices, triangles = points(np.array(mesh.vertices)), faces(np.array(mesh.faces))
    trimesh.Trimesh(vertices, triangles, vertex_colors=(200, 150, 100, 255), process=False).export(path)
    return path


def make(path, **settings):
    return ScanMap.from_mesh(path, cache=False, meters_per_pixel=0.05, **settings)


ROOMS = [(sheets, True), (sheets, False), (solids, True), (solids, False)]
IDS = ["sheets", "sheets, open", "solids", "solids, open"]
# What an exporter may have done to the points and the faces, and settings that undo it.
DONE = {
    "nothing": ({}, {}),
    "y up": ({"points": lambda v: np.stack([v[:, 0], v[:, 2], -v[:, 1]], axis=1)}, {}),
    "z down": ({"points": lambda v: v * (1, -1, -1)}, {"up": "-z"}),
    "y down": ({"points": lambda v: np.stack([v[:, 0], -v[:, 2], v[:, 1]], axis=1)}, {"up": "-y"}),
    "x up": ({"points": lambda v: v[:, [2, 0, 1]]}, {"up": "x"}),
    "flipped": ({"faces": lambda f: f[:, ::-1]}, {"flip_faces": True}),
    "y and z exchanged": ({"points": lambda v: v[:, [0, 2, 1]]}, {"up": "y", "flip_faces": True}),
    "x and y exchanged": ({"points": lambda v: v[:, [1, 0, 2]]}, {"flip_faces": True}),
    "x mirrored": ({"points": lambda v: v * (-1, 1, 1)}, {"flip_faces": True}),
    "z mirrored": ({"points": lambda v: v * (1, 1, -1)}, {"up": "-z", "flip_faces": True}),
    "feet": ({"points": lambda v: v / 0.3048}, {"meters_per_unit": 0.3048}),
    "decimeters": ({"points": lambda v: v * 10}, {"meters_per_unit": 0.1}),
}


@pytest.mark.parametrize(("room", "ceiling"), ROOMS, ids=IDS)
@pytest.mark.parametrize("done", DONE)
def test_every_way_of_writing_a_room_is_the_room_or_refused(tmp_path, room, ceiling, done, capsys):
    reference = make(save(tmp_path / "reference.ply", room(ceiling)))
    how, undo = DONE[done]
    path = save(tmp_path / "room.ply", room(ceiling), **how)
    if undo:
        with pytest.raises(SceneError, match=r"room\.ply"):
            make(path)
    scan = make(path, **undo)
    assert scan.walkable.sum() == pytest.approx(reference.walkable.sum(), rel=0.02)
    report = scan.settings["report"]
    assert report["storey_height"] == pytest.approx(HEIGHT, abs=0.01)
    assert report["storey_from"] == ("ceiling" if ceiling else "tops of walls")
    assert "unit: meters" in capsys.readouterr().err


def test_yards_are_taken_for_meters_unless_the_unit_is_given(tmp_path, capsys):
    """A storey in yards is a plausible one in meters; docs/scan_files.md says so."""
    path = save(tmp_path / "room.ply", sheets(True), points=lambda v: v / 0.9144)
    assert make(path).settings["report"]["storey_height"] == pytest.approx(HEIGHT / 0.9144, abs=0.01)
    assert "unit: meters" in capsys.readouterr().err
    assert make(path, meters_per_unit=0.9144).settings["report"]["storey_height"] == pytest.approx(HEIGHT, abs=0.01)


def test_the_message_names_the_remedy(tmp_path):
    for done, ways in (("z down", "up='-z'"), ("flipped", "flip_faces=True"), ("feet", "meters_per_unit=0.3048")):
        path = save(tmp_path / "room.ply", sheets(True), **DONE[done][0])
        with pytest.raises(SceneError, match=rf"; give {ways}, or allow_implausible=True if it is meant$"):
            make(path)
        assert make(path, allow_implausible=True).settings["report"]["walkable_area"] > 5


@pytest.mark.parametrize("how", [{"points": lambda v: v * (1, -1, -1)}, {"faces": lambda f: f[:, ::-1]}])
def test_a_floor_alone_that_looks_down_is_refused(tmp_path, how):
    path = save(tmp_path / "floor.ply", level(0, 0, 6, 5, 0), **how)
    with pytest.raises(SceneError, match=r"has no floor: .* with -z up it has 30.0 m2: give up='-z', or flip_faces"):
        make(path)


def test_an_empty_room_says_that_its_top_is_not_known(tmp_path, capsys):
    make(save(tmp_path / "room.ply", sheets(True, furniture=False)))
    assert "(an empty room: whether it stands on its head is not known)" in capsys.readouterr().err


def lean(degrees, axis=(0.6, 0.8, 0)):
    matrix = trimesh.transformations.rotation_matrix(np.deg2rad(degrees), axis)[:3, :3]
    return lambda v: v @ matrix.T


@pytest.mark.parametrize("degrees", [0.5, 1, 3, 10])
@pytest.mark.parametrize("room", [sheets, solids])
def test_a_lean_is_taken_away_and_said(tmp_path, room, degrees, capsys):
    reference = make(save(tmp_path / "reference.ply", room(True)))
    scan = make(save(tmp_path / "room.ply", room(True), lean(degrees)))
    assert scan.settings["report"]["lean"] == pytest.approx(degrees, abs=0.01)
    assert f"{degrees:.1f} degrees of lean taken away" in capsys.readouterr().err
    assert scan.walkable.sum() == pytest.approx(reference.walkable.sum(), rel=0.02)
    assert np.nanmax(abs(scan.height[scan.walkable])) < 0.01


def test_a_large_lean_is_refused_in_degrees(tmp_path):
    path = save(tmp_path / "room.ply", level(0, 0, 6, 5, 0), lean(20))
    with pytest.raises(SceneError, match=r"leans by 20\.0 degrees with z up, more than 15; turn it upright"):
        make(path, up="z")


@pytest.mark.parametrize("scale", [1, 3.2808])
def test_a_floor_alone_says_that_its_unit_is_not_known(tmp_path, scale, capsys):
    ScanMap.from_mesh(save(tmp_path / "floor.ply", level(0, 0, 6, 5, 0), lambda v: v * scale), up="z", cache=False)
    assert "no ceiling, no walls" in (text := capsys.readouterr().err)
    assert "unit: taken for meters (no storey that would show it)" in text


def test_a_noisy_floor_does_not_lean(tmp_path):
    """Its faces look everywhere, on average up: the points stay as they are."""
    rng = np.random.default_rng(0)
    mesh = level(0, 0, 6, 5, 0).subdivide().subdivide().subdivide().subdivide()
    path = save(tmp_path / "floor.ply", mesh, lambda v: v + rng.normal(0, 0.02, v.shape))
    loaded = load_mesh(path, "z")
    assert loaded.notes["lean"] == 0
    assert np.array_equal(loaded.vertices, trimesh.load(path, process=False).vertices)


def test_stairs_and_ramps_do_not_lean(tmp_path):
    parts = [level(0, 0, 6, 5, 0), quad((6, 0, 0), (9, 0, 0.5), (9, 5, 0.5), (6, 5, 0)), level(9, 0, 12, 5, 0.5)]
    assert load_mesh(save(tmp_path / "ramp.ply", trimesh.util.concatenate(parts)), "z").notes["lean"] == 0


def test_a_room_on_its_side_is_not_taken_for_a_room_of_walls(tmp_path):
    path = save(tmp_path / "room.ply", sheets(False), **DONE["z down"][0])
    with pytest.raises(SceneError, match=r"could stand on either side: .* give up='y' or up='-z'"):
        make(path)


@pytest.mark.parametrize("up", AXES)
def test_every_axis_is_turned_up_without_mirroring(up):
    matrix = turned(np.eye(3), up)
    assert np.linalg.det(matrix) == pytest.approx(1)
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if up[0] == "-" else 1
    assert turned(axis[None], up)[0].tolist() == [0, 0, 1]


def test_hardly_any_walkable_floor_is_refused(tmp_path):
    """A floor full of posts but for one corner."""
    posts = [box(x, y, 0, x + 0.1, y + 0.1, 2.5) for x in np.arange(0, 9.9, 0.25) for y in np.arange(0, 9.9, 0.25)]
    kept = [post for post in posts if not (post.bounds[0][:2] < 1.4).all()]
    path = save(tmp_path / "posts.ply", trimesh.util.concatenate([level(0, 0, 10, 10, 0), *kept]))
    with pytest.raises(SceneError, match=r"only \d\.\d% of its floor can be walked on; give allow_implausible=True"):
        make(path)
    assert make(path, allow_implausible=True).settings["report"]["walkable_share"] < 0.05


def test_the_report_is_stored_with_the_map(tmp_path, capsys):
    path = write(trimesh.Scene([floor()]), tmp_path / "floor.glb")
    made = ScanMap.from_mesh(path)
    said = capsys.readouterr().err
    assert "5.0 x 4.0 x 0.0 m, z up, 2 faces, 1 textures" in said and "20.0 m2 of floor, 18.2 m2 walkable (91%" in said
    kept = ScanMap.from_mesh(path)  # from the cache
    assert capsys.readouterr().err == "" and kept.settings["report"] == made.settings["report"]
    kept.save(tmp_path / "map.npz")
    assert ScanMap.load(tmp_path / "map.npz").settings["report"]["floor_area"] == pytest.approx(20)


def test_an_apartment_has_no_settings_of_files():
    with pytest.raises(ValueError, match="an apartment stands upright, it takes no flip_faces; got True"):
        ScanMap.apartment(0, flip_faces=True)
