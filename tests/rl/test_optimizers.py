"""The encoder's own learning rate: the arithmetic, and inside each algorithm of Stable-Baselines3."""

import copy
import importlib
from pathlib import Path
from typing import Any

import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import ALGORITHMS, RandomImages, build, write
from torch import nn

from sb3_abisim.rl.extractors import ActionBisimExtractor, VanillaExtractor
from sb3_abisim.rl.optimizers import EncoderLRAdam, mark_encoder

# TRPO has no optimizer for its actor but its own; the optimizer of its policy trains the critic alone.
WITH_OPTIMIZER = [name for name in ALGORITHMS if name != "TRPO"]
LR = 0.01


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "e.safetensors")


def networks() -> tuple[nn.Linear, nn.Linear]:
    th.manual_seed(3)
    return nn.Linear(4, 3), nn.Linear(3, 2)


def loss(encoder: nn.Module, head: nn.Module, step: int) -> th.Tensor:
    inputs = th.randn(5, 4, generator=th.Generator().manual_seed(step))
    return (head(encoder(inputs)) - step).square().sum()


@pytest.mark.parametrize("kwargs", [{}, {"eps": 1e-5, "weight_decay": 0.1, "betas": (0.5, 0.9)}])
def test_equals_two_optimizers_of_torch(kwargs: dict[str, Any]) -> None:
    encoder, head = networks()
    mark_encoder(encoder)
    # Mixed order: an encoder's parameters stand wherever the policy has them.
    parameters = [head.weight, *encoder.parameters(), head.bias]
    ours = EncoderLRAdam(parameters, lr=1.0, encoder_lr_factor=0.125, **kwargs)
    plain_encoder, plain_head = networks()
    theirs = [
        th.optim.Adam(plain_encoder.parameters(), lr=LR / 8, **kwargs),
        th.optim.Adam(plain_head.parameters(), lr=LR, **kwargs),
    ]
    for step in range(5):
        rate = LR / (step + 1)
        for group in ours.param_groups:  # what SB3 does in train()
            group["lr"] = rate
        for optimizer, factor in zip(theirs, (0.125, 1.0), strict=True):
            optimizer.param_groups[0]["lr"] = rate * factor
        ours.zero_grad()
        loss(encoder, head, step).backward()
        ours.step()
        for optimizer in theirs:
            optimizer.zero_grad()
        loss(plain_encoder, plain_head, step).backward()
        for optimizer in theirs:
            optimizer.step()
        assert [group["lr"] for group in ours.param_groups] == [rate, rate]
        for module, plain in ((encoder, plain_encoder), (head, plain_head)):
            assert all(th.equal(a, b) for a, b in zip(module.parameters(), plain.parameters(), strict=True))


def test_closure_and_failure_leave_the_rate() -> None:
    encoder, head = networks()
    mark_encoder(encoder)
    optimizer = EncoderLRAdam([*encoder.parameters(), *head.parameters()], lr=LR, encoder_lr_factor=0.5)

    def fail() -> float:
        raise RuntimeError("no loss")

    assert optimizer.step(lambda: 1.5) == 1.5
    with pytest.raises(RuntimeError, match="no loss"):
        optimizer.step(fail)
    assert [group["lr"] for group in optimizer.param_groups] == [LR, LR]


def test_survives_deepcopy() -> None:
    """Copies of parameters lose their marks."""
    encoder, head = networks()
    mark_encoder(encoder)
    optimizer = EncoderLRAdam([*encoder.parameters(), *head.parameters()], lr=LR, encoder_lr_factor=0.5)
    twin_encoder, twin_head, twin = copy.deepcopy((encoder, head, optimizer))
    for modules, one in (((encoder, head), optimizer), ((twin_encoder, twin_head), twin)):
        loss(*modules, 1).backward()
        one.step()
    assert all(th.equal(a, b) for a, b in zip(encoder.parameters(), twin_encoder.parameters(), strict=True))


def test_a_factor_of_one_is_adam() -> None:
    """The default changes nothing."""
    encoder, head = networks()
    mark_encoder(encoder)
    plain_encoder, plain_head = networks()
    pairs = [
        (EncoderLRAdam([*encoder.parameters(), *head.parameters()], lr=LR), encoder, head),
        (th.optim.Adam([*plain_encoder.parameters(), *plain_head.parameters()], lr=LR), plain_encoder, plain_head),
    ]
    for optimizer, *modules in pairs:
        loss(*modules, 1).backward()
        optimizer.step()
    assert th.equal(encoder.weight, plain_encoder.weight) and th.equal(head.weight, plain_head.weight)


@pytest.mark.parametrize("factor", [0, -0.1, float("nan"), float("inf")])
def test_wrong_factor(factor: float) -> None:
    with pytest.raises(ValueError, match=r"above 0, got .*freeze=True"):
        EncoderLRAdam([], encoder_lr_factor=factor)


def with_rate(name: str, path: Path, factor: float) -> Any:
    """The model of the tests of extractors, with our optimizer, a fine-tuned encoder and no weight decay."""
    model = build(name, path, False)
    kwargs = copy.deepcopy(model.policy_kwargs)
    kwargs.pop("use_sde", None)
    kwargs |= {"optimizer_class": EncoderLRAdam, "optimizer_kwargs": {"encoder_lr_factor": factor, "eps": 1e-12}}
    algorithm, settings = ALGORITHMS[name]
    env = RandomImages(continuous=name in ("SAC", "TD3", "TQC"))
    return algorithm(type(model.policy), env, seed=5, device="cpu", learning_rate=LR, policy_kwargs=kwargs, **settings)


def optimizers(model: Any) -> list[EncoderLRAdam]:
    owners = [model.policy, getattr(model, "actor", None), getattr(model, "critic", None)]
    found = [getattr(owner, "optimizer", None) for owner in owners]
    return [optimizer for optimizer in found if optimizer is not None]


