"""Reads datasets: memory-mapped transitions (s_t, a_t, s_{t+k}) that never cross an episode's end.

No frames are loaded. Per frame, the reader keeps 5 bytes plus the size of an action, one more where a split is asked
for, and four more during a pass. Pages of the files that were read count as this process's memory until they are given
back, which happens now and then.
"""

import functools
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.common.files import file_hash
from sb3_abisim.common.spaces import space_from_json
from sb3_abisim.common.transitions import TransitionBatch
from sb3_abisim.common.vocabulary import current_env_kwargs
from sb3_abisim.data.episodes import (
    frames_of_eval,
    segments_before,
    shuffle_chunks,
    stack_members,
    steps_remaining,
)
from sb3_abisim.data.format import (
    CONFIG_NAME,
    CUT,
    HASH_KEY,
    INSIDE,
    META_NAME,
    DatasetError,
    array_layout,
    check_meta,
    from_json_file,
    holds_frames,
)
from sb3_abisim.data.shard_files import ShardFiles, repair

# Above this size, opening a dataset compares sizes only; TransitionDataset(path, verify=True) compares hashes too.
VERIFY_BELOW_BYTES = 4 * 10**9
# Files whose hash this process has found right: (path, size, time of the last change, sha256).
_VERIFIED: set[tuple[str, int, int, str]] = set()

Split = Literal["train", "eval"]
# Steps between two observations: a number, or the fewest and the most of them.
Steps = int | tuple[int, int] | list[int]


