"""The layers of ScanNav's encoders, of which other networks take some; :mod:`sb3_abisim.networks.base` wraps them.

The residual network is the visual encoder of habitat-baselines' PointNav policy, as the paper uses it: half the
resolution by averaging, a ResNet18 with 32 base planes and group norm, and a compression to 2048 numbers.
"""

import math

import torch as th
from torch import nn

from sb3_abisim.networks.group_norm import GroupNorm

FEATURES_DIM = 2048
BASE_PLANES = 32
N_GROUPS = 16


class BasicBlock(nn.Module):
    """Two 3x3 convolutions with group norm, added to their input.

    :param n_in: input channels
    :param n_out: output channels
    :param stride: of the first convolution; the input is brought to the same shape by a 1x1 convolution if need be
    """

    def __init__(self, n_in: int, n_out: int, stride: int) -> None:
        super().__init__()
        self.convs = nn.Sequential(
            nn.Conv2d(n_in, n_out, 3, stride, padding=1, bias=False),
            GroupNorm(N_GROUPS, n_out),
            nn.ReLU(),
            nn.Conv2d(n_out, n_out, 3, padding=1, bias=False),
            GroupNorm(N_GROUPS, n_out),
        )
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or n_in != n_out:
            self.shortcut = nn.Sequential(nn.Conv2d(n_in, n_out, 1, stride, bias=False), GroupNorm(N_GROUPS, n_out))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Add the convolved input to the input.

        :param x: (batch, n_in, height, width)
        """
        return th.relu(self.convs(x) + self.shortcut(x))


def resnet18_backbone(n_input_channels: int) -> nn.Sequential:
    """Images to 256 channels at a 32nd of their size: 2,800,448 weights with four input channels.

    :param n_input_channels: channels of the images
    """
    layers: list[nn.Module] = [
        nn.Conv2d(n_input_channels, BASE_PLANES, 7, stride=2, padding=3, bias=False),
        GroupNorm(N_GROUPS, BASE_PLANES),
        nn.ReLU(),
        nn.MaxPool2d(3, stride=2, padding=1),
    ]
    n_in = BASE_PLANES
    for stage in range(4):
        n_out = BASE_PLANES * 2**stage
        layers += [BasicBlock(n_in, n_out, 1 if stage == 0 else 2), BasicBlock(n_out, n_out, 1)]
        n_in = n_out
    return nn.Sequential(*layers)


def resnet18_layers(n_input_channels: int, image_size: int) -> nn.Sequential:
    """Habitat's visual encoder: images to 2048 numbers at 64, 128 and 256 pixels.

    :param n_input_channels: channels of the images
    :param image_size: height and width of the images
    """
    side = math.ceil(image_size / 2 / 32)
    return nn.Sequential(nn.AvgPool2d(2), resnet18_backbone(n_input_channels), *compression(side**2))


def compression(n_positions: int, features_dim: int = FEATURES_DIM) -> nn.Sequential:
    """The backbone's map to about ``features_dim`` numbers, the same number of channels at each position.

    :param n_positions: of the map
    :param features_dim: how many numbers, to a multiple of ``n_positions``
    """
    n_compressed = max(1, round(features_dim / n_positions))
    return nn.Sequential(
        nn.Conv2d(BASE_PLANES * 8, n_compressed, 3, padding=1, bias=False),
        GroupNorm(1, n_compressed),
        nn.ReLU(),
        nn.Flatten(),
    )


def small_layers(n_input_channels: int, stride: int = 4, n_channels: int = 32) -> nn.Sequential:
    """128 x 128 images to 2048 = 32 x 8 x 8 numbers, for computers without an accelerator.

    :param n_input_channels: channels of the images
    :param stride: of the first layer, which at 2 would take most of the time on images of this size
    :param n_channels: of the last layer
    """
    return nn.Sequential(
        nn.Conv2d(n_input_channels, 16, 5, stride=stride, padding=2),
        nn.ReLU(),
        nn.Conv2d(16, 32, 3, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(32, n_channels, 3, stride=2, padding=1),
        nn.Flatten(),
    )
