"""The network of Mnih et al. (2015) for Atari games, as Stable-Baselines3's ``NatureCNN`` builds it."""

import math
from typing import Any

import gymnasium as gym
from torch import nn

from sb3_abisim.networks.base import NATURE_SIZE, require_size
from sb3_abisim.registry import register_network


def make_nature(observation_space: gym.Space[Any], features_dim: int = 512) -> nn.Module:
    """Three convolutions and a linear layer, a ReLU after each: the layers of Stable-Baselines3's ``NatureCNN``.

    :param observation_space: images of at least 36 pixels, channels first
    :param features_dim: size of the embedding
    :raises ValueError: for smaller images
    """
    n_channels, height, width = require_size("nature", observation_space, NATURE_SIZE)
    # Kernels of 8, 4 and 3 with strides of 4, 2 and 1, without padding.
    n_positions = math.prod((((side - 8) // 4 + 1) - 4) // 2 + 1 - 2 for side in (height, width))
    return nn.Sequential(
        nn.Conv2d(n_channels, 32, 8, stride=4),
        nn.ReLU(),
        nn.Conv2d(32, 64, 4, stride=2),
        nn.ReLU(),
        nn.Conv2d(64, 64, 3),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(64 * n_positions, features_dim),
        nn.ReLU(),
    )


register_network("nature", make_nature)
