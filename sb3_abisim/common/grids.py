"""Grids of cells as bitboards, for the layouts of episodes: the cell (column, row) is bit ``stride * row + column``.

A bitboard is a Python int, so that one operation works on all cells at once. Shifts by one column wrap around into the
next row: a caller leaves one column at an edge of the grid blocked.
"""

import numpy as np
from numpy.typing import NDArray


def pack(cells: NDArray[np.bool_]) -> int:
    """The bitboard of a grid.

    :param cells: indexed [row, column], shape (rows, stride)
    """
    return int.from_bytes(np.packbits(cells, bitorder="little").tobytes(), "little")


def unpack(board: int, rows: int, stride: int) -> NDArray[np.bool_]:
    """The grid of a bitboard, the inverse of :func:`pack`.

    :param board: without bits beyond the grid
    :param rows: of the grid
    :param stride: columns of the grid
    :return: indexed [row, column], shape (rows, stride)
    """
    raw = np.frombuffer(board.to_bytes(-(-rows * stride // 8), "little"), dtype=np.uint8)
    return np.unpackbits(raw, count=rows * stride, bitorder="little").view(np.bool_).reshape(rows, stride)


def flood_fill(start: int, free: int, stride: int, stop: int = 0) -> int:
    """The free cells that moves up, down, left and right lead to, and those that they begin with.

    :param start: bitboard of the cells to begin with
    :param free: bitboard of the cells that can be entered
    :param stride: columns of the grid
    :param stop: bitboard; the search ends as soon as one of these cells is reached, 0 for never
    :return: bitboard of the cells reached, all of them free
    """
    reached = start & free
    while not reached & stop:
        # All cells of a front at once.
        grown = (reached | reached << 1 | reached >> 1 | reached << stride | reached >> stride) & free
        if grown == reached:
            break
        reached = grown
    return reached


def fewest_steps(nexts: NDArray[np.int64], goals: NDArray[np.int64]) -> NDArray[np.float32]:
    """The length of the shortest path from each state to each goal.

    :param nexts: the state that each action leads to, (n_states, n_actions)
    :param goals: states, (n_goals,)
    :return: (n_states, n_goals); infinity where there is no path
    """
    steps = np.full((len(nexts), len(goals)), np.inf, dtype=np.float32)
    steps[goals, np.arange(len(goals))] = 0.0
    while True:
        shorter = np.minimum(steps, steps[nexts].min(axis=1) + 1.0)
        if np.array_equal(shorter, steps):
            return steps
        steps = shorter
