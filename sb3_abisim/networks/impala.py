"""The residual network of IMPALA (Espeholt et al. 2018), with 15 convolutions."""

import math
from typing import Any

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.networks.base import require_size
from sb3_abisim.registry import register_network

MIN_SIZE = 8
_WIDTHS = (16, 32, 32)


class Residual(nn.Module):
    """Two 3x3 convolutions, each after a ReLU, added to their input.

    :param n_channels: of input and output
    """

    def __init__(self, n_channels: int) -> None:
        super().__init__()
        self.convs = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(n_channels, n_channels, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(n_channels, n_channels, 3, padding=1),
        )

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Add the convolved input to the input.

        :param x: (batch, n_channels, height, width)
        """
        added: th.Tensor = x + self.convs(x)
        return added


def make_impala(observation_space: gym.Space[Any], features_dim: int = 256) -> nn.Module:
    """Three times a convolution, a pooling that halves the sides and two residual blocks; then a linear layer.

    :param observation_space: images of at least 8 pixels, channels first
    :param features_dim: size of the embedding
    :raises ValueError: for smaller images
    """
    n_in, height, width = require_size("impala", observation_space, MIN_SIZE)
    layers: list[nn.Module] = []
    for n_out in _WIDTHS:
        layers += [nn.Conv2d(n_in, n_out, 3, padding=1), nn.MaxPool2d(3, stride=2, padding=1)]
        layers += [Residual(n_out), Residual(n_out)]
        n_in = n_out
    n_positions = math.prod(math.ceil(side / 2 ** len(_WIDTHS)) for side in (height, width))
    linear = nn.Linear(n_in * n_positions, features_dim)
    return nn.Sequential(*layers, nn.ReLU(), nn.Flatten(), linear, nn.ReLU())


register_network("impala", make_impala)
