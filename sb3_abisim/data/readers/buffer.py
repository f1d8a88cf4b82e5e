"""What a Stable-Baselines3 algorithm has seen: its ``ReplayBuffer`` or ``RolloutBuffer``.

Buffers hold less than episodes do, and each gap is cut or left out:

* A ``ReplayBuffer`` is a ring. Once it is full, its oldest transition is at ``pos``.
* Its next observation at an episode's end is the terminal one. With ``optimize_memory_usage`` there is one array for
  both, in which the next episode's first observation takes the terminal one's place: that transition is left out, as is
  the oldest one of a full ring, whose observation is gone.
* A second ``learn()`` resets the environment in the middle of an episode, which only shows in observations that do not
  follow each other: there, the episode is cut.
* A ``RolloutBuffer`` holds no next observations: the last transition before each ``episode_starts`` is left out, and
  the last of the rollout.
* Off-policy algorithms store the actions of a ``Box`` from -1 to 1, and on-policy ones as the network gave them, before
  they were clipped.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.common.spaces import executed_actions
from sb3_abisim.data.copies import ImageLayout
from sb3_abisim.data.format import CUT, INSIDE, TERMINATED, TRUNCATED
from sb3_abisim.data.importing import CHANNELS_KEY, LEFT_OUT_KEY, LOSSY_KEY, UNSEEN_ENDS_KEY
from sb3_abisim.data.recorded import recorded_layout, unread_keys
from sb3_abisim.data.writer import Segment, check_folder, write_dataset
from sb3_abisim.registry import register_reader

if TYPE_CHECKING:
    from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer

# Steps whose observations are compared at once.
_CHUNK = 256


def import_buffer(
    source: Any,
    folder: str | os.PathLike[str],
    *,
    env_id: str | None = None,
    image_key: str | None = None,
    scaled_actions: bool | None = None,
) -> str:
    """Make a dataset folder of a buffer of Stable-Baselines3.

    :param source: a ``ReplayBuffer`` or ``RolloutBuffer`` (``model.replay_buffer``, ``model.rollout_buffer``), also of
        several environments and of ``Dict`` observations; no file, since to load one can run its code
    :param folder: new or empty
    :param env_id: recorded with the dataset; a buffer does not know it
    :param image_key: which key of a ``Dict`` of observations is the image; None for the only one. Others become factors
    :param scaled_actions: whether the actions of a ``Box`` are from -1 to 1 in place of its bounds; None for what the
        algorithms do: True of a ``ReplayBuffer`` (and of a policy with ``squash_output``), False of a ``RolloutBuffer``
    :return: the hash of the new dataset
    :raises ValueError: for a file, an empty buffer, or one that does not fit
    """
    if isinstance(source, str | os.PathLike):
        raise ValueError(
            f"to load a pickled buffer can run any code, so {os.fspath(source)!r} is not read; load one of "
            "your own with model.load_replay_buffer(FILE), and call "
            'sb3_abisim.import_dataset("buffer", model.replay_buffer, FOLDER)'
        )
    # Slow to import, which other readers need not wait for.
    from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer

    check_folder(Path(folder))
    what = type(source).__name__
    if not isinstance(source, ReplayBuffer | RolloutBuffer):
        raise ValueError(f"a buffer is a ReplayBuffer or a RolloutBuffer of Stable-Baselines3, got {what}")
    off_policy = isinstance(source, ReplayBuffer)
    buffer, copies = _replay(source) if isinstance(source, ReplayBuffer) else _rollout(source)
    if not any(len(copy.order) for copy in copies):
        raise ValueError(f"the {what} is empty; import it after learn()")
    layout = recorded_layout(source.observation_space, image_key, what)
    scaled = off_policy if scaled_actions is None else scaled_actions
    if scaled and isinstance(source.action_space, spaces.Box):
        _require_scaled(buffer.actions, copies)
    actions = executed_actions(source.action_space, buffer.actions, scaled, clipped=not off_policy)
    left_out = ["rewards", *_lost(copies)]
    if isinstance(source, ReplayBuffer) and not source.handle_timeout_termination:
        left_out.append("which episodes were truncated (without handle_timeout_termination, all count as terminated)")
    return write_dataset(
        folder,
        (segment for i, copy in enumerate(copies) for segment in _segments(buffer, copy, i, actions, layout)),
        env_id=env_id or "unknown",
        observation_space=layout.space,
        action_space=source.action_space,
        source={
            "buffer": what,
            "n_envs": source.n_envs,
            CHANNELS_KEY: layout.channels,
            LOSSY_KEY: None,
            LEFT_OUT_KEY: left_out + unread_keys(source.observation_space, layout),
            UNSEEN_ENDS_KEY: sum(int((copy.ended & ~copy.next_known).sum()) for copy in copies),
        },
    )


def _lost(copies: list["_Copy"]) -> list[str]:
    """What is left out because the buffer lacks an observation, for the report."""
    n = sum(int(((copy.ends != INSIDE) & ~copy.next_known).sum()) for copy in copies)
    return [f"{n} transitions whose next observation is not in the buffer"] if n else []


@dataclass(frozen=True)
class _Arrays:
    """A buffer's arrays, each [n_steps, n_envs, ...]; of a ``Dict``, one by key.

    :param observations: what the agent saw
    :param next_observations: what its action led to; those of ``_Copy.next_known`` alone are right
    :param next_offset: steps from an index of ``observations`` to that of ``next_observations``
    :param actions: as they are stored
    """

    observations: Any
    next_observations: Any
    next_offset: int
    actions: NDArray[Any]


@dataclass(frozen=True)
class _Copy:
    """What one environment did.

    :param order: indices of its steps, oldest first
    :param ends: after each step: INSIDE, or how the segment ends
    :param ended: whether the episode ended with the step
    :param next_known: whether the observation after the step is in the buffer; within a segment it is the next one's
    """

    order: NDArray[np.int64]
    ends: NDArray[np.uint8]
    ended: NDArray[np.bool_]
    next_known: NDArray[np.bool_]


def _replay(source: "ReplayBuffer") -> tuple[_Arrays, list[_Copy]]:
    size, pos, shared = source.buffer_size, source.pos, bool(source.optimize_memory_usage)
    order = (np.arange(size) + pos) % size if source.full else np.arange(pos)
    if shared and source.full:
        # The newest next observation took the place of the oldest observation.
        order = order[1:]
    arrays = _Arrays(
        source.observations, source.observations if shared else source.next_observations, int(shared), source.actions
    )
    copies = []
    for i in range(source.n_envs):
        done, timeout = source.dones[order, i] > 0, source.timeouts[order, i] > 0
        ends = np.where(done, np.where(timeout, TRUNCATED, TERMINATED), INSIDE).astype(np.uint8)
        next_known = np.ones(len(order), bool)
        if shared:
            next_known = ~done
        else:
            ends[(ends == INSIDE) & _broken(arrays, order, i)] = CUT
        if len(order):
            next_known[-1] = True
            ends[-1] = ends[-1] or CUT
        copies.append(_Copy(order, ends, done, next_known))
    return arrays, copies


def _broken(arrays: _Arrays, order: NDArray[np.int64], env: int) -> NDArray[np.bool_]:
    """After each step, whether the next one saw something else than what the step led to."""
    broken = np.zeros(len(order), bool)
    for begin in range(0, len(order) - 1, _CHUNK):
        here = slice(begin, min(begin + _CHUNK, len(order) - 1))
        led_to = _take(arrays.next_observations, order[here], env)
        saw = _take(arrays.observations, order[1:][here], env)
        pairs = zip(led_to.values(), saw.values(), strict=True) if isinstance(saw, dict) else [(led_to, saw)]
        for a, b in pairs:
            # What is no number equals itself here.
            same = (a == b) | ((a != a) & (b != b))
            broken[here] |= ~same.reshape(len(same), -1).all(axis=1)
    return broken


def _rollout(source: "RolloutBuffer") -> tuple[_Arrays, list[_Copy]]:
    n_steps, n_envs = source.buffer_size, source.n_envs

    def by_step(array: Any) -> Any:
        """After ``get()``, arrays are flat, one environment after the other."""
        if isinstance(array, Mapping):
            return {key: by_step(part) for key, part in array.items()}
        if not source.generator_ready:
            return array
        return array.reshape(n_envs, n_steps, *array.shape[1:]).swapaxes(0, 1)

    starts = source.episode_starts
    if starts.shape[:2] != (n_steps, n_envs):  # flat in some buffers only
        starts = starts.reshape(n_envs, n_steps).T
    order = np.arange(n_steps if source.full else source.pos)
    observations = by_step(source.observations)
    copies = []
    for i in range(n_envs):
        ended = np.zeros(len(order), bool)
        ended[:-1] = starts[order[1:], i] > 0
        ends = np.where(ended, CUT, INSIDE).astype(np.uint8)
        ends[-1:] = CUT
        copies.append(_Copy(order, ends, ended, ends == INSIDE))
    return _Arrays(observations, observations, 1, by_step(source.actions)), copies


def _require_scaled(stored: NDArray[Any], copies: list[_Copy]) -> None:
    """Refuse the actions of a ``Box`` that are said to be from -1 to 1, and are not."""
    largest = max(float(np.abs(stored[copy.order, i]).max(initial=0.0)) for i, copy in enumerate(copies))
    if largest > 1:
        raise ValueError(
            f"the buffer holds actions up to {largest:g}, which are not scaled to -1..1; pass scaled_actions=False "
            "if they are those of the environment"
        )


def _take(observations: Any, index: NDArray[np.int64], env: int) -> Any:
    if isinstance(observations, Mapping):
        return {key: array[index, env] for key, array in observations.items()}
    return observations[index, env]


def _segments(buffer: _Arrays, copy: _Copy, env: int, actions: NDArray[Any], layout: ImageLayout) -> Iterator[Segment]:
    begin = 0
    for last in np.flatnonzero(copy.ends != INSIDE).tolist():
        steps = copy.order[begin : last + 1]
        parts = [_take(buffer.observations, steps, env)]
        end = int(copy.ends[last])
        begin = last + 1
        if copy.next_known[last]:
            n = len(buffer.actions)
            parts.append(_take(buffer.next_observations, (steps[-1:] + buffer.next_offset) % n, env))
        else:
            steps, end = steps[:-1], CUT
        if len(steps):
            rests = [layout.rests(part) for part in parts]
            factors = {name: np.concatenate([rest[name] for rest in rests]) for name in layout.factors}
            yield Segment(np.concatenate([layout.images(part) for part in parts]), actions[steps, env], end, factors)


register_reader("buffer", import_buffer, help="a replay or rollout buffer of Stable-Baselines3, from Python alone")
