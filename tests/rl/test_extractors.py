"""The extractors inside Stable-Baselines3's algorithms: the weights are the file's, and stay so, or are fine-tuned."""

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import ALGORITHMS, OBSERVATIONS, SPACE, VARIANTS, RandomImages, build, write
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.checks import find_extractors, require_weights
from sb3_abisim.rl.extractors import (
    ActionBisimExtractor,
    BaseEncoderExtractor,
    PretrainedExtractor,
    SSIExtractor,
    VanillaExtractor,
)

pytestmark = pytest.mark.usefixtures("batch_norm_is_known")


def all_extractors(model: BaseAlgorithm) -> list[PretrainedExtractor]:
    """With those of target networks."""
    return [module for module in model.policy.modules() if isinstance(module, PretrainedExtractor)]


def assert_equal_to_file(extractor: BaseEncoderExtractor, path: Path) -> None:
    expected, actual = load_encoder(path).encoder.state_dict(), extractor.encoder.state_dict()
    assert expected.keys() == actual.keys()
    for name, value in expected.items():
        assert th.equal(actual[name], value), name


def embed(path: Path) -> Any:
    with th.no_grad():
        return load_encoder(path).encoder(th.from_numpy(OBSERVATIONS).float() / 255)


@pytest.mark.parametrize("freeze", [True, False])
@pytest.mark.parametrize("name, other_sharing", VARIANTS)
def test_construction_keeps_the_weights(path: Path, name: str, other_sharing: bool, freeze: bool) -> None:
    model = build(name, path, freeze, other_sharing)
    extractors = all_extractors(model)
    n_expected = 2 if other_sharing else {"DQN": 2, "QRDQN": 2, "SAC": 3, "TQC": 3, "TD3": 4}.get(name, 1)
    assert len(extractors) == n_expected  # target networks have separate extractors
    for extractor in extractors:
        assert_equal_to_file(extractor, path)
        assert extractor.hash == load_encoder(path).hash
        assert extractor.n_parameters == sum(p.numel() for p in make_encoder(SPACE).parameters())
    trained = [p for extractor in extractors for p in extractor.parameters()]
    assert (len(trained) == 0) if freeze else all(p.requires_grad for p in trained)


def test_heads_keep_orthogonal_initialization(path: Path) -> None:
    weight = build("PPO", path, False).policy.mlp_extractor.policy_net[0].weight
    assert th.allclose(weight @ weight.T, 2.0 * th.eye(8), atol=1e-5)


@pytest.mark.parametrize("name, other_sharing", VARIANTS)
def test_frozen(batch_norm_path: Path, name: str, other_sharing: bool) -> None:
    """Training, target updates, weight decay, saving and loading without the file leave every bit."""
    model = build(name, batch_norm_path, True, other_sharing, network="BatchNorm")
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(24)
    assert not all(th.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))
    model.policy.set_training_mode(True)
    saved_as = batch_norm_path.parent / "model.zip"
    model.save(saved_as)
    encoder_file = batch_norm_path.read_bytes()
    batch_norm_path.unlink()
    loaded = type(model).load(saved_as, env=RandomImages(continuous=name in ("SAC", "TD3", "TQC")), device="cpu")
    require_weights(loaded)
    loaded.learn(16)
    batch_norm_path.write_bytes(encoder_file)
    for extractor in all_extractors(model) + all_extractors(loaded):
        assert_equal_to_file(extractor, batch_norm_path)
        extractor.train()
        assert not any(module.training for module in extractor.encoder.modules())
        assert extractor.relative_weight_change() == 0.0
        observations = th.from_numpy(OBSERVATIONS).float() / 255
        assert not extractor(observations).requires_grad
        assert th.equal(extractor(observations), embed(batch_norm_path))


@pytest.mark.parametrize("name, other_sharing", VARIANTS)
def test_fine_tuned(path: Path, name: str, other_sharing: bool) -> None:
    model = build(name, path, False, other_sharing)
    model.learn(24)
    moved = find_extractors(model.policy)
    for _, extractor in moved:
        assert 0.0 < extractor.relative_weight_change() < 10.0
        with pytest.raises(AssertionError):
            assert_equal_to_file(extractor, path)
    hash = load_encoder(path).hash
    model.save(path.parent / "model.zip")
    path.unlink()
    loaded = type(model).load(
        path.parent / "model.zip", env=RandomImages(continuous=name in ("SAC", "TD3", "TQC")), device="cpu"
    )
    assert np.array_equal(
        model.predict(OBSERVATIONS, deterministic=True)[0], loaded.predict(OBSERVATIONS, deterministic=True)[0]
    )
    restored = loaded.policy.state_dict()
    assert all(th.equal(value, restored[key]) for key, value in model.policy.state_dict().items())
    for (_, before), (_, after) in zip(moved, find_extractors(loaded.policy), strict=True):
        assert after.relative_weight_change() == before.relative_weight_change() and after.hash == hash
    relative_weight_change = moved[0][1].relative_weight_change()
    loaded.learn(16)
    assert find_extractors(loaded.policy)[0][1].relative_weight_change() != relative_weight_change
    assert moved[0][1].relative_weight_change() == relative_weight_change


