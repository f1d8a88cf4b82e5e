"""Observations of ScanNav: parts of a map, with the agent rendered on them."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap

MAX_VIEW_PIXELS = 16_000_000  # of a whole scene
# Columns that are averaged together, and what is no part of another pixel.
_BLOCK, _ROUNDING = 256, 1e-9
CAMERA_HEIGHT = 3.0  # m above the floor
MAX_DEPTH = 10.0  # m, Habitat's
YELLOW, MAGENTA = (255, 214, 0), (255, 0, 200)
_OCTAGON = tuple((0.13 * math.cos(a), 0.13 * math.sin(a)) for a in (math.pi * (k + 0.5) / 4 for k in range(8)))
# The agent's marker: convex parts, a later one over an earlier. Of each its color and its corners in m, ahead of the
# agent's center and to its left, counter-clockwise. The body of the arrow is as good as round, its nose has another
# color. Which way a plain triangle turns can be seen from its direction modulo 120 degrees: inverse dynamics had no use
# for more, and agents on such encoders did not know front from back (docs/scan_nav.md).
MARKERS: dict[str, tuple[tuple[tuple[int, int, int], tuple[tuple[float, float], ...]], ...]] = {
    "arrow": ((YELLOW, _OCTAGON), (MAGENTA, ((0.24, 0.06), (0.1, 0.06), (0.1, -0.06), (0.24, -0.06)))),
    "box": ((YELLOW, ((0.14, 0.14), (-0.14, 0.14), (-0.14, -0.14), (0.14, -0.14))),),
}
MARKER_RADIUS = 0.25  # m, no marker is larger
# A pixel's share of the marker is counted on this many points per side.
SAMPLES = 4


class SceneView:
    """A map at the scale of the observations, with a border as wide as half a view around it.

    Each pixel has the area-weighted mean of the map's colors and depths under it; what lies beyond the map is a hole.

    :param scan: the map
    :param image_size: pixels of a view per side, even
    :param view_size: meters of a view per side
    """

    def __init__(self, scan: ScanMap, image_size: int, view_size: float) -> None:
        self.pitch = view_size / image_size
        self.image_size = image_size
        n_pixels = math.prod(n * scan.meters_per_pixel / self.pitch + image_size + 1 for n in scan.walkable.shape)
        if n_pixels > MAX_VIEW_PIXELS:
            raise SceneError(
                f"{scan.source} at {self.pitch:.3g} m per pixel has {n_pixels:.3g} pixels, more than "
                f"{MAX_VIEW_PIXELS}; lower image_size, raise view_size, or check the map's meters_per_pixel"
            )
        ratio, border = self.pitch / scan.meters_per_pixel, image_size // 2
        shape = [math.ceil(n / ratio - _ROUNDING) + 2 * border for n in scan.walkable.shape]
        # uint8 (4, ...): red, green, blue, depth in 255 parts of the camera's height.
        self.rgbd = np.zeros((4, *shape), np.uint8)
        # float32, Habitat's depth: meters / MAX_DEPTH.
        self.depth = np.zeros(shape, np.float32)
        inner = slice(border, shape[0] - border), slice(border, shape[1] - border)
        # One at a time: a large map leaves no memory for all of them.
        for index, channel in enumerate(np.moveaxis(scan.orthophoto, -1, 0)):
            self.rgbd[index][inner] = np.rint(area_means(channel, ratio))
        surface, above = ~np.isnan(scan.height), np.nan_to_num(scan.height)
        nearness = np.where(surface, np.clip((CAMERA_HEIGHT - above) / CAMERA_HEIGHT, 0, 1), 0)
        self.rgbd[3][inner] = np.rint(area_means(255 * nearness, ratio))
        del nearness
        meters = np.where(surface, np.clip(CAMERA_HEIGHT - above, 0, MAX_DEPTH) / MAX_DEPTH, 0)
        self.depth[inner] = area_means(meters, ratio)


def area_means(channel: NDArray[Any], ratio: float) -> NDArray[np.float64]:
    """Means over squares of ``ratio`` x ``ratio`` pixels, which need not be a whole number; beyond the channel is 0.

    :param channel: numbers, (height, width)
    :param ratio: size of a square, in pixels
    :return: (ceil(height / ratio), ceil(width / ratio))
    """
    for _ in range(2):
        blocks = [channel[:, k : k + _BLOCK] for k in range(0, channel.shape[1], _BLOCK)]
        channel = np.concatenate([_means_of_columns(block, ratio) for block in blocks], axis=1).T
    return channel


def _means_of_columns(channel: NDArray[Any], ratio: float) -> NDArray[np.float64]:
    total = np.pad(np.cumsum(channel, axis=0, dtype=np.float64), ((1, 1), (0, 0)), mode="edge")
    total[0] = 0
    n = len(channel)
    edges = np.minimum(np.arange(math.ceil(n / ratio - _ROUNDING) + 1) * ratio, n)
    whole = edges.astype(np.int64)
    at_edges = total[whole] + (edges - whole)[:, None] * (total[whole + 1] - total[whole])
    means: NDArray[np.float64] = np.diff(at_edges, axis=0) / ratio
    return means


class MarkerPainter:
    """Renders the agent, convex polygons that turn with it, into the colors of observations.

    :param marker: a key of :data:`MARKERS`
    :param image_size: of the observations
    :param pitch: meters per pixel
    """

    def __init__(self, marker: str, image_size: int, pitch: float) -> None:
        self._parts = [_PartPainter(color, corners, image_size, pitch) for color, corners in MARKERS[marker]]

    def render(
        self, observations: NDArray[np.uint8], centers: NDArray[np.float64], headings: NDArray[np.float64]
    ) -> None:
        """Render one marker into each observation, in place.

        :param observations: contiguous, (n, 3 or more, image_size, image_size); the first three channels change
        :param centers: (column, row) in pixels, at least the marker's radius and two pixels from the border
        :param headings: in degrees, 0 is up and 90 is left
        """
        for part in self._parts:
            part.render(observations, centers, headings)


class _PartPainter:
    def __init__(
        self, color: tuple[int, int, int], corners_in_m: tuple[tuple[float, float], ...], image_size: int, pitch: float
    ) -> None:
        corners = np.array(corners_in_m) / pitch
        following = np.roll(corners, -1, axis=0)
        along = following - corners
        # A point p is inside where each normal . p + offset is positive.
        self._normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
        self._offsets = -(self._normals * corners).sum(axis=1)[:, None]
        self._radius = float(np.hypot(*corners.T).max())
        self._size = int(np.ceil(2 * self._radius)) + 1
        self._image_size = image_size
        self._points = (np.arange(self._size * SAMPLES) + 0.5) / SAMPLES
        steps = np.arange(self._size)[:, None] * image_size + np.arange(self._size)
        self._where = np.arange(3)[:, None, None] * image_size**2 + steps
        self._color = np.array(color, dtype=np.uint32)[:, None, None]

    def render(
        self, observations: NDArray[np.uint8], centers: NDArray[np.float64], headings: NDArray[np.float64]
    ) -> None:
        corner = np.floor(centers - self._radius).astype(np.int64)
        points = corner[:, :, None] + self._points - centers[:, :, None]
        angle = np.deg2rad(headings)[:, None]
        ahead, left = self._normals.T
        # Ahead is (-sin, -cos) in columns and rows, left is (-cos, sin).
        per_column = -np.sin(angle) * ahead - np.cos(angle) * left
        per_row = -np.cos(angle) * ahead + np.sin(angle) * left
        across = (per_column[:, :, None] * points[:, None, 0]).astype(np.float32)
        down = (per_row[:, :, None] * points[:, None, 1] + self._offsets).astype(np.float32)
        inside = across[:, 0, None, :] >= -down[:, 0, :, None]
        for k in range(1, len(self._offsets)):
            inside &= across[:, k, None, :] >= -down[:, k, :, None]
        share = _count_samples(inside)
        starts = corner[:, 1] * self._image_size + corner[:, 0] + np.arange(len(observations)) * observations[0].size
        flat = observations.reshape(-1)
        where = starts[:, None, None, None] + self._where
        below, share, whole = flat[where].astype(np.uint32), share[:, None], SAMPLES**2
        flat[where] = (below * (whole - share) + self._color * share + whole // 2) // whole


def _count_samples(inside: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """How many of the 4 x 4 points of each pixel are true: (n, 4 h, 4 w) to (n, h, w)."""
    # Four neighboring bytes are one number; its bytes are added up by the multiplication, in the topmost one.
    words = inside.view(np.uint32)
    rows = words[:, 0::4] + words[:, 1::4] + words[:, 2::4] + words[:, 3::4]
    counts: NDArray[np.uint32] = (rows * np.uint32(0x01010101)) >> np.uint32(24)
    return counts
