"""The encoder's own learning rate inside the algorithms of Stable-Baselines3."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import ALGORITHMS, VARIANTS, RandomImages, build
from stable_baselines3.common.callbacks import CallbackList, ConvertCallback
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

from sb3_abisim import EncoderCallback
from sb3_abisim.rl.extractors import VanillaExtractor
from sb3_abisim.rl.fine_tuning import FineTuning, make_schedule

# TRPO moves its policy without an optimizer.
WITH_OPTIMIZER = [(name, other_sharing) for name, other_sharing in VARIANTS if name != "TRPO"]
CONTINUOUS = ("SAC", "TD3", "TQC")
LR = 0.002


class Recording:
    """Notes the learning rate of each parameter while an optimizer steps, and the progress that remains then."""

    model: ClassVar[Any] = None
    steps: ClassVar[list[tuple[float, dict[int, float]]]] = []

    def step(self, closure: Callable[[], float] | None = None) -> Any:
        # Some tests take this optimizer alone, and no notes.
        if self.model is not None:
            rates = {id(p): g["lr"] for g in self.param_groups for p in g["params"]}  # type: ignore[attr-defined]
            self.steps.append((self.model._current_progress_remaining, rates))
        return super().step(closure)  # type: ignore[misc]


class RecordingAdam(Recording, th.optim.Adam): ...


class RecordingAdamW(Recording, th.optim.AdamW): ...


class RecordingSGD(Recording, th.optim.SGD): ...


class RecordingRMSprop(Recording, th.optim.RMSprop): ...


class RecordingRMSpropTFLike(Recording, RMSpropTFLike): ...


OPTIMIZERS = [RecordingAdam, RecordingAdamW, RecordingSGD, RecordingRMSprop, RecordingRMSpropTFLike]


def recorded(model: Any, n_timesteps: int = 24, **settings: Any) -> list[tuple[float, dict[int, float]]]:
    """What the optimizers' steps of a run have seen."""
    Recording.model = model
    Recording.steps.clear()
    model.learn(n_timesteps, callback=EncoderCallback(**settings))
    assert len(Recording.steps) > 1
    return list(Recording.steps)


def make(name: str, path: Path, optimizer: Any = RecordingSGD, freeze: bool = False, sharing: bool = False) -> Any:
    model = build(name, path, freeze, sharing, {"optimizer_class": optimizer, "optimizer_kwargs": {}})
    model.learning_rate = lambda progress: LR * (0.5 + progress)
    model._setup_lr_schedule()
    return model


def encoder_ids(model: Any) -> set[int]:
    return {id(p) for name, p in model.policy.named_parameters() if "features_extractor.encoder" in name}


def check(model: Any, steps: list[Any], expected: Callable[[float, float], float]) -> None:
    """All parameters but the encoder's had Stable-Baselines3's rate, and the encoder's what is expected of it."""
    encoder = encoder_ids(model)
    met = set()
    for progress, rates in steps:
        theirs = model.lr_schedule(progress)
        for parameter, rate in rates.items():
            is_encoder = parameter in encoder
            assert rate == (expected(progress, theirs) if is_encoder else theirs)
            met.add(is_encoder)
    assert met == {True, False}
    assert len({progress for progress, _ in steps}) > 1


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_each_optimizer(path: Path, name: str, optimizer: Any) -> None:
    model = make(name, path, optimizer)
    check(model, recorded(model, encoder_lr="lin_1e-4"), lambda progress, _: progress * 1e-4)
    check(model, recorded(model, encoder_lr_factor=0.1), lambda _, lr: lr * 0.1)


@pytest.mark.parametrize("name", ["encoder_lr", "encoder_lr_factor"])
def test_a_schedule_ends_at_0_where_the_last_rollout_goes_beyond_the_end(path: Path, name: str) -> None:
    model = make("PPO", path)
    steps = recorded(model, 20, **{name: "lin_0.5"})
    assert steps[-1][0] < 0, "rollouts of 8 steps"
    of_encoder = [rates[i] for progress, rates in steps for i in encoder_ids(model)]
    assert of_encoder[0] > 0
    assert of_encoder[-1] == 0


@pytest.mark.parametrize("name, other_sharing", WITH_OPTIMIZER)
def test_each_algorithm(path: Path, name: str, other_sharing: bool) -> None:
    model = make(name, path, sharing=other_sharing)
    rate: dict[str, Any] = {"encoder_lr_factor": lambda progress: progress**2}
    check(model, recorded(model, **rate), lambda progress, lr: lr * progress**2)
    # Without the callback, it is Stable-Baselines3 alone again.
    Recording.steps.clear()
    model.learn(24)
    check(model, Recording.steps, lambda _, lr: lr)
    model.save(path.parent / "model.zip")
    loaded = type(model).load(path.parent / "model.zip", env=RandomImages(name in CONTINUOUS), device="cpu")
    check(loaded, recorded(loaded, encoder_lr=3e-4), lambda progress, lr: 3e-4)


