"""What ScanNav shows, against a ray-cast camera."""

import numpy as np
import pytest
import trimesh
from scan_inputs import map_of_a_room, start_at  # noqa: F401
from scipy import ndimage

from sb3_abisim.envs.scan_nav.apartment import SEEDS, apartment_mesh
from sb3_abisim.envs.scan_nav.env import ScanNavEnv, ScanNavVectorEnv, load_scene
from sb3_abisim.envs.scan_nav.view import MARKER_RADIUS, MARKERS, area_means


def ray_cast(mesh, rays):
    """Color and height that a camera from above sees along each ray, by embree; black and nan for nothing.

    A ray upwards from the cut began inside a solid where it hits an upper side.
    """
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    facing = whole.face_normals[:, 2]
    up = np.flatnonzero(facing > 1e-9)
    floors = trimesh.Trimesh(mesh.vertices, mesh.faces[up], process=False)
    starts, vertical = np.column_stack([rays, np.full(len(rays), 2.0)]), np.tile([0.0, 0.0, 1.0], (len(rays), 1))
    above = whole.ray.intersects_first(starts, vertical)
    below = floors.ray.intersects_first(starts, -vertical)
    below = np.where(below >= 0, up[below], -1)
    face = np.where((above >= 0) & (facing[above] > 0), above, below)
    seen, corners = face >= 0, whole.triangles[face]
    height = np.where(seen, corners[:, :, 2].mean(axis=1), np.nan)
    assert np.ptp(corners[seen, :, 2], axis=1).max() < 1e-6, "what is seen of an apartment is level"
    colors = np.zeros((len(rays), 3))
    first = 0
    for surface in mesh.surfaces:
        mine = np.flatnonzero(seen & (face >= first) & (face < first + surface.n_faces))
        hit = face[mine]
        spots = np.column_stack([rays[mine], height[mine]])
        weights = trimesh.triangles.points_to_barycentric(whole.triangles[hit], spots)
        u, v = np.einsum("nk,nkd->dn", weights, surface.coordinates[hit - first])
        rows, columns = (1 - v) * surface.texture.shape[0] - 0.5, u * surface.texture.shape[1] - 0.5
        for c in range(3):
            texture = surface.texture[..., c].astype(float)
            colors[mine, c] = ndimage.map_coordinates(texture, [rows, columns], order=1, mode="grid-wrap")
        first += surface.n_faces
    return np.rint(colors), height


@pytest.mark.parametrize("seed", SEEDS)
def test_every_pixel_of_an_apartments_map_equals_a_cast_ray(seed):
    scan = load_scene(seed)
    rows, columns = np.indices(scan.walkable.shape)
    x = scan.origin[0] + (columns + 0.5) * scan.meters_per_pixel
    y = scan.origin[1] - (rows + 0.5) * scan.meters_per_pixel
    colors, height = ray_cast(apartment_mesh(seed), np.stack([x, y], axis=-1).reshape(-1, 2))
    assert np.abs(colors - scan.orthophoto.reshape(-1, 3)).max() <= 1
    assert np.allclose(height, scan.height.ravel(), atol=1e-5, equal_nan=True)