def test_a_new_optimizer_for_a_copy_of_a_policy(path: Path) -> None:
    model = with_rate("PPO", path, 0.5)
    twin = copy.deepcopy(model.policy)
    optimizer = EncoderLRAdam(twin.parameters(), lr=LR, encoder_lr_factor=0.5)
    groups = [{p.shape for p in group["params"]} for group in optimizer.param_groups]
    assert groups == [{p.shape for p in group["params"]} for group in model.policy.optimizer.param_groups]


class FirstStep:
    """How far an optimizer's first step moves heads and encoder at most, in units of the learning rate."""

    def __init__(self, optimizer: EncoderLRAdam) -> None:
        self.moved: list[float] = []
        self._before: list[list[th.Tensor]] = []
        optimizer.register_step_pre_hook(self._remember)
        optimizer.register_step_post_hook(self._compare)

    def _remember(self, optimizer: Any, *_: Any) -> None:
        self._before = [[p.detach().clone() for p in group["params"]] for group in optimizer.param_groups]

    def _compare(self, optimizer: Any, *_: Any) -> None:
        if not self.moved:
            groups = [group["params"] for group in optimizer.param_groups]
            for group, before in zip(groups, self._before, strict=True):
                changes = [(p.detach() - old).abs().max() for p, old in zip(group, before, strict=True)]
                self.moved.append(float(max(changes)) / LR)


@pytest.mark.parametrize("name", WITH_OPTIMIZER)
def test_inside_the_algorithms(path: Path, name: str) -> None:
    model = with_rate(name, path, 0.25)
    steps = [FirstStep(optimizer) for optimizer in optimizers(model)]
    assert len(steps) == (2 if name in ("SAC", "TD3", "TQC") else 1)
    model.learn(24)
    for step in steps:
        # Adam's first step moves each number by the learning rate times the sign of its gradient.
        assert step.moved == pytest.approx([1.0, 0.25], rel=1e-3)
    # Saved and loaded without the file, the factor and the moments are as they were, and training goes on.
    model.save(path.parent / "model.zip")
    path.unlink()
    loaded = type(model).load(
        path.parent / "model.zip", env=RandomImages(continuous=name in ("SAC", "TD3", "TQC")), device="cpu"
    )
    for before, after in zip(optimizers(model), optimizers(loaded), strict=True):
        assert type(after) is EncoderLRAdam
        assert [group["lr_factor"] for group in after.param_groups] == [1.0, 0.25]
        states, restored = before.state_dict()["state"], after.state_dict()["state"]
        assert states.keys() == restored.keys() and len(states) > 0
        assert all(th.equal(states[key]["exp_avg"], restored[key]["exp_avg"]) for key in states)
    loaded.learn(16)
    # The encoder's gradient still belongs to the encoder.
    for optimizer in optimizers(loaded):
        names = {id(p): key for key, p in loaded.policy.named_parameters()}
        assert all("features_extractor.encoder" in names[id(p)] for p in optimizer.param_groups[1]["params"])
        assert not any("features_extractor" in names[id(p)] for p in optimizer.param_groups[0]["params"])


def test_untrained_network() -> None:
    kwargs = {
        "features_extractor_class": VanillaExtractor,
        "optimizer_class": EncoderLRAdam,
        "optimizer_kwargs": {"encoder_lr_factor": 0.5},
    }
    model = sb3.PPO("CnnPolicy", RandomImages(), n_steps=8, batch_size=8, policy_kwargs=kwargs, device="cpu")
    assert [len(group["params"]) for group in optimizers(model)[0].param_groups] == [12, 6]


def test_without_an_encoder_to_train(path: Path) -> None:
    rate = {"optimizer_class": EncoderLRAdam, "optimizer_kwargs": {"encoder_lr_factor": 0.5}}
    frozen = {"features_extractor_class": ActionBisimExtractor, "features_extractor_kwargs": {"encoder": str(path)}}
    frozen["features_extractor_kwargs"]["freeze"] = True
    shared = copy.deepcopy(frozen) | {"share_features_extractor": True}
    shared["features_extractor_kwargs"]["freeze"] = False
    for algorithm, policy, env, kwargs in [
        (sb3.PPO, "MlpPolicy", RandomImages(), {}),
        (sb3.PPO, "CnnPolicy", RandomImages(), frozen),
        (sb3.SAC, "CnnPolicy", RandomImages(continuous=True), shared),
    ]:
        with pytest.raises(ValueError, match=r"encoder_lr_factor=0\.5, but none of \d+ parameters is an encoder's"):
            algorithm(policy, env, device="cpu", policy_kwargs=kwargs | copy.deepcopy(rate))


def test_from_yaml(path: Path) -> None:
    """The text of a zoo YAML, evaluated where the zoo evaluates it."""
    namespace = vars(importlib.import_module("rl_zoo3.exp_manager"))
    text = (
        "dict(features_extractor_class=get_class_by_name('sb3_abisim.rl.extractors.ActionBisimExtractor'), "
        f"features_extractor_kwargs={{'encoder': {str(path)!r}}}, "
        "optimizer_class=get_class_by_name('sb3_abisim.rl.optimizers.EncoderLRAdam'), "
        "optimizer_kwargs={'encoder_lr_factor': 0.1, 'eps': 1e-5})"
    )
    model = sb3.DQN("CnnPolicy", RandomImages(), buffer_size=50, policy_kwargs=eval(text, namespace), device="cpu")
    (optimizer,) = optimizers(model)
    assert [group["lr_factor"] for group in optimizer.param_groups] == [1.0, 0.1]
    assert [group["eps"] for group in optimizer.param_groups] == [1e-5, 1e-5]
