"""Faces of any number of corners as triangles that cover their area, no more and no less."""

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import SceneError

# Corners of one face that is not convex, and the sum of their squares over all: cutting off ears takes that long.
MAX_CORNERS = 1000
MAX_WORK = 20_000_000
_FLAT = 1e-9  # a turn of this share of a polygon's squared size is none


class PolygonError(SceneError):
    """A face that has no inside, such as one that crosses itself."""


def strip(indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """The triangles of a strip: every further corner makes one with the two before it.

    :param indices: (n,)
    :return: (n - 2, 3), all of them turning the same way
    """
    n = max(len(indices) - 2, 0)
    k = np.arange(n)
    odd = k % 2
    return indices[np.stack([k, k + 1 + odd, k + 2 - odd], axis=1)] if n else np.zeros((0, 3), dtype=np.int64)


def fan(indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """The triangles of a fan around its first corner.

    :param indices: (n,)
    :return: (n - 2, 3)
    """
    n = max(len(indices) - 2, 0)
    k = np.arange(n)
    return indices[np.stack([np.zeros_like(k), k + 1, k + 2], axis=1)] if n else np.zeros((0, 3), dtype=np.int64)


def triangulate(points: NDArray[np.float64], lengths: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cut faces into triangles.

    :param points: of all corners of all faces, one after the other, (n, 3)
    :param lengths: number of corners of each face; faces of less than three have no triangle
    :return: the triangles' corners as indices into ``points``, (m, 3), and the face that each belongs to, (m,)
    :raises PolygonError: for a face that crosses itself, or has too many corners
    """
    starts = np.cumsum(lengths) - lengths
    three, four, more = (np.flatnonzero(k) for k in (lengths == 3, lengths == 4, lengths > 4))
    corners = [starts[three][:, None] + np.arange(3)]
    owners = [three]
    if len(four):
        quads = starts[four][:, None] + np.arange(4)
        # A corner that points inwards decides which diagonal lies inside.
        quads = np.where(_points_inwards(points[quads], four)[:, None], np.roll(quads, -1, axis=1), quads)
        corners += [quads[:, [0, 1, 2]], quads[:, [2, 3, 0]]]
        owners += [four, four]
    work = 0
    for face in more.tolist():
        own = np.arange(starts[face], starts[face] + lengths[face])
        flat = _flattened(points[own])
        if _is_convex(flat):
            triangles = fan(own)
        else:
            work += len(own) ** 2
            if len(own) > MAX_CORNERS or work > MAX_WORK:
                raise PolygonError(f"face {face} of {len(own)} corners is not convex; triangulate it before export")
            triangles = own[_cut_ears(flat, face)]
        corners.append(triangles)
        owners.append(np.full(len(triangles), face))
    return np.concatenate(corners), np.concatenate(owners)


def _points_inwards(quads: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether the second or the fourth corner of each quadrangle points inwards, (n,)."""
    normals = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    before, after = quads - np.roll(quads, 1, axis=1), np.roll(quads, -1, axis=1) - quads
    crosses = np.cross(before, after)
    turns, size = np.einsum("nkd,nd->nk", crosses, normals), np.linalg.norm(crosses, axis=2).max(axis=1)
    # Both halves of a bow may be of one size, which leaves no area in all.
    canceled = np.linalg.norm(normals, axis=1) <= 1e-6 * size
    inwards = turns < -_FLAT * (normals**2).sum(axis=1, keepdims=True)
    crossed = np.flatnonzero(
        (inwards[:, 0] | inwards[:, 2]) & (inwards[:, 1] | inwards[:, 3]) | (canceled & (size > 1e-12))
    )
    if len(crossed):
        raise PolygonError(f"face {faces[crossed[0]]} crosses itself; triangulate it before export")
    result: NDArray[np.bool_] = inwards[:, 1] | inwards[:, 3]
    return result


def _flattened(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A polygon in the plane that it lies in, counter-clockwise, (n, 2), about 1 in size."""
    points = points - points.mean(axis=0)
    points = points / max(abs(points).max(), 1e-300)
    following = np.roll(points, -1, axis=0)
    normal = np.cross(points, following).sum(axis=0)  # Newell's
    length = np.linalg.norm(normal)
    if length < 1e-12:
        return np.zeros((len(points), 2))
    normal /= length
    along = np.zeros(3)
    along[np.argmin(abs(normal))] = 1.0
    right = np.cross(along, normal)
    right /= np.linalg.norm(right)
    return np.stack([points @ right, points @ np.cross(normal, right)], axis=1)


def _turns(points: NDArray[np.float64]) -> NDArray[np.float64]:
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    turns: NDArray[np.float64] = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return turns


def _is_convex(points: NDArray[np.float64]) -> bool:
    """Whether all corners turn left, and once around in all. A polygon without area counts as convex."""
    if not points.any():
        return True
    turns = _turns(points)
    if (turns < -_FLAT).any():
        return False
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    angles = np.arctan2(turns, (before * after).sum(axis=1))
    return bool(abs(angles.sum() - 2 * np.pi) < 0.1)


def _cut_ears(points: NDArray[np.float64], face: int) -> NDArray[np.int64]:
    """Triangles of a polygon that is not convex, by cutting off one corner after another that holds no other."""
    if _crosses_itself(points):
        raise PolygonError(f"face {face} crosses itself; triangulate it before export")
    left, triangles = list(range(len(points))), []
    while len(left) > 2:
        ear = _find_ear(points[left])
        if ear is None:
            raise PolygonError(f"face {face} has no inside that can be found; triangulate it before export")
        n, flat = ear
        if not flat:
            triangles.append((left[n - 1], left[n], left[(n + 1) % len(left)]))
        left.pop(n)
    corners = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    covered, area = _areas(points[corners]).sum(), _area(points)
    if abs(covered - area) > 1e-6 * area:
        raise PolygonError(f"face {face} has no inside that can be found; triangulate it before export")
    return corners


def _areas(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas: NDArray[np.float64] = abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    return areas


def _area(points: NDArray[np.float64]) -> float:
    following = np.roll(points, -1, axis=0)
    return float((points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum() / 2)


def _find_ear(points: NDArray[np.float64]) -> tuple[int, bool] | None:
    """A corner that can be cut off, and whether it has no area."""
    turns = _turns(points)
    flat = np.flatnonzero(abs(turns) <= _FLAT)
    if len(flat):
        return int(flat[0]), True
    reflex = points[turns < 0]
    for n in np.flatnonzero(turns > 0).tolist():
        a, b, c = points[n - 1], points[n], points[(n + 1) % len(points)]
        # A hole is joined to the outline by an edge there and back: its corners appear twice.
        others = reflex[~((reflex == a).all(axis=1) | (reflex == b).all(axis=1) | (reflex == c).all(axis=1))]
        if not _within(others, a, b, c).any():
            return n, False
    return None


def _within(
    points: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.bool_]:
    inside = np.ones(len(points), dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        along, away = end - start, points - start
        inside &= along[0] * away[:, 1] - along[1] * away[:, 0] >= -_FLAT
    return inside


def _crosses_itself(points: NDArray[np.float64]) -> bool:
    """Whether two edges cross within both."""
    ends = np.roll(points, -1, axis=0)
    along = ends - points

    def side(of: NDArray[np.float64]) -> NDArray[np.float64]:
        """On which side of each edge (rows) points lie (columns)."""
        away = of[None] - points[:, None]
        return np.asarray(along[:, None, 0] * away[..., 1] - along[:, None, 1] * away[..., 0])

    starts, finishes = side(points), side(ends)
    apart = ((starts > _FLAT) & (finishes < -_FLAT)) | ((starts < -_FLAT) & (finishes > _FLAT))
    return bool((apart & apart.T).any())
