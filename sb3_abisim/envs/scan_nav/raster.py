"""Triangles on a grid of pixels, seen from straight above.

Pixel (row r, column c) has its center at (c + 0.5, r + 0.5). A triangle covers the centers inside it; of two that
share an edge exactly one covers a center on it, because both compute the edge's crossing with a row alike.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.surfaces import Surface, colors_at, see_through, solid_at

# Rows of triangles, and pixels, that are worked on at a time: bounds memory.
_CHUNK = 1_000_000

Fragments = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]


def _chunks(counts: NDArray[np.int64]) -> Iterator[slice]:
    """Consecutive runs whose counts add up to about ``_CHUNK``."""
    total = np.cumsum(counts)
    begin = 0
    while begin < len(counts):
        done = total[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(total, done + _CHUNK, side="right")))
        yield slice(begin, end)
        begin = end


def _expand(counts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For counts (2, 0, 3): owners (0, 0, 2, 2, 2) and positions (0, 1, 0, 1, 2)."""
    owners = np.repeat(np.arange(len(counts)), counts)
    return owners, np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)


def fragments(corners: NDArray[np.float64], height: int, width: int) -> Iterator[Fragments]:
    """The pixels whose centers the triangles cover.

    :param corners: of each triangle, (m, 3, 3): column and row in pixels, height in any unit
    :param height: of the grid, in pixels
    :param width: of the grid, in pixels
    :return: runs of (triangle, pixel as row * width + column, height of the triangle there)
    """
    order = np.argsort(corners[..., 1], axis=1, kind="stable")
    tri = np.take_along_axis(corners, order[..., None], axis=1)
    first = np.clip(np.ceil(tri[:, 0, 1] - 0.5), 0, height).astype(np.int64)
    n_rows = np.clip(np.ceil(tri[:, 2, 1] - 0.5), 0, height).astype(np.int64) - first
    edge, other = tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]
    determinant = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_x = (edge[:, 2] * other[:, 1] - edge[:, 1] * other[:, 2]) / determinant
        slope_y = (edge[:, 0] * other[:, 2] - edge[:, 2] * other[:, 0]) / determinant
    lowest, highest = tri[..., 2].min(axis=1), tri[..., 2].max(axis=1)
    visible = np.flatnonzero((n_rows > 0) & (determinant != 0))
    for run in _chunks(n_rows[visible]):
        owners, row = _expand(n_rows[visible[run]])
        face = visible[run][owners]
        row += first[face]
        y = np.asarray(row + 0.5, dtype=np.float64)
        a, b, c = tri[face, 0], tri[face, 1], tri[face, 2]
        upper = (y < b[:, 1])[:, None]
        sides = np.sort([_crossing(a, c, y), _crossing(np.where(upper, a, b), np.where(upper, b, c), y)], axis=0)
        begin, end = np.clip(np.ceil(sides - 0.5), 0, width).astype(np.int64)
        for part in _chunks(end - begin):
            owners, column = _expand((end - begin)[part])
            f, r = face[part][owners], row[part][owners]
            column += begin[part][owners]
            z = tri[f, 0, 2] + slope_x[f] * (column + 0.5 - tri[f, 0, 0]) + slope_y[f] * (r + 0.5 - tri[f, 0, 1])
            # Steep triangles would leave their corners by rounding.
            yield f, r * width + column, np.clip(z, lowest[f], highest[f]).astype(np.float32)


