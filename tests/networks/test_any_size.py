"""The networks for any number of channels and any size, alone and under every objective."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn

from sb3_abisim.networks.base import default_network, make_encoder
from sb3_abisim.objectives.base import TensorBatch
from sb3_abisim.registry import get_method, methods, networks

MIN_SIZES = {"nature": 36, "impala": 8, "resnet18": 16, "small": 3, "glimpse": 16}
OBJECTIVES = [name for name, method in methods().items() if method.objective is not None]


def image_space(*shape: int) -> gym.spaces.Box:
    return gym.spaces.Box(0, 255, shape, np.uint8)


@pytest.mark.parametrize("n_channels", [1, 3, 4, 12])
@pytest.mark.parametrize("name", MIN_SIZES)
def test_any_channels_and_sizes(name: str, n_channels: int) -> None:
    least = MIN_SIZES[name]
    for size in ((least, least), (least, least + 9), (least + 2, least), (43, 51)):
        shape = (n_channels, *size)
        encoder = make_encoder(image_space(*shape), name)
        output = encoder(th.rand(2, *shape))
        assert output.shape == (2, encoder.features_dim) and encoder.spec() == {"name": name, "kwargs": {}}
        assert float((output[0] - output[1]).detach().abs().max()) > 0


@pytest.mark.parametrize(("name", "least"), MIN_SIZES.items())
def test_the_least_size_is_said(name: str, least: int) -> None:
    for size in ((least - 1, 99), (99, least - 1)):
        message = f"{name} takes images of at least {least} x {least} pixels, got {size[0]} x {size[1]}; "
        message += "enlarge" if name == "small" else "name another network, such as small"
        with pytest.raises(ValueError, match=message):
            make_encoder(image_space(3, *size), name)


@pytest.mark.parametrize(("name", "n"), [("nature", 512), ("impala", 256), ("small", 256)])
def test_other_sizes_of_the_embedding(name: str, n: int) -> None:
    space = image_space(3, 40, 40)
    assert (make_encoder(space, name).features_dim, make_encoder(space, name, features_dim=7).features_dim) == (n, 7)


def test_nature_has_the_layers_of_sb3() -> None:
    space = image_space(4, 84, 97)
    theirs, ours = NatureCNN(space), make_encoder(space, "nature")
    weights = zip(theirs.state_dict().values(), ours.layers.state_dict(), strict=True)
    ours.layers.load_state_dict({name: value for value, name in weights})
    x = th.rand(3, 4, 84, 97)
    assert th.allclose(theirs(x), ours(x), atol=1e-6) and ours.features_dim == theirs.features_dim


def test_impala_has_fifteen_convolutions() -> None:
    """Those of the paper's large network, without its memory; sides are halved and rounded up, as there."""
    encoder = make_encoder(image_space(3, 72, 90), "impala")
    convs = [module for module in encoder.modules() if isinstance(module, nn.Conv2d)]
    assert [conv.out_channels for conv in convs] == [16] * 5 + [32] * 10
    (linear,) = (module for module in encoder.modules() if isinstance(module, nn.Linear))
    assert linear.in_features == 32 * 9 * math.ceil(90 / 8)
    # With the second convolutions at zero a block gives back its input.
    (block, _) = encoder.layers[2:4]
    nn.init.zeros_(block.convs[3].weight)
    nn.init.zeros_(block.convs[3].bias)
    x = th.randn(2, 16, 5, 5)
    assert th.equal(block(x), x) and bool((x < 0).any())


def test_resnet18_is_habitats_backbone_without_the_averaging() -> None:
    ours = make_encoder(image_space(4, 64, 64), "resnet18")
    theirs = make_encoder(image_space(4, 128, 128), "ScanNavResNet18", image_size=128)
    assert ours.layers[0](th.rand(1, 4, 64, 64)).shape == (1, 256, 2, 2)
    ours_shapes, theirs_shapes = ([p.shape for p in encoder.parameters()] for encoder in (ours, theirs))
    assert ours_shapes == theirs_shapes
    ours.load_state_dict(dict(zip(ours.state_dict(), theirs.state_dict().values(), strict=True)))
    x = th.rand(2, 4, 64, 64)
    enlarged = x.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
    # The paper's maps to -1..1 first, which the averaging of equal pixels leaves as it is.
    assert th.allclose(ours(2 * x - 1), theirs(enlarged), atol=1e-4)


def test_small_sees_codes_as_well_as_colors() -> None:
    """MiniGrid's cells hold numbers up to 10 of 255."""
    th.manual_seed(0)
    encoder = make_encoder(image_space(3, 7, 7), "small")
    grids = th.randint(0, 11, (64, 3, 7, 7)) / 255
    spread = [float(encoder(scale * grids).detach().std(dim=0).mean()) for scale in (1.0, 23.0)]
    assert spread[0] == pytest.approx(spread[1], rel=0.1)


@pytest.mark.parametrize(
    ("shape", "name"),
    [
        ((3, 15, 15), "Nav2DEncoder"), ((3, 64, 64), "PointMazeEncoder"), ((4, 128, 128), "ScanNavEncoder"),
        ((4, 64, 64), "nature"), ((1, 84, 84), "nature"), ((12, 36, 200), "nature"), ((3, 35, 200), "small"),
        ((3, 7, 7), "small"), ((1, 15, 15), "small"), ((12, 7, 7), "small"),
    ],
)  # fmt: skip
def test_default_networks(shape: tuple[int, ...], name: str) -> None:
    assert default_network(shape) == name == make_encoder(image_space(*shape)).spec()["name"]
    assert name in networks()


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize(
    ("network", "shape"),
    [
        ("nature", (4, 37, 44)),
        ("impala", (1, 21, 9)),
        ("resnet18", (12, 17, 33)),
        ("small", (3, 7, 11)),
        ("glimpse", (4, 33, 21)),
    ],
)
def test_every_objective_trains_on_them(objective: str, network: str, shape: tuple[int, ...]) -> None:
    """One step moves every weight of the encoder, and the decoder reaches odd sizes."""
    th.manual_seed(0)
    space = image_space(*shape)
    method, kwargs = get_method(objective), {}
    if method.base is not None:
        kwargs["base_encoder"] = make_encoder(space, network)
    if method.objective.reads_action_sequences:
        kwargs["k"] = 1
    module: Any = method.objective(make_encoder(space, network), gym.spaces.Discrete(5), **kwargs)
    actions = th.randint(0, 5, (6, 1) if method.objective.reads_action_sequences else (6,))
    batch = TensorBatch.of(th.rand(6, *shape), actions, th.rand(6, *shape))
    before = {name: weight.detach().clone() for name, weight in module.encoder.named_parameters()}
    optimizer = th.optim.Adam([weight for weight in module.parameters() if weight.requires_grad], lr=1e-2)
    for _ in range(2):
        loss, terms = module.loss(batch)
        assert bool(th.isfinite(loss)) and all(bool(th.isfinite(term)) for term in terms.values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        module.after_step()
    moved = [not th.equal(weight, before[name]) for name, weight in module.encoder.named_parameters()]
    assert all(moved)
