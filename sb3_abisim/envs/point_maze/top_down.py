"""A small rasterizer for mazes seen from straight above, without GL.

An observation is the static layer of an episode (floor, walls, obstacles, goal; every edge lies on the pixel grid) plus
the agent, a disc whose pixels are mixed in proportion to the area it covers of them. The mixing is integer arithmetic
on a table of coverages, so the same state gives the same bytes in a batch and alone.

Observations are uint8, channels first, RGB. Pixel coordinates are (column, row) as real numbers: (0, 0) is the top left
corner and pixel (row r, column c) is the square [c, c + 1) x [r, r + 1).
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

IMAGE_SIZE = 64
AGENT_RADIUS = 0.3  # m
# Directions of the discrete actions as observed, x to the right and y down; in Nav2D's order.
DIRECTIONS = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)], dtype=np.float64)

FLOOR = (226, 226, 220)
WALL = (78, 78, 84)
OBSTACLE = (38, 44, 64)
GOAL = (40, 170, 70)
AGENT = (220, 40, 40)

# Positions within a pixel are rounded to 1/128 of it: at most two gray levels between neighboring ones.
_SUBPIXEL_BITS = 7
SUBPIXELS = 1 << _SUBPIXEL_BITS
_PART_WEIGHTS = np.array((1, SUBPIXELS))


def disc_coverage(center: NDArray[np.float64], radius: float, size: int) -> NDArray[np.float64]:
    """The exact share of each pixel that a disc covers.

    :param center: (column, row) of the disc's center in pixels, shape (..., 2)
    :param radius: in pixels, above 0
    :param size: the coverage is computed for the pixels of rows and columns 0 to ``size`` - 1
    :return: shape (..., size, size), indexed [row, column], 0..1
    """
    edges = np.arange(size + 1, dtype=np.float64)
    x = np.clip(edges - center[..., 0, None], -radius, radius)[..., None, :]
    y = np.clip(edges - center[..., 1, None], -radius, radius)[..., :, None]
    full = np.pi * radius**2
    left, above = _area_below(x, radius), _area_below(y, radius)
    # Area of the part of the disc with abscissa up to x and ordinate up to y.
    inside = (left + above) / 2 + x * y - full / 4
    outside = np.where(x < 0, np.where(y < 0, 0.0, left), np.where(y < 0, above, left + above - full))
    corner = np.where(x**2 + y**2 < radius**2, inside, outside)
    return np.clip(np.diff(np.diff(corner, axis=-1), axis=-2), 0.0, 1.0)


def _area_below(x: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Area of the part of a centered disc with abscissa up to ``x``, for x within the radius."""
    area: NDArray[np.float64] = x * np.sqrt(radius**2 - x**2) + radius**2 * (np.arcsin(x / radius) + np.pi / 2)
    return area


@cache
def _alpha_table(radius: float) -> NDArray[np.uint8]:
    """Coverage 0..255 of the patch around a disc for every position of its top left corner within a pixel.

    :return: shape (SUBPIXELS * SUBPIXELS, patch * patch), the first index is row position * SUBPIXELS + column position
    """
    patch = _patch_size(radius)
    offsets = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS + radius
    rows, columns = np.meshgrid(offsets, offsets, indexing="ij")
    table = np.rint(disc_coverage(np.stack([columns, rows], axis=-1), radius, patch) * 255).astype(np.uint8)
    table = table.reshape(SUBPIXELS**2, patch**2)
    table.flags.writeable = False
    return table


def _patch_size(radius: float) -> int:
    return int(np.floor(2 * radius)) + 2