def _crossing(a: NDArray[np.float64], b: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    x: NDArray[np.float64] = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    return x


class Nearest:
    """The lowest (or highest) of all fragments at each pixel, and its triangle.

    :param n_pixels: of the grid
    :param highest: keep the highest instead of the lowest
    """

    def __init__(self, n_pixels: int, highest: bool = False) -> None:
        self._keep = np.maximum if highest else np.minimum
        self.height = np.full(n_pixels, -np.inf if highest else np.inf, dtype=np.float32)
        self.face = np.full(n_pixels, -1, dtype=np.int32)

    def add(self, face: NDArray[np.int64], pixel: NDArray[np.int64], z: NDArray[np.float32]) -> None:
        """Take in fragments; of equally high ones the last is kept.

        :param face: triangle of each
        :param pixel: pixel of each
        :param z: height of each
        """
        self._keep.at(self.height, pixel, z)
        won = self.height[pixel] == z
        self.face[pixel[won]] = face[won]


def shade(
    corners: NDArray[np.float64],
    surfaces: tuple[Surface, ...],
    face: NDArray[np.int64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """The colors of points on triangles.

    :param corners: of all triangles, (m, 3, 3); only the first two coordinates are read
    :param surfaces: their coloring, in their order
    :param face: triangle of each point, (n,)
    :param x: first coordinate of each point
    :param y: second coordinate of each point
    :return: (n, 3), RGB
    """
    return colors_at(surfaces, face, corner_weights(corners, face, x, y))


def corner_weights(
    corners: NDArray[np.float64], face: NDArray[np.int64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How much each corner of a triangle counts at a point on it, (n, 3).

    :param corners: of all triangles, (m, 3, 3); only the first two coordinates are read
    :param face: triangle of each point, (n,)
    :param x: first coordinate of each point
    :param y: second coordinate of each point
    """
    a, b, c = corners[face, 0, :2], corners[face, 1, :2], corners[face, 2, :2]
    ab, ac, ap = b - a, c - a, np.stack([x, y], axis=1) - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    beta = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
    gamma = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
    weights: NDArray[np.float64] = np.clip(np.stack([1 - beta - gamma, beta, gamma], axis=1), 0, 1)
    return weights


def contour_pixels(corners: NDArray[np.float64], level: float, height: int, width: int) -> NDArray[np.int64]:
    """The pixels that the triangles' cut with a horizontal plane passes through, to half a pixel.

    :param corners: as for :func:`fragments`
    :param level: height of the plane
    :param height: of the grid, in pixels
    :param width: of the grid, in pixels
    :return: pixels as row * width + column, some of them several times
    """
    cells = [rows * width + columns for _, columns, rows, _ in _contour(corners[..., :3], level, height, width)]
    return np.concatenate(cells) if cells else np.zeros(0, dtype=np.int64)


def solid_contour_pixels(
    corners: NDArray[np.float64], surfaces: tuple[Surface, ...], level: float, height: int, width: int
) -> NDArray[np.int64]:
    """As :func:`contour_pixels`, without those of faces that one sees through there.

    :param corners: as for :func:`fragments`
    :param surfaces: the triangles' coloring, in their order
    :param level: height of the plane
    :param height: of the grid, in pixels
    :param width: of the grid, in pixels
    """
    clear = see_through(surfaces)
    if not clear.any():
        return contour_pixels(corners, level, height, width)
    cells = [contour_pixels(corners[~clear], level, height, width)]
    faces = np.flatnonzero(clear)
    # The corners' weights are carried along like coordinates.
    weighted = np.concatenate([corners[faces], np.broadcast_to(np.eye(3), (len(faces), 3, 3))], axis=2)
    for face, columns, rows, weights in _contour(weighted, level, height, width):
        solid = solid_at(surfaces, faces[face], weights)
        cells.append((rows * width + columns)[solid])
    return np.concatenate(cells)


def _contour(
    corners: NDArray[np.float64], level: float, height: int, width: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]:
    """Face, column and row of points on the cut, and what the corners carry behind their three coordinates there."""
    above = corners[..., 2] > level
    cut = np.flatnonzero(above.any(axis=1) & ~above.all(axis=1))
    tri = corners[cut]
    after = np.roll(tri, -1, axis=1)
    crosses = (tri[..., 2] > level) != (after[..., 2] > level)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (level - tri[..., 2]) / (after[..., 2] - tri[..., 2])
        points = tri + share[..., None] * (after - tri)
    # Exactly two edges of each triangle cross the plane.
    ends = points[crosses].reshape(-1, 2, corners.shape[2])
    # The parts outside the grid are clipped below; this bounds their number.
    n = np.ceil(np.abs(ends[:, 1, :2] - ends[:, 0, :2]).max(axis=1, initial=0) * 2).astype(np.int64) + 1
    for run in _chunks(n):
        owner, position = _expand(n[run])
        t = position / np.maximum(n[run][owner] - 1, 1)
        there = ends[run][owner, 0] + t[:, None] * (ends[run][owner, 1] - ends[run][owner, 0])
        cells = np.floor(there[:, :2]).astype(np.int64)
        inside = (cells >= 0).all(axis=1) & (cells < (width, height)).all(axis=1)
        yield cut[run][owner[inside]], cells[inside, 0], cells[inside, 1], there[inside, 3:]


def solid_fragments(
    corners: NDArray[np.float64], surfaces: tuple[Surface, ...], height: int, width: int
) -> Iterator[Fragments]:
    """As :func:`fragments`, without those that one sees through.

    :param corners: as for :func:`fragments`
    :param surfaces: the triangles' coloring, in their order
    :param height: of the grid, in pixels
    :param width: of the grid, in pixels
    """
    clear = see_through(surfaces)
    for face, pixel, z in fragments(corners, height, width):
        if clear.any() and (asked := np.flatnonzero(clear[face])).size:
            row, column = np.divmod(pixel[asked], width)
            weights = corner_weights(corners, face[asked], column + 0.5, row + 0.5)
            kept = np.ones(len(face), dtype=bool)
            kept[asked] = solid_at(surfaces, face[asked], weights)
            face, pixel, z = face[kept], pixel[kept], z[kept]
        yield face, pixel, z
