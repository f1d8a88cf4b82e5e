"""The wrapper for dm_control shows the task's objects, and clips where the sky and planes are."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.moving_background import GEOM, PLANE, SIZE, MovingBackground

# Geom 0 is a plane, geom 1 an object. Object 0 of another type is a site.
SITE = 6


class Physics:
    """Sky above, then a plane, an object, and a site that has the number of the plane."""

    model = SimpleNamespace(geom_type=np.array([PLANE, 6]))

    def render(self, height: int, width: int, camera_id: int, segmentation: bool = False, **kwargs: Any) -> np.ndarray:
        assert (height, width, camera_id) == (SIZE, SIZE, 1)
        if not segmentation:
            assert kwargs["render_flag_overrides"]["skybox"] is False
            return np.full((SIZE, SIZE, 3), (10, 20, 30), np.uint8)
        seen = np.full((SIZE, SIZE, 2), -1)
        seen[16:32], seen[32:48], seen[48:] = (0, GEOM), (1, GEOM), (0, SITE)
        return seen


class Task(gym.Env[Any, Any]):
    observation_space, action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(2)
    _env = SimpleNamespace(physics=Physics())

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(2, np.float32), 1.0, False, False, {}


@pytest.mark.parametrize("split", ["train", "eval"])
def test_what_is_replaced(split: str) -> None:
    env = MovingBackground(Task(), split, camera_id=1)
    first, _ = env.reset(seed=3)
    second = env.step(0)[0]
    for shown in (first, second):
        assert env.observation_space.contains(shown)
        assert (shown[:, 32:] == np.array([10, 20, 30], np.uint8)[:, None, None]).all(), "the object and the site"
        assert not (shown[:, :32] == np.array([10, 20, 30], np.uint8)[:, None, None]).all(axis=0).any()
    assert (first[:, :32] != second[:, :32]).any(), "the clip goes on"
    again, _ = MovingBackground(Task(), split, camera_id=1).reset(seed=3)
    np.testing.assert_array_equal(again, first)
    other, _ = env.reset()
    assert (other != first).any()
