"""Augmented observations: in training mode with gradients only, in each algorithm, by any registered name."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from extractor_inputs import ALGORITHMS, OBSERVATIONS, SPACE, RandomImages, build, dim
from gymnasium import spaces
from torch import nn

import sb3_abisim
from sb3_abisim import registry
from sb3_abisim.rl.augment import Augment
from sb3_abisim.rl.checks import check_trained_with
from sb3_abisim.rl.combined import CombinedEncoderExtractor
from sb3_abisim.rl.extractors import ActionBisimExtractor, BaseEncoderExtractor, VanillaExtractor
from sb3_abisim.zoo.named import named_policy_kwargs

INPUTS = th.from_numpy(OBSERVATIONS).float() / 255
NAMES = ["random_shift", "random_crop", "color_jitter"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("freeze", [True, False])
def test_in_training_mode_with_gradients_only(path: Path, name: str, freeze: bool) -> None:
    plain = ActionBisimExtractor(SPACE, str(path), freeze, task_features_dim=4)
    extractor = ActionBisimExtractor(SPACE, str(path), freeze, task_features_dim=4, augment=name)
    extractor.load_state_dict(plain.state_dict())
    state = th.random.get_rng_state()
    with th.no_grad():
        assert th.equal(extractor.train()(INPUTS), plain(INPUTS))
    assert th.equal(extractor.eval()(INPUTS), plain(INPUTS))
    assert th.equal(th.random.get_rng_state(), state)
    features = extractor.train()(INPUTS)
    # Both networks see them.
    for part in (slice(0, 576), slice(576, None)):
        assert not th.isclose(features[:, part], plain(INPUTS)[:, part]).all()
    features.sum().backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in extractor.parameters() if p.grad is not None)
    assert sum(p.grad is not None for p in extractor.parameters()) == len(list(extractor.parameters())) > 8


def test_none_draws_nothing(path: Path) -> None:
    extractor = ActionBisimExtractor(SPACE, str(path)).train()
    state = th.random.get_rng_state()
    extractor(INPUTS)
    assert th.equal(th.random.get_rng_state(), state)
    keys = ActionBisimExtractor(SPACE, str(path), augment="random_shift").state_dict().keys()
    assert keys == extractor.state_dict().keys()


# Which copies of the encoder are shown augmented observations, in each algorithm; the table of docs/while_rl_runs.md.
POLICY, SEPARATE = ["features_extractor"], ["pi_features_extractor", "vf_features_extractor"]
ACTOR, CRITIC = ["actor.features_extractor"], ["critic.features_extractor"]
SHOWN = {
    ("PPO", False): POLICY,
    ("PPO", True): SEPARATE,
    ("A2C", False): POLICY,
    ("TRPO", False): POLICY,
    ("RecurrentPPO", False): POLICY,
    ("DQN", False): ["q_net.features_extractor"],
    ("QRDQN", False): ["quantile_net.features_extractor"],
    ("SAC", False): ACTOR + CRITIC,
    ("SAC", True): ACTOR,
    ("TD3", False): ACTOR + CRITIC,
    ("TD3", True): ACTOR,
    ("TQC", False): ACTOR + CRITIC,
    ("TQC", True): ACTOR,
}


@pytest.mark.parametrize("name, other_sharing", SHOWN)
def test_who_is_shown_augmented_observations(
    path: Path, monkeypatch: pytest.MonkeyPatch, name: str, other_sharing: bool
) -> None:
    model = build(name, path, True, other_sharing, task_features_dim=4, augment="random_shift")
    of = {id(module.augment): key for key, module in model.policy.named_modules() if hasattr(module, "augment")}
    shown, forward = [], Augment.forward

    def record(self: Augment, observations: th.Tensor) -> th.Tensor:
        augmented = forward(self, observations)
        if augmented is not observations:
            shown.append(of[id(self)])
        return augmented

    monkeypatch.setattr(Augment, "forward", record)
    model.predict(OBSERVATIONS)
    assert not shown
    model.learn(24)
    # The first name of the policy's features extractor, where it has several.
    names = {"features_extractor": "pi_features_extractor"} if SHOWN[name, other_sharing] == SEPARATE else {}
    assert {names.get(key, key) for key in shown} == set(SHOWN[name, other_sharing])


@pytest.mark.parametrize("name", ["PPO", "DQN", "SAC"])
def test_a_saved_model_goes_on_with_its_augmentation(tmp_path: Path, name: str) -> None:
    algorithm, settings = ALGORITHMS[name]
    kwargs = {"features_extractor_class": sb3_abisim.DrQExtractor, "net_arch": [8]}
    env = RandomImages(continuous=name == "SAC")
    model = algorithm("CnnPolicy", env, seed=5, device="cpu", policy_kwargs=kwargs, **settings)
    model.learn(24)
    model.save(tmp_path / "model.zip")
    loaded = algorithm.load(tmp_path / "model.zip", env=env, device="cpu")
    found = [module for module in loaded.policy.modules() if isinstance(module, BaseEncoderExtractor)]
    assert found and all(module.augment is not None and module.augment.name == "random_shift" for module in found)
    assert np.array_equal(*(each.predict(OBSERVATIONS, deterministic=True)[0] for each in (model, loaded)))
    loaded.learn(16)


def test_drq_is_vanilla_on_shifted_observations() -> None:
    th.manual_seed(0)
    vanilla, after = VanillaExtractor(SPACE), th.rand(3)
    th.manual_seed(0)
    drq = sb3_abisim.DrQExtractor(SPACE)
    # What the policy draws next is the same for both.
    assert th.equal(th.rand(3), after)
    assert vanilla.augment is None and isinstance(drq, VanillaExtractor) and drq.augment is not None
    drq.load_state_dict(vanilla.state_dict())
    assert th.equal(drq.eval()(INPUTS), vanilla(INPUTS))
    th.manual_seed(1)
    shifted = drq.train()(INPUTS)
    th.manual_seed(1)
    assert th.equal(shifted, vanilla(registry.get_augmentation("random_shift")(INPUTS)))
    assert sb3_abisim.DrQExtractor(SPACE, augment="color_jitter").augment.name == "color_jitter"


def test_registered_and_imported_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry._AUGMENTATIONS, "by_name", dict(registry._AUGMENTATIONS.by_name))
    sb3_abisim.register_augmentation("dim", dim)
    plain = VanillaExtractor(SPACE)
    for name in ("dim", "extractor_inputs:dim"):
        extractor = VanillaExtractor(SPACE, augment=name, augment_kwargs={"factor": 0.25})
        extractor.load_state_dict(plain.state_dict())
        assert th.equal(extractor(INPUTS), plain(INPUTS / 4))
    assert repr(extractor.augment) == "Augment(extractor_inputs:dim, factor=0.25)"
    with pytest.raises(ValueError, match="the augmentation 'dim' is registered already"):
        sb3_abisim.register_augmentation("dim", dim)


@pytest.mark.parametrize(
    "augment, kwargs, text",
    [
        ("shift", None, "unknown augmentation 'shift'; known are random_noise, random_shift, .*color_jitter"),
        ("no_such_module:dim", None, "cannot import the augmentation 'no_such_module:dim'"),
        ("extractor_inputs:SPACE", None, "is no function but"),
        ("extractor_inputs:narrow", None, r"must keep the shape \(2, 3, 15, 15\), but gives \(2, 3, 14, 15\)"),
        ("random_shift", {"pad": 4}, "'random_shift' does not take .* augment_kwargs={'pad': 4}: .*'pad'"),
        ("color_jitter", {"frame_channels": 2}, "frame_channels=2 are none"),
        (None, {"pad": 4}, "augment_kwargs={'pad': 4} belong to no augmentation"),
    ],
)
def test_mistakes(augment: str | None, kwargs: dict[str, Any] | None, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        VanillaExtractor(SPACE, augment=augment, augment_kwargs=kwargs)


def test_a_file_alone_has_no_augmentation_imported() -> None:
    kwargs = {"features_extractor_kwargs": {"augment": "antigravity:fly"}}
    with pytest.raises(ValueError, match=r"names the augmentation 'antigravity:fly'; .*--packages antigravity"):
        named_policy_kwargs(kwargs, "config.yml")
    kwargs["features_extractor_kwargs"]["augment"] = "random_shift"
    assert named_policy_kwargs(kwargs, "config.yml") == kwargs


def test_all_images_of_a_dictionary(path: Path) -> None:
    wide = spaces.Box(0, 255, (3, 40, 44), np.uint8)
    space = spaces.Dict({"camera": SPACE, "speed": spaces.Box(-1, 1, (2,)), "wide": wide})
    kwargs: dict[str, Any] = {"encoders": {"camera": str(path)}, "untrained": True}
    extractor = CombinedEncoderExtractor(space, **kwargs, augment="random_crop")
    plain = CombinedEncoderExtractor(space, **kwargs)
    inputs = {"camera": INPUTS, "speed": th.ones(6, 2), "wide": th.rand(6, 3, 40, 44)}
    before = extractor.eval()(inputs)
    after = extractor.train()(inputs)
    changed = (before != after).any(dim=0)
    # Gymnasium sorts keys.
    assert changed[:576].any() and not changed[576:578].any() and changed[578:].any()
    assert all(name.startswith("extractors.") for name in plain.state_dict())
    assert isinstance(plain.extractors["speed"], nn.Flatten)


def test_messages_say_so(path: Path) -> None:
    model = build("PPO", path, False, augment="color_jitter", augment_kwargs={"strength": 0.2})
    asked = copy.deepcopy(model.policy_kwargs)
    check_trained_with(model, asked)
    asked["features_extractor_kwargs"]["augment_kwargs"] = None
    with pytest.raises(ValueError, match=r"augment=color_jitter {'strength': 0.2}, not with .*augment=color_jitter$"):
        check_trained_with(model, asked)


@pytest.mark.parametrize("training", [True, False])
def test_an_exported_program_sees_plain_observations(path: Path, training: bool) -> None:
    extractor = ActionBisimExtractor(SPACE, str(path), augment="random_shift").train(training)
    program = th.export.export(extractor, (INPUTS,))
    assert th.allclose(program.module()(INPUTS), extractor.eval()(INPUTS), atol=1e-5)
