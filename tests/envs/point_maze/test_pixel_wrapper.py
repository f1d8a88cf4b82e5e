"""PointMazePixels around the ids of gymnasium-robotics."""

import warnings
from collections.abc import Callable, Iterator

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.pixel_wrapper import PointMazePixels

UP, DOWN, LEFT, RIGHT = range(4)

# Asymmetric on purpose: wider than high, with walls in different places in each row.
MAP = [
    [1, 1, 1, 1, 1, 1, 1],
    [1, "r", 0, 0, 0, 1, 1],
    [1, 0, 1, 1, 0, "g", 1],
    [1, 0, 0, 0, 0, 0, 1],
    [1, 1, 1, 1, 1, 1, 1],
]
CELL = 9  # 64 // 7
LEFT_EDGE, TOP_EDGE = 0, 9  # (64 - 7 * 9) // 2, (64 - 5 * 9) // 2

Make = Callable[..., gym.Env]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[gym.Env] = []

    def build(env_id: str = "PointMaze_UMaze-v3", **kwargs: object) -> gym.Env:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import gymnasium_robotics

            gym.register_envs(gymnasium_robotics)
            made.append(gym.make(env_id, **kwargs))
        return made[-1]

    yield build
    for env in made:
        env.close()


def on_map(make: Make, **kwargs: object) -> PointMazePixels:
    return PointMazePixels(make(maze_map=MAP, continuing_task=False, max_episode_steps=3000), **kwargs)  # type: ignore[arg-type]


def cell_of(row: int, column: int) -> tuple[slice, slice]:
    top, left = TOP_EDGE + row * CELL, LEFT_EDGE + column * CELL
    return slice(top, top + CELL), slice(left, left + CELL)


