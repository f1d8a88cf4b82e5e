"""What is in a dataset: lengths, actions, coverage, duplicates; from samples, so that its size takes no memory."""

import hashlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CUT, TERMINATED, TRUNCATED

SEED = 0
# Frames read at once are at most so many bytes; of all that are looked at, only hashes are kept.
CHUNK_BYTES = 16 * 2**20
MAX_FRAMES = 4096
MAX_EPISODES = 1024
MAX_ACTIONS = 100_000
MAX_FACTOR_BYTES = 64 * 2**20
N_BINS = 20
# Choices that get a bar each.
MAX_CHOICES = 24
MAP_SIZE = 24
END_NAMES = {TERMINATED: "terminated", TRUNCATED: "truncated", CUT: "cut off"}


@dataclass(frozen=True)
class Episodes:
    """Episodes, those put together that go on from shard to shard.

    :param segments: of each, the segments that it consists of, in order
    :param n_steps: of each
    :param ends: how each ended: ``TERMINATED``, ``TRUNCATED`` or ``CUT``
    """

    segments: list[list[tuple[int, int]]]
    n_steps: NDArray[np.int64]
    ends: NDArray[np.uint8]

    def frames(self, episode: int) -> NDArray[np.int64]:
        """Frames of an episode, in order. The last one of a cut segment is the first one of the next, once more.

        :param episode: its number
        """
        parts = [np.arange(first, last + 1) for first, last in self.segments[episode]]
        return np.concatenate([*(part[:-1] for part in parts[:-1]), parts[-1]])


def episodes_of(dataset: TransitionDataset) -> Episodes:
    """The episodes of a dataset.

    :param dataset: any
    """
    first, last, before = dataset.segments()
    ends = dataset.ends[last]
    number: dict[int, int] = {}
    parts: list[list[int]] = []
    # A segment goes on with an earlier one.
    for segment in range(len(last)):
        previous = int(before[segment])
        if previous in number:
            number[segment] = number[previous]
            parts[number[previous]].append(segment)
        else:
            number[segment] = len(parts)
            parts.append([segment])
    lengths = last - first
    return Episodes(
        [[(int(first[k]), int(last[k])) for k in part] for part in parts],
        np.array([lengths[part].sum() for part in parts], np.int64),
        np.array([ends[part[-1]] for part in parts], np.uint8),
    )


@dataclass(frozen=True)
class Chart:
    """A histogram.

    :param shares: height of each column, the highest 1
    :param low: text at its left end
    :param high: text at its right end
    """

    shares: list[float]
    low: str
    high: str


def chart_of(values: NDArray[Any], low: float | None = None, high: float | None = None) -> Chart | None:
    """A histogram of numbers; None where there are none, or infinite ones.

    :param values: of any shape
    :param low: left end; None for the lowest value
    :param high: right end; None for the highest value
    """
    numbers = values.astype(np.float64).ravel()
    if not len(numbers) or not np.isfinite(numbers).all():
        return None
    low, high = (numbers.min() if low is None else low), (numbers.max() if high is None else high)
    counts = np.histogram(numbers, N_BINS, (low, high if high > low else low + 1))[0]
    return Chart((counts / max(counts.max(), 1)).tolist(), short(low), short(high))


def short(number: float) -> str:
    """A number with at most four digits that matter.

    :param number: any
    """
    return f"{number:.4g}"


def action_parts(dataset: TransitionDataset, starts: NDArray[np.int64]) -> list[dict[str, Any]]:
    """What actions consist of, each part by itself.

    :param dataset: any
    :param starts: frames that transitions start at
    :return: name, and ``rows`` (label and share of each choice) or ``chart``
    """
    space = dataset.action_space
    values = dataset.actions(starts).reshape(len(starts), -1)
    sizes, offsets = _choices(space)
    parts: list[dict[str, Any]] = []
    for k in range(values.shape[1]):
        name = "the action" if values.shape[1] == 1 else f"component {k}"
        part: dict[str, Any] = {"name": name, "rows": [], "chart": None}
        if sizes is None:
            assert isinstance(space, spaces.Box)
            part["chart"] = chart_of(values[:, k], float(space.low.flat[k]), float(space.high.flat[k]))
        elif sizes[k] > MAX_CHOICES:
            part["chart"] = chart_of(values[:, k], float(offsets[k]), float(offsets[k] + sizes[k] - 1))
        else:
            counts = np.bincount(values[:, k].astype(np.int64) - offsets[k], minlength=sizes[k])
            shares = (counts / len(starts)).tolist()
            part["rows"] = [{"label": f"{offsets[k] + choice}", "share": share} for choice, share in enumerate(shares)]
        parts.append(part)
    return parts


def _choices(space: gym.Space[Any]) -> tuple[list[int] | None, list[int]]:
    """Number of choices and the first of each component; None for numbers."""
    if isinstance(space, spaces.Discrete):
        return [int(space.n)], [int(space.start)]
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec.ravel().tolist(), space.start.ravel().tolist()
    if isinstance(space, spaces.MultiBinary):
        n = int(np.prod(space.n))
        return [2] * n, [0] * n
    return None, []


