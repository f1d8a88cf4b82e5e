"""Environments whose observations show where they come from; child processes import them by ``--packages``.

An observation's three channels hold the step within the episode, the episode's random number, and the action that led
here (255 for none). An observation of the wrong step, episode or copy therefore shows as a wrong number.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.base import BatchEnv

SHAPE = (3, 4, 5)
LIMIT = 6
NO_ACTION = 255


class IndexVectorEnv(BatchEnv):
    """Episodes end by themselves after 2 to 9 steps, and are truncated after ``max_episode_steps``."""

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset: bool = True,
        offset: int = 0,
    ) -> None:
        observation_space = gym.spaces.Box(0, 255, SHAPE, np.uint8)
        action_space = gym.spaces.Discrete(3, start=1)
        super().__init__(num_envs, observation_space, action_space, max_episode_steps, render_mode, autoreset)
        self.offset = offset
        self._step, self._length, self._number, self._action = np.zeros((4, num_envs), dtype=np.int64)

    def _reset_envs(self, indices: NDArray[np.int64]) -> None:
        for i in indices:
            self._length[i] = self._generators[i].integers(2, 10)
            self._number[i] = self._generators[i].integers(256)
        self._step[indices] = 0
        self._action[indices] = NO_ACTION

    def _advance(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        self._step += 1
        self._action[:] = actions
        return np.zeros(self.num_envs), self._step >= self._length

    def _observe(self, indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        values = np.stack([self._step[indices] + self.offset, self._number[indices], self._action[indices]], axis=1)
        return np.broadcast_to(values[:, :, None, None], (len(indices), *SHAPE)).astype(np.uint8)

    def factors(self) -> dict[str, NDArray[Any]]:
        return {
            "step": self._step.astype(np.int32),
            "pair": np.stack([self._step, self._number], axis=1).astype(np.float32),
            "even": self._step % 2 == 0,
        }


class PlainEnv(gym.Env):
    """An environment of somebody else: continuous actions, no batch, no factors; observations as above, no action."""

    def __init__(self, channels_last: bool = False) -> None:
        self.channels_last = channels_last
        shape = (*SHAPE[1:], SHAPE[0]) if channels_last else SHAPE
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gym.spaces.Box(np.float32([-1, 2]), np.float32([1, 5]))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._step, self._number = 0, int(self.np_random.integers(256))
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self._step += 1
        return self._observe(), 0.0, bool(self.np_random.random() < 0.2), False, {}

    def _observe(self) -> NDArray[np.uint8]:
        values = np.array([self._step, self._number, NO_ACTION], dtype=np.uint8)
        observation = np.broadcast_to(values[:, None, None], SHAPE)
        return np.ascontiguousarray(np.moveaxis(observation, 0, -1) if self.channels_last else observation)


gym.register("IndexEnv-v0", entry_point=PlainEnv, vector_entry_point=IndexVectorEnv, max_episode_steps=LIMIT)
gym.register("PlainEnv-v0", entry_point=PlainEnv, max_episode_steps=LIMIT)


class SilentWrapper(gym.Wrapper[Any, Any, Any, Any]):
    """Does not take any environment, and does not say why."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        raise AssertionError