class DiscPainter:
    """Renders one antialiased disc into each observation of a batch.

    :param radius: in pixels
    :param size: height and width of the observations, in pixels
    :param color: RGB, 0..255
    """

    def __init__(self, radius: float, size: int, color: tuple[int, int, int] = AGENT) -> None:
        self.radius = radius
        self.size = size
        self._alphas = _alpha_table(radius)
        patch = _patch_size(radius)
        self._limit = (size - patch + 1) << _SUBPIXEL_BITS
        self._weights = np.array((1, size))
        self._steps = (np.arange(patch)[:, None] * size + np.arange(patch)).reshape(-1)
        self._channels = np.arange(3)[:, None] * size**2 + self._steps
        self._color = np.array(color, dtype=np.uint32)[:, None]

    def _locate(self, centers: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Flat index of each patch's first pixel, and its coverage, shapes (n,) and (n, patch * patch)."""
        fine = np.floor((centers - self.radius) * SUBPIXELS).astype(np.int64)
        # Negative numbers are the largest unsigned ones.
        if fine.view(np.uint64).max() >= self._limit:
            raise ValueError(
                f"a disc of {self.radius} pixels leaves the {self.size} x {self.size} observation: {centers}"
            )
        whole, part = fine >> _SUBPIXEL_BITS, fine & (SUBPIXELS - 1)
        return whole @ self._weights, self._alphas[part @ _PART_WEIGHTS]

    def render(
        self, observations: NDArray[np.uint8], centers: NDArray[np.float64], over: NDArray[np.uint8] | None = None
    ) -> None:
        """Render the discs in place.

        :param observations: contiguous, shape (n, 3, size, size)
        :param centers: (column, row) in pixels, shape (n, 2)
        :param over: what the discs' edges mix with, contiguous and shaped like ``observations``, which None stands for
        :raises ValueError: where a disc, or the pixel beside it, would lie outside the observation
        """
        first, alphas = self._locate(centers)
        flat = observations.reshape(-1)
        starts = first + np.arange(len(observations)) * (3 * self.size**2)
        where = starts[:, None, None] + self._channels
        alpha = alphas[:, None, :].astype(np.uint32)
        below = flat[where] if over is None else over.reshape(-1)[where]
        mixed = (below * (255 - alpha) + self._color * alpha + 127) // 255
        flat[where] = mixed if over is None else np.where(alpha > 0, mixed, flat[where])

    def mark(self, masks: NDArray[np.bool_], centers: NDArray[np.float64]) -> None:
        """Set the pixels that the discs touch, in place.

        :param masks: contiguous, shape (n, size, size)
        :param centers: (column, row) in pixels, shape (n, 2)
        """
        first, alphas = self._locate(centers)
        flat = masks.reshape(-1)
        where = (first + np.arange(len(masks)) * self.size**2)[:, None] + self._steps
        flat[where] |= alphas > 0


def floor(size: int) -> NDArray[np.uint8]:
    """An observation of nothing but floor, shape (3, size, size).

    :param size: height and width, in pixels
    """
    return np.tile(np.array(FLOOR, dtype=np.uint8)[:, None, None], (1, size, size))


def paint(observation: NDArray[np.uint8], where: NDArray[np.bool_], color: tuple[int, int, int]) -> None:
    """Fill the pixels ``where`` (height, width) of one observation (3, height, width) with a color, in place.

    :param observation: uint8, contiguous or not
    :param where: bool
    :param color: RGB, 0..255
    """
    for channel, value in zip(observation, color, strict=True):
        channel[where] = value


def enlarge(
    backdrop: NDArray[np.uint8],
    center: NDArray[np.float64],
    radius: float,
    scale: int = 8,
) -> NDArray[np.uint8]:
    """An image for people: the backdrop with sharp, larger pixels and the disc rendered at the larger scale.

    :param backdrop: the observation without the agent, shape (3, size, size)
    :param center: (column, row) of the disc in pixels of the backdrop
    :param radius: in pixels of the backdrop
    :param scale: how many pixels each pixel becomes per side
    :return: shape (size * scale, size * scale, 3), RGB
    """
    large = backdrop.repeat(scale, axis=1).repeat(scale, axis=2).transpose(1, 2, 0)
    alpha = disc_coverage(np.asarray(center) * scale, radius * scale, len(large))[..., None]
    return np.rint(large * (1 - alpha) + np.array(AGENT) * alpha).astype(np.uint8)
