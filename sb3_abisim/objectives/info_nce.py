"""Contrastive base encoder (the paper's appendix on alternative base cases): InfoNCE between transitions and actions.

====================  =======================================  ==========================================
paper                 here                                     meaning
====================  =======================================  ==========================================
psi_theta             ``encoder``                              state encoder
psi_eta,A             ``action_encoder``                       from actions to the space of state pairs
d                     minus the L2 distance                    similarity
a+, a-                ``actions``, all other ``candidates``    action taken, actions not taken
====================  =======================================  ==========================================

Choices: the paper's equation is the likelihood itself and says "d is the l2 distance". Minimized as written, it would
push each transition away from its action. So the loss here is the negative logarithm, and d minus the distance.

The pair is written [psi(s), psi(s') - psi(s)], not [psi(s), psi(s')]: an embedded action can be near to the change
that it makes, but not near to all states that it was taken in. In a trial with the plain pair, Nav2D stayed at chance.

With ``Discrete`` actions and k = 1 the negatives are all other actions. Otherwise they are the actions, or sequences
of k actions, of the batch's other transitions, unless they equal the positive.
"""

import math
from typing import Any

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.heads import MLP
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.registry import register_method

HIDDEN_DIM = 256


def info_nce_loss(
    pairs: th.Tensor, candidates: th.Tensor, positives: th.Tensor, excluded: th.Tensor | None = None
) -> tuple[th.Tensor, dict[str, th.Tensor]]:
    """``-log (exp(d(z, a+)) / sum_a exp(d(z, a)))`` with ``d(x, y) = -|x - y|_2``, mean over the batch.

    :param pairs: embeddings of both ends of each transition, (batch, 2 features_dim)
    :param candidates: embedded actions, (n_candidates, 2 features_dim)
    :param positives: index of the action taken, int64 (batch,)
    :param excluded: bool (batch, n_candidates), candidates that are no negatives; the positive's entry is ignored
    """
    logits = -th.cdist(pairs, candidates)
    if excluded is not None:
        positive = nn.functional.one_hot(positives, len(candidates)).bool()
        logits = logits.masked_fill(excluded & ~positive, -math.inf)
    info_nce = nn.functional.cross_entropy(logits, positives)
    return info_nce, {"info_nce": info_nce, "accuracy": (logits.argmax(dim=1) == positives).float().mean()}


class InfoNCE(Objective):
    """Embed what a transition and its action have in common.

    :param encoder: the network to pretrain
    :param action_space: as for :class:`~sb3_abisim.objectives.base.Objective`
    :param k: steps of a transition, whose k actions are the positive
    :param l1_penalty: weight of the L1 norm of both embeddings, as in :mod:`sb3_abisim.objectives.ssi`
    """

    name = "info_nce"
    reads_action_sequences = True

    def __init__(self, encoder: Encoder, action_space: gym.Space[Any], k: int = 1, l1_penalty: float = 0.0) -> None:
        super().__init__(encoder, action_space)
        if not 0 <= l1_penalty < math.inf:
            raise ValueError(f"l1_penalty must be a number of at least 0, got {l1_penalty}")
        self.k, self.l1_penalty = k, l1_penalty
        self.action_encoder = MLP(k * self.action_dim, HIDDEN_DIM, 2 * encoder.features_dim)

    @classmethod
    def check_k(cls, k: int | list[int]) -> None:
        """Refuse sequences of several lengths.

        :param k: steps between the two observations
        :raises ValueError: for a range
        """
        if not isinstance(k, int):
            raise ValueError(f"info_nce takes sequences of one length, got k = {k}; give one number")

    def chance_accuracy(self, batch_size: int) -> float:
        """One in the number of candidates: all action sequences, or those of the batch, if they are fewer.

        :param batch_size: of the batches
        """
        return 1.0 / min(batch_size, self.actions.count**self.k)

    def remedies(self) -> list[str]:
        """To do without the penalty."""
        return ["objective_kwargs.l1_penalty:0"] if self.l1_penalty else []

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """InfoNCE; terms ``info_nce``, ``l1_norm`` and ``accuracy`` (share of actions found among the candidates).

        :param batch: transitions with ``actions`` of shape (batch, k, *shape of an action)
        """
        psi, psi_next = batch.split_pair(self.encoder(batch.frames))
        pairs = th.cat([psi, psi_next - psi], dim=1)
        every = self.actions.enumerate(pairs.device) if self.k == 1 else None
        if every is not None:
            positives = self.actions.index(batch.actions[:, 0])
            loss, terms = info_nce_loss(pairs, self.action_encoder(every), positives)
        else:
            sequences = self.action_inputs(batch.actions).flatten(start_dim=1)
            same = (sequences[:, None] == sequences[None]).all(dim=2)
            positives = th.arange(len(pairs), device=pairs.device)
            loss, terms = info_nce_loss(pairs, self.action_encoder(sequences), positives, excluded=same)
        l1_norm = (psi.abs().sum(dim=1) + psi_next.abs().sum(dim=1)).mean()
        terms["l1_norm"] = l1_norm
        return loss + self.l1_penalty * l1_norm, {name: term.detach() for name, term in terms.items()}


register_method("info_nce", InfoNCE, label="InfoNCE", extractor="InfoNCEExtractor", color="#000000")