def factor_parts(dataset: TransitionDataset, index: NDArray[np.int64]) -> list[dict[str, Any]]:
    """The states behind frames.

    :param dataset: any
    :param index: of frames, ascending
    :return: per factor: name, shape, n_distinct, low, high, and of one that varies ``chart`` (one number) or ``map``
        (two)
    """
    parts = []
    for name, values in _some_factors(dataset, index).items():
        rows = values.reshape(len(values), -1)
        numeric = rows.astype(np.float64)
        n_distinct = len(np.unique(rows, axis=0))
        finite = bool(np.isfinite(numeric).all()) and rows.size > 0
        part: dict[str, Any] = {
            "name": name,
            "shape": " x ".join(map(str, values.shape[1:])) or "1",
            "n_distinct": n_distinct,
            "low": short(numeric.min()) if finite else "not finite",
            "high": short(numeric.max()) if finite else "not finite",
            "chart": chart_of(numeric) if rows.shape[1] == 1 and n_distinct > 1 else None,
            "map": _map(numeric) if rows.shape[1] == 2 and n_distinct > 1 and finite else None,
        }
        parts.append(part)
    return parts


def _some_factors(dataset: TransitionDataset, index: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    if not dataset.meta["factors"]:
        return {}
    per_frame = sum(values.nbytes for values in dataset.factors(index[:1]).values())
    n = min(len(index), max(1, MAX_FACTOR_BYTES // max(per_frame, 1)))
    return dataset.factors(spread(index, n))


def _map(points: NDArray[np.float64]) -> dict[str, Any]:
    """Where points lie: cells that are visited, the darker the more often."""
    low, high = points.min(axis=0), points.max(axis=0)
    # Whole numbers that lie close together get a cell each.
    size = MAP_SIZE
    if (points == np.rint(points)).all() and (high - low).max() < MAP_SIZE:
        size = int((high - low).max()) + 1
    scale = np.where(high > low, (high - low), 1.0)
    places = np.minimum((points - low) / scale * size, size - 1).astype(np.int64)
    counts = np.zeros((size, size), np.int64)
    np.add.at(counts, (places[:, 0], places[:, 1]), 1)
    cells = [
        {
            "x": int(column),
            "y": int(row),
            "share": round(0.15 + 0.85 * math.sqrt(counts[row, column] / counts.max()), 3),
        }
        for row, column in np.argwhere(counts)
    ]
    return {"size": size, "cells": cells, "visited": len(cells) / size**2}


@dataclass(frozen=True)
class Duplicates:
    """What occurs more than once, among what was read.

    :param n_frames: observations read
    :param n_distinct: distinct ones among them
    :param repeated: share of observations that some other is equal to
    :param n_pairs: transitions read
    :param unchanged: share of transitions whose two observations are equal
    :param n_episodes: whole episodes read
    :param equal_episodes: share of episodes that some other is equal to
    """

    n_frames: int
    n_distinct: int
    repeated: float
    n_pairs: int
    unchanged: float
    n_episodes: int
    equal_episodes: float


def find_duplicates(dataset: TransitionDataset, episodes: Episodes, starts: NDArray[np.int64]) -> Duplicates:
    """Compare hashes of observations and of whole episodes.

    :param dataset: any
    :param episodes: its
    :param starts: frames that transitions start at, ascending
    """
    obs = list(_frame_hashes(dataset, starts))
    following = list(_frame_hashes(dataset, starts + 1))
    whole = spread(np.flatnonzero(episodes.ends != CUT), MAX_EPISODES)
    firsts = np.array([episodes.segments[k][0][0] for k in whole], np.int64)
    runs = [
        hash + hashlib.sha256(dataset.actions(episodes.frames(int(k))[:-1]).tobytes()).digest()
        for k, hash in zip(whole, _frame_hashes(dataset, firsts), strict=True)
    ]
    unchanged = sum(one == other for one, other in zip(obs, following, strict=True)) / max(len(obs), 1)
    return Duplicates(
        len(obs), len(set(obs)), _share_repeated(obs), len(obs), unchanged, len(runs), _share_repeated(runs)
    )


def _share_repeated(hashes: list[bytes]) -> float:
    counts = Counter(hashes)
    return sum(count for count in counts.values() if count > 1) / max(len(hashes), 1)


def _frame_hashes(dataset: TransitionDataset, index: NDArray[np.int64]) -> Iterator[bytes]:
    n = max(1, CHUNK_BYTES // int(np.prod(dataset.observation_space.shape)))
    for k in range(0, len(index), n):
        for frame in dataset.frames(index[k : k + n]):
            yield hashlib.sha256(frame.tobytes()).digest()


def spread(index: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """At most n of some indices, chosen at random but the same in every call, in their order.

    :param index: any
    :param n: how many
    """
    if len(index) <= n:
        return index
    return np.sort(np.random.default_rng(SEED).choice(index, n, replace=False))
