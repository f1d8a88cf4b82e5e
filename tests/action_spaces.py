"""Action spaces of every kind, and transitions and an environment that show which action was taken."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.common.spaces import sample_actions
from sb3_abisim.objectives.base import TensorBatch

SPACES = {
    "discrete": spaces.Discrete(3, start=5),
    "multi_discrete": spaces.MultiDiscrete([3, 2], start=[1, -1]),
    "multi_discrete_2d": spaces.MultiDiscrete([[2, 3], [2, 2]]),
    "multi_binary": spaces.MultiBinary(3),
    "multi_binary_2d": spaces.MultiBinary((2, 2)),
    "box_2d_float64": spaces.Box(np.array([[0.0, 10], [-1, 2]]), np.array([[100.0, 30], [1, 5]]), dtype=np.float64),
    "box_scalar": spaces.Box(-0.01, 0.01, (), np.float32),
}


def effects(space: gym.Space[Any], actions: NDArray[Any]) -> NDArray[np.float64]:
    """The numbers of actions, each from -1 for the smallest to 1 for the largest, (n, number of components)."""
    flat = np.asarray(actions, np.float64).reshape(len(actions), -1)
    if isinstance(space, spaces.Box):
        low, high = space.low.reshape(-1), space.high.reshape(-1)
    elif isinstance(space, spaces.MultiBinary):
        low, high = 0, 1
    elif isinstance(space, spaces.Discrete):
        low, high = space.start, space.start + space.n - 1
    else:
        low, high = space.start.reshape(-1), (space.start + space.nvec - 1).reshape(-1)
    result: NDArray[np.float64] = 2 * (flat - low) / (np.asarray(high) - low) - 1
    return result


def make_batch(space: gym.Space[Any], n: int, seed: int = 0, sequences: bool = False) -> TensorBatch:
    """Four numbers between 0 and 1; each component of the action moves one of them."""
    generator = np.random.default_rng(seed)
    actions = sample_actions(space, (n,), generator)
    s = generator.random((n, 1, 1, 4))
    s_next = s.copy()
    moved = effects(space, actions)
    s_next[:, 0, 0, : moved.shape[1]] += 0.3 * moved
    obs, next_obs = (th.as_tensor(array, dtype=th.float32) for array in (s, s_next))
    return TensorBatch.of(obs, th.as_tensor(actions[:, None] if sequences else actions), next_obs)


class ActionEnv(gym.Env[NDArray[np.uint8], Any]):
    """The first pixels of an observation hold the components of the action that led here, from 1 to 255."""

    def __init__(self, kind: str = "discrete") -> None:
        self.observation_space = spaces.Box(0, 255, (3, 15, 15), np.uint8)
        self.action_space = SPACES[kind]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self._observe(None), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(np.asarray(action)), (action, self.action_space)
        return self._observe(action), 0.0, False, False, {}

    def _observe(self, action: Any) -> NDArray[np.uint8]:
        observation = np.zeros((3, 15, 15), np.uint8)
        if action is not None:
            levels = shown(self.action_space, np.asarray(action)[None])[0]
            observation[0, 0, : len(levels)] = levels
        return observation


def shown(space: gym.Space[Any], actions: NDArray[Any]) -> NDArray[np.uint8]:
    """What the environment shows of actions, (n, number of components)."""
    return (128 + 127 * effects(space, actions)).round().astype(np.uint8)


gym.register("ActionEnv-v0", entry_point=ActionEnv, max_episode_steps=7)
