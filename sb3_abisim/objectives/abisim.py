"""Action-bisimulation (the paper's Eqs. 6 to 8 and Algorithm 1).

====================  ==============================  =====================================================
paper                 here                            meaning
====================  ==============================  =====================================================
psi_theta             ``base_encoder``                single-step encoder, trained before and frozen
phi_eta               ``encoder``                     multi-step encoder, the result
phi                   ``target_encoder``              its exponential moving average, for the target
f_upsilon             ``forward_model``               Gaussian model of phi(s') given phi(s) and a
c                     ``c``                           weight of the recursive step
tau                   ``tau``                         rate of the moving average
====================  ==============================  =====================================================

Pairs of states are sampled among those of a batch, many more pairs than states: distances between n embeddings cost
little beside the n embeddings. There are two expectations over actions:

* ``expectation="uniform"``: the forward model predicts the next embedding for all ``Discrete`` actions, or for
  ``n_action_samples`` uniform ones of another space, the same for both states (Eq. 7).
* ``expectation="behavior"``: pairs are transitions that took the same action, and the target uses the next states
  of the data. No forward model stands in the target. Actions are the same if all components are equal; those of a
  ``Box`` differ by at most ``action_radius`` in the L2 norm. The target is then one sample of the expectation, so its
  loss must be the squared one: the minimizer of the paper's absolute difference would be the median over actions, and
  an obstacle that blocks one of four moves would not count.

There are two ways to choose the pairs:

* ``pairs="random"``: uniformly (the paper).
* ``pairs="nearest"``: half of them are the batch's nearest by base distance, and every error counts relative to its
  base distance. Random pairs differ in where the agent is. Their distances are nearly sums of two norms, which say
  little about what else an embedding depends on. Pairs with the agent in like places show the influence of each
  obstacle. The choice looks at the states alone, so the expectation over actions stays what it is.

Departures that the released code makes are options here: smooth L1 as loss, a reset of the forward model at an
interval, and a start from the base encoder's weights.
"""

import copy
import math
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.heads import MLP
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.registry import register_method

LOSSES = {"l1": nn.functional.l1_loss, "smooth_l1": nn.functional.smooth_l1_loss, "mse": nn.functional.mse_loss}
EXPECTATIONS = ("uniform", "behavior")
PAIRS = ("random", "nearest")
# Share of nearest pairs for pairs="nearest".
NEAREST_SHARE = 0.5
# Added to base distances, in units of their mean: an error counts at most 20 times that of a pair at the mean.
NEAREST_FLOOR = 0.05
HIDDEN_DIM = 256
_LOG_STD_RANGE = (-5.0, 2.0)


def action_bisim_target(base_distance: th.Tensor, next_distance: th.Tensor, c: float) -> th.Tensor:
    """Eq. 7: ``(1 - c) |psi(s_i) - psi(s_j)|_1 + c E_a[W_1(s_i, s_j, a)]``.

    :param base_distance: L1 distances of single-step embeddings, any shape
    :param next_distance: expected W1 distances of next embeddings, same shape
    :param c: 0 <= c < 1
    """
    return (1.0 - c) * base_distance + c * next_distance


def l1_distance(x: th.Tensor, y: th.Tensor) -> th.Tensor:
    """L1 distances between the rows of two tensors.

    :param x: (n, features_dim)
    :param y: (n, features_dim)
    :return: (n,)
    """
    return (x - y).abs().sum(dim=1)


def relative_scale(base_distance: th.Tensor) -> th.Tensor:
    """Factors on distances that make errors relative to the base distance, near 1 for a pair at the mean.

    :param base_distance: of the pairs of a batch, (n_pairs,)
    :return: (n_pairs,)
    """
    mean = base_distance.mean()
    # All zero (a base that has collapsed) would divide by zero; any factor will do then.
    return mean / (base_distance + NEAREST_FLOOR * mean).clamp_min(th.finfo(mean.dtype).tiny)


