"""The rooms of PointMaze: where obstacles and starts may lie, and what stands still in an observation."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.grids import flood_fill, pack, unpack
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.top_down import IMAGE_SIZE

PIXELS_PER_METER = 4
WALL_PIXELS = 2
N_OBSTACLES = 20
OBSTACLE_PIXELS = 8
GOAL_RADIUS = 1.0  # m
GOAL_MARK_PIXELS = 4
ROOM_SIZE = (IMAGE_SIZE - 2 * WALL_PIXELS) / PIXELS_PER_METER  # m, between the walls
CORNER_DISTANCE = 3.5  # m, of goals in the corners from the center along each axis

_CENTER = IMAGE_SIZE // 2


def to_pixels(positions: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Positions (x, y) in meters, shape (..., 2), as (column, row) in pixels.

    :param positions: in meters from the middle of the observation, y down
    """
    return positions * np.float64(PIXELS_PER_METER) + _CENTER


def to_meters(pixels: NDArray[Any]) -> NDArray[np.float64]:
    """(column, row) in pixels, shape (..., 2), as positions (x, y) in meters.

    :param pixels: real numbers, shape (..., 2)
    """
    return (pixels - _CENTER) / PIXELS_PER_METER


# The layout of an episode, computed on bitboards (:mod:`~sb3_abisim.common.grids`) whose cells are pixels. The walls
# are never free, so shifts do not wrap around.

_STRIDE = IMAGE_SIZE


def _square(column: int, row: int, side: int) -> int:
    line = ((1 << side) - 1) << column
    return sum(line << (_STRIDE * r) for r in range(row, row + side))


def _unpack(board: int) -> NDArray[np.bool_]:
    """The pixels of a bitboard, shape (64, 64)."""
    return unpack(board, IMAGE_SIZE, _STRIDE)


def _corner_choices(goal: tuple[int, int]) -> NDArray[np.int64]:
    """Every allowed (column, row) of an obstacle's top left pixel, for a goal at (column, row)."""
    corners = np.arange(WALL_PIXELS, IMAGE_SIZE - WALL_PIXELS - OBSTACLE_PIXELS + 1)
    columns, rows = ((corners > at - _REACH - OBSTACLE_PIXELS) & (corners < at + _REACH) for at in goal)
    return corners[np.argwhere(~(columns[:, None] & rows))]


def _start_blocks() -> int:
    """The 2 x 2 blocks around whose center no position within half a pixel per axis is at the goal."""
    offset = np.maximum(np.abs(np.arange(IMAGE_SIZE) + 1 - _CENTER) - 0.5, 0.0)
    outside = np.hypot(offset[:, None], offset) > GOAL_RADIUS * PIXELS_PER_METER
    return pack(outside)


# The goal lies in the middle of a square of this half side, which is free of obstacles and inside the walls.
_REACH = int(GOAL_RADIUS * PIXELS_PER_METER)
_RANDOM_GOALS = np.arange(WALL_PIXELS + _REACH, IMAGE_SIZE - WALL_PIXELS - _REACH + 1)
# Along each axis, with goals in the corners.
_CORNER_GOALS = _CENTER + int(CORNER_DISTANCE * PIXELS_PER_METER) * np.array((-1, 1))
_OBSTACLE = _square(0, 0, OBSTACLE_PIXELS)
_FULL = (1 << IMAGE_SIZE**2) - 1
_WALLS = _FULL & ~_square(WALL_PIXELS, WALL_PIXELS, IMAGE_SIZE - 2 * WALL_PIXELS)
# A corridor is made of 2 x 2 pixels of free floor, named by their top left one; this one is the goal's.
_GOAL_BLOCK = _square(_CENTER - 1, _CENTER - 1, 1)
_CORNERS = _corner_choices((_CENTER, _CENTER))
_START_BLOCKS = _start_blocks()
_NEAR_BLOCKS = _FULL & ~_START_BLOCKS

