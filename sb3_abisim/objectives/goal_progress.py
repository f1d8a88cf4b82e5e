"""Goal progress: values of random goals, and each action's progress towards them, on a trained base encoder.

Reward-free, from the same random play as the other objectives. Goals are states of the data. A state is in a goal when
its base embedding is among the nearest to that of the goal's state. The encoder is trained so that two linear heads on
its embedding tell, for every goal g:

====================  ==============================  ======================================================
symbol                here                            meaning
====================  ==============================  ======================================================
psi                   ``base_encoder``                trained before, by any method, and frozen
phi                   ``encoder``                     the result
Q(s, a, g)            ``value_head``                  universal value function, gamma to the power of the steps to g
V(s, g)               :meth:`GoalProgress.values`     1 in the goal, else max over a of Q(s, a, g)
P(s, a, g)            ``progress_head``               steps by which the action brings the goal nearer
gamma, tau            ``gamma``, ``tau``              discount, rate of the moving average that makes the targets
====================  ==============================  ======================================================

Values are learned by greedy temporal differences from single transitions (universal value functions, Schaul et al.
2015), so -log V / log(1/gamma) is the distance in steps. A value is nearly all position, and what an action changes of
it is small. Progress is that change: the difference of the distances, by the target network, at the two observations
that were seen. A blocked move shows the same observation twice, so its progress is exactly 0. A step counts the same
near a goal and far from it.

Both heads are linear in the action's inputs, too (:mod:`sb3_abisim.objectives.actions`), so that the greedy action is
known at once: with continuous actions it is a corner of the box.
"""

import copy
import math
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_abisim.networks.base import Encoder
from sb3_abisim.objectives.actions import Actions
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.registry import register_method

# A goal that is farther away counts as that many steps: the logarithm of a smaller value would be noise.
HORIZON = 50


def value_targets(next_values: th.Tensor, gamma: float) -> th.Tensor:
    """``gamma V(s', g)``, the target of Q(s, a, g).

    :param next_values: V(s', g) of the target network, 1 in the goal, (batch, n_goals)
    :param gamma: discount, in (0, 1)
    """
    return gamma * next_values


def progress_targets(values: th.Tensor, next_values: th.Tensor, gamma: float) -> th.Tensor:
    """``(log V(s', g) - log V(s, g)) / log(1 / gamma)``, steps towards each goal, clipped to -1..1.

    :param values: V(s, g) of the target network, (batch, n_goals), in 0..1
    :param next_values: V(s', g), likewise
    :param gamma: discount, in (0, 1)
    """
    least = gamma**HORIZON
    steps = (next_values.clamp_min(least).log() - values.clamp_min(least).log()) / -math.log(gamma)
    return steps.clamp(-1.0, 1.0)


def goal_progress_loss(
    q: th.Tensor,
    q_target: th.Tensor,
    progress: th.Tensor,
    progress_target: th.Tensor,
    value_weight: float,
    progress_weight: float,
) -> tuple[th.Tensor, dict[str, th.Tensor]]:
    """``value_weight (Q - y)^2 + progress_weight (P - progress)^2``, mean over batch and goals.

    :param q: Q(s, a, g) of the action taken, (batch, n_goals)
    :param q_target: its target, without gradient
    :param progress: P(s, a, g) of the action taken, (batch, n_goals)
    :param progress_target: its target, without gradient
    :param value_weight: at least 0
    :param progress_weight: at least 0
    """
    value_loss = nn.functional.mse_loss(q, q_target)
    progress_loss = nn.functional.mse_loss(progress, progress_target)
    loss = value_weight * value_loss + progress_weight * progress_loss
    return loss, {"value_loss": value_loss, "progress_loss": progress_loss}