class ForwardModel(nn.Module):
    """Gaussian model of the next embedding: ``N(mean, diag(std^2))`` given an embedding and an action.

    :param features_dim: size of the embedding
    :param action_dim: size of the action input
    """

    def __init__(self, features_dim: int, action_dim: int) -> None:
        super().__init__()
        self.dims = (features_dim + action_dim, HIDDEN_DIM, 2 * features_dim)
        self.network = MLP(*self.dims)

    def forward(self, phi: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Mean and standard deviation of the next embedding; the mean is predicted as a change of ``phi``.

        :param phi: embeddings, (batch, features_dim)
        :param actions: action inputs, (batch, action_dim)
        :return: two tensors (batch, features_dim)
        """
        change, log_std = self.network(th.cat([phi, actions], dim=1)).chunk(2, dim=1)
        return phi + change, log_std.clamp(*_LOG_STD_RANGE).exp()

    def nll(self, phi: th.Tensor, actions: th.Tensor, phi_next: th.Tensor) -> th.Tensor:
        """Eq. 6: negative log-likelihood of the next embedding, mean over batch and dimensions.

        :param phi: embeddings, (batch, features_dim); pass them detached, as the objective does
        :param actions: action inputs, (batch, action_dim)
        :param phi_next: embeddings that followed, (batch, features_dim)
        """
        mean, std = self(phi, actions)
        log_prob: th.Tensor = th.distributions.Normal(mean, std).log_prob(phi_next)  # type: ignore[no-untyped-call]
        return -log_prob.mean()

    def reset(self) -> None:
        """Sample new weights."""
        self.network.load_state_dict(MLP(*self.dims).state_dict())


class ActionBisimulation(Objective):
    """Make L1 distances of embeddings equal the action-bisimulation metric.

    :param encoder: the network to pretrain
    :param action_space: as for :class:`~sb3_abisim.objectives.base.Objective`
    :param base_encoder: any trained encoder; frozen here
    :param c: weight of the recursive step, 0 <= c < 1
    :param tau: rate of the target encoder, per update; the smaller, the more updates it takes to look ahead
    :param expectation: "uniform" or "behavior" (module docstring)
    :param distance_loss: "l1" (the paper), "smooth_l1" (the released code) or "mse"
    :param l1_penalty: weight of the mean L1 norm of the embedding in the loss. Distances of most pairs are sums of two
        norms, so parts of an embedding that respond to far obstacles alone may fluctuate at no cost. A small penalty
        silences them
    :param pairs: "random" or "nearest" (module docstring)
    :param n_pairs: pairs of states per update
    :param n_action_samples: actions per update for "uniform", where they are not ``Discrete``
    :param action_radius: for "behavior" with a ``Box``, the largest L2 distance of two actions that count as the same;
        each of their numbers spans -1..1
    :param warm_start: begin from the base encoder's weights, if it is the same network
    :param forward_reset_interval: updates between resets of the forward model, None for never
    """

    name = "abisim"

    def __init__(
        self,
        encoder: Encoder,
        action_space: gym.Space[Any],
        base_encoder: Encoder,
        c: float = 0.9,
        tau: float = 0.01,
        expectation: str = "uniform",
        distance_loss: str = "l1",
        l1_penalty: float = 0.0,
        pairs: str = "random",
        n_pairs: int = 4096,
        n_action_samples: int = 8,
        action_radius: float = 0.2,
        warm_start: bool = False,
        forward_reset_interval: int | None = None,
    ) -> None:
        super().__init__(encoder, action_space)
        if not 0 <= c < 1:
            raise ValueError(f"c must lie in [0, 1), got {c}: the recursion has no fixed point otherwise")
        if not 0 <= l1_penalty < math.inf:
            raise ValueError(f"l1_penalty must be a number of at least 0, got {l1_penalty}")
        if not 0 < tau <= 1:
            raise ValueError(f"tau must lie in (0, 1], got {tau}")
        for name, value, known in (
            ("expectation", expectation, EXPECTATIONS),
            ("distance_loss", distance_loss, LOSSES),
            ("pairs", pairs, PAIRS),
        ):
            if value not in known:
                raise ValueError(f"{name} must be one of {tuple(known)}, got {value!r}")
        if forward_reset_interval is not None and forward_reset_interval < 1:
            raise ValueError(f"forward_reset_interval must be at least 1 or None, got {forward_reset_interval}")
        self.c, self.tau, self.l1_penalty = c, tau, l1_penalty
        self.expectation, self.distance_loss = expectation, distance_loss
        for name, count in (("n_pairs", n_pairs), ("n_action_samples", n_action_samples)):
            if not isinstance(count, int) or count < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {count}")
        self.pairs, self.n_pairs = pairs, n_pairs
        self.n_action_samples, self.action_radius = n_action_samples, action_radius
        self.forward_reset_interval = forward_reset_interval
        if warm_start:
            if encoder.spec() != base_encoder.spec():
                raise ValueError(
                    f"warm_start needs equal networks, got {encoder.spec()} and a base of {base_encoder.spec()}"
                )
            encoder.load_state_dict(base_encoder.state_dict())
        self.base_encoder = copy.deepcopy(base_encoder).requires_grad_(False)
        self.target_encoder = copy.deepcopy(encoder).requires_grad_(False)
        self.forward_model = ForwardModel(encoder.features_dim, self.action_dim) if expectation == "uniform" else None
        self.n_updates: th.Tensor
        self.register_buffer("n_updates", th.zeros((), dtype=th.int64))

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """Eq. 8 (and Eq. 6 for the forward model); gradients reach the encoder and the forward model alone.

        :param batch: transitions with k = 1
        :raises ValueError: with ``expectation="behavior"``, if no two of them took the same action
        """
        with th.no_grad():
            psi = self.base_encoder(batch.obs)
        i, j = self._sample_pairs(batch.actions, psi)
        phi = self.encoder(batch.obs)
        with th.no_grad():
            phi_next = self.target_encoder(batch.next_obs)
        terms: dict[str, th.Tensor] = {}
        if self.forward_model is None:
            next_distance = l1_distance(phi_next[i], phi_next[j])
        else:
            with th.no_grad():
                phi_target = self.target_encoder(batch.obs)
                next_distance = self._expected_w1(phi_target, i, j)
            terms["forward_nll"] = self.forward_model.nll(phi_target, self.action_inputs(batch.actions), phi_next)
        base_distance = l1_distance(psi[i], psi[j])
        target = action_bisim_target(base_distance, next_distance, self.c)
        # Unlike phi[i], the gradient of index_select adds up in a fixed order on several threads, too.
        distance = l1_distance(phi.index_select(0, i), phi.index_select(0, j))
        scale = relative_scale(base_distance) if self.pairs == "nearest" else th.ones_like(base_distance)
        metric_loss = LOSSES[self.distance_loss](scale * distance, scale * target)
        l1_norm = phi.abs().sum(dim=1).mean()
        terms |= {"metric_loss": metric_loss, "distance": distance.mean(), "target": target.mean(), "l1_norm": l1_norm}
        loss = metric_loss + self.l1_penalty * l1_norm + terms.get("forward_nll", 0.0)
        return loss, {name: term.detach() for name, term in terms.items()}

    def _sample_pairs(self, actions: th.Tensor, psi: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Indices of ``n_pairs`` pairs of different transitions (all, if there are fewer), each (n_pairs,)."""
        n = len(actions)
        if self.expectation == "behavior":
            allowed = self.actions.same(actions, self.action_radius)
        else:
            allowed = th.ones(n, n, dtype=th.bool, device=actions.device)
        # Distances are symmetric, and a state's distance to itself is zero on both sides and teaches nothing.
        pairs = allowed.triu(diagonal=1).nonzero()
        if len(pairs) == 0:
            raise ValueError(
                f"no two of the batch's {n} transitions took the same action; set a larger batch_size or action_radius"
            )
        n_nearest = int(NEAREST_SHARE * self.n_pairs) if self.pairs == "nearest" else 0
        chosen = th.randperm(len(pairs))[: self.n_pairs - n_nearest].to(actions.device)
        if n_nearest:
            # pdist goes through the pairs in the same order, in a tenth of the time of cdist on a CPU.
            above = th.triu_indices(n, n, offset=1, device=psi.device)
            base_distance = nn.functional.pdist(psi, p=1.0)[allowed[above[0], above[1]]]
            chosen = th.cat([base_distance.topk(min(n_nearest, len(pairs)), largest=False).indices, chosen])
        i, j = pairs[chosen].unbind(dim=1)
        return i, j

    def _expected_w1(self, phi: th.Tensor, i: th.Tensor, j: th.Tensor) -> th.Tensor:
        """E_a[W_1] between the predictions for pairs of a batch, (n_pairs,); both states take the same actions.

        As in the paper, W_1 is the L1 distance of the means.
        """
        assert self.forward_model is not None
        actions = self.actions.sample(self.n_action_samples, phi.device)
        total = th.zeros(len(i), device=phi.device)
        for action in actions:
            mean, _ = self.forward_model(phi, action.expand(len(phi), -1))
            total += l1_distance(mean[i], mean[j])
        return total / len(actions)

    @th.no_grad()
    def after_step(self) -> None:
        """Move the target encoder, ``phi <- tau phi_eta + (1 - tau) phi``, and reset the forward model when due."""
        polyak_update(self.encoder.parameters(), self.target_encoder.parameters(), self.tau)
        self.n_updates += 1
        interval = self.forward_reset_interval
        if self.forward_model is not None and interval is not None and int(self.n_updates) % interval == 0:
            self.forward_model.reset()


register_method(
    "abisim",
    ActionBisimulation,
    label="action-bisimulation",
    extractor="ActionBisimExtractor",
    base="ssi",
    color="#0072B2",
    curve="metric_loss",
    results=("metric_loss", "distance"),
)
