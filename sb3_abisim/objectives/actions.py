"""What objectives ask of an action space, a class for each kind; actions are tensors as datasets give them.

====================  =======================================  ================================================
space                 as a network's input                     inverse model
====================  =======================================  ================================================
``Discrete``          one-hot                                  softmax
``MultiDiscrete``     a one-hot per component                  a softmax per component
``MultiBinary``       its bits                                 a Bernoulli per bit
``Box``               flattened, from -1 at the lower bound    a Gaussian per number, in the same scale
                      to 1 at the upper one
====================  =======================================  ================================================

Components are predicted independently of each other: their log-likelihoods add up. A prediction is right if all its
components are. Whatever unit a ``Box`` has, its numbers lie in -1..1 here, so that nothing else depends on it.
"""

import math
from abc import ABC, abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_abisim.common.spaces import check_action_space

# A layer of 256 inputs then has 25 million weights.
MAX_OUTPUTS = 100_000
_LOG_STD_RANGE = (-5.0, 2.0)


class Actions(ABC):
    """The actions of a space."""

    # Number of different actions, math.inf for a Box.
    count: float
    # Numbers of an action as a network's input, and numbers that the inverse model gives for it.
    input_dim: int
    n_outputs: int
    # Accuracy of guessing.
    chance: float

    @abstractmethod
    def inputs(self, actions: th.Tensor) -> th.Tensor:
        """Actions as network inputs.

        :param actions: as in :class:`~sb3_abisim.common.transitions.TransitionBatch`, (..., *shape of an action)
        :return: float32 (..., input_dim)
        """

    @abstractmethod
    def score(self, outputs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """How well an inverse model's outputs predict the actions taken.

        :param outputs: (batch, n_outputs)
        :param actions: (batch, *shape of an action)
        :return: log-likelihood of each action (batch,), and the share of predictions with all components right; for a
            ``Box`` the coefficient of determination, clipped to 0..1
        """

    @abstractmethod
    def sample(self, n: int, device: th.device) -> th.Tensor:
        """Actions that stand for uniformly random ones, as network inputs: all of them if there are at most ``n``.

        :param n: how many, at least 1
        :param device: of the result; random numbers are sampled on the CPU, so that they do not depend on it
        :return: float32 (number of actions, input_dim)
        """

    @abstractmethod
    def components(self, actions: th.Tensor) -> th.Tensor:
        """What actions consist of, each of which may be read by itself.

        :param actions: (batch, *shape of an action)
        :return: (batch, number of components): int64, the number of a choice from 0; float32 in -1..1 for a ``Box``
        """

    def enumerate(self, device: th.device) -> th.Tensor | None:
        """All actions as network inputs, in the order of :meth:`index`; None for a space that is not ``Discrete``.

        :param device: of the result
        """
        return None

    def index(self, actions: th.Tensor) -> th.Tensor:
        """Where actions stand in :meth:`enumerate`.

        :param actions: (batch, *shape of an action)
        :return: int64 (batch,)
        """
        raise NotImplementedError

    def same(self, actions: th.Tensor, radius: float) -> th.Tensor:
        """Which pairs of actions are the same: all their components are equal.

        :param actions: (batch, *shape of an action)
        :param radius: for a ``Box``, the largest L2 distance in -1..1 that counts as the same
        :return: bool (batch, batch)
        """
        numbers: th.Tensor = th.unique(actions, dim=0, return_inverse=True)[1]
        return numbers[:, None] == numbers[None]

    @abstractmethod
    def greatest(self, coefficients: th.Tensor) -> th.Tensor:
        """The greatest value that a linear function of the inputs takes over all actions.

        :param coefficients: (..., input_dim)
        :return: (...)
        """


class DiscreteActions(Actions):
    """One of n, counted from the space's start.

    :param space: of one environment
    """

    def __init__(self, space: spaces.Discrete) -> None:
        self.n, self.start = int(space.n), int(space.start)
        self.count = self.input_dim = self.n_outputs = self.n
        self.chance = 1.0 / self.n

    def inputs(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.inputs`."""
        return nn.functional.one_hot(self.index(actions), self.n).float()

    def score(self, outputs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """See :meth:`Actions.score`."""
        index = self.index(actions)
        log_prob = -nn.functional.cross_entropy(outputs, index, reduction="none")
        return log_prob, (outputs.argmax(dim=1) == index).float().mean()

    def sample(self, n: int, device: th.device) -> th.Tensor:
        """All of them, whatever ``n`` is (the paper's expectation)."""
        return th.eye(self.n, device=device)

    def components(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.components`."""
        return self.index(actions)[:, None]

    def enumerate(self, device: th.device) -> th.Tensor:
        """See :meth:`Actions.enumerate`."""
        return th.eye(self.n, device=device)

    def index(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.index`."""
        return actions - self.start

    def greatest(self, coefficients: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.greatest`."""
        return coefficients.amax(dim=-1)


class MultiDiscreteActions(Actions):
    """Several choices at once.

    :param space: of one environment
    """

    def __init__(self, space: spaces.MultiDiscrete) -> None:
        self.sizes, self.start = space.nvec.flatten().tolist(), th.as_tensor(space.start.flatten())
        self.shape = space.shape
        self.count, self.chance = math.prod(self.sizes), 1.0 / math.prod(self.sizes)
        self.input_dim = self.n_outputs = sum(self.sizes)

    def inputs(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.inputs`."""
        return self._one_hot(self.components(actions))

    def score(self, outputs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """See :meth:`Actions.score`."""
        components = self.components(actions)
        log_prob, right = th.zeros(len(outputs), device=outputs.device), th.ones_like(components[:, 0]).bool()
        for logits, component in zip(th.split(outputs, self.sizes, dim=1), components.unbind(dim=1), strict=True):
            log_prob = log_prob - nn.functional.cross_entropy(logits, component, reduction="none")
            right &= logits.argmax(dim=1) == component
        return log_prob, right.float().mean()

    def sample(self, n: int, device: th.device) -> th.Tensor:
        """See :meth:`Actions.sample`."""
        if self.count <= n:
            components = th.cartesian_prod(*(th.arange(size) for size in self.sizes)).reshape(-1, len(self.sizes))
        else:
            components = th.stack([th.randint(size, (n,)) for size in self.sizes], dim=1)
        return self._one_hot(components).to(device)

    def components(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.components`."""
        flat = actions.flatten(start_dim=actions.dim() - len(self.shape)).long()
        return flat - self.start.to(flat)

    def _one_hot(self, components: th.Tensor) -> th.Tensor:
        parts = components.unbind(dim=-1)
        return th.cat([nn.functional.one_hot(c, n) for c, n in zip(parts, self.sizes, strict=True)], dim=-1).float()

    def greatest(self, coefficients: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.greatest`."""
        parts = th.split(coefficients, self.sizes, dim=-1)
        return th.stack([part.amax(dim=-1) for part in parts]).sum(dim=0)


class MultiBinaryActions(Actions):
    """Several bits at once.

    :param space: of one environment
    """

    def __init__(self, space: spaces.MultiBinary) -> None:
        self.shape: tuple[int, ...] = space.shape
        self.input_dim = self.n_outputs = math.prod(self.shape)
        self.count, self.chance = 2**self.input_dim, 0.5**self.input_dim

    def inputs(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.inputs`."""
        return actions.flatten(start_dim=actions.dim() - len(self.shape)).float()

    def score(self, outputs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """See :meth:`Actions.score`."""
        bits = self.inputs(actions)
        log_prob = -nn.functional.binary_cross_entropy_with_logits(outputs, bits, reduction="none").sum(dim=1)
        return log_prob, ((outputs > 0) == (bits > 0)).all(dim=1).float().mean()

    def sample(self, n: int, device: th.device) -> th.Tensor:
        """See :meth:`Actions.sample`."""
        if self.count <= n:
            numbers = th.arange(int(self.count))[:, None]
            return (numbers >> th.arange(self.input_dim) & 1).float().to(device)
        return th.randint(2, (n, self.input_dim)).float().to(device)

    def components(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.components`."""
        return self.inputs(actions).long()

    def greatest(self, coefficients: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.greatest`."""
        return coefficients.clamp_min(0.0).sum(dim=-1)


class BoxActions(Actions):
    """Real numbers, from -1 at their lower bound to 1 at the upper one.

    :param space: of one environment, bounded
    """

    count, chance = math.inf, 0.0

    def __init__(self, space: spaces.Box) -> None:
        self.shape = space.shape
        self.input_dim = math.prod(self.shape)
        self.n_outputs = 2 * self.input_dim
        low, high = (bound.astype(np.float64).flatten() for bound in (space.low, space.high))
        half = (high - low) / 2
        # Where the bounds are equal, there is nothing to scale.
        self._center, self._half = th.as_tensor(low + half), th.as_tensor(np.where(half > 0, half, 1.0))

    def inputs(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.inputs`."""
        flat = actions.flatten(start_dim=actions.dim() - len(self.shape)) if self.shape else actions[..., None]
        return ((flat - self._center.to(flat)) / self._half.to(flat)).float()

    def score(self, outputs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """See :meth:`Actions.score`."""
        actions = self.inputs(actions)
        mean, log_std = outputs.chunk(2, dim=1)
        log_std = log_std.clamp(*_LOG_STD_RANGE)
        log_prob = th.distributions.Normal(mean, log_std.exp()).log_prob(actions).sum(dim=1)  # type: ignore[no-untyped-call]
        unexplained = (mean - actions).pow(2).sum() / (actions - actions.mean(dim=0)).pow(2).sum()
        return log_prob, (1.0 - unexplained).clamp_min(0.0).detach()

    def sample(self, n: int, device: th.device) -> th.Tensor:
        """See :meth:`Actions.sample`."""
        return -1.0 + 2.0 * th.rand(n, self.input_dim).to(device)

    def components(self, actions: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.components`."""
        return self.inputs(actions)

    def same(self, actions: th.Tensor, radius: float) -> th.Tensor:
        """See :meth:`Actions.same`."""
        inputs = self.inputs(actions)
        return th.cdist(inputs, inputs) <= radius

    def greatest(self, coefficients: th.Tensor) -> th.Tensor:
        """See :meth:`Actions.greatest`."""
        # Inputs lie in -1..1: a corner is best.
        return coefficients.abs().sum(dim=-1)


_KINDS: dict[type, Any] = {
    spaces.Discrete: DiscreteActions,
    spaces.MultiDiscrete: MultiDiscreteActions,
    spaces.MultiBinary: MultiBinaryActions,
    spaces.Box: BoxActions,
}


def actions_of(space: gym.Space[Any]) -> Actions:
    """The actions of a space.

    :param space: of one environment
    :raises ValueError: for a space that cannot be sampled or predicted
    """
    check_action_space(space)
    actions: Actions = next(_KINDS[kind] for kind in type(space).__mro__ if kind in _KINDS)(space)
    if actions.n_outputs > MAX_OUTPUTS:
        raise ValueError(
            f"{space} takes {actions.n_outputs} outputs to predict, more than {MAX_OUTPUTS}; group actions that do the "
            "same"
        )
    return actions