@pytest.mark.parametrize("name", ALGORITHMS)
def test_missing_file(tmp_path: Path, path: Path, name: str) -> None:
    missing = tmp_path / "mistyped.safetensors"
    model = build(name, missing, True)
    for call in (lambda: require_weights(model), lambda: model.predict(OBSERVATIONS), lambda: model.learn(24)):
        with pytest.raises(FileNotFoundError, match=r"searched .*mistyped\.safetensors.*pretrain"):
            call()
    assert all(extractor.hash is None for extractor in all_extractors(model))
    # A zip saved in this state is no better when loaded.
    model.save(tmp_path / "empty.zip")
    with pytest.raises(FileNotFoundError):
        type(model).load(tmp_path / "empty.zip", device="cpu").predict(OBSERVATIONS)
    # Nor is a good model into which it is loaded.
    good = build(name, path, True)
    good.predict(OBSERVATIONS)
    good.save(tmp_path / "good.zip")
    good.set_parameters(tmp_path / "empty.zip", device="cpu")
    with pytest.raises(FileNotFoundError, match="no pretrained weights"):
        good.predict(OBSERVATIONS)
    model.set_parameters(tmp_path / "good.zip", device="cpu")
    require_weights(model)
    for extractor in all_extractors(model):
        assert_equal_to_file(extractor, path)


def test_policy_saved_alone_loads_without_the_file(path: Path) -> None:
    model = build("PPO", path, True)
    model.policy.save(path.parent / "policy")
    path.unlink()
    policy = type(model.policy).load(path.parent / "policy", device="cpu")
    observations = th.from_numpy(OBSERVATIONS)
    assert th.equal(policy.get_distribution(observations).distribution.logits, logits(model, OBSERVATIONS))


def logits(model: Any, observations: Any) -> Any:
    return model.policy.get_distribution(th.from_numpy(observations)).distribution.logits


def test_features_are_the_embedding(path: Path) -> None:
    policy = build("PPO", path, True).policy
    assert policy.features_dim == 576
    assert th.equal(policy.extract_features(th.from_numpy(OBSERVATIONS), policy.features_extractor), embed(path))


def test_channels_last_environment(path: Path) -> None:
    """SB3 transposes observations; predictions agree with those for the same observations channels first."""
    arguments = build("PPO", path, True).policy_kwargs
    last = sb3.PPO("CnnPolicy", RandomImages(channels_last=True), seed=5, device="cpu", policy_kwargs=dict(arguments))
    first = sb3.PPO("CnnPolicy", RandomImages(), seed=5, device="cpu", policy_kwargs=dict(arguments))
    transposed: Any = last.policy.obs_to_tensor(OBSERVATIONS.transpose(0, 2, 3, 1))[0]
    assert th.equal(logits(last, transposed.numpy()), logits(first, OBSERVATIONS))
    with pytest.raises(ValueError, match=r"\[3, 15, 15\].*\[15, 15, 3\]"):
        ActionBisimExtractor(spaces.Box(0, 255, (15, 15, 3), np.uint8), str(path))


def test_models_of_one_file_are_independent(path: Path) -> None:
    vec_env = DummyVecEnv([RandomImages, RandomImages])
    policy_kwargs = build("PPO", path, False).policy_kwargs
    first = sb3.PPO("CnnPolicy", vec_env, n_steps=8, batch_size=8, policy_kwargs=copy.deepcopy(policy_kwargs))
    second = sb3.PPO("CnnPolicy", vec_env, n_steps=8, batch_size=8, policy_kwargs=copy.deepcopy(policy_kwargs))
    first.learn(16)
    assert find_extractors(first.policy)[0][1].relative_weight_change() > 0.0
    assert_equal_to_file(all_extractors(second)[0], path)


class DictImages(gym.Wrapper[Any, Any, Any, Any]):
    def __init__(self) -> None:
        super().__init__(RandomImages())
        self.observation_space = spaces.Dict({"image": SPACE, "speed": spaces.Box(-1, 1, (2,))})

    def reset(self, **kwargs: Any) -> Any:
        return self._wrap(self.env.reset(**kwargs)[0]), {}

    def step(self, action: Any) -> Any:
        observation, *rest = self.env.step(action)
        return self._wrap(observation), *rest

    def _wrap(self, observation: Any) -> dict[str, Any]:
        return {"image": observation, "speed": np.zeros(2, np.float32)}


class Nested(BaseFeaturesExtractor):
    """A custom extractor around one of ours."""

    def __init__(self, observation_space: spaces.Dict, encoder: str, network: str) -> None:
        inner = ActionBisimExtractor(observation_space["image"], encoder, freeze=True, network=network)
        super().__init__(observation_space, inner.features_dim + 2)
        self.parts = nn.ModuleDict({"image": nn.Sequential(inner)})

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return th.cat([self.parts["image"](observations["image"]), observations["speed"]], dim=1)


