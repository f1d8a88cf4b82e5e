"""Beta variational autoencoder (Higgins et al. 2017), the paper's baseline bVAE.

It reconstructs the observation through a noisy embedding.

====================  =======================================  ==========================================
Higgins et al.        here                                     meaning
====================  =======================================  ==========================================
q_phi(z | x)          ``encoder``, ``log_std``                 Gaussian with independent dimensions
p_theta(x | z)        ``decoder``                              one Bernoulli variable per intensity
beta                  ``kl_weight``                            weight of the divergence from N(0, 1)
====================  =======================================  ==========================================

Choices, since the paper gives none: the encoder's output is the mean of q, so that RL gets the mean. The log standard
deviation is a linear function of it. Intensities in 0..1 take the Bernoulli likelihood (as in Higgins et al.), summed
over the observation. The loss is its mean over the batch.
"""

import math
from typing import Any

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.decoder import Decoder
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.registry import register_method

_LOG_STD_RANGE = (-5.0, 2.0)


def beta_vae_loss(
    logits: th.Tensor, observations: th.Tensor, mean: th.Tensor, log_std: th.Tensor, kl_weight: float
) -> tuple[th.Tensor, dict[str, th.Tensor]]:
    """``-log p(x | z) + beta KL(q(z | x) || N(0, 1))``, mean over the batch.

    :param logits: of the reconstruction, (batch, channels, height, width)
    :param observations: in 0..1, of the same shape
    :param mean: of q(z | x), (batch, features_dim)
    :param log_std: of q(z | x), (batch, features_dim)
    :param kl_weight: beta, at least 0
    """
    n = len(observations)
    reconstruction = nn.functional.binary_cross_entropy_with_logits(logits, observations, reduction="sum") / n
    kl = 0.5 * (mean**2 + (2.0 * log_std).exp() - 1.0 - 2.0 * log_std).sum(dim=1).mean()
    return reconstruction + kl_weight * kl, {"reconstruction": reconstruction, "kl": kl}


class BetaVAE(Objective):
    """Embed what an observation can be reconstructed from.

    :param encoder: the network to pretrain
    :param action_space: not used by the loss
    :param kl_weight: beta
    """

    name = "beta_vae"

    def __init__(self, encoder: Encoder, action_space: gym.Space[Any], kl_weight: float = 1.0) -> None:
        super().__init__(encoder, action_space)
        if not 0 <= kl_weight < math.inf:
            raise ValueError(f"kl_weight must be a number of at least 0, got {kl_weight}")
        self.kl_weight = kl_weight
        self.log_std = nn.Linear(encoder.features_dim, encoder.features_dim)
        self.decoder = Decoder(encoder.features_dim, encoder.input_shape)

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """The negative evidence lower bound; terms ``reconstruction``, ``kl`` and ``squared_error`` (per intensity).

        :param batch: transitions, of which the observations alone are read
        """
        mean = self.encoder(batch.obs)
        log_std = self.log_std(mean).clamp(*_LOG_STD_RANGE)
        z = mean + log_std.exp() * th.randn(mean.shape).to(mean.device)
        logits = self.decoder(z)
        loss, terms = beta_vae_loss(logits, batch.obs, mean, log_std, self.kl_weight)
        terms["squared_error"] = (logits.sigmoid() - batch.obs).pow(2).mean()
        return loss, {name: term.detach() for name, term in terms.items()}


register_method(
    "beta_vae",
    BetaVAE,
    label="β-VAE",
    extractor="BetaVAEExtractor",
    color="#56B4E9",
    curve="reconstruction",
    results=("squared_error", "kl"),
)
