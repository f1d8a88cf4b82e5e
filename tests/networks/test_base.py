"""Encoders: the paper's sizes, rebuilt from their specs, and networks that somebody else registers."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_abisim import registry
from sb3_abisim.networks.base import Encoder, make_encoder, preprocess, set_memory_format
from sb3_abisim.registry import register_network

BUILT_IN = {name: network for name, network in registry.networks().items() if network.observation_shape}


def image_space(*shape):
    return gym.spaces.Box(0, 255, shape, np.uint8)


@pytest.mark.parametrize(
    ("shape", "features_dim"),
    [((3, 15, 15), 576), ((3, 64, 64), 32), ((4, 128, 128), 2048), ((4, 256, 256), 2048)],
)
def test_paper_sizes(shape, features_dim):
    encoder = make_encoder(image_space(*shape))
    assert encoder(th.rand(2, *shape)).shape == (2, features_dim) and encoder.features_dim == features_dim


@pytest.mark.parametrize(("shape", "features_dim"), [((3, 15, 15), 144), ((3, 64, 64), 50)])
def test_other_sizes_of_the_embedding(shape, features_dim):
    encoder = make_encoder(image_space(*shape), features_dim=features_dim)
    assert encoder(th.rand(2, *shape)).shape == (2, features_dim) and encoder.features_dim == features_dim
    assert encoder.spec()["kwargs"]["features_dim"] == features_dim


@pytest.mark.parametrize("features_dim", [0, -9, 100])
def test_sizes_that_nav2d_cannot_have(features_dim):
    with pytest.raises(ValueError, match=f"features_dim must be a multiple of 9, got {features_dim}"):
        make_encoder(image_space(3, 15, 15), features_dim=features_dim)


@pytest.mark.parametrize("name", BUILT_IN)
def test_spec_rebuilds_the_network(name):
    shape = BUILT_IN[name].observation_shape
    encoder = make_encoder(image_space(*shape), name)
    spec = encoder.spec()
    again = make_encoder(image_space(*shape), spec["name"], **spec["kwargs"])
    again.load_state_dict(encoder.state_dict())
    x = th.rand(2, *shape)
    assert th.equal(encoder(x), again(x))


def is_channels_last(module):
    weights = [m.weight for m in module.modules() if isinstance(m, th.nn.Conv2d) and m.weight[0, 0].numel() > 1]
    return bool(weights) and all(w.is_contiguous(memory_format=th.channels_last) for w in weights)


@pytest.mark.parametrize("name", BUILT_IN)
def test_weights_lie_channels_last(name):
    """However they got there: built, initialized as SB3 does, copied, or read from another layout."""
    encoder = make_encoder(image_space(*BUILT_IN[name].observation_shape), name)
    holder = th.nn.Sequential(encoder)
    holder.apply(ActorCriticPolicy.init_weights)
    assert is_channels_last(encoder) and is_channels_last(copy.deepcopy(encoder))
    encoder.load_state_dict({k: w.contiguous() for k, w in encoder.state_dict().items()})
    assert is_channels_last(encoder)


@pytest.mark.parametrize("size", [64, 128, 256])
def test_habitats_resnet(size):
    """Sizes and numbers of weights of habitat-baselines' encoder."""
    encoder = make_encoder(image_space(4, size, size), "ScanNavResNet18", image_size=size)
    assert encoder(th.rand(1, 4, size, size)).shape == (1, 2048)
    n_backbone = sum(p.numel() for p in encoder.layers[1].parameters())
    assert n_backbone == 2_800_448
    n_channels = {64: 2048, 128: 512, 256: 128}[size]
    assert sum(p.numel() for p in encoder.parameters()) == n_backbone + n_channels * (256 * 9 + 2)
    assert encoder.layers[1](th.rand(1, 4, size // 2, size // 2)).shape == (1, 256, size // 64, size // 64)
    with pytest.raises(ValueError, match="image_size must be 64, 128 or 256, got 96"):
        make_encoder(image_space(4, 96, 96), "ScanNavResNet18", image_size=96)


def test_inputs_are_mapped_to_plus_minus_one():
    encoder = make_encoder(image_space(3, 15, 15))
    seen = []
    encoder.layers.register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    encoder(th.tensor([0.0, 0.5, 1.0]).repeat_interleave(225).reshape(1, 3, 15, 15))
    assert seen[0][0, :, 4, 4].tolist() == [-1.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("shape", "name", "kwargs", "message"),
    [
        ((20, 20, 3), None, {}, r"\(20, 20, 3\) have their channels last.*VecTransposeImage"),
        ((3, 64, 64), "ResNet", {}, "ResNet"),
        ((3, 64, 64), "PointMazeEncoder", {"width": 3}, r"'width'\); correct network_kwargs"),
        ((3, 64, 64), "nature", {"width": 3}, r"'width'\); it takes features_dim; correct network_kwargs"),
        ((3, 15, 15), "PointMazeEncoder", {}, "shape .*, got .*; name another network, such as small"),
        ((4, 64, 64), "PointMazeEncoder", {}, "shape"),
        ((8,), "PointMazeEncoder", {}, "observations must be images"),
    ],
    ids=str,
)
def test_refuses(shape, name, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_encoder(image_space(*shape), name, **kwargs)


def test_other_channel_counts():
    encoder = make_encoder(image_space(4, 64, 64), "PointMazeEncoder", n_input_channels=4, features_dim=7)
    assert encoder(th.rand(1, 4, 64, 64)).shape == (1, 7)


def test_standardize_keeps_ratios_of_distances():
    th.manual_seed(0)
    encoder = make_encoder(image_space(3, 15, 15))
    x, y = th.rand(500, 3, 15, 15), th.rand(20, 3, 15, 15)
    before = th.cdist(encoder(y), encoder(y), p=1).detach()
    for _ in range(2):
        encoder.standardize(x)
        z = encoder(x)
        assert th.allclose(z.mean(dim=0), th.zeros(576), atol=1e-4)
        assert float(z.detach().var(dim=0, correction=0).mean()) == pytest.approx(1.0, rel=1e-4)
    after = th.cdist(encoder(y), encoder(y), p=1).detach()
    ratios = (after / before)[~th.eye(20, dtype=th.bool)]
    assert float(ratios.max() / ratios.min()) == pytest.approx(1.0, rel=1e-3) and float(ratios.mean()) != 1.0


def test_standardize_refuses_a_collapsed_embedding():
    encoder = make_encoder(image_space(3, 15, 15))
    with pytest.raises(ValueError, match="collapsed"):
        encoder.standardize(th.zeros(4, 3, 15, 15))


def test_weights_are_float32_whatever_the_default_is():
    th.set_default_dtype(th.float64)
    try:
        encoder = make_encoder(image_space(3, 15, 15))
    finally:
        th.set_default_dtype(th.float32)
    assert {parameter.dtype for parameter in encoder.parameters()} == {th.float32}


class Pooled(th.nn.Module):
    """A network as a user writes it: no base class, a layer that differs in training, and 5-d weights."""

    def __init__(self, n_channels: int, width: int) -> None:
        super().__init__()
        self.conv = th.nn.Conv2d(n_channels, width, 3)
        self.norm = th.nn.BatchNorm2d(width)
        self.deep = th.nn.Conv3d(1, 2, (width, 1, 1))

    def forward(self, observations):
        features = self.norm(self.conv(observations)).relu()
        return self.deep(features[:, None]).flatten(1)


def pooled(observation_space, width=4):
    return Pooled(observation_space.shape[0], width)


@pytest.fixture
def registered(monkeypatch):
    """Registers networks for one test."""
    registry.networks()
    monkeypatch.setattr(registry._NETWORKS, "by_name", dict(registry._NETWORKS.by_name))
    return register_network


def test_a_registered_factory_may_give_any_module(registered):
    registered("pooled", pooled)
    th.manual_seed(0)
    encoder = make_encoder(image_space(2, 7, 5), "pooled", width=3)
    # Two maps of 5 x 3, found by a forward pass that leaves no trace.
    assert encoder.features_dim == 30 and encoder(th.rand(3, 2, 7, 5)).shape == (3, 30)
    th.manual_seed(0)
    module = pooled(image_space(2, 7, 5), width=3)
    after = make_encoder(image_space(2, 7, 5), "pooled", width=3).layers
    assert after.training and int(after.norm.num_batches_tracked) == 0 and float(after.norm.running_mean.sum()) == 0
    assert [p.shape for p in after.parameters()] == [p.shape for p in module.parameters()]
    assert encoder.spec() == {"name": "pooled", "kwargs": {"width": 3}}
    x = th.rand(3, 2, 7, 5)
    assert th.equal(encoder.eval()(x), encoder.layers(x)), "nothing comes before it or after"
    assert is_channels_last(encoder)


def test_looking_for_the_size_takes_no_random_numbers(registered):
    registered("noisy", lambda space: th.nn.Sequential(th.nn.Flatten(), th.nn.Dropout(), Noise()))
    th.manual_seed(0)
    expected = th.rand(3)
    th.manual_seed(0)
    assert make_encoder(image_space(1, 2, 2), "noisy").features_dim == 4
    assert th.equal(th.rand(3), expected)


class Noise(th.nn.Module):
    def forward(self, x):
        return x + th.randn_like(x)


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (th.nn.Conv2d(2, 3, 3), r"must give a tensor \(batch, features_dim\), got \(1, 3, 5, 3\); end it in Flatten"),
        (th.nn.Flatten(0), r"got \(70,\)"),
        (th.nn.AdaptiveMaxPool2d(1, return_indices=True), "must give a tensor .* got tuple"),
        (th.nn.LSTM(5, 3), r"bad does not take observations of shape \(2, 7, 5\): LSTM"),
        (th.nn.Conv2d(3, 3, 3), r"bad does not take observations of shape \(2, 7, 5\)"),
        (th.nn.Linear(9, 3), r"bad does not take observations of shape \(2, 7, 5\)"),
    ],
    ids=str,
)
def test_a_registered_network_of_the_wrong_shape_is_refused(registered, module, message):
    registered("bad", lambda space: module)
    with pytest.raises(ValueError, match=message):
        make_encoder(image_space(2, 7, 5), "bad")


def test_a_registered_network_may_be_the_default_of_a_shape(registered):
    registered("pooled", pooled, observation_shape=(1, 9, 9))
    assert make_encoder(image_space(1, 9, 9)).spec() == {"name": "pooled", "kwargs": {}}
    assert make_encoder(image_space(1, 9, 8)).spec()["name"] == "small"
    with pytest.raises(ValueError, match=r"pooled does not take these arguments .*depth.*; it takes "):
        make_encoder(image_space(1, 9, 9), depth=3)


def test_preprocessing_is_that_of_sb3():
    images = np.random.default_rng(0).integers(256, size=(4, 3, 7, 5), dtype=np.uint8)
    x = preprocess(images, image_space(3, 7, 5))
    assert x.dtype == th.float32 and th.equal(x, th.as_tensor(images).float() / 255)
    laid_out = th.as_tensor(images).contiguous(memory_format=th.channels_last)
    assert preprocess(laid_out, image_space(3, 7, 5)).is_contiguous(memory_format=th.channels_last)


def test_the_memory_format_changes_no_weight():
    module = Pooled(2, 3)
    before = {name: value.clone() for name, value in module.state_dict().items()}
    for memory_format in (th.channels_last, th.contiguous_format):
        set_memory_format(module, memory_format)
        assert module.conv.weight.is_contiguous(memory_format=memory_format)
        assert all(th.equal(value, before[name]) for name, value in module.state_dict().items())


@pytest.mark.parametrize(
    ("network", "shape", "kwargs", "features_dim"),
    [
        (None, (3, 15, 15), {"features": "trunk"}, 64 * 5 * 5),
        (None, (3, 15, 15), {"hidden_dim": 12}, 12),
        (None, (3, 64, 64), {"features": "trunk"}, 16 * 8 * 8),
        (None, (3, 64, 64), {"features": "trunk", "hidden_dim": 12}, 12),
        (None, (4, 128, 128), {"features": "trunk"}, 32 * 16 * 16),
        ("ScanNavResNet18", (4, 64, 64), {"features": "trunk", "image_size": 64}, 256),
        ("nature", (2, 40, 44), {"features": "trunk"}, 64 * 1 * 2),
        ("nature", (2, 40, 44), {"features": "trunk", "hidden_dim": 12}, 12),
        ("impala", (2, 20, 20), {"features": "trunk", "hidden_dim": 12}, 12),
        ("resnet18", (2, 33, 33), {"features": "trunk"}, 256 * 2 * 2),
        ("small", (1, 7, 7), {"features": "trunk"}, 64 * 2 * 2),
    ],
)
def test_every_network_hands_out_its_trunk_or_a_layer_on_top(network, shape, kwargs, features_dim) -> None:
    space = image_space(*shape)
    own = {name: value for name, value in kwargs.items() if name not in ("features", "hidden_dim")}
    plain, encoder = make_encoder(space, network, **own), make_encoder(space, network, **kwargs)
    assert encoder.features_dim == features_dim
    again = make_encoder(space, encoder.spec()["name"], **encoder.spec()["kwargs"])
    assert again.spec() == encoder.spec() != plain.spec()
    assert encoder.warm_start(plain) > 0
    first = next(name for name, _ in plain.named_parameters())
    assert th.equal(encoder.state_dict()[first], plain.state_dict()[first])
    x = th.rand(2, *shape)
    with th.no_grad():
        features = encoder(x)
    assert features.shape == (2, features_dim)
    if "hidden_dim" in kwargs:
        assert float(features.min()) >= 0


def test_a_network_that_is_one_module_takes_a_layer_on_top_but_has_no_trunk():
    space = image_space(3, 9, 9)
    network = "user_networks:Pooled"
    plain, encoder = make_encoder(space, network), make_encoder(space, network, hidden_dim=5)
    assert encoder.features_dim == 5 and encoder.spec()["kwargs"] == {"hidden_dim": 5}
    n_shared = sum(tensor.numel() for tensor in plain.layers.state_dict().values())
    assert encoder.warm_start(plain) == n_shared
    with pytest.raises(ValueError, match=r"features='trunk' needs a network that is an nn.Sequential.*features:embed"):
        make_encoder(space, network, features="trunk")


def test_arguments_of_a_networks_own_stay_its_own():
    encoder = make_encoder(image_space(3, 9, 9), "user_networks:with_hidden_dim", hidden_dim=7)
    assert encoder.features_dim == 4 and encoder.layers[1].out_features == 7
    assert encoder.spec()["kwargs"] == {"hidden_dim": 7}


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"features": "all"}, "features must be 'embedding' or 'trunk'"),
        ({"hidden_dim": 0}, "hidden_dim must be a whole"),
    ],
)
def test_other_features_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_encoder(image_space(3, 15, 15), None, **kwargs)


@pytest.mark.parametrize("name", ["Nav2DEncoder", "PointMazeEncoder", "ScanNavEncoder"])
def test_the_layout_of_observations_changes_speed_alone(name):
    """Those that gradients are recorded of lie with channels last; embeddings and gradients are the same to the bit."""
    shape = BUILT_IN[name].observation_shape
    encoder = make_encoder(image_space(*shape), name)
    strides = []
    encoder.layers[0].register_forward_pre_hook(lambda _, inputs: strides.append(inputs[0].stride()))
    observations = th.rand(8, *shape, generator=th.Generator().manual_seed(0))
    results = []
    for forward in (encoder, lambda x: Encoder.forward(encoder, 2 * x - 1)):
        encoder.zero_grad()
        embeddings = forward(observations)
        embeddings.square().sum().backward()
        results.append([embeddings, *(parameter.grad.clone() for parameter in encoder.parameters())])
    assert all(th.equal(one, other) for one, other in zip(*results, strict=True))
    with th.no_grad():
        assert th.equal(encoder(observations), results[0][0])
    # The stride of the channels.
    assert [stride[1] == 1 for stride in strides] == [True, False, False]
