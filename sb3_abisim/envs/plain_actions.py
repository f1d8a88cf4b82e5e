"""A wrapper whose actions Stable-Baselines3 takes, around an environment whose actions it does not.

Stable-Baselines3 counts actions from 0 and gives rows of numbers. Datasets, objectives and encoders take the others as
they are, so the wrapper is for training alone, and changes no observation.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

# How an env_wrapper of hyperparameters names the wrapper.
PLAIN_ACTIONS = "sb3_abisim.PlainActions"


def require_plain(space: gym.Space[Any]) -> None:
    """Refuse actions that Stable-Baselines3 does not take, and :class:`PlainActions` makes it take.

    :param space: of actions
    :raises ValueError: naming the wrapper
    """
    if plain_space(space) != space:
        raise ValueError(
            f"Stable-Baselines3 takes actions that count from 0 and lie in one row, and these do not: {space}; wrap "
            f"the environment in {PLAIN_ACTIONS} (in the zoo, add -params env_wrapper:{PLAIN_ACTIONS}, after other "
            "wrappers if there are any)"
        )


def plain_space(space: gym.Space[Any]) -> gym.Space[Any]:
    """The same actions, counted from 0 and in one row.

    :param space: of actions
    :return: of another space than ``Discrete``, ``MultiDiscrete``, ``MultiBinary`` and a ``Box`` of one number, itself
    """
    if isinstance(space, spaces.Discrete):
        return space if space.start == 0 else spaces.Discrete(int(space.n))
    if isinstance(space, spaces.MultiDiscrete):
        is_flat = space.nvec.ndim == 1 and not space.start.any()
        return space if is_flat else spaces.MultiDiscrete(space.nvec.reshape(-1), dtype=space.dtype.type)
    if isinstance(space, spaces.MultiBinary):
        return space if len(space.shape) == 1 else spaces.MultiBinary(int(np.prod(space.shape)))
    if isinstance(space, spaces.Box) and space.shape == ():
        return spaces.Box(space.low.reshape(1), space.high.reshape(1), dtype=space.dtype.type)
    return space


class PlainActions(gym.ActionWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Actions counted from 0 and in one row of numbers, made those of the environment.

    For ``Discrete`` and ``MultiDiscrete`` with another ``start``, ``MultiDiscrete`` and ``MultiBinary`` of several
    dimensions, and a ``Box`` of a single number. Other actions stay as they are.

    :param env: any environment
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.action_space = plain_space(env.action_space)

    def action(self, action: Any) -> Any:
        """The action of the environment.

        :param action: of :attr:`action_space`
        """
        space = self.env.action_space
        if plain_space(space) == space:
            return action
        if isinstance(space, spaces.Discrete):
            return space.start + np.int64(action)
        start = space.start if isinstance(space, spaces.MultiDiscrete) else 0
        return np.asarray(np.reshape(action, space.shape or ()) + start, space.dtype)
