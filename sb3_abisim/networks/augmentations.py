"""Random augmentations of observations, sampled for each of a batch, for contrastive pretraining and for RL.

All take float (batch, channels, height, width) in 0..1 and a strength, and return new tensors of the same shape. The
frames of a stack, which are channels here, are augmented alike. Random numbers are sampled on the CPU from torch's
global generator, so that they do not depend on the device.
"""

from collections.abc import Callable

import torch as th
from torch import nn

from sb3_abisim.registry import register_augmentation

# Yarats et al. (2021) shift images of 84 pixels by up to 4.
SHIFT = 4 / 84
# Laskin et al. (2020) cut 84 pixels out of 100.
CROP = 16 / 100
# Of red, green and blue in what the eye sees as brightness (ITU-R BT.601).
_LUMA = (0.299, 0.587, 0.114)


def random_noise(images: th.Tensor, strength: float = 0.1) -> th.Tensor:
    """Add Gaussian noise to every intensity; the result may leave 0..1.

    :param images: the observations
    :param strength: standard deviation, at least 0
    """
    return images + strength * th.randn(images.shape).to(images)


def random_shift(images: th.Tensor, strength: float = SHIFT) -> th.Tensor:
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


def random_crop(images: th.Tensor, strength: float = CROP) -> th.Tensor:
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


def color_jitter(images: th.Tensor, strength: float = 0.4, frame_channels: int | None = None) -> th.Tensor:
    """Change saturation, brightness and contrast, in this order, each by a random factor; the result stays in 0..1.

    :param images: the observations
    :param strength: the factors lie in 1 - strength to 1 + strength; in 0..1
    :param frame_channels: channels of one frame: 1 (gray), 3 (RGB), or 4 (RGB and another, which stays); None for 3,
        where the channels can be divided by 3
    :raises ValueError: for channels that do not make whole frames
    """
    n, n_channels, height, width = images.shape
    per_frame = 3 if frame_channels is None else frame_channels
    if per_frame not in (1, 3, 4) or n_channels % per_frame:
        raise ValueError(
            f"color_jitter takes frames of 1, 3 or 4 channels, and {n_channels} channels with frame_channels="
            f"{frame_channels} are none; name their number in augment_kwargs, as {{frame_channels: 1}} for gray frames"
        )
    frames = images.reshape(n, -1, per_frame, height, width)
    colors, rest = frames[:, :, :3], frames[:, :, 3:]
    factors = 1.0 + strength * (2.0 * th.rand(3, n, 1, 1, 1, 1) - 1.0)
    saturation, brightness, contrast = factors.to(images)
    gray = _luma(colors)
    colors = (gray + saturation * (colors - gray)) * brightness
    middle = _luma(colors).mean(dim=(3, 4), keepdim=True)
    colors = (middle + contrast * (colors - middle)).clamp(0.0, 1.0)
    return th.cat([colors, rest], dim=2).reshape(images.shape)


def _luma(colors: th.Tensor) -> th.Tensor:
    """Of (batch, frames, 1 or 3, height, width), with 1 for the third."""
    if colors.shape[2] == 1:
        return colors
    return (colors * colors.new_tensor(_LUMA)[:, None, None]).sum(dim=2, keepdim=True)


for _function in (random_noise, random_shift, random_crop, color_jitter):
    register_augmentation(_function.__name__, _function)

# As CURL's settings name them.
AUGMENTATIONS: dict[str, Callable[[th.Tensor, float], th.Tensor]] = {
    "noise": random_noise,
    "shift": random_shift,
    "crop": random_crop,
}


def _integers(n: int, largest: int) -> th.Tensor:
    return th.randint(-largest, largest + 1, (n,))
