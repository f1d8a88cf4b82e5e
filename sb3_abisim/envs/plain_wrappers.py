"""What the usual wrappers of an environment note of a step, without calling them.

``gymnasium.make`` puts three wrappers around an environment and Stable-Baselines3 a fourth. Within a batch of rows that
have moved already, a step through them does little but count, and takes longer than the physics. Where an episode does
not end, the counts can be written directly; a step that ends one, and any other wrapper, needs the wrappers themselves.
"""

import sys
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from stable_baselines3.common.monitor import Monitor

from sb3_abisim.envs.base import SingleEnv

# Of exactly these classes: a subclass may do anything.
_PLAIN = (OrderEnforcing, PassiveEnvChecker, TimeLimit, Monitor)


def _is_plain(wrapper: gym.Wrapper[Any, Any, Any, Any]) -> bool:
    # rl-zoo3 puts a time limit of its own in the place of Gymnasium's, which differs at the ends of episodes alone.
    patches = sys.modules.get("rl_zoo3.gym_patches")
    return type(wrapper) in _PLAIN or (patches is not None and type(wrapper) is patches.PatchedTimeLimit)


class PlainWrappers:
    """The wrappers of one environment, if they are all of Gymnasium's and Stable-Baselines3's own.

    :param env: in its wrappers. Gymnasium's time limit may be the one that rl-zoo3 puts in its place
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env = env
        self._wrappers: list[Any] = []
        while isinstance(env, gym.Wrapper):
            self._wrappers.append(env)
            env = env.env
        self._copy = env
        self._is_plain = type(env).step is SingleEnv.step and all(map(_is_plain, self._wrappers))
        self._limits: list[Any] = [one for one in self._wrappers if isinstance(one, TimeLimit)]
        self._monitors: list[Any] = [one for one in self._wrappers if type(one) is Monitor]

    def are_plain(self) -> bool:
        """Whether a step may be counted by :meth:`count`; not before Gymnasium's checker has done its first checks."""
        if not self._is_plain:
            return False
        for one in self._wrappers:
            # Gymnasium before 1.4 checks no reuse of data.
            reuse_checked = getattr(one, "checked_data_reuse", True)
            if type(one) is PassiveEnvChecker and not (one.checked_step and reuse_checked):
                return False
        # Somebody may have put another method into an object.
        return not any("step" in vars(one) for one in (*self._wrappers, self._copy))

    def end_next(self) -> bool:
        """Whether the time limit ends the episode with the coming step, or something is not as after a reset."""
        for limit in self._limits:
            elapsed = limit._elapsed_steps
            if elapsed is None or elapsed + 1 >= limit._max_episode_steps:
                return True
        return any(monitor.needs_reset for monitor in self._monitors)

    def count(self, reward: float) -> None:
        """Note a step that does not end the episode.

        :param reward: of the step
        """
        for limit in self._limits:
            limit._elapsed_steps += 1
        for monitor in self._monitors:
            monitor.rewards.append(reward)
            monitor.total_steps += 1
