"""Encoders whose embeddings are known, for the instruments that look at encoders."""

from pathlib import Path

import numpy as np
import torch as th
from torch import nn

from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.registry import networks


class Masked(nn.Module):
    """The pixels that a mask keeps, as they are (0..1), and no others."""

    def __init__(self, mask):
        super().__init__()
        self.kept = th.as_tensor(mask).flatten().nonzero()[:, 0]

    def forward(self, observations):
        return observations.flatten(1)[:, self.kept]


def file_of(layers, shape, objective="ssi", seed=0):
    """An encoder file that was never on a disk."""
    n_features = len(layers.kept) if isinstance(layers, Masked) else int(np.prod(shape[1:]))
    # What an untrained encoder of the same network is made of.
    network = next(name for name, network in networks().items() if network.observation_shape == shape)
    encoder = Encoder(layers, n_features, network, {}, shape)
    metadata = {"objective": objective, "settings": {"seed": seed}, "env_id": "?", "preprocessing": {}}
    return EncoderFile(Path("nowhere"), "0" * 64, encoder, metadata)


def identity(shape):
    """An encoder that embeds an observation as its pixels."""
    return file_of(Masked(np.ones(shape)), shape)
