"""ResNet18 with group norm for images of any size: the backbone of ``ScanNavResNet18`` without its first averaging."""

import math
from typing import Any

import gymnasium as gym
from torch import nn

from sb3_abisim.networks.base import require_size
from sb3_abisim.networks.resnet import FEATURES_DIM, compression, resnet18_backbone
from sb3_abisim.registry import register_network

MIN_SIZE = 16


def make_resnet18(observation_space: gym.Space[Any], features_dim: int = FEATURES_DIM) -> nn.Module:
    """Habitat's ResNet18 (32 base planes) at the full resolution, and its compression.

    :param observation_space: images of at least 16 pixels, channels first
    :param features_dim: size of the embedding, to the next multiple of the number of positions in the last map
    :raises ValueError: for smaller images
    """
    n_channels, height, width = require_size("resnet18", observation_space, MIN_SIZE)
    n_positions = math.prod(math.ceil(side / 32) for side in (height, width))
    return nn.Sequential(resnet18_backbone(n_channels), compression(n_positions, features_dim))


register_network("resnet18", make_resnet18)
