"""The rooms of PointMaze: where obstacles and starts may lie, and what stands still in the picture."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.top_down import IMAGE_SIZE

PIXELS_PER_METER = 4
WALL_PIXELS = 2
N_OBSTACLES = 20
OBSTACLE_PIXELS = 8
GOAL_RADIUS = 1.0  # m
GOAL_MARK_PIXELS = 4

_CENTER = IMAGE_SIZE // 2


def to_pixels(positions: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Positions (x, y) in meters, shape (..., 2), as (column, row) in pixels.

    :param positions: in meters from the middle of the picture, y down
    """
    return positions * np.float64(PIXELS_PER_METER) + _CENTER


def to_meters(pixels: NDArray[Any]) -> NDArray[np.float64]:
    """(column, row) in pixels, shape (..., 2), as positions (x, y) in meters.

    :param pixels: real numbers, shape (..., 2)
    """
    return (pixels - _CENTER) / PIXELS_PER_METER


# The layout of an episode, computed on bitboards: bit 64 * row + column of a Python int is a pixel.

_STRIDE = IMAGE_SIZE


def _square(column: int, row: int, side: int) -> int:
    line = ((1 << side) - 1) << column
    return sum(line << (_STRIDE * r) for r in range(row, row + side))


def _unpack(board: int) -> NDArray[np.bool_]:
    """The pixels of a bitboard, shape (64, 64)."""
    raw = np.frombuffer(board.to_bytes(IMAGE_SIZE**2 // 8, "little"), dtype=np.uint8)
    return np.unpackbits(raw, bitorder="little").view(np.bool_).reshape(IMAGE_SIZE, IMAGE_SIZE)


def _corner_choices() -> NDArray[np.int64]:
    """Every allowed (column, row) of an obstacle's top left pixel."""
    corners = np.arange(WALL_PIXELS, IMAGE_SIZE - WALL_PIXELS - OBSTACLE_PIXELS + 1)
    reach = int(GOAL_RADIUS * PIXELS_PER_METER)
    at_goal = (corners > _CENTER - reach - OBSTACLE_PIXELS) & (corners < _CENTER + reach)
    return corners[np.argwhere(~(at_goal[:, None] & at_goal))]


def _start_blocks() -> int:
    """The 2 x 2 blocks around whose center no position within half a pixel per axis is at the goal."""
    offset = np.maximum(np.abs(np.arange(IMAGE_SIZE) + 1 - _CENTER) - 0.5, 0.0)
    outside = np.hypot(offset[:, None], offset) > GOAL_RADIUS * PIXELS_PER_METER
    return int.from_bytes(np.packbits(outside, bitorder="little").tobytes(), "little")


_OBSTACLE = _square(0, 0, OBSTACLE_PIXELS)
_FULL = (1 << IMAGE_SIZE**2) - 1
_WALLS = _FULL & ~_square(WALL_PIXELS, WALL_PIXELS, IMAGE_SIZE - 2 * WALL_PIXELS)
# A corridor is made of 2 x 2 pixels of free floor, named by their top left one; this one is the goal's.
_GOAL_BLOCK = _square(_CENTER - 1, _CENTER - 1, 1)
_CORNERS = _corner_choices()
_START_BLOCKS = _start_blocks()

WALL_MASK = _unpack(_WALLS)
GOAL_MASK = _unpack(_square(_CENTER - GOAL_MARK_PIXELS // 2, _CENTER - GOAL_MARK_PIXELS // 2, GOAL_MARK_PIXELS))
_EMPTY_LAYER = top_down.floor(IMAGE_SIZE)
top_down.paint(_EMPTY_LAYER, WALL_MASK, top_down.WALL)
top_down.paint(_EMPTY_LAYER, GOAL_MASK, top_down.GOAL)


def _connected(blocks: int, start: int, goal: int) -> bool:
    """Whether shifts by one pixel within ``blocks`` lead from ``start`` to ``goal``."""
    reached = goal & blocks
    while not reached & start:
        grown = (reached | reached << 1 | reached >> 1 | reached << _STRIDE | reached >> _STRIDE) & blocks
        if grown == reached:
            return False
        reached = grown
    return True


def draw_layout(generator: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.float64]]:
    """Draw the obstacles and the start of an episode, until a corridor 0.5 m wide joins start and goal.

    :param generator: the environment's own
    :return: (column, row) of the obstacles' top left pixels, shape (20, 2); where obstacles and walls are, bool
        (64, 64); the start (x, y) in meters
    """
    while True:
        corners = _CORNERS[generator.integers(len(_CORNERS), size=N_OBSTACLES)]
        occupied = _WALLS
        for column, row in corners.tolist():
            occupied |= _OBSTACLE << (_STRIDE * row + column)
        free = _FULL & ~occupied
        blocks = free & free >> 1 & free >> _STRIDE & free >> (_STRIDE + 1)
        choices = np.flatnonzero(_unpack(blocks & _START_BLOCKS))
        if not len(choices):
            continue
        block = int(choices[generator.integers(len(choices))])
        jitter = generator.uniform(-0.5, 0.5, size=2)
        if _connected(blocks, 1 << block, _GOAL_BLOCK):
            row, column = divmod(block, _STRIDE)
            return corners, _unpack(occupied), to_meters(np.array([column + 1, row + 1]) + jitter)


def static_layer(solid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The picture without agent, (3, 64, 64).

    :param solid: where walls and obstacles are, (64, 64)
    """
    layer = _EMPTY_LAYER.copy()
    top_down.paint(layer, solid & ~WALL_MASK, top_down.OBSTACLE)
    return layer
