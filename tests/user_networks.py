"""A user's module with networks: what ``user_networks:Factory`` names."""

from typing import Any

import gymnasium as gym
import torch as th
from torch import nn


class Pooled(nn.Module):
    """A class that is its own factory."""

    def __init__(self, observation_space: gym.Space[Any], width: int = 4, stride: int = 2) -> None:
        super().__init__()
        self.conv = nn.Conv2d(observation_space.shape[0], width, 3, stride=stride)
        self.head = nn.Linear(width, 6)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features: th.Tensor = self.head(self.conv(observations).relu().mean(dim=(2, 3)))
        return features


def tiny(observation_space: gym.Space[Any]) -> nn.Module:
    return nn.Sequential(nn.Conv2d(observation_space.shape[0], 5, 3, stride=3), nn.BatchNorm2d(5), nn.Flatten())


def with_hidden_dim(observation_space: gym.Space[Any], hidden_dim: int = 3) -> nn.Module:
    """Calls an argument of its own as ours is called."""
    n_inputs = gym.spaces.flatdim(observation_space)
    return nn.Sequential(nn.Flatten(), nn.Linear(n_inputs, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, 4))


NOT_A_FACTORY = 3
