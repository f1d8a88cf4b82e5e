"""Color jitter of moving backgrounds, which train episodes have.

A few clips have a few colors, and an encoder that has seen no others takes a saturated background for an agent that
has moved (docs/figures.md). Each train episode therefore shows its clip with another color jitter.
"""

import numpy as np
from numpy.typing import NDArray


class ColorJitter:
    """A jitter for each environment: mirrored or not, the channels exchanged, each over another range.

    Integer arithmetic only: the same bytes on every machine.

    :param n_envs: number of environments
    """

    def __init__(self, n_envs: int) -> None:
        self._flips = np.ones((n_envs, 2), dtype=np.int64)
        self._channels = np.tile(np.arange(3), (n_envs, 1))
        # Intensity x becomes (256 first + (last - first) x) / 256, from `first` at 0 to nearly `last` at 255.
        self._first = np.zeros((n_envs, 3, 1, 1), dtype=np.uint16)
        self._last = np.full((n_envs, 3, 1, 1), 256, dtype=np.uint16)

    def sample(self, index: int, generator: np.random.Generator) -> None:
        """Sample a new jitter for environment ``index``; half of them keep the range of each channel.

        :param index: of the environment
        :param generator: of the episode
        """
        self._flips[index] = 1 - 2 * generator.integers(0, 2, 2)
        self._channels[index] = generator.permutation(3)
        first, last = generator.integers(0, 256, (2, 3, 1, 1))
        keeps_range = generator.random() < 0.5
        self._first[index], self._last[index] = (0, 256) if keeps_range else (first, last)

    def apply(self, frames: NDArray[np.uint8], indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Frames with the jitter of their environments.

        :param frames: uint8 (m, 3, height, width)
        :param indices: of environments, shape (m,)
        :return: a new array of the same shape
        """
        turned = np.empty_like(frames)
        rows = zip(self._channels[indices].tolist(), self._flips[indices].tolist(), strict=True)
        for i, (channels, (vertical, horizontal)) in enumerate(rows):
            for shown, channel in enumerate(channels):
                turned[i, shown] = frames[i, channel, ::vertical, ::horizontal]
        first, last = self._first[indices], self._last[indices]
        # Half of the jitters keep the range, and the arithmetic would leave their frames as they are.
        changed = np.flatnonzero(((first != 0) | (last != 256)).any(axis=(1, 2, 3)))
        if changed.size:
            first, last = first[changed], last[changed]
            # Where a range is inverted, both products wrap at 2^16, and their sum is right again.
            jittered = turned[changed] * (last - first)
            jittered += np.uint16(256) * first
            jittered >>= 8
            turned[changed] = jittered
        return turned
