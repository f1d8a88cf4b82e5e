"""The solid part of a point maze, rendered once more for tests."""

import numpy as np


def solid_pixels(obstacles: np.ndarray) -> np.ndarray:
    """Walls and obstacles on the 64 x 64 grid, [row, column], from the centers in meters."""
    solid = np.ones((64, 64), dtype=bool)
    solid[2:62, 2:62] = False
    for x, y in obstacles:
        column, row = (x - 1 + 8) * 4, (y - 1 + 8) * 4
        assert column == int(column) and row == int(row)
        assert 2 <= column <= 54 and 2 <= row <= 54
        solid[int(row) : int(row) + 8, int(column) : int(column) + 8] = True
    return solid
