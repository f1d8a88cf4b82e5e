"""Task features: appended, trained beside an encoder that stays as it is, and out of what is said of the encoder."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from extractor_inputs import OBSERVATIONS, SPACE, RandomImages, build, write
from gymnasium import spaces
from stable_baselines3 import PPO

from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.callbacks import EncoderCallback
from sb3_abisim.rl.checks import check_trained_with, find_extractors
from sb3_abisim.rl.combined import CombinedEncoderExtractor
from sb3_abisim.rl.extractors import ActionBisimExtractor, EncoderExtractor, PretrainedExtractor, VanillaExtractor
from sb3_abisim.rl.fine_tuning import _encoder_parameters
from sb3_abisim.rl.policy_kwargs import policy_kwargs
from sb3_abisim.rl.task_features import make_task_network
from sb3_abisim.rl.unfreeze import unfreeze_encoder

INPUTS = th.from_numpy(OBSERVATIONS).float() / 255
VARIANTS = [("PPO", False), ("PPO", True), ("DQN", False), ("SAC", False), ("SAC", True), ("TD3", False)]


def task_weights(model: Any) -> list[th.Tensor]:
    """Of the networks that learn, without targets."""
    extractors: list[Any] = [extractor for _, extractor in find_extractors(model.policy)]
    return [weight.detach().clone() for extractor in extractors for weight in extractor.task_features.parameters()]


def test_they_stand_behind_the_embedding(path: Path) -> None:
    extractor = ActionBisimExtractor(SPACE, str(path), True, task_features_dim=8)
    features = extractor(INPUTS)
    assert extractor.features_dim == features.shape[1] == 576 + 8
    assert th.equal(features[:, :576], load_encoder(path).encoder(INPUTS))
    assert th.equal(features[:, 576:], extractor.task_features(INPUTS))
    assert len(set(features[:, 576:].flatten().tolist())) > 8
    untrained = VanillaExtractor(SPACE, task_features_dim=8)
    assert untrained(INPUTS).shape[1] == untrained.features_dim == untrained.encoder.features_dim + 8


def test_none_costs_nothing(path: Path) -> None:
    th.manual_seed(0)
    plain, after = ActionBisimExtractor(SPACE, str(path)), th.rand(3)
    th.manual_seed(0)
    make_encoder(SPACE)
    assert th.equal(th.rand(3), after)
    keys = ActionBisimExtractor(SPACE, str(path), task_features_dim=8).state_dict().keys()
    assert {key for key in keys if not key.startswith("task_features.")} == plain.state_dict().keys() != keys
    assert not any(module for name, module in plain.named_children() if name != "encoder")


@pytest.mark.parametrize("name, other_sharing", VARIANTS)
def test_they_learn_while_the_frozen_encoder_stays(path: Path, name: str, other_sharing: bool) -> None:
    model = build(name, path, True, other_sharing, task_features_dim=8)
    before = task_weights(model)
    model.learn(24)
    assert len(before) in (9, 18) and not any(map(th.equal, before, task_weights(model)))
    model.save(path.parent / "model.zip")
    expected = load_encoder(path).encoder.state_dict()
    path.unlink()
    env = RandomImages(continuous=name in ("SAC", "TD3"))
    loaded = type(model).load(path.parent / "model.zip", env=env, device="cpu")
    actions = [each.predict(OBSERVATIONS, deterministic=True)[0] for each in (model, loaded)]
    assert np.array_equal(*actions) and all(map(th.equal, task_weights(model), task_weights(loaded)))
    loaded.learn(16)
    for module in (*model.policy.modules(), *loaded.policy.modules()):
        if isinstance(module, PretrainedExtractor):
            assert all(map(th.equal, module.encoder.state_dict().values(), expected.values()))
            assert module.relative_weight_change() == 0.0


def test_ortho_init_reaches_them_and_not_the_encoder(path: Path) -> None:
    extractor = build("PPO", path, False, task_features_dim=8).policy.features_extractor
    last = extractor.task_features.layers[-2].weight
    assert th.allclose(last @ last.T, 2.0 * th.eye(8), atol=1e-5)
    assert all(map(th.equal, extractor.encoder.state_dict().values(), load_encoder(path).encoder.state_dict().values()))


def test_they_are_no_part_of_the_encoder(path: Path) -> None:
    extractor = ActionBisimExtractor(SPACE, str(path), task_features_dim=8)
    policy = build("PPO", path, False, task_features_dim=8).policy
    own_rate = {id(parameter) for parameter in _encoder_parameters(policy)}
    assert own_rate == {id(parameter) for parameter in policy.features_extractor.encoder.parameters()}
    plain = ActionBisimExtractor(SPACE, str(path))
    assert extractor.n_parameters == plain.n_parameters and th.equal(extractor.initial_weights, plain.initial_weights)
    with th.no_grad():
        next(extractor.task_features.parameters()).add_(1.0)
    assert extractor.relative_weight_change() == 0.0
    untrained = VanillaExtractor(SPACE, task_features_dim=8)
    assert th.equal(untrained.initial_weights, th.cat([p.flatten() for p in untrained.encoder.parameters()]))


def test_the_encoder_can_be_unfrozen_beside_them(path: Path) -> None:
    model = build("PPO", path, True, task_features_dim=8)
    model.learn(8)
    unfreeze_encoder(model)
    model.save(path.parent / "model.zip")
    loaded = type(model).load(path.parent / "model.zip", env=RandomImages(), device="cpu")
    for each in (model, loaded):
        th.manual_seed(0)
        each.set_random_seed(1)
        each.learn(8)
    assert all(map(th.equal, task_weights(model), task_weights(loaded)))
    assert find_extractors(model.policy)[0][1].relative_weight_change() > 0.0


@pytest.mark.parametrize("size", [-1, True, 2.5, "8"])
def test_sizes_that_are_none(path: Path, size: Any) -> None:
    with pytest.raises(ValueError, match=f"task_features_dim must be a whole number of at least 0, got {size!r}"):
        ActionBisimExtractor(SPACE, str(path), task_features_dim=size)


@pytest.mark.parametrize("side, name", [(35, "small"), (36, "nature"), (64, "nature")])
def test_the_network_follows_from_the_size(side: int, name: str) -> None:
    network = make_task_network(spaces.Box(0, 255, (4, side, side), np.uint8), 5)
    assert network is not None and network.features_dim == 5
    assert network.spec() == {"name": name, "kwargs": {"features_dim": 5}}


def test_beside_each_encoder_of_a_dictionary(path: Path) -> None:
    space = spaces.Dict({"a": SPACE, "b": SPACE, "speed": spaces.Box(-1, 1, (2,))})
    encoders = {"a": str(path), "b": str(write(path.parent / "ssi", objective="ssi"))}
    extractor = CombinedEncoderExtractor(space, encoders, freeze=True, task_features_dim=4)
    features = extractor({"a": INPUTS, "b": INPUTS.flip(0), "speed": th.ones(6, 2)})
    assert extractor.features_dim == features.shape[1] == 2 * (576 + 4) + 2
    assert th.equal(features[:, :576], load_encoder(path).encoder(INPUTS))
    assert len(list(extractor.parameters())) == 2 * 9


def test_policy_kwargs_pass_them_on(path: Path) -> None:
    kwargs = policy_kwargs(path, freeze=True, extractor_kwargs={"task_features_dim": 4})
    model = PPO("CnnPolicy", RandomImages(), policy_kwargs=kwargs, device="cpu")
    assert model.policy.features_dim == 576 + 4
    assert isinstance(model.policy.features_extractor, EncoderExtractor)


def test_messages_say_so(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = build("PPO", path, True, task_features_dim=8)
    model.learn(8, callback=EncoderCallback())
    assert "parameters, frozen, task_features_dim=8\n" in capsys.readouterr().out
    asked = copy.deepcopy(model.policy_kwargs)
    check_trained_with(model, asked)
    asked["features_extractor_kwargs"]["task_features_dim"] = 4
    with pytest.raises(ValueError, match=r"frozen, task_features_dim=8, not with .*frozen, task_features_dim=4"):
        check_trained_with(model, asked)


def test_they_go_through_torch_export(path: Path) -> None:
    extractor = ActionBisimExtractor(SPACE, str(path), True, task_features_dim=8).eval()
    program = th.export.export(extractor, (INPUTS,))
    assert th.allclose(program.module()(INPUTS), extractor(INPUTS), atol=1e-5)
