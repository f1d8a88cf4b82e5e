"""Actions as Stable-Baselines3 gives them reach an environment whose actions it does not take."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from action_spaces import SPACES
from gymnasium import spaces
from stable_baselines3 import A2C
from stable_baselines3.common.env_checker import check_env

from sb3_abisim.envs.plain_actions import PLAIN_ACTIONS, PlainActions, plain_space, require_plain

# What Stable-Baselines3 is shown, and one action there and in the environment.
EXPECTED: dict[str, tuple[gym.Space[Any], Any, Any]] = {
    "discrete": (spaces.Discrete(3), 2, 7),
    "multi_discrete": (spaces.MultiDiscrete([3, 2]), [2, 0], [3, -1]),
    "multi_discrete_2d": (spaces.MultiDiscrete([2, 3, 2, 2]), [0, 2, 1, 0], [[0, 2], [1, 0]]),
    "multi_binary_2d": (spaces.MultiBinary(4), [1, 0, 0, 0], [[1, 0], [0, 0]]),
    "box_scalar": (spaces.Box(-0.01, 0.01, (1,), np.float32), [0.01], 0.01),
    "multi_binary": (SPACES["multi_binary"], [1, 0, 1], [1, 0, 1]),
    "box_2d_float64": (SPACES["box_2d_float64"], [[3.0, 11], [0, 4]], [[3.0, 11], [0, 4]]),
}


class Takes(gym.Env[Any, Any]):
    """Keeps what it was given, which must lie in its space."""

    def __init__(self, space: gym.Space[Any]) -> None:
        self.observation_space, self.action_space = spaces.Box(-1, 1, (2,)), space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), (action, self.action_space)
        self.taken = action
        return np.zeros(2, np.float32), 0.0, False, False, {}


@pytest.mark.parametrize("kind", SPACES)
def test_the_environment_gets_its_own_actions(kind: str) -> None:
    space, given, taken = EXPECTED[kind]
    env = PlainActions(Takes(SPACES[kind]))
    assert env.action_space == space and env.action_space.dtype == SPACES[kind].dtype
    require_plain(space)
    if space != SPACES[kind]:
        with pytest.raises(ValueError, match=f"(?s)do not: .*wrap the environment in {PLAIN_ACTIONS}"):
            require_plain(SPACES[kind])
    env.step(given if kind == "discrete" else np.array(given, space.dtype))
    assert np.array_equal(env.unwrapped.taken, np.array(taken, SPACES[kind].dtype))
    env.action_space.seed(0)
    for _ in range(20):
        env.step(env.action_space.sample())


@pytest.mark.parametrize("kind", [kind for kind, (space, _, _) in EXPECTED.items() if space != SPACES[kind]])
def test_stable_baselines3_trains_on_them(kind: str) -> None:
    env = PlainActions(Takes(SPACES[kind]))
    check_env(env, warn=False)
    A2C("MlpPolicy", env, n_steps=4, device="cpu").learn(8)


def test_other_spaces_are_left_alone() -> None:
    space = spaces.Tuple([spaces.Discrete(2, start=1)])
    assert plain_space(space) is space
    require_plain(space)


def test_hyperparameters_find_it_by_its_name() -> None:
    import sb3_abisim

    assert PLAIN_ACTIONS == "sb3_abisim.PlainActions" and sb3_abisim.PlainActions is PlainActions
    spec = PlainActions(gym.make("CartPole-v1")).spec
    assert spec is not None and spec.additional_wrappers[-1].name == "PlainActions"
