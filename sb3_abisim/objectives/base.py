"""The contract between an objective and the training loop."""

from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.networks.base import Encoder


@dataclass(frozen=True)
class TensorBatch:
    """Transitions (s_t, a_t, s_{t+k}) on a device, observations already through SB3's ``preprocess_obs``.

    :param frames: float (m, channels, height, width) in 0..1; those that several transitions share stand once
    :param actions: a_t, int64 (batch,) for ``Discrete``, float32 (batch, action_dim) for ``Box``; with a second
        dimension k where an objective reads a_t to a_{t+k-1}
    :param now: where s_t stands among the frames, int64 (batch,) or a slice
    :param later: where s_{t+k} stands among them
    """

    frames: th.Tensor
    actions: th.Tensor
    now: th.Tensor | slice
    later: th.Tensor | slice

    @classmethod
    def of(cls, observations: th.Tensor, actions: th.Tensor, next_observations: th.Tensor) -> "TensorBatch":
        """A batch of transitions that share no frame.

        :param observations: s_t, float (batch, channels, height, width) in 0..1
        :param actions: see the class
        :param next_observations: s_{t+k}, as ``observations``
        """
        n = len(observations)
        return cls(th.cat([observations, next_observations]), actions, slice(None, n), slice(n, None))

    @property
    def observations(self) -> th.Tensor:
        """s_t, float (batch, channels, height, width) in 0..1."""
        return _rows(self.frames, self.now)

    @property
    def next_observations(self) -> th.Tensor:
        """s_{t+k}, as ``observations``."""
        return _rows(self.frames, self.later)

    def at_both_ends(self, embeddings: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Embeddings of s_t and of s_{t+k}.

        :param embeddings: of the frames, (m, features_dim)
        :return: two tensors (batch, features_dim)
        """
        return _rows(embeddings, self.now), _rows(embeddings, self.later)


def _rows(tensor: th.Tensor, where: th.Tensor | slice) -> th.Tensor:
    # Unlike tensor[where], the gradient of index_select adds up in a fixed order on several threads, too.
    return tensor[where] if isinstance(where, slice) else tensor.index_select(0, where)


class Objective(nn.Module):
    """A loss and everything it trains: the encoder and its heads.

    No optimiser, logging or file is known here. Whatever must survive an interruption is a parameter or a buffer.

    :param encoder: the network to pretrain
    :param action_space: ``Discrete`` (starting at 0) or one-dimensional ``Box``
    :raises ValueError: for another action space
    """

    name: ClassVar[str]
    # Whether batches must hold all k actions between the two observations; the constructor then takes k.
    reads_action_sequences: ClassVar[bool] = False

    def __init__(self, encoder: Encoder, action_space: gym.Space[Any]) -> None:
        super().__init__()
        discrete = isinstance(action_space, gym.spaces.Discrete) and action_space.start == 0
        box = isinstance(action_space, gym.spaces.Box) and len(action_space.shape) == 1
        if not (discrete or box):
            raise ValueError(f"actions must be Discrete starting at 0 or a one-dimensional Box, got {action_space}")
        self.encoder = encoder
        self.action_space = action_space

    @classmethod
    def check_k(cls, k: int | list[int]) -> None:
        """Refuse transitions over a number of steps that this objective is not made for.

        :param k: steps between the two observations, or the fewest and the most of them
        :raises ValueError: naming the remedy
        """
        if k != 1:
            raise ValueError(f"{cls.name} takes single steps, got k = {k}; set k to 1, or use acro or info_nce")

    @property
    def n_actions(self) -> int | None:
        """Number of discrete actions, None for continuous ones."""
        return int(self.action_space.n) if isinstance(self.action_space, gym.spaces.Discrete) else None

    @property
    def action_dim(self) -> int:
        """Size of an action as a network input: one-hot for discrete actions."""
        return self.n_actions or int(self.action_space.shape[0])  # type: ignore[index]

    def action_inputs(self, actions: th.Tensor) -> th.Tensor:
        """Actions as network inputs.

        :param actions: as in :class:`TensorBatch`
        :return: float32 (batch, action_dim), or (batch, k, action_dim)
        """
        if self.n_actions is None:
            return actions
        return nn.functional.one_hot(actions, self.n_actions).float()

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """The scalar to minimise, and its named terms (detached) for the log.

        :param batch: transitions
        """
        raise NotImplementedError

    def chance_accuracy(self, batch_size: int) -> float | None:
        """What the term ``accuracy`` is without having learned anything; None for a loss that has no such term.

        :param batch_size: of the batches
        """
        return None

    def after_step(self) -> None:
        """Called after each optimiser step, for target networks and schedules."""
