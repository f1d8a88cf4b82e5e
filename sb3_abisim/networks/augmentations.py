"""Random augmentations of observations, sampled for each of a batch, for contrastive pretraining.

All take float (batch, channels, height, width) in 0..1 and a strength, and return new tensors of the same shape.
Random numbers are sampled on the CPU, so that they do not depend on the device.
"""

from collections.abc import Callable

import torch as th
from torch import nn


def random_noise(images: th.Tensor, strength: float) -> th.Tensor:
    """Add Gaussian noise to every intensity; the result may leave 0..1.

    :param images: the observations
    :param strength: standard deviation, at least 0
    """
    return images + strength * th.randn(images.shape).to(images)


def random_shift(images: th.Tensor, strength: float) -> th.Tensor:
    """Shift by whole pixels, repeating the border (Yarats et al. 2021).

    :param images: the observations
    :param strength: largest shift along each axis, as a share of the side; above 0, it is a pixel at least
    """
    n, _, height, width = images.shape
    dy, dx = (
        _integers(n, max(round(strength * side), int(strength > 0))).to(images.device) for side in (height, width)
    )
    rows = (th.arange(height, device=images.device) + dy[:, None]).clamp(0, height - 1)
    columns = (th.arange(width, device=images.device) + dx[:, None]).clamp(0, width - 1)
    batch = th.arange(n, device=images.device)[:, None, None]
    # Indexing puts the channels last; batch, rows and columns broadcast to (batch, height, width).
    shifted: th.Tensor = images.movedim(1, -1)[batch, rows[:, :, None], columns[:, None, :]]
    return shifted.movedim(-1, 1)


def random_crop(images: th.Tensor, strength: float) -> th.Tensor:
    """Cut a window out at a random place and enlarge it to the full size.

    Laskin et al. (2020) leave it small, but an encoder here takes one size.

    :param images: the observations
    :param strength: share of each side that is cut away, in 0..1
    """
    n = len(images)
    # Centers in the coordinates of grid_sample, where the image spans -1..1.
    centers = strength * (2.0 * th.rand(n, 2) - 1.0)
    theta = th.zeros(n, 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = 1.0 - strength
    theta[:, :, 2] = centers
    grid = nn.functional.affine_grid(theta.to(images), list(images.shape), align_corners=False)
    return nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


AUGMENTATIONS: dict[str, Callable[[th.Tensor, float], th.Tensor]] = {
    "noise": random_noise,
    "shift": random_shift,
    "crop": random_crop,
}


def _integers(n: int, largest: int) -> th.Tensor:
    return th.randint(-largest, largest + 1, (n,))
