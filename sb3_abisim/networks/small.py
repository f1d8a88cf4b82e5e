"""A network for images under 36 pixels, such as MiniGrid's grids of 7 x 7 cells."""

import math
from typing import Any

import gymnasium as gym
from torch import nn

from sb3_abisim.networks.base import require_size
from sb3_abisim.networks.group_norm import GroupNorm
from sb3_abisim.registry import register_network

MIN_SIZE = 3


def make_small(observation_space: gym.Space[Any], features_dim: int = 256) -> nn.Module:
    """Three 3x3 convolutions, the last two with stride 2, and a linear layer.

    A grid of codes such as MiniGrid's holds numbers from 0 to 10, which arrive here as hundredths. The norm after the
    first convolution makes the others see them as well as they see colors.

    :param observation_space: images of at least 3 pixels, channels first
    :param features_dim: size of the embedding
    :raises ValueError: for smaller images
    """
    n_channels, height, width = require_size("small", observation_space, MIN_SIZE)
    n_positions = math.prod(math.ceil(side / 4) for side in (height, width))
    return nn.Sequential(
        nn.Conv2d(n_channels, 16, 3, padding=1, bias=False),
        GroupNorm(1, 16, eps=1e-8),
        nn.ReLU(),
        nn.Conv2d(16, 32, 3, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(32, 64, 3, stride=2, padding=1),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(64 * n_positions, features_dim),
        nn.ReLU(),
    )


register_network("small", make_small)
