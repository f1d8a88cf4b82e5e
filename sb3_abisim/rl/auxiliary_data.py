"""Transitions of what Stable-Baselines3's algorithms have just seen, for an objective that trains while RL runs.

A transition never crosses an episode's end, and its next observation is the true one:

* A rollout buffer has no next observations. That of an episode's last step stands in ``info["terminal_observation"]``
  alone, and that of a rollout's last step is the observation that the next rollout begins with.
* A replay buffer is a ring, whose oldest step is at ``pos`` once it is full. It is read by index and not by its own
  ``sample``, so that n-step buffers give single steps, and no global random numbers are used. With
  ``optimize_memory_usage`` it has one array for both observations, in which the next episode's first observation takes
  the place of a terminal one, and the newest next observation that of the oldest observation: these steps are left out.
* Actions are those that the environment got (:func:`~sb3_abisim.common.spaces.executed_actions`).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer

from sb3_abisim.common.spaces import executed_actions
from sb3_abisim.common.transitions import TransitionBatch

Index = NDArray[np.int64]
# So many times as many steps as are needed are looked at before a batch is given up.
MAX_ROUNDS = 50


class Steps(ABC):
    """Steps of several environments, [n_steps, n_envs], the oldest first.

    :param n_steps: of each environment
    :param n_envs: number of environments
    """

    n_steps: int
    n_envs: int

    @property
    def size(self) -> int:
        """Number of all steps."""
        return self.n_steps * self.n_envs

    @abstractmethod
    def ended(self, t: Index, env: Index) -> NDArray[np.bool_]:
        """Whether the step after is of another episode.

        :param t: of the steps, [m]
        :param env: of the steps, [m]
        """

    @abstractmethod
    def has_next(self, t: Index, env: Index) -> NDArray[np.bool_]:
        """Whether the observation that a step led to is known.

        :param t: of the steps, [m]
        :param env: of the steps, [m]
        """

    @abstractmethod
    def observations(self, key: str | None, t: Index, env: Index) -> NDArray[np.uint8]:
        """Observations before steps, [m, C, H, W].

        :param key: of the image in a ``Dict``, None for observations that are one image
        :param t: of the steps, [m]
        :param env: of the steps, [m]
        """

    @abstractmethod
    def next_observations(self, key: str | None, t: Index, env: Index) -> NDArray[np.uint8]:
        """Observations that steps led to, [m, C, H, W]; where :meth:`has_next`.

        :param key: as above
        :param t: of the steps, [m]
        :param env: of the steps, [m]
        """

    @abstractmethod
    def actions(self, t: Index, env: Index) -> NDArray[Any]:
        """Actions as the environments got them, [m, *shape of an action].

        :param t: of the steps, any shape
        :param env: of the steps, likewise
        """


class RolloutSteps(Steps):
    """Those of rollouts, one after the other.

    :param observed: observations by key, each [n_steps, n_envs, C, H, W]; the key is None for one image
    :param taken: actions, [n_steps, n_envs, *shape of an action]
    :param dones: whether an episode ended with the step, [n_steps, n_envs]
    :param terminal: observations by key, then by (step, environment), of the steps with which an episode ended
    :param last: the observations after the last step, by key, each [n_envs, C, H, W]
    """

    def __init__(
        self,
        observed: dict[str | None, NDArray[np.uint8]],
        taken: NDArray[Any],
        dones: NDArray[np.bool_],
        terminal: dict[str | None, dict[tuple[int, int], NDArray[np.uint8]]],
        last: dict[str | None, NDArray[np.uint8]],
    ) -> None:
        self.n_steps, self.n_envs = dones.shape
        self.observed, self.taken, self.dones, self.terminal, self.last = observed, taken, dones, terminal, last
        self._known = ~dones
        for t, env in next(iter(terminal.values()), {}):
            self._known[t, env] = True

    @classmethod
    def join(cls, parts: list["RolloutSteps"]) -> "RolloutSteps":
        """Rollouts that followed each other as one.

        :param parts: the oldest first, at least one
        """
        if len(parts) == 1:
            return parts[0]
        starts = np.cumsum([0, *(part.n_steps for part in parts)]).tolist()
        terminal = {
            key: {
                (start + t, env): observation
                for start, part in zip(starts, parts, strict=False)
                for (t, env), observation in part.terminal[key].items()
            }
            for key in parts[0].observed
        }
        observed = {key: np.concatenate([part.observed[key] for part in parts]) for key in parts[0].observed}
        taken, dones = (np.concatenate([getattr(part, name) for part in parts]) for name in ("taken", "dones"))
        return cls(observed, taken, dones, terminal, parts[-1].last)

    def ended(self, t: Index, env: Index) -> NDArray[np.bool_]:
        """See :class:`Steps`."""
        return self.dones[t, env]

    def has_next(self, t: Index, env: Index) -> NDArray[np.bool_]:
        """See :class:`Steps`."""
        return self._known[t, env]

    def observations(self, key: str | None, t: Index, env: Index) -> NDArray[np.uint8]:
        """See :class:`Steps`."""
        return self.observed[key][t, env]

    def next_observations(self, key: str | None, t: Index, env: Index) -> NDArray[np.uint8]:
        """See :class:`Steps`."""
        after = np.minimum(t + 1, self.n_steps - 1)
        found = self.observed[key][after, env]
        newest = t == self.n_steps - 1
        found[newest] = self.last[key][env[newest]]
        for i in np.flatnonzero(self.dones[t, env]):
            found[i] = self.terminal[key][int(t[i]), int(env[i])]
        return found

    def actions(self, t: Index, env: Index) -> NDArray[Any]:
        """See :class:`Steps`."""
        return self.taken[t, env]

    def to_tensors(self) -> dict[str, th.Tensor]:
        """Everything as tensors, for :meth:`from_tensors`."""
        named: dict[str, Any] = {"taken": self.taken, "dones": self.dones}
        for key, observed in self.observed.items():
            terminal = self.terminal[key]
            named[f"observed.{key or ''}"], named[f"last.{key or ''}"] = observed, self.last[key]
            if terminal:
                named["ends"] = np.array(list(terminal), np.int64)
                named[f"terminal.{key or ''}"] = np.stack(list(terminal.values()))
        return {name: th.from_numpy(np.ascontiguousarray(array)) for name, array in named.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, th.Tensor]) -> "RolloutSteps":
        """The inverse of :meth:`to_tensors`.

        :param tensors: by name
        """
        parts: dict[str, dict[str | None, Any]] = {"observed": {}, "last": {}, "terminal": {}}
        for name, tensor in tensors.items():
            kind, dot, key = name.partition(".")
            if dot:
                parts[kind][key or None] = tensor.numpy()
        ends = [(int(t), int(env)) for t, env in tensors["ends"]] if "ends" in tensors else []
        terminal = {key: dict(zip(ends, parts["terminal"].get(key, ()), strict=True)) for key in parts["observed"]}
        return cls(parts["observed"], tensors["taken"].numpy(), tensors["dones"].numpy(), terminal, parts["last"])


class RolloutHistory:
    """The newest rollouts, as many as hold enough steps; of long ones, the newest alone.

    :param n_least: steps, over all environments
    """

    def __init__(self, n_least: int) -> None:
        self.n_least = n_least
        self.parts: list[RolloutSteps] = []

    def add(self, rollout: RolloutSteps) -> None:
        """Add a rollout, and drop those that are not needed any more.

        :param rollout: if it does not begin where the one before ended (another ``learn`` has reset the environments),
            the others are dropped
        """
        if self.parts:
            last, first = self.parts[-1].last, {key: array[0] for key, array in rollout.observed.items()}
            if not all(np.array_equal(last[key], first[key]) for key in first):
                self.parts = []
        self.parts.append(rollout)
        while sum(part.size for part in self.parts[1:]) >= self.n_least:
            del self.parts[0]

    def release(self) -> None:
        """Forget a rollout that is enough by itself: the next one will be, too, and its observations are many."""
        if len(self.parts) == 1 and self.parts[0].size >= self.n_least:
            self.parts = []


def read_rollout(
    buffer: RolloutBuffer,
    keys: list[str | None],
    space: gym.Space[Any],
    scaled: bool,
    dones: list[NDArray[np.bool_]],
    terminal: dict[str | None, dict[tuple[int, int], NDArray[np.uint8]]],
    last: Any,
) -> RolloutSteps:
    """The steps of a rollout that has just ended, before the algorithm has shuffled its buffer.

    :param buffer: full
    :param keys: of the images
    :param space: of actions
    :param scaled: whether actions of a ``Box`` lie in -1..1 (a policy with ``squash_output``)
    :param dones: of each step, [n_envs]
    :param terminal: see :class:`RolloutSteps`
    :param last: the algorithm's last observations
    """
    assert not buffer.generator_ready, "the rollout is read before train(), which flattens it"
    # No copies: the buffer makes new arrays for the next rollout.
    observations: Any = buffer.observations
    observed = {key: observations if key is None else observations[key] for key in keys}
    taken = executed_actions(space, buffer.actions, scaled, clipped=not scaled)
    newest = {key: np.array(last if key is None else last[key]) for key in keys}
    return RolloutSteps(observed, taken, np.array(dones, bool), terminal, newest)


class ReplaySteps(Steps):
    """Those of a replay buffer, read where they lie.

    :param buffer: of an off-policy algorithm
    """

    def __init__(self, buffer: ReplayBuffer) -> None:
        self._buffer = buffer
        # The newest next observation took the place of the oldest observation.
        self._shared = bool(buffer.optimize_memory_usage)
        skipped = int(self._shared and buffer.full)
        self._first = buffer.pos + skipped if buffer.full else 0
        self.n_steps = buffer.buffer_size - skipped if buffer.full else buffer.pos
        self.n_envs = buffer.n_envs

    def _rows(self, t: Index) -> Index:
        return (self._first + t) % self._buffer.buffer_size

    def ended(self, t: Index, env: Index) -> NDArray[np.bool_]:
        """See :class:`Steps`; also where the step after saw something else: a second ``learn`` resets environments."""
        ended: NDArray[np.bool_] = self._buffer.dones[self._rows(t), env] > 0
        if not self._shared:
            inside = np.flatnonzero(~ended & (t + 1 < self.n_steps))
            rows, after, envs = self._rows(t[inside]), self._rows(t[inside] + 1), env[inside]
            led_to, saw = self._buffer.next_observations, self._buffer.observations
            for key in [None] if isinstance(saw, np.ndarray) else list(saw):
                before, behind = (array if key is None else array[key] for array in (led_to, saw))
                same = before[rows, envs] == behind[after, envs]
                ended[inside] |= ~same.all(axis=tuple(range(1, same.ndim)))
        return ended

    def has_next(self, t: Index, env: Index) -> NDArray[np.bool_]:
        """See :class:`Steps`."""
        if not self._shared:
            return np.ones(len(t), bool)
        known: NDArray[np.bool_] = self._buffer.dones[self._rows(t), env] == 0
        return known

    def observations(self, key: str | None, t: Index, env: Index) -> NDArray[np.uint8]:
        """See :class:`Steps`."""
        array: Any = self._buffer.observations
        found: NDArray[np.uint8] = (array if key is None else array[key])[self._rows(t), env]
        return found

    def next_observations(self, key: str | None, t: Index, env: Index) -> NDArray[np.uint8]:
        """See :class:`Steps`."""
        if self._shared:
            return self.observations(key, t + 1, env)
        array: Any = self._buffer.next_observations
        found: NDArray[np.uint8] = (array if key is None else array[key])[self._rows(t), env]
        return found

    def actions(self, t: Index, env: Index) -> NDArray[Any]:
        """See :class:`Steps`."""
        stored = self._buffer.actions[self._rows(t), env]
        return executed_actions(self._buffer.action_space, stored, scaled=True, clipped=False)


def sample_batch(
    steps: Steps,
    generator: np.random.Generator,
    batch_size: int,
    k: int | list[int] = 1,
    sequences: bool = False,
    key: str | None = None,
) -> TransitionBatch[NDArray[Any]] | None:
    """Transitions that are sampled uniformly, with replacement.

    :param steps: to sample from
    :param generator: moved on
    :param batch_size: number of transitions
    :param k: steps between the two observations, or the fewest and the most of them, of which each transition samples a
        number
    :param sequences: whether actions are all k between the two observations, instead of the first
    :param key: of the image, None for observations that are one
    :return: None while there are too few steps
    :raises ValueError: if there are enough, but hardly any k of them in one episode
    """
    fewest, most = (k, k) if isinstance(k, int) else k
    if steps.size < batch_size or steps.n_steps < fewest:
        return None
    found: list[NDArray[np.int64]] = []
    n_found = 0
    for _ in range(MAX_ROUNDS):
        t = generator.integers(0, steps.n_steps - fewest + 1, batch_size)
        env = generator.integers(0, steps.n_envs, batch_size)
        n = generator.integers(fewest, most + 1, batch_size)
        found.append(np.stack([t, env, n])[:, _in_one_episode(steps, t, env, n)])
        n_found += found[-1].shape[1]
        if n_found >= batch_size:
            break
    else:
        if steps.size < 2 * batch_size:
            return None
        raise ValueError(
            f"of the newest {steps.size} steps hardly any {k} lie in one episode and lead to an observation that is "
            "kept; lower k, or choose an objective of single steps, such as ssi"
        )
    t, env, n = np.concatenate(found, axis=1)[:, :batch_size]
    frames = np.concatenate([steps.observations(key, t, env), steps.next_observations(key, t + n - 1, env)])
    taken = (t[:, None] + np.arange(fewest), env[:, None] + np.zeros(fewest, np.int64)) if sequences else (t, env)
    return TransitionBatch(frames, steps.actions(*taken), slice(None, batch_size), slice(batch_size, None))


def _in_one_episode(steps: Steps, t: Index, env: Index, n: Index) -> NDArray[np.bool_]:
    """Whether n steps from t on are of one episode, and the last of them leads to an observation that is known."""
    fits = t + n <= steps.n_steps
    for j in range(int(n.max()) - 1):
        # The last of the n may end the episode, those before it may not.
        inner = np.flatnonzero(fits & (j < n - 1))
        fits[inner] &= ~steps.ended(t[inner] + j, env[inner])
    inside = np.flatnonzero(fits)
    fits[inside] &= steps.has_next(t[inside] + n[inside] - 1, env[inside])
    return fits


def sample_observations(
    steps: Steps, generator: np.random.Generator, n: int, key: str | None = None
) -> NDArray[np.uint8] | None:
    """Different observations from all over the steps; None while there are fewer.

    :param steps: to sample from
    :param generator: moved on
    :param n: how many
    :param key: of the image, None for observations that are one
    """
    if steps.size < n:
        return None
    chosen = generator.choice(steps.size, n, replace=False)
    return steps.observations(key, chosen // steps.n_envs, chosen % steps.n_envs)
