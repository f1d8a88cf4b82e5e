"""Augmented observations, where RL learns from them.

Laskin et al. (2020, RAD), Yarats et al. (2021, DrQ). Which copies of the encoder see them in which algorithm follows
from one rule, below; docs/while_rl_runs.md spells it out.
"""

import functools
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.registry import get_augmentation


class Augment(nn.Module):
    """Augments observations in training mode while gradients are recorded, and passes them on otherwise.

    Agents act and are evaluated in evaluation mode. Targets of value functions are computed without gradients. So both
    see the plain observation, and so does an exported program. Random numbers come from torch's global generator, which
    ``seed=`` of Stable-Baselines3 sets: whoever restores its state goes on exactly.

    :param observation_space: images, channels first
    :param name: of a registered augmentation, or ``pkg.module:Function``
    :param kwargs: its keyword arguments
    :raises ValueError: for an unknown name, or one that does not take these observations and arguments
    """

    def __init__(self, observation_space: gym.Space[Any], name: str, kwargs: Mapping[str, Any] | None = None) -> None:
        super().__init__()
        self.name, self.kwargs = name, dict(kwargs or {})
        self._augment_fn = functools.partial(get_augmentation(name), **self.kwargs)
        example = th.zeros(2, *(observation_space.shape or ()))
        try:
            with th.no_grad(), th.random.fork_rng(devices=[]):
                shape = tuple(self._augment_fn(example).shape)
        except (TypeError, RuntimeError, AttributeError) as error:
            raise ValueError(
                f"the augmentation {name!r} does not take observations {observation_space.shape} with augment_kwargs="
                f"{self.kwargs}: {error}"
            ) from error
        if shape != tuple(example.shape):
            raise ValueError(
                f"the augmentation {name!r} must keep the shape {tuple(example.shape)}, but gives {shape}; enlarge "
                "what it cuts out"
            )

    def extra_repr(self) -> str:
        """Its name and arguments, for ``repr``."""
        return self.name + "".join(f", {key}={value}" for key, value in self.kwargs.items())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Augment each observation of a batch by numbers of its own, the same for all frames of a stack.

        :param observations: float (batch, channels, height, width) in 0..1
        :return: the same shape
        """
        if th.compiler.is_exporting() or not (self.training and th.is_grad_enabled()):
            return observations
        augmented: th.Tensor = self._augment_fn(observations)
        return augmented