WALL_MASK = _unpack(_WALLS)
_EMPTY_LAYER = top_down.floor(IMAGE_SIZE)
top_down.paint(_EMPTY_LAYER, WALL_MASK, top_down.WALL)


class Layout(NamedTuple):
    """What an episode begins with.

    :param corners: (column, row) of the obstacles' top left pixels, shape (20, 2)
    :param solid: where obstacles and walls are, bool (64, 64)
    :param start: (x, y) in meters
    :param goal: (column, row) of the corner between pixels at which it lies
    """

    corners: NDArray[np.int64]
    solid: NDArray[np.bool_]
    start: NDArray[np.float64]
    goal: tuple[int, int]


def goal_mask(goal: tuple[int, int] = (_CENTER, _CENTER)) -> NDArray[np.bool_]:
    """The pixels of the mark at the goal, bool (64, 64).

    :param goal: (column, row) of the corner between pixels at which it lies
    """
    left, top = (at - GOAL_MARK_PIXELS // 2 for at in goal)
    mask = np.zeros((IMAGE_SIZE, IMAGE_SIZE), dtype=bool)
    mask[top : top + GOAL_MARK_PIXELS, left : left + GOAL_MARK_PIXELS] = True
    return mask


GOAL_MASK = goal_mask()


def sample_layout(generator: np.random.Generator, goals: str = "center") -> Layout:
    """Sample the goal, if it is not the center, the obstacles and the start of an episode, until a corridor 0.5 m wide
    joins start and goal.

    :param generator: that of the environment
    :param goals: where the goal lies: "center"; "random", uniformly over the corners between pixels that lie 1 m or
        more inside the walls; "corners", 3.5 m from the center along each axis
    """
    goal, choices_of_corners, start_blocks, shift = (_CENTER, _CENTER), _CORNERS, _START_BLOCKS, 0
    while True:
        if goals != "center":
            choices_of_goal = _CORNER_GOALS if goals == "corners" else _RANDOM_GOALS
            column, row = generator.choice(choices_of_goal, size=2).tolist()
            goal, choices_of_corners = (column, row), _corner_choices((column, row))
            shift = _STRIDE * (row - _CENTER) + column - _CENTER
            # Within the walls, so that no bit is shifted into another row.
            start_blocks = _FULL & ~_shifted(_NEAR_BLOCKS, shift)
        corners = choices_of_corners[generator.integers(len(choices_of_corners), size=N_OBSTACLES)]
        occupied = _WALLS
        for column, row in corners.tolist():
            occupied |= _OBSTACLE << (_STRIDE * row + column)
        free = _FULL & ~occupied
        blocks = free & free >> 1 & free >> _STRIDE & free >> (_STRIDE + 1)
        choices = np.flatnonzero(_unpack(blocks & start_blocks))
        if not len(choices):
            continue
        block = int(choices[generator.integers(len(choices))])
        jitter = generator.uniform(-0.5, 0.5, size=2)
        start = 1 << block
        if flood_fill(_shifted(_GOAL_BLOCK, shift), blocks, _STRIDE, stop=start) & start:
            row, column = divmod(block, _STRIDE)
            return Layout(corners, _unpack(occupied), to_meters(np.array([column + 1, row + 1]) + jitter), goal)


def _shifted(board: int, by: int) -> int:
    return board << by if by >= 0 else board >> -by


def static_layer(solid: NDArray[np.bool_], mark: NDArray[np.bool_] = GOAL_MASK) -> NDArray[np.uint8]:
    """The observation without agent, (3, 64, 64).

    :param solid: where walls and obstacles are, (64, 64)
    :param mark: the pixels of the goal, of :func:`goal_mask`
    """
    layer = _EMPTY_LAYER.copy()
    top_down.paint(layer, mark, top_down.GOAL)
    top_down.paint(layer, solid & ~WALL_MASK, top_down.OBSTACLE)
    return layer