@pytest.mark.parametrize("name", ["PPO", "DQN"])
def test_nested_in_a_combined_extractor(batch_norm_path: Path, name: str) -> None:
    policy_kwargs = {
        "features_extractor_class": Nested,
        "features_extractor_kwargs": {"encoder": str(batch_norm_path), "network": "BatchNorm"},
    }
    algorithm, settings = ALGORITHMS[name]
    model = algorithm("MultiInputPolicy", DictImages(), policy_kwargs=policy_kwargs, device="cpu", **settings)
    model.learn(16)
    for extractor in all_extractors(model):
        assert_equal_to_file(extractor, batch_norm_path)
    names = {"PPO": ["features_extractor.parts.image.0"], "DQN": ["q_net.features_extractor.parts.image.0"]}
    assert [found for found, _ in find_extractors(model.policy)] == names[name]


@pytest.mark.parametrize(
    "name, other_sharing, names",
    [
        ("PPO", False, ["features_extractor"]),
        ("PPO", True, ["features_extractor", "vf_features_extractor"]),
        ("DQN", False, ["q_net.features_extractor"]),
        ("QRDQN", False, ["quantile_net.features_extractor"]),
        ("SAC", False, ["actor.features_extractor", "critic.features_extractor"]),
        ("SAC", True, ["actor.features_extractor"]),
        ("TD3", False, ["actor.features_extractor", "critic.features_extractor"]),
    ],
)
def test_find_extractors(path: Path, name: str, other_sharing: bool, names: list[str]) -> None:
    assert [found for found, _ in find_extractors(build(name, path, False, other_sharing).policy)] == names


def test_batch_norm_of_a_trained_encoder_learns(batch_norm_path: Path) -> None:
    extractor = ActionBisimExtractor(SPACE, str(batch_norm_path), network="BatchNorm")
    (batch_norm,) = (module for module in extractor.encoder.modules() if isinstance(module, nn.BatchNorm2d))
    assert extractor.train() is extractor and batch_norm.training
    extractor.eval()
    assert not batch_norm.training


def test_frozen_and_trained_models_exchange_weights(batch_norm_path: Path) -> None:
    frozen, trained = (
        ActionBisimExtractor(SPACE, str(batch_norm_path), freeze, network="BatchNorm") for freeze in (True, False)
    )
    with th.no_grad():
        next(trained.encoder.parameters()).add_(1.0)
    frozen.load_state_dict(trained.state_dict())
    assert frozen.relative_weight_change() == trained.relative_weight_change() > 0.0
    assert not list(frozen.parameters()) and not any(
        v.requires_grad for v in frozen.state_dict(keep_vars=True).values()
    )


def test_relative_weight_change(path: Path) -> None:
    extractor = ActionBisimExtractor(SPACE, str(path))
    assert extractor.relative_weight_change() == 0.0
    weights = dict(extractor.encoder.named_parameters())
    norm = sum(w.detach().double().square().sum().item() for w in weights.values()) ** 0.5
    with th.no_grad():
        weights["layers.2.bias"][3] += 0.75
        weights["layers.4.weight"][1, 2, 0, 1] -= 1.0
    assert extractor.relative_weight_change() == pytest.approx(1.25 / norm, rel=1e-4)


def test_vanilla_is_initialized_by_sb3_and_its_change_is_measured_from_there() -> None:
    policy_kwargs = {"features_extractor_class": VanillaExtractor}
    model = sb3.PPO("CnnPolicy", RandomImages(), n_steps=8, batch_size=8, policy_kwargs=policy_kwargs, device="cpu")
    ((_, extractor),) = find_extractors(model.policy)
    weight = extractor.encoder.state_dict()["layers.0.weight"].flatten(1)
    assert th.allclose(weight.T @ weight, 2.0 * th.eye(27), atol=1e-5)
    assert extractor.relative_weight_change() == 0.0 and extractor.hash is None and not extractor.frozen
    require_weights(model)
    model.learn(8)
    assert extractor.relative_weight_change() > 0.0


def test_vanilla_and_pretrained_have_one_network(path: Path) -> None:
    th.manual_seed(0)
    vanilla = VanillaExtractor(SPACE)
    after_vanilla = th.rand(3)
    th.manual_seed(0)
    pretrained = SSIExtractor(SPACE, str(write(path, objective="ssi")))
    assert isinstance(vanilla, BaseEncoderExtractor)
    assert vanilla.encoder.spec() == pretrained.encoder.spec() and vanilla.n_parameters == pretrained.n_parameters
    th.manual_seed(0)
    SSIExtractor(SPACE, str(path))
    # What the policy draws next (its heads) is the same for both.
    assert th.equal(th.rand(3), after_vanilla)