class TransitionDataset:
    """A finished dataset folder, larger than memory if need be.

    A frame index counts the frames of all shards, in order. Pickling (for worker processes) sends the path only.

    With ``frame_stack`` n in its preprocessing, an observation is a stack: the n frames up to the index, oldest first,
    and zeros in place of those before an episode's first, as from Stable-Baselines3's ``VecFrameStack``.

    :param path: the folder
    :param eval_fraction: share of the episodes (whole ones and cut ones) that make up ``split="eval"``, in [0, 1)
    :param verify: True compares every file with its sha256, False only sizes; None does so once per process for
        datasets below ``VERIFY_BELOW_BYTES``
    :raises DatasetError: if the folder is not a finished dataset, or is damaged, or has no frames and the scenes that
        they would be rendered from are not the same any more
    """

    def __init__(self, path: str | os.PathLike[str], eval_fraction: float = 0.05, verify: bool | None = None) -> None:
        if not 0 <= eval_fraction < 1:
            raise ValueError(f"eval_fraction must be in [0, 1), got {eval_fraction}")
        self.path = Path(path)
        self.eval_fraction = eval_fraction
        self.meta = _read_meta(self.path)
        self.hash: str = self.meta[HASH_KEY]
        self.env_id: str = self.meta["env_id"]
        self.env_kwargs = current_env_kwargs(self.meta["env_kwargs"])
        self.n_transitions: int = self.meta["n_transitions"]
        self.n_frames: int = self.meta["n_frames"]
        self.preprocessing: dict[str, Any] = self.meta.get("preprocessing", {})
        self.frame_stack: int = self.preprocessing.get("frame_stack", 1)
        self._frame_shape = tuple(self.meta["observation_space"]["shape"])
        self.observation_space: spaces.Box = space_from_json(  # type: ignore[assignment]
            {
                **self.meta["observation_space"],
                "shape": [self.frame_stack * self._frame_shape[0], *self._frame_shape[1:]],
            }
        )
        self.action_space = space_from_json(self.meta["action_space"])
        self._check_files(verify)
        self._render_fn: Callable[[dict[str, NDArray[Any]]], NDArray[np.uint8]] | None = None
        if not holds_frames(self.meta):
            from sb3_abisim.data.rendering import make_render_fn

            self._render_fn = make_render_fn(self.path, self.meta)
        frames_per_shard = [shard["n_frames"] for shard in self.meta["shards"]]
        # Shard k holds the frames self._offsets[k] to self._offsets[k + 1] - 1.
        self._offsets = np.concatenate([[0], np.cumsum(frames_per_shard)]).astype(np.int64)
        self._files = ShardFiles(self.path, self.meta)
        # Pretraining makes batches in one thread and evaluates in another; open files and renderers are shared.
        self._lock = threading.Lock()
        n_shards = len(frames_per_shard)
        self._actions = np.concatenate([self._files.whole("actions", k) for k in range(n_shards)])
        self._ends = np.concatenate([self._files.whole("ends", k) for k in range(n_shards)])
        self._last = np.flatnonzero(self._ends != INSIDE)  # the last frame of each segment
        self._check_ends()
        self._remaining = steps_remaining(self._last)
        self._before = segments_before(self.meta, self._ends, self._last)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self.eval_fraction, False)

    @property
    def ends(self) -> NDArray[np.uint8]:
        """Per frame: 0 within a segment, and on its last frame 1 terminated, 2 truncated, 3 cut by a shard's end."""
        return self._ends.copy()

    def segments(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Episodes, or the parts that shards cut them into.

        :return: per segment the first frame, the last frame, and the segment that it goes on with (-1 where it begins
            an episode), each int64
        """
        return np.concatenate([[0], self._last[:-1] + 1]), self._last.copy(), self._before.copy()

    def valid_starts(self, k: int = 1, split: Split | None = None) -> NDArray[np.int64]:
        """The frames t for which frame t + k belongs to the same episode, ascending.

        :param k: steps, at least 1
        :param split: "eval" for the segments that are only evaluated on, "train" for the others, None for all
        :raises ValueError: if there is none
        """
        if k < 1:
            raise ValueError(f"k must be at least 1, got {k}")
        if split not in (None, "train", "eval"):
            raise ValueError(f"split must be 'train', 'eval' or None, got {split!r}")
        longest = int(self._remaining.max())
        if k > longest:
            raise ValueError(f"no episode of {self.path} has k = {k} steps, the longest has {longest}; lower k")
        starts = np.flatnonzero(self._has_steps(k, split))
        if not len(starts):
            raise ValueError(
                f"no transition of {k} steps in split {split!r} of {self.path} ({len(self._last)} segments, "
                f"eval_fraction {self.eval_fraction}); collect more transitions or use split=None"
            )
        return starts

    def _has_steps(self, k: int, split: Split | None) -> NDArray[np.bool_]:
        """Per frame, whether frame t + k belongs to the same episode, of the split."""
        valid: NDArray[np.bool_] = self._remaining >= k
        if split is None:
            return valid
        return valid & (self._in_eval if split == "eval" else ~self._in_eval)

    @functools.cached_property
    def _in_eval(self) -> NDArray[np.bool_]:
        """Per frame, whether it belongs to the split "eval"; the log of pretraining asks for it at every row."""
        return frames_of_eval(self._last, self._before, self.eval_fraction)

    def pairs(self, k: Steps = 1, split: Split | None = None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """All pairs of frames (t, t + steps) of the same episode.

        :param k: steps, at least 1, or the fewest and the most of them
        :param split: see :meth:`valid_starts`
        :return: t and steps, each int64 [m]
        :raises ValueError: if there is none
        """
        fewest, most = (k, k) if isinstance(k, int) else k
        if fewest > most:
            raise ValueError(f"k must be the fewest steps and the most, got {list(k)}")  # type: ignore[arg-type]
        first = self.valid_starts(fewest, split)  # raises if there is no pair at all
        if fewest == most:
            # One number takes no memory for each of millions of pairs.
            return first, np.broadcast_to(np.int64(fewest), first.shape)
        steps = np.arange(fewest, most + 1)
        starts = [np.flatnonzero(self._has_steps(int(n), split)) for n in steps]
        return np.concatenate(starts), np.repeat(steps, [len(found) for found in starts])

    def frames(self, index: Any) -> NDArray[np.uint8]:
        """Frames at the given indices, in stacks where the dataset says so.

        :param index: integers [m] in 0..n_frames - 1
        :return: uint8 [m, C, H, W], a copy; C counts the channels of all frames of a stack
        :raises IndexError: for an index out of range
        """
        return self._frames(self._check_index(index))

    def actions(self, index: Any) -> NDArray[Any]:
        """Actions taken at the given frames, [m, *shape of an action]; zero at a segment's last frame.

        :param index: integers [m] in 0..n_frames - 1
        """
        return self._actions[self._check_index(index)]

    def factors(self, index: Any) -> dict[str, NDArray[Any]]:
        """The simulator's state behind the given frames: name to [m, ...]; for probes, never for a loss.

        :param index: integers [m] in 0..n_frames - 1
        """
        return self._factors(self._check_index(index))

    def batches(
        self,
        batch_size: int,
        k: Steps = 1,
        seed: int = 0,
        epoch: int = 0,
        start: int = 0,
        split: Split | None = None,
        sequences: bool = False,
        chunk_length: int = 1,
    ) -> Iterator[TransitionBatch[NDArray[Any]]]:
        """One shuffled pass over all :meth:`pairs`; the last, incomplete batch is dropped.

        The order is a function of (seed, epoch) alone, so that a position in training is two integers.

        With ``chunk_length`` above 1, chunks of transitions that follow each other in an episode are shuffled instead
        of single ones. A frame then ends one transition and begins the next, so that little more than half as many have
        to be read and embedded. Where episodes are cut into chunks is sampled for each pass.

        :param batch_size: transitions per batch
        :param k: steps between the two observations, or the fewest and the most of them
        :param seed: of the order
        :param epoch: which pass
        :param start: batches to skip
        :param split: see :meth:`valid_starts`
        :param sequences: whether actions are all k between the two frames, instead of the first
        :param chunk_length: transitions per chunk, at least 1; with a range of steps, frames that transitions start at
        :raises ValueError: if there are fewer transitions than one batch takes
        """
        if sequences and not isinstance(k, int):
            raise ValueError(f"sequences of actions need one length, got k = {k}; give one number")
        for name, value, least in (
            ("batch_size", batch_size, 1),
            ("chunk_length", chunk_length, 1),
            ("start", start, 0),
        ):
            if value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        starts, steps = self.pairs(k, split)
        if len(starts) < batch_size:
            raise ValueError(f"batch_size {batch_size} exceeds the {len(starts)} transitions of {k} steps; lower it")
        # Sampled now and not at the first batch, so that mistakes raise here.
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, epoch])))
        if chunk_length == 1 and steps.strides == (0,):
            # The same order as below. Where that is enough, four bytes for a transition instead of sixteen.
            fits = self.n_frames <= np.iinfo(np.int32).max
            starts = generator.permutation(starts.astype(np.int32) if fits else starts)
        else:
            order = (
                generator.permutation(len(starts))
                if chunk_length == 1
                else shuffle_chunks(starts, chunk_length, self._ends, self._last, generator)
            )
            starts, steps = starts[order], steps[order]
        return self._iterate(starts, steps, batch_size, start, sequences, chunk_length > 1)

    def _iterate(
        self,
        starts: NDArray[np.int64],
        steps: NDArray[np.int64],
        batch_size: int,
        start: int,
        sequences: bool,
        shared: bool,
    ) -> Iterator[TransitionBatch[NDArray[Any]]]:
        for i in range(start, len(starts) // batch_size):
            here = slice(i * batch_size, (i + 1) * batch_size)
            index = starts[here].astype(np.int64)
            # Both frames of a pair lie close together on disk: one gather reads each page once.
            both = np.concatenate([index, index + steps[here]])
            obs_index: Any = slice(None, batch_size)
            next_obs_index: Any = slice(batch_size, None)
            if shared:
                both, places = np.unique(both, return_inverse=True)
                obs_index, next_obs_index = places[obs_index], places[next_obs_index]
            taken = index[:, None] + np.arange(steps[0]) if sequences else index
            yield TransitionBatch(self._frames(both), self._actions[taken], obs_index, next_obs_index)

    def _check_index(self, index: Any) -> NDArray[np.int64]:
        array = np.asarray(index)
        if array.ndim != 1 or (array.dtype.kind not in "iu" and array.size):
            raise IndexError(f"indices must be one-dimensional integers, got {array.dtype} of shape {array.shape}")
        bad = array[(array < 0) | (array >= self.n_frames)]
        if bad.size:
            raise IndexError(f"frame index {bad[0]} is out of range, the dataset has {self.n_frames} frames")
        return array.astype(np.int64)

    def _frames(self, index: NDArray[np.int64]) -> NDArray[np.uint8]:
        if self._render_fn is not None:
            factors = self._factors(index)
            with self._lock:
                return self._render_fn(factors)
        if self.frame_stack == 1:
            return self._gather("frames", index)
        members = stack_members(index, self.frame_stack, self._ends, self._last, self._before)
        there = members >= 0
        # Stacks of steps that follow each other share frames: each is read once.
        read, places = np.unique(members[there], return_inverse=True)
        out = np.zeros((*members.shape, *self._frame_shape), np.uint8)
        out[there] = self._gather("frames", read)[places]
        return out.reshape(len(index), *self.observation_space.shape)

    def _factors(self, index: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {name: self._gather(f"factor_{name}", index) for name in self.meta["factors"]}

    def _gather(self, name: str, index: NDArray[np.int64]) -> NDArray[Any]:
        dtype, row_shape = array_layout(self.meta, name)
        out = np.empty((len(index), *row_shape), dtype)
        order = np.argsort(index)
        ascending = index[order]
        bounds = np.searchsorted(ascending, self._offsets)
        for shard in np.flatnonzero(np.diff(bounds)):
            here = slice(bounds[shard], bounds[shard + 1])
            with self._lock:
                out[order[here]] = self._files.rows(name, int(shard), ascending[here] - self._offsets[shard])
        return out

    def _check_files(self, verify: bool | None) -> None:
        entries = {name: entry for shard in self.meta["shards"] for name, entry in shard["files"].items()}
        small = sum(entry["bytes"] for entry in entries.values()) < VERIFY_BELOW_BYTES
        for name, entry in entries.items():
            path = self.path / name
            try:
                status = path.stat()
            except FileNotFoundError:
                raise DatasetError(f"{path} is missing; {repair(self.path, self.meta)}") from None
            if status.st_size != entry["bytes"]:
                raise DatasetError(
                    f"{path} has {status.st_size} bytes instead of {entry['bytes']}; {repair(self.path, self.meta)}"
                )
            key = (str(path.resolve()), status.st_size, status.st_mtime_ns, entry["sha256"])
            if verify is False or (verify is None and (not small or key in _VERIFIED)):
                continue
            if file_hash(path) != entry["sha256"]:
                raise DatasetError(f"{path} is damaged (sha256 does not match); {repair(self.path, self.meta)}")
            _VERIFIED.add(key)

    def _check_ends(self) -> None:
        shard_ends = self._offsets[1:] - 1
        fits = self.n_frames == self._offsets[-1] == self.n_transitions + len(self._last)
        if not fits or self._ends.max() > CUT or (self._ends[shard_ends] == INSIDE).any():
            raise DatasetError(f"the episode ends of {self.path} contradict its meta.json; it is damaged or forged")


def _read_meta(path: Path) -> dict[str, Any]:
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder; collect a dataset with sb3-abisim collect")
    if not (path / META_NAME).exists():
        if (path / CONFIG_NAME).exists():
            raise DatasetError(f"{path} is unfinished (no {META_NAME}); run the command that began it again")
        raise DatasetError(f"{path} is not a dataset (no {META_NAME}); make one with sb3-abisim collect")
    try:
        meta = from_json_file(path / META_NAME)
        check_meta(meta)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, IndexError) as error:
        remedy = "run the command that made the dataset again, in a new folder if it refuses"
        raise DatasetError(f"{path / META_NAME} is damaged, or not that of a dataset: {error}; {remedy}") from None
    return meta
