"""The same as torch's, with gradients of single parameters."""

import numpy as np
import torch as th
from gymnasium.spaces import Box
from torch import nn

from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.group_norm import GroupNorm


def test_output_and_gradients_are_those_of_torch() -> None:
    th.manual_seed(0)
    norm, torchs = GroupNorm(2, 6, eps=1e-3), nn.GroupNorm(2, 6, eps=1e-3)
    nn.init.normal_(norm.weight)
    nn.init.normal_(norm.bias)
    torchs.load_state_dict(norm.state_dict())
    images, direction = th.rand(5, 6, 4, 3), th.rand(5, 6, 4, 3)
    ours, theirs = norm(images), torchs(images)
    th.testing.assert_close(ours, theirs)
    for name, parameter in norm.named_parameters():
        (expected,) = th.autograd.grad((theirs * direction).sum(), torchs.get_parameter(name), retain_graph=True)
        (found,) = th.autograd.grad((ours * direction).sum(), parameter, retain_graph=True)
        th.testing.assert_close(found, expected)


def test_the_gradient_of_one_parameter_alone() -> None:
    """As TRPO takes it; with torch's own module this ends the process."""
    for name, shape in (("small", (3, 7, 7)), ("resnet18", (3, 36, 36))):
        encoder = make_encoder(Box(0, 255, shape, np.uint8), name)
        norms = [module for module in encoder.modules() if isinstance(module, nn.GroupNorm)]
        assert norms and all(type(module) is GroupNorm for module in norms)
        loss = encoder(th.rand(4, *shape)).pow(2).sum()
        for parameter in encoder.parameters():
            assert th.autograd.grad(loss, parameter, retain_graph=True)[0].shape == parameter.shape
