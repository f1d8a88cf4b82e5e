"""Which loss moves which parameters of SAC, TD3 and TQC, and the encoder that actor and critic share."""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import OBSERVATIONS, RandomImages, build
from stable_baselines3.common.torch_layers import NatureCNN

from sb3_abisim import EncoderCallback
from sb3_abisim.rl.fine_tuning import FineTuning

OFF_POLICY = ("SAC", "TD3", "TQC")
LOSSES = ("critic", "actor")


def make(name: str, path: Path, shared: bool = True, freeze: bool = False, optimizer: Any = th.optim.Adam) -> Any:
    """A model with a filled buffer and without the loss of SAC's entropy."""
    more = {"optimizer_class": optimizer, "optimizer_kwargs": {}}
    model = build(name, path, freeze, shared, more)
    model.learning_starts = 1000
    model.learn(12)
    model.learning_starts = 0
    if name != "TD3":
        model.ent_coef_optimizer, model.ent_coef_tensor = None, th.tensor(0.1)
    return model


@contextmanager
def loss_alone(kept: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Of the two losses of an update, which come in this order, one has the gradient zero."""
    backward, calls = th.Tensor.backward, [0]

    def scaled(loss: th.Tensor, *args: Any, **kwargs: Any) -> None:
        name = LOSSES[calls[0] % 2]
        calls[0] += 1
        backward(loss if name == kept else loss * 0, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(th.Tensor, "backward", scaled)
        yield
    assert calls[0] == 2


def moved(model: Any, kept: str, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> set[str]:
    """The parts of the policy, without targets, that one update by one of the losses moves."""
    old = copy.deepcopy(model.policy.state_dict())
    tuning = FineTuning(**settings)
    tuning.install(model)
    with loss_alone(kept, monkeypatch):
        model.train(gradient_steps=1, batch_size=4)
    tuning.remove(model)
    changed = set()
    for name, value in model.policy.state_dict().items():
        owner, part = name.split(".")[:2]
        if not th.equal(value, old[name]) and not owner.endswith("_target"):
            changed.add(f"{owner}.encoder" if part == "features_extractor" else owner)
    return changed


@pytest.mark.parametrize("name", OFF_POLICY)
def test_which_loss_moves_which_parameters(path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    both = {"actor.encoder", "critic.encoder"}
    for shared, kept, settings, expected in (
        (False, "critic", {}, {"critic", "critic.encoder"}),
        (False, "actor", {}, {"actor", "actor.encoder"}),
        (True, "critic", {}, {"critic"}),
        (True, "actor", {}, {"actor", *both}),
        (True, "critic", {"encoder_trained_by": "critic"}, {"critic", *both}),
        (True, "actor", {"encoder_trained_by": "critic"}, {"actor"}),
        (True, "critic", {"encoder_trained_by": "critic", "encoder_lr": 1e-5}, {"critic", *both}),
    ):
        model = make(name, path, shared)
        assert moved(model, kept, monkeypatch, **settings) == expected, (shared, kept, settings)  # type: ignore[arg-type]


class Nested(th.optim.Adam):
    """A step that calls its parent's, both with torch's hooks."""

    def step(self, closure: Callable[[], float] | None = None) -> Any:  # type: ignore[override]
        return super().step(closure)


@pytest.mark.parametrize("optimizer", [th.optim.SGD, th.optim.AdamW, Nested])
@pytest.mark.parametrize("name", OFF_POLICY)
def test_the_encoder_makes_one_step_by_the_gradient_of_the_critics_loss(path: Path, name: str, optimizer: Any) -> None:
    """Compared with the same loss computed here, for two updates, the second one with what the first has left."""
    model = make(name, path, optimizer=optimizer)
    encoder = list(model.critic.features_extractor.parameters())
    twins = [th.nn.Parameter(p.detach().clone()) for p in encoder]
    reference = optimizer(twins, lr=0.01)
    model.learning_rate = 0.01
    model._setup_lr_schedule()
    gradients: list[list[th.Tensor]] = []
    backward = th.Tensor.backward

    def note(loss: th.Tensor) -> None:
        if len(gradients) % 2 == 0:
            gradients.append(list(th.autograd.grad(loss, encoder, retain_graph=True)))
        else:
            # The actor's does not reach the encoder at all.
            found = th.autograd.grad(loss, encoder, retain_graph=True, allow_unused=True)
            gradients.append([])
            assert found == (None,) * len(encoder)
        backward(loss)

    tuning = FineTuning(encoder_trained_by="critic")
    tuning.install(model)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(th.Tensor, "backward", note)
        model.train(gradient_steps=2, batch_size=4)
    for found in gradients[::2]:
        for twin, gradient in zip(twins, found, strict=True):
            twin.grad = gradient
        reference.step()
    assert all(th.equal(a, b) for a, b in zip(encoder, twins, strict=True))
    tuning.remove(model)
    assert model.critic.share_features_extractor is True


@pytest.mark.parametrize("name", OFF_POLICY)
def test_targets_follow_and_the_model_is_saved_and_goes_on(path: Path, name: str) -> None:
    model = build(name, path, False, True)
    target = model.critic_target.features_extractor
    before = [p.clone() for p in target.parameters()]
    model.learn(8, callback=EncoderCallback(encoder_trained_by="critic"))
    old, model.tau = [p.clone() for p in target.parameters()], 0.3
    assert not any(th.equal(a, b) for a, b in zip(before, old, strict=True))
    tuning = FineTuning(encoder_trained_by="critic")
    tuning.install(model)
    model.train(gradient_steps=1, batch_size=4)
    # Stable-Baselines3 averages the target encoder of TD3 with that of the actor and that of the critic, which are one.
    kept = 0.7**2 if name == "TD3" else 0.7
    for a, b, new in zip(old, target.parameters(), model.critic.features_extractor.parameters(), strict=True):
        assert th.allclose(b, kept * a + (1 - kept) * new, atol=1e-6)
    tuning.remove(model)
    model.save(path.parent / "model.zip")
    path.unlink()
    loaded = type(model).load(path.parent / "model.zip", env=RandomImages(True), device="cpu")
    owner = "critic" if name == "TD3" else "actor"
    states = [
        getattr(m, owner).optimizer.state[p] for m in (model, loaded) for p in m.critic.features_extractor.parameters()
    ]
    half = len(states) // 2
    for one, other in zip(states[:half], states[half:], strict=True):
        assert len(one) > 0 and all(th.equal(one[key], other[key]) for key in one)
    loaded.learn(16, callback=EncoderCallback(encoder_trained_by="critic"), reset_num_timesteps=False)
    assert np.isfinite(loaded.predict(OBSERVATIONS)[0]).all()


def test_any_extractor_can_be_shared(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a subclass of an algorithm is one."""
    kwargs = {"features_extractor_class": NatureCNN, "share_features_extractor": True, "net_arch": [8]}
    env = RandomImages(True)
    env.observation_space = type(env.observation_space)(0, 255, (3, 36, 36), np.uint8)
    for kept, expected in (("critic", {"critic", "actor.encoder", "critic.encoder"}), ("actor", {"actor"})):
        model = sb3.DDPG("CnnPolicy", env, policy_kwargs=kwargs, buffer_size=50, learning_starts=20, device="cpu")
        model.learn(12)
        assert moved(model, kept, monkeypatch, encoder_trained_by="critic") == expected


def test_what_is_refused(path: Path) -> None:
    for name in ("PPO", "A2C", "TRPO", "RecurrentPPO", "DQN", "QRDQN"):
        with pytest.raises(ValueError, match=f"is for SAC, TD3 and TQC, .*; {name} has one loss"):
            build(name, path, False).learn(8, callback=EncoderCallback(encoder_trained_by="critic"))
    for name in OFF_POLICY:
        model = build(name, path, False)
        with pytest.raises(ValueError, match=rf"of this {name} have an encoder each.*share_features_extractor=True"):
            model.learn(8, callback=EncoderCallback(encoder_trained_by="critic"))
        assert model.num_timesteps == 0
    crossq = sb3_contrib.CrossQ("MlpPolicy", RandomImages(True), policy_kwargs={"net_arch": [8]}, buffer_size=10)
    with pytest.raises(ValueError, match="CrossQ has one loss or optimizes the policy otherwise"):
        crossq.learn(8, callback=EncoderCallback(encoder_trained_by="critic"))
    with pytest.raises(ValueError, match="encoder_trained_by must be 'critic', got 'actor'"):
        EncoderCallback(encoder_trained_by="actor")
    frozen = build("SAC", path, True, True)
    with pytest.raises(ValueError, match="the policy holds none"):
        frozen.learn(8, callback=EncoderCallback(encoder_trained_by="critic"))
