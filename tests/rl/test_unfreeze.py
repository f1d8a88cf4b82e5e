"""Frozen encoders that are fine-tuned later on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import OBSERVATIONS, SPACE, VARIANTS, RandomImages, build, write
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_abisim import ActionBisimExtractor, EncoderCallback, VecEncodeObservations, load_encoder, unfreeze_encoder
from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.rl.extractors import PretrainedExtractor

pytestmark = pytest.mark.usefixtures("batch_norm_is_known")


def shapes(optimizer: th.optim.Optimizer) -> list[tuple[int, ...]]:
    return [tuple(parameter.shape) for group in optimizer.param_groups for parameter in group["params"]]


def optimizers(policy: Any) -> list[th.optim.Optimizer]:
    owners = (policy, getattr(policy, "actor", None), getattr(policy, "critic", None))
    return [owner.optimizer for owner in owners if getattr(owner, "optimizer", None) is not None]


@pytest.mark.parametrize("name, other_sharing", VARIANTS)
def test_training_goes_on_with_the_encoder(tmp_path: Path, name: str, other_sharing: bool) -> None:
    path = write(tmp_path / "e.safetensors")
    model = build(name, path, True, other_sharing)
    model.learn(24)
    kwargs = model.policy_kwargs
    before = {id(p): dict(o.state[p]) for o in optimizers(model.policy) for g in o.param_groups for p in g["params"]}
    unfreeze_encoder(model)
    # As a model that was never frozen, in the same order.
    never = build(name, path, False, other_sharing)
    assert list(map(shapes, optimizers(model.policy))) == list(map(shapes, optimizers(never.policy)))
    assert [n for n, _ in model.policy.named_parameters()] == [n for n, _ in never.policy.named_parameters()]
    after = {id(p): dict(o.state[p]) for o in optimizers(model.policy) for g in o.param_groups for p in g["params"]}
    assert any(before.values()) and len(after) > len(before)
    for parameter, state in before.items():
        assert all(value is after[parameter][key] for key, value in state.items())
    assert kwargs["features_extractor_kwargs"]["freeze"] is True
    model.learn(24, reset_num_timesteps=False)
    for _, extractor in find_extractors(model.policy):
        assert 0.0 < extractor.relative_weight_change() < 10.0 and not extractor.frozen
        assert extractor.hash == load_encoder(path).hash
    model.save(tmp_path / "model.zip")
    path.unlink()
    loaded = type(model).load(tmp_path / "model.zip", env=RandomImages(name in ("SAC", "TD3", "TQC")), device="cpu")
    state = loaded.policy.state_dict()
    assert all(th.equal(value, state[key]) for key, value in model.policy.state_dict().items())
    loaded.learn(16, reset_num_timesteps=False)
    assert np.isfinite(loaded.predict(OBSERVATIONS, deterministic=True)[0]).all()


def test_the_extractor_alone(tmp_path: Path) -> None:
    path = str(write(tmp_path / "e.safetensors", "BatchNorm"))
    frozen, trained = (ActionBisimExtractor(SPACE, path, freeze, network="BatchNorm") for freeze in (True, False))
    frozen.train()
    x = th.from_numpy(OBSERVATIONS).float() / 255
    output = frozen(x)
    new = frozen.unfreeze()
    assert [p.shape for p in new] == [p.shape for p in trained.encoder.parameters()] and not frozen.frozen
    assert [name for name, _ in frozen.named_parameters()] == [name for name, _ in trained.named_parameters()]
    assert all(a is b for a, b in zip(new, frozen.parameters(), strict=True))
    (norm,) = (module for module in frozen.modules() if isinstance(module, nn.BatchNorm2d))
    assert norm.training and th.equal(frozen.eval()(x), output) and frozen.unfreeze() == []
    assert frozen(x).requires_grad
    assert frozen.relative_weight_change() == 0.0


def test_nothing_to_unfreeze(tmp_path: Path) -> None:
    path = write(tmp_path / "e.safetensors")
    with pytest.raises(ValueError, match="holds no frozen encoder"):
        unfreeze_encoder(build("PPO", path, False))


class Own(PretrainedExtractor):
    """A custom extractor that is always frozen."""

    def __init__(self, observation_space: Any, encoder: str) -> None:
        super().__init__(observation_space, encoder, freeze=True)


def test_a_model_that_could_not_be_loaded_again_is_left_as_it_is(tmp_path: Path) -> None:
    path = write(tmp_path / "e.safetensors")
    kwargs = {"features_extractor_class": Own, "features_extractor_kwargs": {"encoder": str(path)}}
    model = sb3.PPO("CnnPolicy", RandomImages(), policy_kwargs=kwargs, device="cpu")
    with pytest.raises(ValueError, match=r"hold no freeze=True.*take freeze as an argument"):
        unfreeze_encoder(model)
    assert find_extractors(model.policy)[0][1].frozen


# At a step of a run.


class Steps(BaseCallback):
    """Notes at which step each update came, and whether it moved the encoder."""

    def _on_training_start(self) -> None:
        self.found: list[tuple[int, bool]] = []
        self._old = self._weights()

    def _weights(self) -> list[th.Tensor]:
        return [e._flat_weights().clone() for _, e in find_extractors(self.model.policy)]

    def _on_rollout_start(self) -> None:
        new = self._weights()
        self.found.append((self.num_timesteps, any(not th.equal(a, b) for a, b in zip(self._old, new, strict=True))))
        self._old = new

    def _on_step(self) -> bool:
        return True


def continuous(name: str) -> bool:
    return name in ("SAC", "TD3", "TQC")


@pytest.mark.parametrize("name, other_sharing", VARIANTS)
def test_at_a_step(tmp_path: Path, name: str, other_sharing: bool, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "e.safetensors", "BatchNorm")
    more = {} if name in ("A2C", "QRDQN") else {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {}}
    model = build(name, path, True, other_sharing, more, network="BatchNorm")
    target = getattr(model, "critic_target", getattr(model, "q_net_target", None))
    settings: dict[str, Any] = {"unfreeze_at": 15}
    if name != "TRPO":
        settings["encoder_lr"] = "lin_1e-3"
    if continuous(name) and other_sharing:
        settings["encoder_trained_by"] = "critic"
    steps = Steps()
    model.learn(32, callback=CallbackList([EncoderCallback(**settings), steps]))
    # An update is noted with the step of the rollout that comes after it.
    assert {moved for step, moved in steps.found if step < 15} == {False}
    updates = {step: moved for step, moved in steps.found if step >= 15}
    assert all(updates.values()) and min(updates) == 16
    out = capsys.readouterr().out
    assert out.count("Encoder: frozen until step 15") == 1 and out.count("Encoder: fine-tuned from step 16 on") == 1
    if target is not None:
        (frozen,) = {module.frozen for module in target.modules() if isinstance(module, PretrainedExtractor)}
        (moved,) = {m.relative_weight_change() > 0 for m in target.modules() if isinstance(m, PretrainedExtractor)}
        assert not frozen and moved


def test_the_update_at_the_step_itself_trains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "e.safetensors", "BatchNorm")
    for unfreeze_at in (16, 17):
        build("PPO", path, True, network="BatchNorm").learn(32, callback=EncoderCallback(unfreeze_at=unfreeze_at))
        is_at_16 = "Encoder: fine-tuned from step 16 on" in capsys.readouterr().out
        assert is_at_16 == (unfreeze_at == 16)


@pytest.mark.parametrize("name", ["PPO", "A2C", "DQN", "SAC", "TD3"])
@pytest.mark.parametrize("before", [True, False])
def test_continued_on_either_side(tmp_path: Path, name: str, before: bool) -> None:
    path = write(tmp_path / "e.safetensors")
    settings: dict[str, Any] = {"unfreeze_at": 15, "encoder_lr": 1e-4}
    if continuous(name):
        settings["encoder_trained_by"] = "critic"
    states = []
    for is_loaded in (False, True):
        model = build(name, path, True, continuous(name))
        model.learn(8 if before else 24, callback=EncoderCallback(**settings))
        model.save(tmp_path / "model.zip")
        if is_loaded:
            loaded = type(model).load(tmp_path / "model.zip", env=RandomImages(continuous(name)), device="cpu")
            loaded.replay_buffer = getattr(model, "replay_buffer", None)
            model = loaded
        else:
            model.set_env(RandomImages(continuous(name)))
        model.set_random_seed(3)
        model._last_obs = None
        # Steps are counted anew where rl-zoo3 continues a run.
        model.learn(24, callback=EncoderCallback(**settings), reset_num_timesteps=before)
        assert not find_extractors(model.policy)[0][1].frozen
        assert find_extractors(model.policy)[0][1].relative_weight_change() > 0
        states.append(model.policy.state_dict())
    assert all(th.equal(value, states[1][key]) for key, value in states[0].items())


def test_what_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "e.safetensors")
    for wrong in (0, -5, 1.5, "100", True):
        with pytest.raises(ValueError, match="unfreeze_at must be a whole number of environment steps above 0, got"):
            EncoderCallback(unfreeze_at=wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="unfreeze_at=9, but the policy holds no frozen encoder; give freeze"):
        build("PPO", path, False).learn(8, callback=EncoderCallback(unfreeze_at=9))
    env = VecEncodeObservations(DummyVecEnv([RandomImages]), str(path), device="cpu")
    model = sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(ValueError, match=r"embeds observations in the environment.*give freeze: true"):
        model.learn(8, callback=EncoderCallback(unfreeze_at=9))
    kwargs = {"features_extractor_class": Own, "features_extractor_kwargs": {"encoder": str(path)}}
    own = sb3.PPO("CnnPolicy", RandomImages(), n_steps=8, batch_size=8, policy_kwargs=kwargs, device="cpu")
    # Before anything is learned, and not when the step has come.
    with pytest.raises(ValueError, match="take freeze as an argument"):
        own.learn(8, callback=EncoderCallback(unfreeze_at=9))
    assert own.num_timesteps == 0
    never = build("PPO", path, True)
    never.learn(8, callback=EncoderCallback(unfreeze_at=9))
    assert find_extractors(never.policy)[0][1].frozen