def in_polygon(points, polygon, heading):
    """Whether points (..., 2), east and north of the agent, lie in a part of its marker, by the winding of corners."""
    angle = np.deg2rad(heading)
    ahead, left = np.array([-np.sin(angle), np.cos(angle)]), np.array([-np.cos(angle), -np.sin(angle)])
    corners = [a * ahead + b * left for a, b in polygon]
    inside = np.ones(points.shape[:-1], dtype=bool)
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        inside &= (b[0] - a[0]) * (points[..., 1] - a[1]) - (b[1] - a[1]) * (points[..., 0] - a[0]) >= 0
    return inside


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("marker", "episode"), [("arrow", 1), ("box", 3)])
def test_observations_equal_a_ray_cast_orthographic_camera(seed, marker, episode):
    """At most 1 of 1,000 pixels differs by more than one gray level."""
    mesh = apartment_mesh(seed)
    env = ScanNavEnv(scenes=seed, marker=marker, goals_per_scene=4)
    observation, _ = env.reset(seed=episode)
    factors = env.factors()
    pitch, fine = 6.0 / 128, 0.02
    # The camera's rays: those of the 2 cm lattice that lie in the view, and one more on each side.
    west, north = factors["goal"] + (-3, 3)
    scan = env.batch.scans[0]
    first = np.floor((np.array([west, -north]) + np.array([-scan.origin[0], scan.origin[1]])) / fine).astype(int)
    n = int(6 / fine) + 2
    xs = scan.origin[0] + (first[0] + np.arange(n) + 0.5) * fine
    ys = scan.origin[1] - (first[1] + np.arange(n) + 0.5) * fine
    rays = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    colors, height = ray_cast(mesh, rays)
    depth = np.where(np.isnan(height), 0, 255 * np.clip((3 - height) / 3, 0, 1))
    seen = np.column_stack([colors, depth]).reshape(n, n, 4)

    def shares(low_edges, begin):
        """Overlap of each pixel with the square of each ray."""
        low, high = begin + np.arange(128)[:, None] * pitch, begin + (np.arange(128)[:, None] + 1) * pitch
        return np.clip(np.minimum(high, low_edges + fine) - np.maximum(low, low_edges), 0, None) / pitch

    columns, rows = shares(xs - fine / 2, west), shares(-ys - fine / 2, -north)
    expected = np.rint(np.einsum("ri,ijc,kj->crk", rows, seen, columns, optimize=True))
    spots = (np.arange(128 * 4) + 0.5) * pitch / 4
    points = np.stack(np.meshgrid(west + spots, north - spots), axis=-1) - factors["agent"]
    for color, polygon in MARKERS[marker]:
        share = in_polygon(points, polygon, factors["heading"]).reshape(128, 4, 128, 4).mean(axis=(1, 3))
        expected[:3] = expected[:3] * (1 - share) + np.array(color)[:, None, None] * share
        assert share.sum() * pitch**2 > 0.015, "the agent is in view"
    wrong = (np.abs(observation - expected) > 1).any(axis=0)
    assert wrong.mean() <= 0.001


def test_area_means():
    """Against a plain loop over overlaps."""
    channel, ratio = np.random.default_rng(0).random((7, 10)), 2.3
    means = area_means(channel, ratio)
    assert means.shape == (4, 5)
    for (i, j), value in np.ndenumerate(means):
        total = 0.0
        for (r, c), color in np.ndenumerate(channel):
            rows = min((i + 1) * ratio, r + 1) - max(i * ratio, r)
            columns = min((j + 1) * ratio, c + 1) - max(j * ratio, c)
            total += color * max(rows, 0) * max(columns, 0)
        assert value == pytest.approx(total / ratio**2)


@pytest.mark.parametrize(("marker", "repeats"), [("arrow", False), ("box", True)])
def test_the_arrow_shows_the_heading(room, marker, repeats):
    env = ScanNavEnv(scenes=room, marker=marker)
    observations = [start_at(env, (3.0, 3.0), (4.0, 3.0), heading)[0] for heading in (0, 90, 180, 10)]
    assert np.array_equal(observations[0], observations[1]) == repeats
    assert np.array_equal(observations[0], observations[2]) == repeats
    changed = (observations[0] != observations[3]).any(axis=0).sum()
    assert 2 <= changed <= 60
    assert np.array_equal(observations[0][3], observations[1][3]), "depth has no marker"


def test_north_is_up_and_the_goal_in_the_middle(room):
    env = ScanNavEnv(scenes=room)
    start, goal = (4.0, 4.0), (4.0, 3.0)
    observation, other = (start_at(env, start, goal, heading)[0] for heading in (0, 180))
    rows, columns = np.nonzero((observation != other).any(axis=0))
    placed = env.factors()["goal"]
    assert np.abs(placed - goal).max() <= 6 / 128
    expected = 64 + (np.array(start) - placed) * (128 / 6, -128 / 6)
    assert (columns.mean(), rows.mean()) == pytest.approx(tuple(expected), abs=1.5)


def test_no_marker_is_larger_than_the_border_allows():
    corners = [corner for parts in MARKERS.values() for _, polygon in parts for corner in polygon]
    assert max(np.hypot(*corner) for corner in corners) <= MARKER_RADIUS


def test_the_marker_is_part_of_the_content_hash(room, monkeypatch):
    """Datasets of states render observations later: another marker would give other observations."""
    kwargs = {"scenes": room, "goals_per_scene": 1}
    arrow, box = (ScanNavVectorEnv(marker=marker, **kwargs).content_hash for marker in ("arrow", "box"))
    assert arrow != box == ScanNavVectorEnv(marker="box", **kwargs).content_hash
    monkeypatch.setitem(MARKERS, "arrow", MARKERS["box"])
    assert ScanNavVectorEnv(**kwargs).content_hash == box