def color_share(observation: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    return (np.abs(observation.astype(int) - np.array(color)[:, None, None]).max(axis=0) == 0).astype(float)


def test_the_observation_shows_the_map_the_goal_and_the_agent(make: Make) -> None:
    env = on_map(make)
    observation, _ = env.reset(seed=0)
    walls = color_share(observation, top_down.WALL)
    for row, line in enumerate(MAP):
        for column, value in enumerate(line):
            if value == 1:
                # The disc of 0.3 m that stands for the ball of 0.1 m may overlap a wall by a pixel.
                assert walls[cell_of(row, column)].mean() > 0.85
                assert row + column <= 3 or walls[cell_of(row, column)].all()
            elif value == 0:
                assert not walls[cell_of(row, column)].any()
    assert walls[:TOP_EDGE].all() and walls[TOP_EDGE + 5 * CELL :].all() and walls[:, 63].all()
    # Noise moves agent and goal by up to a quarter of a cell.
    for color, (row, column) in ((top_down.AGENT, (1, 1)), (top_down.GOAL, (2, 5))):
        rows, columns = np.nonzero(color_share(observation, color))
        assert abs(rows.mean() + 0.5 - (TOP_EDGE + (row + 0.5) * CELL)) <= CELL / 4 + 0.5
        assert abs(columns.mean() + 0.5 - (LEFT_EDGE + (column + 0.5) * CELL)) <= CELL / 4 + 0.5


def test_agent_and_goal_are_rendered_where_the_simulator_has_them(make: Make) -> None:
    env = on_map(make)
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        for name, color in (("agent", top_down.AGENT), ("goal", top_down.GOAL)):
            x, y = env.factors()[name]
            rows, columns = np.nonzero(color_share(observation, color))
            # The map is 7 m x 5 m; its middle is the origin.
            assert abs(columns.mean() + 0.5 - (LEFT_EDGE + (x + 3.5) * CELL)) < 0.5
            assert abs(rows.mean() + 0.5 - (TOP_EDGE + (y + 2.5) * CELL)) < 0.5
        np.testing.assert_allclose(env.factors()["goal"], env.env.unwrapped.goal * (1, -1), rtol=1e-6)  # type: ignore[attr-defined]


@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize(("action", "direction"), [(UP, (0, -1)), (DOWN, (0, 1)), (LEFT, (-1, 0)), (RIGHT, (1, 0))])
def test_pushes_move_the_agent_as_seen_in_the_observation(
    make: Make, continuous: bool, action: int, direction: tuple[int, int]
) -> None:
    env = on_map(make, continuous=continuous, frame_skip=10, momentum=False)
    env.reset(seed=0, options={"reset_cell": np.array([3, 3]) if action in (LEFT, RIGHT) else np.array([2, 1])})
    before = env.factors()["agent"]
    env.step(np.array(direction, dtype=np.float32) if continuous else action)
    moved = env.factors()["agent"] - before
    # 10 steps of 0.01 s at 100 N on 4.19 kg, from rest.
    np.testing.assert_allclose(moved, np.array(direction) * 0.13, atol=0.01)


def test_frame_skip_and_momentum(make: Make) -> None:
    once, skipping = on_map(make), on_map(make, frame_skip=5)
    resting = on_map(make, frame_skip=5, momentum=False)
    for env in (once, skipping, resting):
        env.reset(seed=3)
    push, rest = np.array([0.5, 0.0], dtype=np.float32), np.zeros(2, dtype=np.float32)
    for _ in range(5):
        once.step(push)
    skipping.step(push)
    resting.step(push)
    np.testing.assert_array_equal(once.factors()["agent"], skipping.factors()["agent"])
    np.testing.assert_array_equal(resting.factors()["agent"], skipping.factors()["agent"])
    assert skipping.factors()["velocity"][0] > 0.3
    before = resting.factors()["agent"]
    skipping.step(rest)
    resting.step(rest)
    np.testing.assert_array_equal(resting.factors()["agent"], before)
    assert skipping.factors()["agent"][0] > before[0] + 0.01


def test_reaching_the_goal_is_a_success_and_ends_the_episode(make: Make) -> None:
    env = on_map(make, continuous=False, frame_skip=30, momentum=False)
    env.reset(seed=0, options={"reset_cell": np.array([3, 5])})
    _, reward, terminated, truncated, info = env.step(UP)
    assert (reward, terminated, truncated, info["is_success"]) == (1.0, True, False, True)
    env.reset(seed=0, options={"reset_cell": np.array([1, 1])})
    _, reward, terminated, truncated, info = env.step(UP)
    assert (reward, terminated, truncated, info["is_success"]) == (0.0, False, False, False)


def test_backgrounds_fill_the_floor_and_nothing_else(make: Make) -> None:
    plain, moving = on_map(make), on_map(make, backgrounds=load_backgrounds(split="train"))
    push = np.array([0.3, 0.2], dtype=np.float32)
    clean, _ = plain.reset(seed=4)
    first, _ = moving.reset(seed=4)
    floor = color_share(clean, top_down.FLOOR) > 0
    np.testing.assert_array_equal(first[:, ~floor], clean[:, ~floor])
    assert (first[:, floor] != clean[:, floor]).mean() > 0.5
    second = moving.step(push)[0]
    assert (second[:, floor] != first[:, floor]).mean() > 0.1
    np.testing.assert_array_equal(moving.reset(seed=4)[0], first)
    np.testing.assert_array_equal(moving.step(push)[0], second)
    # Later episodes have the same mazes with and without clips.
    plain.reset()
    moving.reset()
    np.testing.assert_array_equal(plain.factors()["agent"], moving.factors()["agent"])


def test_render_needs_no_gl_and_shows_the_scene(make: Make) -> None:
    env = on_map(make)
    observation, _ = env.reset(seed=0)
    frame = env.render()
    assert frame.shape == (512, 512, 3) and frame.dtype == np.uint8 and env.render_mode == "rgb_array"
    shrunk = frame.reshape(64, 8, 64, 8, 3).mean(axis=(1, 3)).transpose(2, 0, 1)
    assert np.abs(shrunk - observation).max() <= 3


@pytest.mark.parametrize("env_id", ["PointMaze_UMaze-v3", "PointMaze_Large-v3", "PointMaze_Open_Diverse_GR-v3"])
@pytest.mark.parametrize("continuous", [True, False])
def test_check_env(make: Make, env_id: str, continuous: bool) -> None:
    env = PointMazePixels(make(env_id), continuous=continuous)
    check_env(env)
    observation, _ = env.reset(seed=0)
    assert (color_share(observation, top_down.AGENT)).any()


def test_bad_use_is_refused(make: Make) -> None:
    with pytest.raises(ValueError, match="PointMaze ids"):
        PointMazePixels(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="frame_skip"):
        PointMazePixels(make(), frame_skip=0)
    with pytest.raises(ValueError, match="at most 21 cells"):
        PointMazePixels(make(maze_map=[[1] * 22, [1, 0, *[1] * 20], [1, 0, *[1] * 20], [1] * 22]))
    env = PointMazePixels(make())
    env.reset(seed=0)
    for action in (np.array([1.5, 0]), np.array([np.nan, 0]), np.zeros(3)):
        with pytest.raises(ValueError, match="action"):
            env.step(action)
    env = PointMazePixels(make(), continuous=False)
    env.reset(seed=0)
    for action in (4, -1, 0.5):
        with pytest.raises(ValueError, match="action"):
            env.step(action)
