"""Clips whose frames show which they are, for the tests of backgrounds."""

import numpy as np
import pytest

from sb3_abisim.envs.backgrounds.clips import Backgrounds, Clip, array_hash


def numbered_clip(name, number, length):
    """A clip whose frame f is filled with 10 * number + f."""
    frames = np.empty((length, 3, 64, 64), dtype=np.uint8)
    frames[:] = (10 * number + np.arange(length))[:, None, None, None]
    return Clip(name, name, length, array_hash(frames), lambda: frames)


@pytest.fixture(name="numbered")
def numbered_clips():
    return Backgrounds("test", "train", [numbered_clip("a", 1, 4), numbered_clip("b", 2, 3), numbered_clip("c", 3, 7)])
