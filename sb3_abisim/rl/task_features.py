"""A small trainable network beside an encoder: what the task needs and the encoder does not hold.

An encoder that was pretrained on what actions change need not hold what they do not change, such as a goal that is
somewhere else in every episode. The paper names the remedy, "an additional channel for task-relevant information". This
is that channel: another network on the same observation, whose output stands behind the encoder's.
"""

from typing import Any

import gymnasium as gym

from sb3_abisim.networks.base import Encoder, generic_network, make_encoder


def make_task_network(observation_space: gym.Space[Any], features_dim: int) -> Encoder | None:
    """The network of ``task_features_dim``, with random weights.

    Stable-Baselines3's ``NatureCNN`` with ``features_dim`` outputs, or ``small`` for images under 36 pixels. It is
    cheap beside the paper's networks (its first convolutions have strides of 4 and 2), and what Stable-Baselines3 takes
    when nothing is pretrained.

    :param observation_space: images, channels first
    :param features_dim: size of its output; 0 for no network
    :return: None for 0
    :raises ValueError: for a size that is no whole number of at least 0
    """
    if isinstance(features_dim, bool) or not isinstance(features_dim, int) or features_dim < 0:
        raise ValueError(f"task_features_dim must be a whole number of at least 0, got {features_dim!r}")
    if features_dim == 0:
        return None
    return make_encoder(observation_space, generic_network(observation_space.shape or ()), features_dim=features_dim)
