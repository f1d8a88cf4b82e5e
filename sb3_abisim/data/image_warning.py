"""A warning at the end of a dataset whose observations can hardly be images in 0..255."""

import warnings

import numpy as np

from sb3_abisim.common.images import ImageCheck
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import holds_frames

# Frames looked at together. Of images as they should be, those of the first block are enough.
_BLOCK = 256


def warn_of_images(dataset: TransitionDataset, stacklevel: int = 3) -> None:
    """Warn if observations never exceed 1, are all of one value, or all the same; it reads on until it knows.

    :param dataset: finished; one whose frames are rendered from factors is not looked at
    :param stacklevel: as for ``warnings.warn``
    """
    if not holds_frames(dataset.meta):
        return
    check = ImageCheck(n_same_batches=1)
    for begin in range(0, dataset.n_frames, _BLOCK):
        frames = dataset.frames(np.arange(begin, min(begin + _BLOCK, dataset.n_frames)))
        check.add(frames[:, -dataset.meta["observation_space"]["shape"][0] :])
        if check.is_settled:
            return
    if problem := check.problem():
        warnings.warn(f"{dataset.path} ({dataset.env_id}): {problem}", stacklevel=stacklevel + 1)
