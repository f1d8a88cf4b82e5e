"""Augmentations: what they do to one image, and that the frames of a stack are treated alike."""

from collections.abc import Callable

import pytest
import torch as th
from torch import nn

from sb3_abisim.networks.augmentations import CROP, SHIFT, color_jitter, random_crop, random_shift

FRAMES = th.rand(64, 3, 21, 17, generator=th.Generator().manual_seed(0))


@pytest.fixture(autouse=True)
def seed() -> None:
    th.manual_seed(0)


@pytest.mark.parametrize("augment", [random_shift, random_crop, color_jitter])
def test_the_frames_of_a_stack_are_augmented_alike(augment: Callable[[th.Tensor], th.Tensor]) -> None:
    first, second, third = augment(FRAMES.repeat(1, 3, 1, 1)).split(3, dim=1)
    assert th.equal(first, second) and th.equal(first, third)
    assert first.min() >= 0.0 and first.max() <= 1.0
    # Another draw for each of the batch.
    same = augment(FRAMES[:1].repeat(64, 1, 1, 1))
    assert len({tuple(image.flatten().tolist()) for image in same}) > 5
    # From torch's global generator.
    th.manual_seed(3)
    once = augment(FRAMES)
    th.manual_seed(3)
    assert th.equal(once, augment(FRAMES)) and not th.equal(once, augment(FRAMES))


@pytest.mark.parametrize("side, pad", [(84, 4), (64, 3), (15, 1)])
def test_a_random_shift_pads_by_the_border_and_crops(side: int, pad: int) -> None:
    images = th.rand(300, 2, side, side)
    padded = nn.functional.pad(images, (pad,) * 4, mode="replicate")
    places = [(y, x) for y in range(2 * pad + 1) for x in range(2 * pad + 1)]
    found = []
    for shifted, image in zip(random_shift(images), padded, strict=True):
        found += [(y, x) for y, x in places if th.equal(shifted, image[:, y : y + side, x : x + side])]
    assert len(found) == 300 and len(set(found)) > 0.8 * len(places)
    assert {y for y, _ in found} == {x for _, x in found} == set(range(2 * pad + 1))
    assert round(SHIFT * 84) == 4 and CROP == 0.16


def test_a_color_jitter_stretches_around_the_gray() -> None:
    image = th.tensor([0.5, 0.25, 0.75]).repeat(4000, 1)[:, :, None, None].repeat(1, 1, 2, 1)
    jittered = color_jitter(image, strength=0.2)
    luma = (jittered[:, :, 0, 0] * th.tensor([0.299, 0.587, 0.114])).sum(dim=1)
    brightness = luma / (image[0, :, 0, 0] * th.tensor([0.299, 0.587, 0.114])).sum()
    # Of an image of one color, contrast and saturation both stretch the color around its gray.
    stretch = (jittered[:, 2, 0, 0] - jittered[:, 1, 0, 0]) / 0.5 / brightness
    assert 0.8 < brightness.min() < 0.81 and 1.19 < brightness.max() < 1.2
    assert 0.64 < stretch.min() < 0.7 and 1.36 < stretch.max() < 1.44


def test_channels_of_a_frame() -> None:
    gray = FRAMES[:, :2]
    first, second = color_jitter(gray, frame_channels=1).split(1, dim=1)
    assert not th.equal(first, gray[:, :1]) and not th.equal(second, gray[:, 1:])
    depth = th.cat([FRAMES, gray[:, :1]] * 2, dim=1)
    jittered = color_jitter(depth, frame_channels=4)
    assert th.equal(jittered[:, 3], depth[:, 3]) and th.equal(jittered[:, 7], depth[:, 7])
    assert not th.equal(jittered[:, :3], depth[:, :3]) and th.equal(jittered[:, :3], jittered[:, 4:7])
    for channels, per_frame in ((4, None), (5, 3), (4, 2), (4, 0)):
        with pytest.raises(ValueError, match=rf"{channels} channels with frame_channels={per_frame} are none; name"):
            color_jitter(th.rand(2, channels, 5, 5), frame_channels=per_frame)
