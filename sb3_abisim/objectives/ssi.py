"""SSI, regularized single-step inverse dynamics (the paper's Eq. 5, L_ss).

====================  =======================================  ==========================================
paper                 here                                     meaning
====================  =======================================  ==========================================
psi_theta             ``encoder``                              single-step encoder
f_nu,inverse          ``inverse_model``                        weak model of p(a | psi(s), psi(s'))
beta                  ``l1_penalty``                           weight of the L1 norm of both embeddings
beta_max, alpha       ``l1_penalty``, ``accuracy``             adaptive regularization (appendix)
====================  =======================================  ==========================================

Choices: losses are means over the batch where the paper writes sums over the dataset. The paper's table ends the
inverse model in a layer of 256 (Nav2D) or 32 (Pointmass) units, which is no distribution over actions. Here it ends in
one logit per action, or mean and log standard deviation per continuous action dimension; in an action of several
components, each component has its own (:mod:`sb3_abisim.objectives.actions`). The accuracy alpha is the share of
actions with all components right, for continuous actions the coefficient of determination, clipped to 0..1.
"""

import math
from typing import Any

import gymnasium as gym
import torch as th

from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.heads import MLP
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.registry import register_method

ADAPTIVE_FORMS = ("paper", "released", "chance_corrected")
HIDDEN_DIM = 256
# What to try where nothing was learned.
LIGHT_PENALTY = 0.001
LARGE_DELTA_SCALE = 3.0


def inverse_dynamics_loss(
    log_prob: th.Tensor, psi: th.Tensor, psi_next: th.Tensor, beta: float | th.Tensor
) -> tuple[th.Tensor, dict[str, th.Tensor]]:
    """Eq. 5: ``-log f(a | psi(s), psi(s')) + beta (|psi(s)|_1 + |psi(s')|_1)``, mean over the batch.

    :param log_prob: log-likelihood of the action taken, (batch,)
    :param psi: embedding of s, (batch, features_dim)
    :param psi_next: embedding of s', (batch, features_dim)
    :param beta: weight of the penalty, at least 0
    """
    inverse_nll = -log_prob.mean()
    l1_norm = (psi.abs().sum(dim=1) + psi_next.abs().sum(dim=1)).mean()
    return inverse_nll + beta * l1_norm, {"inverse_nll": inverse_nll, "l1_norm": l1_norm}


def adaptive_beta(beta_max: float, accuracy: th.Tensor, form: str, chance: float = 0.0) -> th.Tensor:
    """The regularization for the present accuracy: more of it once actions are predicted well.

    A guess among n actions is right in 1 of n cases, where both other forms already ask for some penalty. The penalty
    can hold an embedding that has found nothing yet at zero for good. "chance_corrected" asks for none then.

    :param beta_max: largest weight
    :param accuracy: of the previous iteration, 0..1
    :param form: "paper", ``beta_max (1 - exp(-4 alpha^2))``, "released", ``beta_max exp(-5 (alpha - 1)^2)``, or
        "chance_corrected" (ours), the paper's with alpha the share of the way from chance to certainty
    :param chance: accuracy of guessing, below 1
    """
    if form == "chance_corrected":
        accuracy = ((accuracy - chance) / (1.0 - chance)).clamp_min(0.0)
        form = "paper"
    if form == "paper":
        return beta_max * (1.0 - th.exp(-4.0 * accuracy**2))
    return beta_max * th.exp(-5.0 * (accuracy - 1.0) ** 2)


class InverseDynamics(Objective):
    """Embed what is needed to predict which action led from s_t to s_{t+k}, and as little else as possible.

    :param encoder: the network to pretrain
    :param action_space: as for :class:`~sb3_abisim.objectives.base.Objective`
    :param l1_penalty: beta, or beta_max with ``adaptive``
    :param adaptive: None for a fixed beta, else "paper", "released" or "chance_corrected" (see :func:`adaptive_beta`)
    :param delta_scale: how much more the inverse model's input shows of the change than of the state:
        (psi(s) / w, w (psi(s') - psi(s))). Where the agent is a small part of a varied observation, a large scale lets
        the change stand out from the start; 1 is the plain input
    """

    name = "ssi"

    def __init__(
        self,
        encoder: Encoder,
        action_space: gym.Space[Any],
        l1_penalty: float = 1e-4,
        adaptive: str | None = None,
        delta_scale: float = 1.0,
    ) -> None:
        super().__init__(encoder, action_space)
        if not 0 <= l1_penalty < math.inf:
            raise ValueError(f"l1_penalty must be a number of at least 0, got {l1_penalty}")
        if adaptive is not None and adaptive not in ADAPTIVE_FORMS:
            raise ValueError(f"adaptive must be None or one of {ADAPTIVE_FORMS}, got {adaptive!r}")
        if not 0 < delta_scale < math.inf:
            raise ValueError(f"delta_scale must be a number above 0, got {delta_scale}")
        self.l1_penalty = l1_penalty
        self.adaptive = adaptive
        self.delta_scale = delta_scale
        self.inverse_model = MLP(2 * encoder.features_dim, HIDDEN_DIM, self.actions.n_outputs)
        # Accuracy of the previous iteration; a buffer, so that an interrupted run goes on with the same beta.
        self.accuracy: th.Tensor
        self.register_buffer("accuracy", th.zeros(()))

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """Eq. 5 on a batch; terms ``inverse_nll``, ``l1_norm``, ``beta`` and ``accuracy``.

        :param batch: transitions (s_t, a_t, s_{t+k})
        """
        psi, psi_next = batch.split_pair(self.encoder(batch.frames))
        inputs = th.cat([psi / self.delta_scale, self.delta_scale * (psi_next - psi)], dim=1)
        log_prob, accuracy = self.actions.score(self.inverse_model(inputs), batch.actions)
        beta = th.as_tensor(self.l1_penalty)
        if self.adaptive is not None:
            beta = adaptive_beta(self.l1_penalty, self.accuracy, self.adaptive, self.chance_accuracy(len(psi)))
        loss, terms = inverse_dynamics_loss(log_prob, psi, psi_next, beta)
        if self.training:
            self.accuracy.copy_(accuracy)
        return loss, {**{k: v.detach() for k, v in terms.items()}, "beta": beta, "accuracy": accuracy}

    def chance_accuracy(self, batch_size: int) -> float:
        """One in the number of actions; 0 for a ``Box``, whose accuracy is a coefficient of determination.

        :param batch_size: makes no difference
        """
        return self.actions.chance

    def remedies(self) -> list[str]:
        """The settings of Nav2D, with which embeddings left zero that the penalty would have held there."""
        found = []
        if self.l1_penalty > LIGHT_PENALTY:
            found.append(f"objective_kwargs.l1_penalty:{LIGHT_PENALTY}")
        if self.delta_scale < LARGE_DELTA_SCALE:
            found.append(f"objective_kwargs.delta_scale:{LARGE_DELTA_SCALE}")
        if self.l1_penalty > 0 and self.adaptive != "chance_corrected":
            found.append("objective_kwargs.adaptive:chance_corrected")
        return found


register_method("ssi", InverseDynamics, label="single-step inverse dynamics", extractor="SSIExtractor", color="#009E73")
