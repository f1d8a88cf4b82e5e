"""Clips of 64x64 frames, and which of them belong to which side of the split."""

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SIZE = 64
FRAME_SHAPE = (3, SIZE, SIZE)
SPLITS = ("train", "eval")
# A custom clip keeps its file open, of which a process may have 256 on macOS.
MAX_OPEN_CLIPS = 200


@dataclass(frozen=True)
class Clip:
    """A sequence of background frames, loaded when first shown.

    :param name: unique among the clips of a source
    :param group: clips of one video or photograph share their group, and a group lies on one side of the split
    :param length: number of frames, at least 2
    :param hash: sha256 of the frames' bytes, in hexadecimal
    :param load: returns the frames, uint8 (length, 3, 64, 64), RGB
    """

    name: str
    group: str
    length: int
    hash: str
    load: Callable[[], NDArray[np.uint8]]

    @property
    def clip_id(self) -> int:
        """A number that stands for the content, in whatever split or selection the clip is found; 0 <= id < 2**60."""
        return int(self.hash[:15], 16)


class Backgrounds:
    """Clips of one side of the split, with frames fetched by (clip, frame).

    :param source: where the clips come from, for messages: "photo_pan" or a path
    :param split: "train" or "eval"
    :param clips: at least one
    """

    def __init__(self, source: str, split: str, clips: Sequence[Clip]) -> None:
        assert clips, "a side of the split has at least one clip"
        self.source = source
        self.split = split
        self.clips = tuple(clips)
        self.names = tuple(clip.name for clip in clips)
        self.lengths = np.array([clip.length for clip in clips], dtype=np.int64)
        self.clip_ids = np.array([clip.clip_id for clip in clips], dtype=np.int64)
        # Of clips that were shown, the latest ones at the end.
        self._arrays: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._selected: dict[tuple[str, ...], Backgrounds] = {}

    @property
    def n_clips(self) -> int:
        """Number of clips."""
        return len(self.clips)

    @property
    def content_hash(self) -> str:
        """sha256 over the clips in their order and the shape of a frame; one pixel of a clip changes it."""
        content = [list(FRAME_SHAPE), [[clip.name, clip.length, clip.hash] for clip in self.clips]]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def select(self, names: Iterable[str]) -> "Backgrounds":
        """The clips with these names, in the order given.

        :param names: of clips, distinct, at least one
        :raises ValueError: for a name that is not among this split's clips, a repeated name, or none at all
        """
        chosen = list(names)
        unknown = sorted(set(chosen) - set(self.names))
        if unknown or not chosen or len(set(chosen)) < len(chosen):
            problem = f"unknown: {unknown}" if unknown else f"got {chosen}"
            raise ValueError(
                f"clips must be distinct names of the {self.split} clips of {self.source}, {problem}; "
                f"there are {', '.join(self.names)}"
            )
        # One for all environments, as its clips take memory once.
        if tuple(chosen) not in self._selected:
            clips = [self.clips[self.names.index(name)] for name in chosen]
            self._selected[tuple(chosen)] = Backgrounds(self.source, self.split, clips)
        return self._selected[tuple(chosen)]

    def fold(self, clip: NDArray[np.int64], frame: NDArray[np.int64]) -> NDArray[np.int64]:
        """Frame indices within the clips: a clip plays forwards, then backwards, and so on, without repeating its ends.

        :param clip: indices of clips, shape (m,)
        :param frame: shape (m,), at least 0
        :return: shape (m,), each below the clip's length
        """
        last = self.lengths[clip] - 1
        phase = frame % (2 * last)
        return np.where(phase <= last, phase, 2 * last - phase)

    def frames(self, clip: NDArray[np.int64], frame: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Frames of clips in a new array.

        :param clip: indices of clips, shape (m,)
        :param frame: shape (m,), at least 0; folded at the clips' ends
        :return: uint8 (m, 3, 64, 64)
        """
        frames = np.empty((len(clip), *FRAME_SHAPE), dtype=np.uint8)
        rows = zip(clip.tolist(), self.fold(clip, frame).tolist(), strict=True)
        for i, (c, f) in enumerate(rows):
            if c not in self._arrays:
                self._arrays[c] = self._load(c)
                if len(self._arrays) > MAX_OPEN_CLIPS:
                    self._arrays.popitem(last=False)
            self._arrays.move_to_end(c)
            frames[i] = self._arrays[c][f]
        return frames

    def _load(self, index: int) -> NDArray[np.uint8]:
        clip = self.clips[index]
        array = clip.load()
        assert array.shape == (clip.length, *FRAME_SHAPE) and array.dtype == np.uint8
        return array


def split_groups(groups: Iterable[str], seed: int, eval_fraction: float) -> tuple[set[str], set[str]]:
    """Divide groups by the rank of a hash of seed and name, so that neither the machine nor their order matters.

    :param groups: at least two different names
    :param seed: another seed gives another split
    :param eval_fraction: share of the groups for evaluation, rounded, at least one group on each side
    :return: (train groups, eval groups)
    """
    ranked = sorted(set(groups), key=lambda group: hashlib.sha256(f"{seed}:{group}".encode()).digest())
    n_eval = min(max(1, round(eval_fraction * len(ranked))), len(ranked) - 1)
    return set(ranked[n_eval:]), set(ranked[:n_eval])


def array_hash(frames: NDArray[np.uint8]) -> str:
    """sha256 of an array's bytes, in hexadecimal.

    :param frames: of any shape and dtype
    """
    return hashlib.sha256(np.ascontiguousarray(frames).data).hexdigest()