class GoalHead(nn.Module):
    """A linear layer from the embedding to a number for each goal and action, linear in the action's inputs, too.

    :param features_dim: size of the embedding
    :param n_goals: number of goals
    :param actions: of the environment
    """

    def __init__(self, features_dim: int, n_goals: int, actions: Actions) -> None:
        super().__init__()
        self.n_goals, self.actions = n_goals, actions
        self.linear = nn.Linear(features_dim, n_goals * (1 + actions.input_dim))

    def forward(self, phi: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """What the number is without the action, and the coefficients of the action's inputs.

        :param phi: (batch, features_dim)
        :return: (batch, n_goals) and (batch, n_goals, input_dim)
        """
        outputs: th.Tensor = self.linear(phi).view(len(phi), self.n_goals, -1)
        return outputs[..., 0], outputs[..., 1:]

    def of_action(self, phi: th.Tensor, inputs: th.Tensor) -> th.Tensor:
        """The numbers of the action taken.

        :param phi: (batch, features_dim)
        :param inputs: of the action, (batch, input_dim)
        :return: (batch, n_goals)
        """
        constant, coefficients = self(phi)
        numbers: th.Tensor = constant + (coefficients * inputs[:, None]).sum(dim=2)
        return numbers

    def greedy(self, phi: th.Tensor) -> th.Tensor:
        """The numbers of the best action.

        :param phi: (batch, features_dim)
        :return: (batch, n_goals)
        """
        constant, coefficients = self(phi)
        numbers: th.Tensor = constant + self.actions.greatest(coefficients)
        return numbers


class GoalProgress(Objective):
    """Embed the values of random goals, and what each action does to them.

    :param encoder: the network to pretrain; both heads are linear on its embedding, which should be wide
    :param action_space: of the environment
    :param base_encoder: any trained encoder; frozen here, it says which states are in a goal
    :param n_goals: states of the data that are goals
    :param goal_share: share of all states that are in a goal
    :param gamma: discount, in (0, 1)
    :param tau: rate of the target network, per update
    :param value_weight: weight of the squared TD error
    :param progress_weight: weight of the squared error of the progress; 0 leaves the values alone
    :param warm_start: begin from the base encoder's weights in all layers that both networks have
    """

    name = "goal_progress"

    def __init__(
        self,
        encoder: Encoder,
        action_space: gym.Space[Any],
        base_encoder: Encoder,
        n_goals: int = 128,
        goal_share: float = 0.02,
        gamma: float = 0.9,
        tau: float = 0.02,
        value_weight: float = 10.0,
        progress_weight: float = 1.0,
        warm_start: bool = True,
    ) -> None:
        super().__init__(encoder, action_space)
        if not isinstance(n_goals, int) or n_goals < 1:
            raise ValueError(f"n_goals must be a whole number of at least 1, got {n_goals}")
        for name, value in (("goal_share", goal_share), ("gamma", gamma)):
            if not 0 < value < 1:
                raise ValueError(f"{name} must lie between 0 and 1, got {value}")
        if not 0 < tau <= 1:
            raise ValueError(f"tau must lie in (0, 1], got {tau}")
        for name, value in (("value_weight", value_weight), ("progress_weight", progress_weight)):
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be a number of at least 0, got {value}")
        self.n_goals, self.goal_share, self.gamma, self.tau = n_goals, goal_share, gamma, tau
        self.value_weight, self.progress_weight = value_weight, progress_weight
        if warm_start and not encoder.warm_start(base_encoder):
            raise ValueError(
                f"warm_start: {encoder.spec()} has no layer of its base {base_encoder.spec()}; give another network or "
                "warm_start: false"
            )
        self.base_encoder = copy.deepcopy(base_encoder).requires_grad_(False)
        self.value_head = GoalHead(encoder.features_dim, n_goals, self.actions)
        self.progress_head = GoalHead(encoder.features_dim, n_goals, self.actions)
        self.target_encoder = copy.deepcopy(encoder).requires_grad_(False)
        self.target_head = copy.deepcopy(self.value_head).requires_grad_(False)
        # Of the goals' states; nan until `prepare` has chosen them.
        self.goals: th.Tensor
        self.radii: th.Tensor
        self.register_buffer("goals", th.full((n_goals, base_encoder.features_dim), math.nan))
        self.register_buffer("radii", th.full((n_goals,), math.nan))

    @th.no_grad()
    def prepare(self, observations: th.Tensor) -> None:
        """Choose the goals among states of the data, and how near to them a state has to be.

        :param observations: from all over the data, float (n, channels, height, width) in 0..1
        :raises ValueError: if there are fewer than ``n_goals``
        """
        psi = th.cat([self.base_encoder(part) for part in th.split(observations, 256)])
        if len(psi) <= self.n_goals:
            raise ValueError(f"n_goals={self.n_goals}, but there are {len(psi)} states to choose from; lower it")
        self.goals.copy_(psi[th.randperm(len(psi))[: self.n_goals].to(psi.device)])
        # Beside the goal's state itself.
        rank = 1 + max(1, round(self.goal_share * len(psi)))
        self.radii.copy_(th.cdist(self.goals, psi, p=1.0).kthvalue(rank, dim=1).values)

    def in_goals(self, psi: th.Tensor) -> th.Tensor:
        """Whether states are in each goal.

        :param psi: their base embeddings, (batch, base features_dim)
        :return: bool (batch, n_goals)
        """
        return th.cdist(psi, self.goals, p=1.0) <= self.radii

    @th.no_grad()
    def values(self, batch: TensorBatch) -> tuple[th.Tensor, th.Tensor]:
        """V(s, g) and V(s', g) of the target network, 1 for a state that is in the goal.

        :param batch: transitions
        :return: two tensors (batch, n_goals), in 0..1
        """
        values = self.target_head.greedy(self.target_encoder(batch.frames)).clamp(0.0, 1.0)
        in_goals = self.in_goals(self.base_encoder(batch.frames))
        return batch.split_pair(th.where(in_goals, th.ones_like(values), values))

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """Both squared errors; terms ``value_loss``, ``progress_loss``, ``value`` (mean of V) and ``progress_r2``.

        :param batch: transitions with k = 1
        """
        values, next_values = self.values(batch)
        q_target = value_targets(next_values, self.gamma)
        progress_target = progress_targets(values, next_values, self.gamma)
        inputs = self.action_inputs(batch.actions)
        phi = self.encoder(batch.obs)
        q, progress = self.value_head.of_action(phi, inputs), self.progress_head.of_action(phi, inputs)
        loss, named = goal_progress_loss(
            q, q_target, progress, progress_target, self.value_weight, self.progress_weight
        )
        named["value"] = values.mean()
        named["progress_r2"] = 1.0 - named["progress_loss"] / progress_target.var(correction=0).clamp_min(1e-9)
        return loss, {name: term.detach() for name, term in named.items()}

    @th.no_grad()
    def after_step(self) -> None:
        """Move the target network, ``target <- tau online + (1 - tau) target``."""
        polyak_update(self.encoder.parameters(), self.target_encoder.parameters(), self.tau)
        polyak_update(self.value_head.parameters(), self.target_head.parameters(), self.tau)

    @classmethod
    def base_network_kwargs(cls, network_kwargs: dict[str, Any]) -> dict[str, Any]:
        """The base is the plain network: what is put on top belongs to this encoder.

        :param network_kwargs: of this encoder's network
        """
        return {name: value for name, value in network_kwargs.items() if name not in ("features", "hidden_dim")}


register_method(
    "goal_progress",
    GoalProgress,
    label="goal progress",
    extractor="GoalProgressExtractor",
    base="ssi",
    color="#8C6D31",
    curve="progress_r2",
    results=("progress_r2", "value_loss"),
)