@pytest.mark.parametrize("name", ["A2C", "DQN", "TD3"])
def test_a_run_that_is_continued_goes_on_as_it_would_have(path: Path, name: str) -> None:
    """Saved between two updates, with the moments of Adam, and not by way of the callback."""
    states = []
    for is_loaded in (False, True):
        model = make(name, path, th.optim.Adam)
        model.learn(16, callback=EncoderCallback(encoder_lr=1e-4))
        model.save(path.parent / "model.zip")
        env = RandomImages(name in CONTINUOUS)
        if is_loaded:
            custom = {"learning_rate": model.learning_rate}
            loaded = type(model).load(path.parent / "model.zip", env=env, device="cpu", custom_objects=custom)
            loaded.replay_buffer = getattr(model, "replay_buffer", None)
            model = loaded
        else:
            model.set_env(env)
        model.set_random_seed(3), model.env.seed(3)
        model._last_obs = None
        model.learn(16, callback=EncoderCallback(encoder_lr=1e-4), reset_num_timesteps=False)
        states.append(copy.deepcopy(model.policy.state_dict()))
    assert all(th.equal(value, states[1][key]) for key, value in states[0].items())


def test_the_rate_is_logged(path: Path) -> None:
    model = make("PPO", path)
    seen: list[float] = []
    dump = model.dump_logs

    def look(*args: Any) -> None:
        seen.append(model.logger.name_to_value.get("encoder/learning_rate"))
        dump(*args)

    model.dump_logs = look
    model.learn(24, callback=EncoderCallback(encoder_lr="lin_3e-4"))
    assert seen[1:] == pytest.approx([3e-4 * 2 / 3, 3e-4 / 3])


def test_a_run_that_fails_leaves_nothing_behind(path: Path) -> None:
    model = make("PPO", path)
    callback = EncoderCallback(encoder_lr=lambda progress: -1.0)
    with pytest.raises(ValueError, match=r"encoder_lr is -1\.0 at remaining progress .*let its schedule"):
        model.learn(16, callback=callback)
    check(model, recorded(model, encoder_lr=1e-5), lambda *_: 1e-5)

    def fail(*_: Any) -> bool:
        if model.num_timesteps > 12:
            raise RuntimeError("the environment is gone")
        return True

    with pytest.raises(RuntimeError, match="is gone"):
        model.learn(16, callback=CallbackList([EncoderCallback(encoder_lr=1e-5), ConvertCallback(fail)]))
    check(model, recorded(model, encoder_lr_factor=0.5), lambda _, lr: lr / 2)
    assert len(model.policy.optimizer.param_groups) == 1
    assert not any(isinstance(value, FineTuning) for value in vars(model.policy).values())


def test_untrained_network() -> None:
    kwargs = {"features_extractor_class": VanillaExtractor, "optimizer_class": RecordingAdam, "optimizer_kwargs": {}}
    model = sb3.PPO("CnnPolicy", RandomImages(), n_steps=8, batch_size=8, policy_kwargs=kwargs, device="cpu")
    check(model, recorded(model, encoder_lr_factor=0.5), lambda _, lr: lr / 2)


def test_schedules() -> None:
    for value, at_half in ((3e-4, 3e-4), ("3e-4", 3e-4), ("lin_3e-4", 1.5e-4), (2, 2), (lambda p: p**2, 0.25)):
        assert make_schedule(value, "n")(0.5) == at_half  # type: ignore[arg-type]
    for wrong in (0, -1e-4, "lin_0", "lin_", "cos_1e-3", "1e-3_lin", float("nan"), float("inf"), True, [1]):
        with pytest.raises(ValueError, match="encoder_lr must be a number above 0, lin_NUMBER or a function"):
            EncoderCallback(encoder_lr=wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="encoder_lr=1 and encoder_lr_factor='lin_2': give one of them"):
        EncoderCallback(1, "lin_2")


def test_what_is_refused(path: Path) -> None:
    rate: dict[str, Any] = {"encoder_lr": 1e-4}
    with pytest.raises(ValueError, match="encoder_lr with TRPO, whose policy is moved by a line search"):
        build("TRPO", path, False).learn(8, callback=EncoderCallback(**rate))
    plain = sb3.PPO("MlpPolicy", RandomImages(), n_steps=8, batch_size=8, device="cpu")
    for model in (make("PPO", path, freeze=True), plain):
        with pytest.raises(ValueError, match=r"an encoder that RL trains, and the policy holds none.*freeze=False"):
            model.learn(8, callback=EncoderCallback(**rate))
        assert model.num_timesteps == 0
    callbacks = CallbackList([EncoderCallback(**rate), EncoderCallback()])
    with pytest.raises(ValueError, match="2 callbacks are EncoderCallbacks; give one"):
        make("PPO", path).learn(8, callback=callbacks)


def test_nothing_asked_for_changes_nothing(path: Path) -> None:
    states = []
    for callback in (None, EncoderCallback()):
        model = build("SAC", path, False)
        model.set_random_seed(7)
        model.learn(24, callback=callback)
        states.append(model.policy.state_dict())
    assert all(np.array_equal(value, states[1][key]) for key, value in states[0].items())
    assert set(ALGORITHMS) >= {name for name, _ in WITH_OPTIMIZER}
