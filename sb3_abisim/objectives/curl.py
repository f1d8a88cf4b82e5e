"""CURL (Laskin et al. 2020), a baseline of the paper: match two augmented copies of an observation among others.

====================  =======================================  ==========================================
Laskin et al.         here                                     meaning
====================  =======================================  ==========================================
q = f_q(aug(o))       ``encoder``                              embedding of the query
k = f_k(aug'(o))      ``key_encoder``                          of the key, by a moving average of f_q
W                     ``weight``                               bilinear similarity q W k
m                     ``1 - tau``                              momentum of the average
====================  =======================================  ==========================================

The paper augments by random noise, because shifts or crops would teach the encoder to ignore where the agent is. Shifts
and crops are options. The negatives are the other observations of the batch.
"""

import copy
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_abisim.networks.augmentations import AUGMENTATIONS
from sb3_abisim.networks.base import Encoder
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.registry import register_method


def curl_loss(query: th.Tensor, key: th.Tensor, weight: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
    """InfoNCE with bilinear similarity: ``-log (exp(q_i W k_i) / sum_j exp(q_i W k_j))``, mean over the batch.

    :param query: (batch, features_dim)
    :param key: (batch, features_dim), row i of the same observation as row i of ``query``
    :param weight: W, (features_dim, features_dim)
    """
    logits = query @ weight @ key.T
    labels = th.arange(len(query), device=query.device)
    info_nce = nn.functional.cross_entropy(logits, labels)
    return info_nce, {"info_nce": info_nce, "accuracy": (logits.argmax(dim=1) == labels).float().mean()}


class CURL(Objective):
    """Embed what distinguishes one observation from the others in spite of noise.

    :param encoder: the network to pretrain
    :param action_space: not used by the loss
    :param augmentation: "noise" (the paper), "shift" or "crop"
    :param strength: of the augmentation, above 0 (see :mod:`sb3_abisim.networks.augmentations`)
    :param tau: rate of the key encoder, per update
    """

    name = "curl"

    def __init__(
        self,
        encoder: Encoder,
        action_space: gym.Space[Any],
        augmentation: str = "noise",
        strength: float = 0.1,
        tau: float = 0.05,
    ) -> None:
        super().__init__(encoder, action_space)
        if augmentation not in AUGMENTATIONS:
            raise ValueError(f"augmentation must be one of {tuple(AUGMENTATIONS)}, got {augmentation!r}")
        if not 0 < strength < 1:
            raise ValueError(f"strength must lie between 0 and 1, got {strength}")
        if not 0 < tau <= 1:
            raise ValueError(f"tau must lie in (0, 1], got {tau}")
        self.augmentation, self.strength, self.tau = augmentation, strength, tau
        self.key_encoder = copy.deepcopy(encoder).requires_grad_(False)
        # CURL's authors start it with uniform numbers in 0..1, with which all similarities start alike. The identity
        # makes them dot products.
        self.weight = nn.Parameter(th.eye(encoder.features_dim))

    def chance_accuracy(self, batch_size: int) -> float:
        """One in the number of keys.

        :param batch_size: of the batches
        """
        return 1.0 / batch_size

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """InfoNCE between two augmented copies; terms ``info_nce`` and ``accuracy`` (share of keys found).

        :param batch: transitions, of which the observations alone are read
        """
        augment = AUGMENTATIONS[self.augmentation]
        query = self.encoder(augment(batch.obs, self.strength))
        with th.no_grad():
            key = self.key_encoder(augment(batch.obs, self.strength))
        loss, terms = curl_loss(query, key, self.weight)
        return loss, {name: term.detach() for name, term in terms.items()}

    @th.no_grad()
    def after_step(self) -> None:
        """Move the key encoder, ``k <- tau q + (1 - tau) k``."""
        polyak_update(self.encoder.parameters(), self.key_encoder.parameters(), self.tau)


register_method("curl", CURL, label="CURL", extractor="CURLExtractor", color="#E69F00")
