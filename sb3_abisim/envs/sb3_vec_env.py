"""The environments of this package as a batched VecEnv of Stable-Baselines3: one call moves all copies.

``DummyVecEnv`` steps its environments one after the other, each a batch of one. Here the copies are rows of a single
batch, stepped at once; ``Monitor`` and all other wrappers stay around each copy as they were.
"""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_abisim.envs.base import BatchEnv, SingleEnv


class BatchedVecEnv(DummyVecEnv):
    """``DummyVecEnv`` for the environments of this package: the same observations, rewards and infos, sooner.

    :param env_fns: functions that make the environments: all ``gymnasium.make`` of one id of this package with the
        same arguments, in any wrappers that leave actions as they are and do not look at the environment
        before they step it: all copies have moved by then
    :raises ValueError: for other environments; use ``DummyVecEnv`` for them
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env[Any, Any]]]) -> None:
        super().__init__(env_fns)
        copies = [env.unwrapped for env in self.envs]
        first = copies[0]
        if not isinstance(first, SingleEnv) or first.spec is None:
            raise ValueError(f"{first} was not made by gymnasium.make of an id of sb3_abisim; use DummyVecEnv")
        differing = [copy.spec for copy in copies if copy.spec != first.spec]
        if differing:
            raise ValueError(
                f"the copies must be made alike, got {first.spec} and {differing[0]}; use DummyVecEnv for these"
            )
        self._batch = first.batch_class(num_envs=self.num_envs, autoreset=False, **first.spec.kwargs)
        self._rows = [_Row(self._batch, i) for i in range(self.num_envs)]
        for copy, row in zip(copies, self._rows, strict=True):
            copy.batch = row  # type: ignore[attr-defined]

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step that ``step_async`` began.

        :return: as from ``DummyVecEnv``
        """
        for row in self._rows:
            row.require_reset()
        # Which copies have to be reset is for the rows to know.
        self._batch._needs_reset = False
        outcome = self._batch.step(self.actions)
        for row, action in zip(self._rows, self.actions, strict=True):
            row.prepare(action, outcome)
        return super().step_wait()


class _Row:
    """What a ``SingleEnv`` has for its batch of one: one row of a batch that others share."""

    def __init__(self, batch: BatchEnv, index: int) -> None:
        self._batch, self._index = batch, index
        self._indices = np.array([index])
        self._row = slice(index, index + 1)
        self._needs_reset = True
        self._action: Any = None
        self._outcome: Any = None

    def __getattr__(self, name: str) -> Any:
        # While an object is being copied or unpickled, it has no batch yet.
        if name == "_batch":
            raise AttributeError(name)
        return getattr(self._batch, name)

    def take_generator(self, generator: np.random.Generator) -> None:
        generators = self._batch._generators
        if not generators:
            generators.extend(seeding.np_random(None)[0] for _ in range(self._batch.num_envs))
        generators[self._index] = generator

    def reset(self, *, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._batch._take_options(options or {})
        self._batch._begin(self._indices)
        self._needs_reset = False
        return self._batch._observe(self._indices), {}

    def require_reset(self) -> None:
        if self._needs_reset:
            raise RuntimeError("the episode is over (or has not begun): call reset() before step()")

    def prepare(self, action: Any, outcome: tuple[Any, ...]) -> None:
        """Keep the outcome of the batch's step for the call of ``step`` that comes through the wrappers."""
        self._action, self._outcome = action, outcome

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        if self._outcome is None or not np.array_equal(actions[0], self._action):
            raise ValueError(
                f"BatchedVecEnv has stepped with {self._action!r}, but {actions[0]!r} arrives through the wrappers; "
                "step the VecEnv only, and use DummyVecEnv with wrappers that change actions"
            )
        observations, rewards, terminated, truncated, infos = self._outcome
        self._outcome, row = None, self._row
        self._needs_reset = bool(terminated[self._index] or truncated[self._index])
        info = {name: array[row] for name, array in infos.items()}
        if isinstance(observations, dict):
            observation: Any = {name: array[row] for name, array in observations.items()}
        else:
            observation = observations[row]
        return observation, rewards[row], terminated[row], truncated[row], info

    def oracle_actions(self) -> NDArray[np.int64]:
        actions: NDArray[np.int64] = self._batch.oracle_actions()[self._row]  # type: ignore[attr-defined]
        return actions

    def factors(self) -> dict[str, NDArray[Any]]:
        return {name: array[self._row] for name, array in self._batch.factors().items()}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        return None if self._batch.render_mode is None else (self._batch._render_frame(self._index),)
