"""PointMaze's layouts against a plain flood fill."""

import numpy as np
import pytest
from point_maze_inputs import solid_pixels

from sb3_abisim.common.grids import flood_fill, pack
from sb3_abisim.envs.point_maze import layout as point_maze_layout
from sb3_abisim.envs.point_maze.env import PointMazeVectorEnv


def reachable(solid: np.ndarray, goal: tuple[int, int] = (32, 32)) -> np.ndarray:
    """Top left pixels of the 0.5 m squares that slide to the goal over free floor, by depth-first search.

    :param goal: (row, column) of the corner between pixels
    """
    free = ~(solid[:-1, :-1] | solid[1:, :-1] | solid[:-1, 1:] | solid[1:, 1:])
    seen = np.zeros_like(free)
    stack = [(goal[0] - 1, goal[1] - 1)]
    while stack:
        row, column = stack.pop()
        if free[row, column] and not seen[row, column]:
            seen[row, column] = True
            stack += [(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)]
    return seen


def test_every_layout_keeps_its_promises() -> None:
    env = PointMazeVectorEnv(num_envs=60)
    env.reset(seed=0)
    factors = env.factors()
    covered = np.zeros((64, 64), dtype=int)
    for obstacles, (x, y) in zip(factors["obstacles"], factors["agent"], strict=True):
        assert obstacles.shape == (20, 2)
        solid = solid_pixels(obstacles)
        covered += solid
        assert not solid[28:36, 28:36].any(), "an obstacle within the square around the goal"
        assert np.hypot(x, y) > 1.0
        column, row = (x + 8) * 4, (y + 8) * 4
        rows, columns = np.nonzero(solid)
        gap = np.hypot(
            np.maximum(np.abs(columns + 0.5 - column) - 0.5, 0), np.maximum(np.abs(rows + 0.5 - row) - 0.5, 0)
        ).min()
        assert gap >= 0.5 - 1e-4, "0.125 m between the ball's center and everything solid"
        assert reachable(solid)[round(row) - 1, round(column) - 1]
    assert (covered[2:62, 2:62] > 0).sum() > 0.98 * (60 * 60 - 8 * 8)


def test_blocked_layouts_are_rejected_by_the_flood_fill() -> None:
    """A ring of obstacles around the goal, with a gap of two pixels or of one."""
    for gap, expected in ((2, True), (1, False)):
        board = point_maze_layout._WALLS
        ring = np.zeros((64, 64), dtype=bool)
        ring[20:44, 20:44], ring[24:40, 24:40] = True, False
        ring[20:24, 30 : 30 + gap] = False
        board |= pack(ring)
        free = point_maze_layout._FULL & ~board
        blocks = free & free >> 1 & free >> 64 & free >> 65
        start = 1 << (5 * 64 + 5)
        assert bool(flood_fill(point_maze_layout._GOAL_BLOCK, blocks, 64, stop=start) & start) == expected
        assert reachable(ring | solid_pixels(np.zeros((0, 2))))[5, 5] == expected


@pytest.mark.parametrize("seed", [217, 408, 419, 469])
def test_blocked_layouts_are_sampled_again(seed: int) -> None:
    """One in a hundred is; the first of each of these seeds."""
    layout = point_maze_layout.sample_layout(np.random.default_rng(seed))
    column, row = point_maze_layout.to_pixels(layout.start)
    assert reachable(layout.solid)[round(row) - 1, round(column) - 1] and layout.goal == (32, 32)


def test_random_goals_lie_anywhere_inside_and_can_be_reached() -> None:
    env = PointMazeVectorEnv(num_envs=400, goal="random")
    observations, _ = env.reset(seed=0)
    factors = env.factors()
    goals, agents = factors["goal"], factors["agent"]
    for observation, obstacles, agent, goal in zip(observations, factors["obstacles"], agents, goals, strict=True):
        solid = solid_pixels(obstacles)
        column, row = ((goal + 8) * 4).astype(int)
        assert not solid[row - 4 : row + 4, column - 4 : column + 4].any(), "an obstacle around the goal, or a wall"
        assert np.hypot(*(agent - goal)) > 1.0
        mark = np.zeros((64, 64), dtype=bool)
        mark[row - 2 : row + 2, column - 2 : column + 2] = True
        # The agent's disc may lie over a corner of the mark.
        green = (observation == np.array(point_maze_layout.top_down.GOAL)[:, None, None]).all(axis=0)
        assert green.sum() >= 12 and not (green & ~mark).any()
        at = (agent + 8) * 4
        assert reachable(solid, (row, column))[round(at[1]) - 1, round(at[0]) - 1]
    # In steps of a pixel, a quarter of a meter, uniform over 53 places along each axis.
    assert goals.min() == -6.5 and goals.max() == 6.5 and np.array_equal(goals, np.round(goals * 4) / 4)
    assert (np.abs(goals.mean(axis=0)) < 4 * 3.82 / 20).all() and abs(np.corrcoef(goals.T)[0, 1]) < 0.2
    assert len(np.unique(goals, axis=0)) > 350


def test_goals_in_the_corners() -> None:
    env = PointMazeVectorEnv(num_envs=200, goal="corners")
    env.reset(seed=0)
    places, counts = np.unique(env.factors()["goal"], axis=0, return_counts=True)
    assert places.tolist() == [[-3.5, -3.5], [-3.5, 3.5], [3.5, -3.5], [3.5, 3.5]] and counts.min() > 30
