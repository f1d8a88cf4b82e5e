"""How environments play clips as the background of their observations."""

import hashlib

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.backgrounds.clips import Backgrounds
from sb3_abisim.envs.backgrounds.color_jitter import ColorJitter

ORDERS = ("video", "shuffled")
# Random numbers used per episode, whatever the clips are.
N_SAMPLES = 3


class BackgroundPlayer:
    """Plays the backgrounds of ``n_envs`` environments: one clip per episode, a random start, one frame per step.

    All randomness comes from the generators given to :meth:`start`, by the same number of samples for any clips. What
    an environment samples afterwards is the same in every split.

    :param backgrounds: the clips
    :param n_envs: number of environments
    :param order: "video", or "shuffled" for the frames of a clip in an order sampled for each episode, which removes
        the correlation between neighboring frames
    :param color_jitter: whether each episode shows its clip with another
        :class:`~sb3_abisim.envs.backgrounds.color_jitter.ColorJitter`
    :raises ValueError: for an unknown order
    """

    def __init__(self, backgrounds: Backgrounds, n_envs: int, order: str = "video", color_jitter: bool = False) -> None:
        if order not in ORDERS:
            raise ValueError(f"order must be one of {ORDERS}, got {order!r}")
        self.backgrounds = backgrounds
        self.clip = np.zeros(n_envs, dtype=np.int64)
        self._position = np.zeros(n_envs, dtype=np.int64)
        self._shuffles: list[NDArray[np.int64]] | None = None
        if order == "shuffled":
            self._shuffles = [np.zeros(1, dtype=np.int64)] * n_envs
        self._color_jitter = ColorJitter(n_envs) if color_jitter else None

    @property
    def content_hash(self) -> str:
        """sha256 over the clips, another one where they are shown with color jitter."""
        plain = self.backgrounds.content_hash
        # These words are hashed, and hashes of earlier datasets stay valid: they are no description.
        return plain if self._color_jitter is None else hashlib.sha256(f"{plain} in looks".encode()).hexdigest()

    def start(self, index: int, generator: np.random.Generator) -> None:
        """Begin a new episode of environment ``index``.

        :param index: of the environment
        :param generator: three numbers are sampled from it
        """
        clip_sample, start_sample, seed_sample = generator.random(N_SAMPLES).tolist()
        clip = int(clip_sample * self.backgrounds.n_clips)
        length = int(self.backgrounds.lengths[clip])
        self.clip[index] = clip
        self._position[index] = int(start_sample * length)
        # As many numbers as the order and the jitter need.
        further = np.random.default_rng(int(seed_sample * 2**53))
        if self._shuffles is not None:
            self._shuffles[index] = further.permutation(length)
        if self._color_jitter is not None:
            self._color_jitter.sample(index, further)

    def advance(self) -> None:
        """Go on by one frame in every environment."""
        self._position += 1

    @property
    def frame_index(self) -> NDArray[np.int64]:
        """Index of the frame now shown, within its clip, shape (n_envs,)."""
        frame = self.backgrounds.fold(self.clip, self._position)
        if self._shuffles is not None:
            rows = zip(self._shuffles, frame.tolist(), strict=True)
            frame = np.array([shuffle[position] for shuffle, position in rows], dtype=np.int64)
        return frame

    def frames(self, indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        """The frames now shown in the environments ``indices``: a new array, uint8 (len(indices), 3, 64, 64).

        :param indices: of environments, shape (m,)
        """
        # Positions that are not shuffled need no folding here, the clips do it.
        position = self._position if self._shuffles is None else self.frame_index
        frames = self.backgrounds.frames(self.clip[indices], position[indices])
        return frames if self._color_jitter is None else self._color_jitter.apply(frames, indices)


def composite(
    observations: NDArray[np.uint8], masks: NDArray[np.bool_], backgrounds: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Lay observations over backgrounds; foreground pixels keep their bytes.

    :param observations: uint8 (m, 3, 64, 64)
    :param masks: (m, 64, 64), true where an observation's pixel belongs to the foreground
    :param backgrounds: uint8 (m, 3, 64, 64), overwritten
    :return: ``backgrounds``
    """
    # Bytes of 0 at the foreground and 255 elsewhere, so that bitwise operations choose, faster than a masked copy.
    elsewhere = (masks.view(np.uint8) - np.uint8(1))[:, None]
    np.bitwise_xor(backgrounds, observations, out=backgrounds)
    np.bitwise_and(backgrounds, elsewhere, out=backgrounds)
    np.bitwise_xor(backgrounds, observations, out=backgrounds)
    return backgrounds
