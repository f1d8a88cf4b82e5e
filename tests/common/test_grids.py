"""Bitboards against plain grids of cells."""

import numpy as np
import pytest

from sb3_abisim.common.grids import fewest_steps, flood_fill, pack, unpack

ROWS, STRIDE = 9, 13


def reachable(start: np.ndarray, free: np.ndarray) -> np.ndarray:
    """By depth-first search, cell by cell."""
    reached = np.zeros_like(free)
    stack = [tuple(cell) for cell in np.argwhere(start)]
    while stack:
        row, column = stack.pop()
        if 0 <= row < free.shape[0] and 0 <= column < free.shape[1] and free[row, column] and not reached[row, column]:
            reached[row, column] = True
            stack += [(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)]
    return reached


def random_grid(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Free cells, with the last column blocked as callers must leave it, and one or two cells to start from."""
    generator = np.random.default_rng(seed)
    free = generator.random((ROWS, STRIDE)) < 0.6
    free[:, -1] = False
    start = np.zeros_like(free)
    start.reshape(-1)[generator.integers(free.size, size=1 + seed % 2)] = True
    return free, start


def test_a_cell_is_the_bit_of_its_row_and_column() -> None:
    cells = np.zeros((ROWS, STRIDE), dtype=bool)
    cells[2, 5] = True
    assert pack(cells) == 1 << (2 * STRIDE + 5)


def test_unpack_is_the_inverse_of_pack() -> None:
    cells = np.random.default_rng(0).random((ROWS, STRIDE)) < 0.5
    np.testing.assert_array_equal(unpack(pack(cells), ROWS, STRIDE), cells)


@pytest.mark.parametrize("seed", range(30))
def test_flood_fill_equals_a_depth_first_search(seed: int) -> None:
    free, start = random_grid(seed)
    reached = unpack(flood_fill(pack(start), pack(free), STRIDE), ROWS, STRIDE)
    np.testing.assert_array_equal(reached, reachable(start, free))


@pytest.mark.parametrize("seed", range(30))
def test_stopping_early_does_not_change_whether_a_cell_is_reached(seed: int) -> None:
    free, start = random_grid(seed)
    expected = reachable(start, free)
    for cell in np.ndindex(ROWS, STRIDE):
        stop = 1 << (cell[0] * STRIDE + cell[1])
        assert bool(flood_fill(pack(start), pack(free), STRIDE, stop) & stop) == expected[cell]


def test_the_search_ends_where_it_is_told_to_stop() -> None:
    corridor = (1 << 10) - 1
    assert flood_fill(1, corridor, STRIDE, stop=1 << 3) == 0b1111


def test_the_fewest_steps_go_around_what_is_one_way_and_are_infinite_without_a_path() -> None:
    # 0 -> 1 -> 2 -> 0 in a circle; 3 leads to 0, and nothing leads to 3.
    nexts = np.array([[1, 1], [2, 1], [0, 2], [0, 3]])
    steps = fewest_steps(nexts, np.array([0, 3]))
    np.testing.assert_array_equal(steps, [[0, np.inf], [2, np.inf], [1, np.inf], [1, 0]])
