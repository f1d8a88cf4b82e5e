"""Which frames of a dataset belong together: functions of where its segments end, which read no frames.

Segments follow each other. Segment i holds the frames after ``last[i - 1]`` up to ``last[i]``.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.data.format import CUT, INSIDE, continued_segments

# Which segments make up the eval split is a property of the dataset, not of a run.
_SPLIT_SEED = 20240229


def steps_remaining(last: NDArray[np.int64]) -> NDArray[np.int32]:
    """Steps from each frame to the last of its segment.

    :param last: the last frame of each segment
    """
    n_frames = int(last[-1]) + 1
    return (np.repeat(last, np.diff(last, prepend=-1)) - np.arange(n_frames)).astype(np.int32)


def segments_before(meta: dict[str, Any], ends: NDArray[np.uint8], last: NDArray[np.int64]) -> NDArray[np.int64]:
    """Per segment, the one whose episode it goes on with in the next shard; -1 where it begins one.

    :param meta: the content of meta.json
    :param ends: how each frame's segment ends there, ``INSIDE`` within
    :param last: the last frame of each segment
    """
    before = continued_segments(meta, np.diff(last, prepend=-1) - 1)
    cut = ends[last] == CUT
    return np.where((before >= 0) & cut[before], before, -1)


def frames_of_eval(last: NDArray[np.int64], before: NDArray[np.int64], fraction: float) -> NDArray[np.bool_]:
    """Per frame, whether its episode belongs to the split "eval".

    :param last: the last frame of each segment
    :param before: of :func:`segments_before`
    :param fraction: share of the episodes that do
    """
    begins = before < 0
    episode = np.empty(len(begins), np.int64)
    episode[begins] = np.arange(n_episodes := int(begins.sum()))
    for segment in np.flatnonzero(~begins):
        episode[segment] = episode[before[segment]]
    n_eval = min(n_episodes - 1, max(1, round(fraction * n_episodes))) if fraction else 0
    chosen = np.zeros(n_episodes, dtype=bool)
    chosen[np.random.Generator(np.random.PCG64(_SPLIT_SEED)).permutation(n_episodes)[:n_eval]] = True
    return np.repeat(chosen[episode], np.diff(last, prepend=-1))


def stack_members(
    index: NDArray[np.int64],
    n_stack: int,
    ends: NDArray[np.uint8],
    last: NDArray[np.int64],
    before: NDArray[np.int64],
) -> NDArray[np.int64]:
    """The frames of stacks, oldest first, [m, n_stack]; -1 for what is before an episode's first.

    :param index: the newest frame of each stack, [m]
    :param n_stack: frames of a stack
    :param ends: see :func:`segments_before`
    :param last: the last frame of each segment
    :param before: of :func:`segments_before`
    """
    members = np.empty((len(index), n_stack), np.int64)
    members[:, -1] = frame = index.copy()
    for column in range(n_stack - 2, -1, -1):
        # For frame 0, and -1, that is one of the last frames: the first segment goes on with none in either case.
        starts = np.flatnonzero(ends[frame - 1] != INSIDE)
        # The first frame of a segment that goes on with another is that one's last.
        goes_on = before[np.searchsorted(last, frame[starts])]
        frame = np.maximum(frame - 1, -1)
        frame[starts] = np.where(goes_on >= 0, last[goes_on] - 1, -1)
        members[:, column] = frame
    return members


def shuffle_chunks(
    starts: NDArray[np.int64],
    chunk_length: int,
    ends: NDArray[np.uint8],
    last: NDArray[np.int64],
    generator: np.random.Generator,
) -> NDArray[np.int64]:
    """An order of transitions in which those of a chunk stay together.

    :param starts: the frames that they start at
    :param chunk_length: frames per chunk
    :param ends: see :func:`segments_before`
    :param last: the last frame of each segment
    :param generator: moved on
    """
    lengths = np.diff(last, prepend=-1)
    # Each segment is cut at multiples of chunk_length, counted from a place before its beginning.
    offset = generator.integers(chunk_length, size=len(lengths))
    position = np.arange(len(ends)) - np.repeat(last + 1 - lengths - offset, lengths)
    begins = (position % chunk_length == 0) | (np.roll(ends, 1) != INSIDE)
    chunk = np.cumsum(begins)[starts]
    return np.argsort(generator.permutation(chunk.max() + 1)[chunk], kind="stable")
