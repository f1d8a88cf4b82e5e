"""Group normalization that TRPO can differentiate."""

import torch as th
from torch import nn


class GroupNorm(nn.GroupNorm):
    """As in torch, with scale and shift as operations of their own.

    PyTorch 2.13 crashes on a CPU (SIGSEGV) where the weight's gradient is asked for without the input's, and images
    have their channels last in memory. TRPO asks for the gradient of one parameter at a time.
    """

    def forward(self, input: th.Tensor) -> th.Tensor:
        """Normalize images.

        :param input: float (batch, channels, height, width)
        :return: of the same shape
        """
        normalized = nn.functional.group_norm(input, self.num_groups, eps=self.eps)
        return normalized * self.weight[:, None, None] + self.bias[:, None, None]
