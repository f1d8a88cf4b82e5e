"""An environment of another package; imported by tests and, in child processes, by --packages.

Its image observations fit a default network. Nothing of sb3_abisim names it, and it has no batch.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.registry import EnvTraits, register_traits

SHAPE = (3, 64, 64)
LENGTH = 6


class ToyEnv(gym.Env[NDArray[np.uint8], np.int64]):
    """Random image observations; the reward depends on observation and action. ``scale`` multiplies it."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, scale: float = 1.0, split: str = "train", render_mode: str | None = None) -> None:
        self.observation_space = gym.spaces.Box(0, 255, SHAPE, np.uint8)
        self.action_space = gym.spaces.Discrete(2)
        self.scale, self.split, self.render_mode = scale, split, render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return self._observe(), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        self._step += 1
        observation = self._observe()
        reward = self.scale * (float(observation[0, 0, 0]) / 255 + float(action))
        return observation, reward, self._step == LENGTH, False, {"is_success": True}

    def render(self) -> NDArray[np.uint8]:
        return np.zeros((64, 64, 3), np.uint8)

    def _observe(self) -> NDArray[np.uint8]:
        return self.np_random.integers(0, 256, SHAPE, np.uint8)


class RobotEnv(gym.Env[Any, Any]):
    """A Dict of two cameras of different size, channels last, and where the arm is; the reward depends on the action.

    :param wrist: False leaves out the second camera
    :param continuous: how the action is given
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, wrist: bool = True, continuous: bool = False, render_mode: str | None = None) -> None:
        parts: dict[str, gym.Space[Any]] = {
            "arm": gym.spaces.Box(-1, 1, (3,)), "camera": gym.spaces.Box(0, 255, (20, 24, 3), np.uint8)
        }  # fmt: skip
        parts |= {"wrist": gym.spaces.Box(0, 255, (12, 12, 1), np.uint8)} if wrist else {}
        self.observation_space: gym.Space[Any] = gym.spaces.Dict(parts)
        self.action_space = gym.spaces.Box(-1, 1, (2,)) if continuous else gym.spaces.Discrete(3)
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        self._step = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._step += 1
        return self.observation_space.sample(), float(np.sum(action)), False, self._step == LENGTH, {}

    def render(self) -> NDArray[np.uint8]:
        return np.zeros((20, 24, 3), np.uint8)


class Camera(gym.ObservationWrapper[NDArray[np.uint8], Any, Any]):
    """The robot's camera alone."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = env.observation_space["camera"]  # type: ignore[index]

    def observation(self, observation: Any) -> NDArray[np.uint8]:
        return observation["camera"]  # type: ignore[no-any-return]


class Invert(gym.ObservationWrapper[NDArray[np.uint8], np.int64, NDArray[np.uint8]]):
    """The negative."""

    def observation(self, observation: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return 255 - observation


class Lives(gym.Wrapper[Any, Any, Any, Any]):
    """Ends an episode every two steps, and lets the environment go on, as wrappers of Atari do where a life is lost."""

    over = True

    def reset(self, **kwargs: Any) -> Any:
        if self.over:
            self.shown = self.env.reset(**kwargs)
        return self.shown

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.over, self.shown = terminated or truncated, (observation, info)
        return observation, reward, terminated or self.unwrapped._step % 2 == 0, truncated, info


gym.register("Toy-v0", entry_point=ToyEnv)
gym.register("Robot-v0", entry_point=RobotEnv)
# The same with what sb3_abisim knows of an environment.
gym.register("SplitToy-v0", entry_point=ToyEnv)
register_traits("SplitToy-v0", EnvTraits(splits=("eval", "train"), split_kwargs=("split",)))
