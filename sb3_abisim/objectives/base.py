"""What an objective is to the training loop: a loss and everything that it trains."""

from typing import Any, ClassVar

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.common.transitions import TransitionBatch
from sb3_abisim.networks.base import Encoder
from sb3_abisim.objectives.actions import actions_of

# Observations already through SB3's ``preprocess_obs``, on the objective's device.
TensorBatch = TransitionBatch[th.Tensor]


class Objective(nn.Module):
    """A loss and everything it trains: the encoder and its heads.

    It knows of no optimizer, log or file. Whatever must survive an interruption is a parameter or a buffer.

    :param encoder: the network to pretrain
    :param action_space: ``Discrete``, ``MultiDiscrete``, ``MultiBinary`` or a bounded ``Box`` of floats
    :raises ValueError: for another action space
    """

    name: ClassVar[str]
    # Whether batches must hold all k actions between the two observations. The constructor then takes k.
    reads_action_sequences: ClassVar[bool] = False

    def __init__(self, encoder: Encoder, action_space: gym.Space[Any]) -> None:
        super().__init__()
        self.actions = actions_of(action_space)
        self.encoder = encoder

    @classmethod
    def check_k(cls, k: int | list[int]) -> None:
        """Refuse transitions over a number of steps that this objective is not made for.

        :param k: steps between the two observations, or the fewest and the most of them
        :raises ValueError: naming the remedy
        """
        if k != 1:
            raise ValueError(f"{cls.name} takes single steps, got k = {k}; set k to 1, or use acro or info_nce")

    @property
    def action_dim(self) -> int:
        """Size of an action as a network input, see :mod:`sb3_abisim.objectives.actions`."""
        return self.actions.input_dim

    def action_inputs(self, actions: th.Tensor) -> th.Tensor:
        """Actions as network inputs.

        :param actions: as in :class:`~sb3_abisim.common.transitions.TransitionBatch`
        :return: float32 (batch, action_dim), or (batch, k, action_dim)
        """
        return self.actions.inputs(actions)

    @classmethod
    def base_network_kwargs(cls, network_kwargs: dict[str, Any]) -> dict[str, Any]:
        """Arguments of the base encoder's network, where the base is pretrained first for this objective.

        :param network_kwargs: of this objective's encoder
        """
        return network_kwargs

    def prepare(self, observations: th.Tensor) -> None:
        """Called once, before the first update. What it decides is kept in buffers.

        While RL runs, it is called again now and then where a base changes, with the same observations and the same
        random numbers of torch, so that it decides the same.

        :param observations: from all over the data to train on, float (n, channels, height, width) in 0..1
        """

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """The scalar to minimize, and its named terms (detached) for the log.

        :param batch: transitions
        """
        raise NotImplementedError

    def chance_accuracy(self, batch_size: int) -> float | None:
        """What the term ``accuracy`` is without having learned anything; None for a loss that has no such term.

        :param batch_size: of the batches
        """
        return None

    def remedies(self) -> list[str]:
        """Settings to try where nothing was learned, such as "objective_kwargs.l1_penalty:0", unless they hold."""
        return []

    def after_step(self) -> None:
        """Called after each optimizer step, for target networks and schedules."""
