"""The environments of this package as a batched VecEnv of Stable-Baselines3: one call moves all copies.

``DummyVecEnv`` steps its environments one after the other, each a batch of one. Here the copies are rows of a single
batch, stepped at once; ``Monitor`` and all other wrappers stay around each copy.

Given a Gymnasium ``VectorEnv`` of anybody, :class:`BatchedVecEnv` is a :class:`VectorEnvAdapter` to it.
"""

import copy
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_abisim.envs.base import BatchEnv, SingleEnv
from sb3_abisim.envs.plain_wrappers import PlainWrappers


class BatchedVecEnv(DummyVecEnv):
    """``DummyVecEnv`` for the environments of this package: the same observations, rewards and infos, sooner.

    Where all wrappers of a copy are Gymnasium's and Stable-Baselines3's usual ones, they are called at the ends of
    episodes alone (:mod:`sb3_abisim.envs.plain_wrappers`).

    :param env_fns: functions that make the environments: all ``gymnasium.make`` of one id of this package with the
        same arguments, in any wrappers that leave actions as they are and do not look at the environment
        before they step it: all copies have moved by then. Or a Gymnasium ``VectorEnv``, whatever it comes from; the
        result is then a :class:`VectorEnvAdapter`
    :raises ValueError: for other environments; use ``DummyVecEnv`` for them
    """

    def __new__(cls, env_fns: Any = None) -> Any:
        """An adapter for a ``VectorEnv``; copies without arguments are made by pickle."""
        return VectorEnvAdapter(env_fns) if isinstance(env_fns, VectorEnv) else super().__new__(cls)

    def __init__(self, env_fns: list[Callable[[], gym.Env[Any, Any]]]) -> None:
        super().__init__(env_fns)
        copies = [env.unwrapped for env in self.envs]
        first = copies[0]
        if not isinstance(first, SingleEnv) or first.spec is None:
            raise ValueError(f"{first} was not made by gymnasium.make of an id of sb3_abisim; use DummyVecEnv")
        differing = [one.spec for one in copies if one.spec != first.spec]
        if differing:
            raise ValueError(
                f"the copies must be made alike, got {first.spec} and {differing[0]}; use DummyVecEnv for these"
            )
        self._batch = first.batch_class(num_envs=self.num_envs, autoreset=False, **first.spec.kwargs)
        self._rows = [_Row(self._batch, i) for i in range(self.num_envs)]
        for one, row in zip(copies, self._rows, strict=True):
            one.batch = row  # type: ignore[attr-defined]
        self._wrappers = [PlainWrappers(env) for env in self.envs]

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step that ``step_async`` began.

        :return: as from ``DummyVecEnv``
        """
        for row in self._rows:
            row.require_reset()
        # Which copies have to be reset is for the rows to know.
        self._batch._needs_reset = False
        outcome = self._batch.step(self.actions)
        if self._may_count(outcome):
            return self._count(outcome)
        for row, action in zip(self._rows, self.actions, strict=True):
            row.prepare(action, outcome)
        return super().step_wait()

    def _may_count(self, outcome: tuple[Any, ...]) -> bool:
        """Whether the wrappers need not be called where no episode ends."""
        observations, _, _, _, infos = outcome
        return (
            isinstance(observations, np.ndarray)
            and all(array.ndim == 1 for array in infos.values())
            and all(
                wrappers.env is env and wrappers.are_plain()
                for wrappers, env in zip(self._wrappers, self.envs, strict=True)
            )
        )

    def _count(self, outcome: tuple[Any, ...]) -> VecEnvStepReturn:
        """As ``DummyVecEnv.step_wait``, which calls every copy; here those alone whose episode ends are called."""
        observations, rewards, terminated, _, infos = outcome
        numbers, dones = rewards.tolist(), terminated.tolist()
        columns = {name: array.tolist() for name, array in infos.items() if name[0] != "_"}
        rows: list[dict[str, Any]] = []
        for i, wrappers in enumerate(self._wrappers):
            if dones[i] or wrappers.end_next():
                dones[i], row = self._end(i, outcome)
            else:
                wrappers.count(numbers[i])
                row = {name: column[i] for name, column in columns.items()}
                row["TimeLimit.truncated"] = False
            rows.append(row)
        return observations, rewards.astype(np.float32), np.array(dones, dtype=bool), rows

    def _end(self, i: int, outcome: tuple[Any, ...]) -> tuple[bool, dict[str, Any]]:
        """Let one copy step through its wrappers, and begin its next episode if this one has ended.

        :param i: which
        :param outcome: of the batch's step; the first observation of the next episode is put in its place
        :return: whether it has ended, and its infos
        """
        self._rows[i].prepare(self.actions[i], outcome)
        observation, _, terminated, truncated, info = self.envs[i].step(self.actions[i])
        info["TimeLimit.truncated"] = truncated and not terminated
        if terminated or truncated:
            # A view of the array that the next one is put into.
            info["terminal_observation"] = observation.copy()
            outcome[0][i], self.reset_infos[i] = self.envs[i].reset()
        return terminated or truncated, copy.deepcopy(info)


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


class VectorEnvAdapter(VecEnv):
    """Any Gymnasium ``VectorEnv`` as a ``VecEnv``, in whichever way its copies begin new episodes.

    Where they do so at the next step or not at all, finished copies are reset by ``options["reset_mask"]`` at once, so
    that no action is lost. Infos hold ``terminal_observation``, ``TimeLimit.truncated`` and, as those of ``Monitor``,
    ``episode`` with return, length and time.

    :param env: the environment, with ``metadata["autoreset_mode"]``
    :raises ValueError: for one whose batches hold some of the copies only, or that does not say how it resets
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        mode = env.metadata.get("autoreset_mode")
        try:
            self._mode = AutoresetMode(mode)
        except ValueError:
            raise ValueError(
                f"{env} must say when its copies begin new episodes: metadata['autoreset_mode'] must be one of "
                f"{', '.join(map(str, AutoresetMode))}, got {mode!r}"
            ) from None
        batch = env.action_space.shape or (env.num_envs,)
        if batch[0] != env.num_envs:
            raise ValueError(f"{env} steps {batch[0]} of {env.num_envs} copies at a time; make it without a batch_size")
        self.env, self.metadata, self.spec = env, env.metadata, env.spec
        self._actions: Any = None
        self._started = time.time()
        self._returns, self._lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, int)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Begin a new episode in every copy.

        :return: their first observations
        """
        if any(options != self._options[0] for options in self._options):
            raise ValueError(f"the copies of a VectorEnv are reset with equal options, got {self._options}")
        # Stable-Baselines3's seeds count up from the first, as those of a VectorEnv do; not every one takes others.
        seed: Any = self._seeds[0]
        if seed is not None and self._seeds != [seed + i for i in range(self.num_envs)]:
            seed = list(self._seeds)
        observations, infos = self.env.reset(seed=seed, options=dict(self._options[0]) or None)
        self.reset_infos = [_info_row(infos, i, self.num_envs) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0, 0
        return copy.deepcopy(observations)  # type: ignore[no-any-return]

    def seed_each(self, seeds: Sequence[int]) -> None:
        """Give every copy a seed of its own for the next reset; ``seed`` gives them consecutive ones.

        :param seeds: one for each copy
        """
        self._seeds = list(seeds)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for :meth:`step_wait`.

        :param actions: one for each copy
        """
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step.

        :return: as from ``DummyVecEnv``
        """
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        observations, dones = copy.deepcopy(observations), np.asarray(terminated | truncated, dtype=bool)
        rows = [_info_row(infos, i, self.num_envs) for i in range(self.num_envs)]
        self._returns += rewards
        self._lengths += 1
        ended = np.flatnonzero(dones).tolist()
        if ended:
            begin = self._take_final if self._mode == AutoresetMode.SAME_STEP else self._reset_ended
            observations = begin(observations, dones, infos, rows)
        for i, row in enumerate(rows):
            row["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        for i in ended:
            taken = round(time.time() - self._started, 6)
            statistics = {"r": round(float(self._returns[i]), 6), "l": int(self._lengths[i]), "t": taken}
            rows[i].setdefault("episode", statistics)
            self._returns[i], self._lengths[i] = 0, 0
        return observations, np.asarray(rewards, np.float32), dones, rows

    def _take_final(
        self, observations: Any, dones: NDArray[np.bool_], infos: dict[str, Any], rows: list[dict[str, Any]]
    ) -> Any:
        """The copies have begun their next episodes; what they ended with stands in the infos."""
        if "final_obs" not in infos:
            raise ValueError(f"{self.env} resets in the same step, but infos['final_obs'] is missing; set it there")
        for i in np.flatnonzero(dones):
            of_reset = {name: rows[i][name] for name in rows[i] if name not in ("final_obs", "final_info")}
            # Without final_info, infos describe the step.
            described = "final_info" in rows[i]
            self.reset_infos[i] = of_reset if described else {}
            rows[i] = dict(rows[i]["final_info"]) if described else of_reset
            rows[i]["terminal_observation"] = copy.deepcopy(_row(infos["final_obs"], int(i)))
        return observations

    def _reset_ended(
        self, observations: Any, dones: NDArray[np.bool_], infos: dict[str, Any], rows: list[dict[str, Any]]
    ) -> Any:
        """Reset the copies that have ended, now."""
        for i in np.flatnonzero(dones):
            rows[i]["terminal_observation"] = copy.deepcopy(_row(observations, int(i)))
        first, reset_infos = self.env.reset(options={"reset_mask": dones.copy()})
        first = copy.deepcopy(first)
        going = np.flatnonzero(~dones)
        for before, after in zip(_leaves(observations), _leaves(first), strict=True):
            if not np.array_equal(before[going], after[going]):
                raise ValueError(
                    f"{self.env} does not know options['reset_mask']: other copies were reset, too; make it with "
                    "autoreset_mode=AutoresetMode.SAME_STEP"
                )
        for i in np.flatnonzero(dones):
            self.reset_infos[i] = _info_row(reset_infos, int(i), self.num_envs)
        return first

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Images of all copies, None where it renders none."""
        images: Any = self.env.render()
        return [None] * self.num_envs if images is None else list(images)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of copies; of the environment itself, where it has no copies.

        :param attr_name: its name
        :param indices: of the copies, None for all
        """
        copies, chosen = self._copies(), self._get_indices(indices)
        if copies is not None:
            return [copies[i].get_wrapper_attr(attr_name) for i in chosen]
        if hasattr(self.env.unwrapped, "call"):
            values = self.env.unwrapped.get_attr(attr_name)  # type: ignore[attr-defined]
            return [values[i] for i in chosen]
        return [getattr(self.env.unwrapped, attr_name) for _ in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of copies; of the environment itself, where it has no copies.

        :param attr_name: its name
        :param value: what it becomes
        :param indices: of the copies, None for all
        """
        copies = self._copies()
        if copies is not None:
            for i in self._get_indices(indices):
                setattr(copies[i], attr_name, value)
            return
        self._require_all(f"set {attr_name}", indices)
        if hasattr(self.env.unwrapped, "call"):
            self.env.unwrapped.set_attr(attr_name, value)  # type: ignore[attr-defined]
        else:
            setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of copies.

        :param method_name: its name
        :param method_args: its arguments
        :param indices: of the copies, None for all
        :param method_kwargs: its keyword arguments
        :raises AttributeError: for an environment that has no copies
        """
        copies = self._copies()
        if copies is not None:
            chosen = self._get_indices(indices)
            return [copies[i].get_wrapper_attr(method_name)(*method_args, **method_kwargs) for i in chosen]
        if not hasattr(self.env.unwrapped, "call"):
            raise AttributeError(f"{self.env} steps all copies as one, so that there is no {method_name} of one copy")
        self._require_all(f"call {method_name}", indices)
        return list(self.env.unwrapped.call(method_name, *method_args, **method_kwargs))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Whether copies are wrapped; in a ``Monitor`` they are, so to speak, since infos hold ``episode``.

        :param wrapper_class: of a copy or of the whole
        :param indices: of the copies, None for all
        """
        copies, whole = self._copies(), wrapper_class is Monitor
        env: Any = self.env
        while isinstance(env, VectorWrapper):
            whole, env = whole or isinstance(env, wrapper_class), env.env
        chosen = self._get_indices(indices)
        return [whole or (copies is not None and is_wrapped(copies[i], wrapper_class)) for i in chosen]

    def _copies(self) -> list[gym.Env[Any, Any]] | None:
        """The environments behind a ``SyncVectorEnv`` and the like."""
        copies = getattr(self.env.unwrapped, "envs", None)
        return None if copies is None else list(copies)

    def _require_all(self, what: str, indices: VecEnvIndices) -> None:
        if indices is not None and set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ValueError(f"{self.env} can {what} in all copies alone, got indices {indices}; leave them out")


def _row(batch: Any, i: int) -> Any:
    """One copy's part of a batch of observations."""
    return {name: _row(part, i) for name, part in batch.items()} if isinstance(batch, dict) else batch[i]


def _leaves(batch: Any) -> list[NDArray[Any]]:
    return [leaf for part in batch.values() for leaf in _leaves(part)] if isinstance(batch, dict) else [batch]


def _info_row(infos: dict[str, Any], i: int, num_envs: int) -> dict[str, Any]:
    """One copy's infos: Gymnasium keeps arrays, and beside ``name`` a mask ``_name`` of the copies that have it."""
    row: dict[str, Any] = {}
    for name, values in infos.items():
        mask = infos.get(f"_{name}")
        is_mask = name.startswith("_") and name[1:] in infos
        if is_mask or (mask is not None and not mask[i]):
            continue
        if isinstance(values, dict):
            row[name] = _info_row(values, i, num_envs)
        else:
            row[name] = values[i] if hasattr(values, "__len__") and len(values) == num_envs else values
    return row
