"""Triangles cover a polygon's area: against a test of points by counting crossings, written anew here."""

import numpy as np
import pytest
from scan_inputs import empty_cache  # noqa: F401

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.polygons import PolygonError, fan, strip, triangulate

L = [(0, 0), (6, 0), (6, 2), (2, 2), (2, 6), (0, 6)]  # 20 m2
ARROW = [(0, 0), (6, 3), (0, 6), (2, 3)]  # 12 m2
# A wall with a door that touches its lower edge; a floor with a hole, joined to its outline by an edge there and back.
DOOR = [(0, 0), (2, 0), (2, 2), (3, 2), (3, 0), (6, 0), (6, 3), (0, 3)]
HOLE = [(0, 0), (6, 0), (6, 6), (0, 6), (0, 0), (2, 2), (2, 4), (4, 4), (4, 2), (2, 2)]
STAR = [(3 + r * np.cos(a), 3 + r * np.sin(a)) for r, a in zip([3, 1] * 7, np.arange(14) * np.pi / 7, strict=True)]


def inside(points, polygon):
    """Whether points are inside: a ray to the right crosses the outline an odd number of times."""
    odd = np.zeros(len(points), dtype=bool)
    for (x0, y0), (x1, y1) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        if y0 == y1:
            continue
        crosses = (points[:, 1] < y0) != (points[:, 1] < y1)
        odd ^= crosses & (points[:, 0] < x0 + (points[:, 1] - y0) * (x1 - x0) / (y1 - y0))
    return odd


def times_covered(points, corners, triangles):
    a, b, c = (corners[triangles[:, k]][:, None] for k in range(3))
    sides = []
    for p, q in ((a, b), (b, c), (c, a)):
        along, away = q - p, points - p
        sides.append(along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0])
    return (np.all(np.array(sides) > 0, axis=0) | np.all(np.array(sides) < 0, axis=0)).sum(axis=0)


@pytest.mark.parametrize("polygon", [L, ARROW, DOOR, HOLE, STAR], ids=["L", "arrow", "door", "hole", "star"])
@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("backwards", [False, True])
def test_triangles_cover_a_polygon_once(polygon, first, backwards):
    polygon = polygon[first:] + polygon[:first] if polygon is not HOLE else polygon
    polygon = polygon[::-1] if backwards else polygon
    flat = np.array(polygon, dtype=float)
    turn = np.linalg.qr(np.random.default_rng(first).standard_normal((3, 3)))[0]  # somewhere in space
    triangles, owners = triangulate(np.column_stack([flat, np.zeros(len(flat))]) @ turn.T, np.array([len(flat)]))
    points = np.random.default_rng(1).uniform(-0.5, 6.5, (2000, 2))
    assert np.array_equal(times_covered(points, flat, triangles), inside(points, polygon).astype(int))
    edges = flat[triangles]
    ab, ac = edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0]
    assert ((ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0] < 0) == backwards).all(), "they show the same side"
    assert (owners == 0).all()


def random_polygon(rng, n):
    """Corners around a middle, further and nearer: never crossing itself, mostly not convex."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, n))
    radii = rng.uniform(0.5, 3, n)
    return [(3 + r * np.cos(a), 3 + r * np.sin(a)) for r, a in zip(radii, angles, strict=True)]


def gaps(polygon):
    angles = [np.arctan2(y - 3, x - 3) for x, y in polygon]
    return np.diff(angles + angles[:1]) % (2 * np.pi)


def test_random_polygons_in_one_call():
    rng = np.random.default_rng(0)
    polygons = [random_polygon(rng, int(n)) for n in rng.integers(3, 12, 60)]
    # A gap of more than half a turn would leave the middle outside.
    polygons = [p for p in polygons if all(0 < gap < 3 for gap in gaps(p))]
    corners = np.concatenate([np.array(p) for p in polygons])
    triangles, owners = triangulate(np.column_stack([corners, np.zeros(len(corners))]), np.array([*map(len, polygons)]))
    points = rng.uniform(0, 6, (500, 2))
    for k, polygon in enumerate(polygons):
        assert np.array_equal(times_covered(points, corners, triangles[owners == k]), inside(points, polygon))


@pytest.mark.parametrize(
    "polygon", [[(0, 0), (6, 6), (6, 0), (0, 6)], [(0, 0), (6, 0), (0, 6), (6, 6), (3, 9)]], ids=["bow", "crossed"]
)
def test_a_polygon_that_crosses_itself_is_refused(polygon):
    with pytest.raises(PolygonError, match="face 0 crosses itself; triangulate it before export"):
        triangulate(np.array([(*p, 0.0) for p in polygon]), np.array([len(polygon)]))


def test_a_polygon_of_many_corners_is_bounded():
    n = 2001
    angles = np.arange(n) * 2 * np.pi / n
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], axis=1)
    assert len(triangulate(circle, np.array([n]))[0]) == n - 2
    circle[5] *= 0.5
    with pytest.raises(PolygonError, match="face 0 of 2001 corners is not convex; triangulate it before export"):
        triangulate(circle, np.array([n]))


def test_strips_and_fans():
    corners = np.array([5, 6, 7, 8, 9])
    assert strip(corners).tolist() == [[5, 6, 7], [6, 8, 7], [7, 8, 9]]
    assert fan(corners).tolist() == [[5, 6, 7], [5, 7, 8], [5, 8, 9]]
    assert strip(corners[:2]).shape == fan(corners[:2]).shape == (0, 3)


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_a_floor_that_is_not_convex_keeps_its_area(tmp_path, suffix, first):
    corners, path = L[first:] + L[:first], tmp_path / f"l{suffix}"
    if suffix == ".obj":
        path.write_text("".join(f"v {x} {y} 0 .8 .2 .2\n" for x, y in corners) + "f 1 2 3 4 5 6\n")
    else:
        names = [*(f"property float {n}" for n in "xyz"), *(f"property uchar {n}" for n in ("red", "green", "blue"))]
        head = ["ply", "format ascii 1.0", "element vertex 6", *names, "element face 1"]
        head += ["property list uchar int vertex_indices", "end_header"]
        path.write_text("\n".join(head + [f"{x} {y} 0 200 40 40" for x, y in corners] + ["6 0 1 2 3 4 5"]) + "\n")
    scan = ScanMap.from_mesh(path, cache=False)
    assert np.isfinite(scan.height).sum() * scan.meters_per_pixel**2 == pytest.approx(20, rel=0.01)


def test_a_crossed_face_names_the_file(tmp_path):
    (tmp_path / "bow.obj").write_text("v 0 0 0 1 0 0\nv 6 6 0 1 0 0\nv 6 0 0 1 0 0\nv 0 6 0 1 0 0\nf 1 2 3 4\n")
    with pytest.raises(SceneError, match=r"bow.obj: face 0 crosses itself"):
        ScanMap.from_mesh(tmp_path / "bow.obj")
