"""What a run reports of its encoder, and when it refuses to start."""

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecFrameStack, VecNormalize

from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import save_encoder
from sb3_abisim.rl.callbacks import EncoderCallback
from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.rl.extractors import ActionBisimExtractor, VanillaExtractor
from sb3_abisim.rl.vec_encode import VecEncodeObservations


class Grid(gym.Env):
    """Random 15 x 15 observations with discrete or continuous actions."""

    observation_space = spaces.Box(0, 255, (3, 15, 15), np.uint8)

    def __init__(self, continuous: bool = False) -> None:
        self.action_space = spaces.Box(-1, 1, (2,)) if continuous else spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.np_random.integers(0, 256, (3, 15, 15), np.uint8), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation = self.np_random.integers(0, 256, (3, 15, 15), np.uint8)
        return observation, float(observation[0, 0, 0]), bool(self.np_random.random() < 0.1), False, {}


class Recorder(Logger):
    """Keeps every recorded value, which SB3's logger forgets at each dump."""

    def __init__(self) -> None:
        super().__init__(None, [])
        self.values: list[float] = []

    def record(self, key: str, value: Any, exclude: Any = None) -> None:
        if key == "encoder/relative_weight_change":
            self.values.append(value)


SAVED: dict[str, Any] = {
    "observation_space": Grid.observation_space,
    "action_space": spaces.Discrete(4),
    "env_id": "Nav2D-v0",
    "env_kwargs": {},
    "objective": "abisim",
    "settings": {},
    "dataset_hash": "0" * 64,
    "reference_observations": np.zeros((1, 3, 15, 15), np.uint8) + 9,
}


@pytest.fixture
def encoder(tmp_path: Path) -> tuple[str, str]:
    path = tmp_path / "mine.safetensors"
    hash = save_encoder(path, make_encoder(Grid.observation_space), **SAVED)
    return str(path), hash


def policy_kwargs(encoder: str, freeze: bool = False) -> dict[str, Any]:
    kwargs = {"encoder": encoder, "freeze": freeze}
    return {"features_extractor_class": ActionBisimExtractor, "features_extractor_kwargs": kwargs}


def learn(model: BaseAlgorithm, n_timesteps: int) -> list[float]:
    recorder = Recorder()
    model.set_logger(recorder)
    model.learn(n_timesteps, callback=EncoderCallback())
    return recorder.values


@pytest.mark.parametrize("freeze", [True, False])
def test_ppo(encoder: tuple[str, str], freeze: bool, capsys: pytest.CaptureFixture[str]) -> None:
    path, hash = encoder
    model = PPO("CnnPolicy", Grid(), n_steps=16, batch_size=16, n_epochs=1, policy_kwargs=policy_kwargs(path, freeze))
    changes = learn(model, 48)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Encoder")]
    n_parameters = sum(p.numel() for p in make_encoder(Grid.observation_space).parameters())
    state = "frozen" if freeze else "fine-tuned"
    assert lines == [
        f"Encoder features_extractor: ActionBisimExtractor, source {path}, hash {hash}, "
        f"{n_parameters} parameters, {state}"
    ]
    assert len(changes) == 3 and changes[0] == 0.0
    assert changes[1:] == [0.0, 0.0] if freeze else 0.0 < changes[1] < changes[2]


def test_relative_weight_change_is_the_largest_of_several(
    encoder: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    model = SAC("CnnPolicy", Grid(True), buffer_size=50, learning_starts=100, policy_kwargs=policy_kwargs(encoder[0]))
    with th.no_grad():
        for factor, (_, extractor) in zip((1.5, 1.25), find_extractors(model.policy), strict=True):
            for parameter in extractor.encoder.parameters():
                parameter *= factor
    assert learn(model, 1) == [pytest.approx(0.5)]
    named = re.findall(r"Encoder (\S+):", capsys.readouterr().out)
    assert named == ["actor.features_extractor", "critic.features_extractor"]


def test_missing_weights_stop_training_before_the_first_step() -> None:
    model = DQN("CnnPolicy", Grid(), buffer_size=50, policy_kwargs=policy_kwargs("no/such.safetensors"))
    with pytest.raises(FileNotFoundError, match=r"no/such\.safetensors"):
        learn(model, 10)
    assert model.num_timesteps == 0


def test_a_model_of_another_encoders_embeddings_does_not_go_on(encoder: tuple[str, str], tmp_path: Path) -> None:
    def environment(file: str) -> VecNormalize:
        return VecNormalize(VecEncodeObservations(DummyVecEnv([Grid]), file, device="cpu"), norm_obs=False)

    other = str(Path(encoder[0]).with_name("other.safetensors"))
    th.manual_seed(1)
    save_encoder(
        Path(other),
        make_encoder(Grid.observation_space),
        **{**SAVED, "objective": "ssi"},
    )
    env = environment(encoder[0])
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu")
    learn(model, 8)
    model.save(tmp_path / "model.zip"), env.save(str(tmp_path / "vecnormalize.pkl"))
    for file in (encoder[0], other):
        loaded = VecNormalize.load(str(tmp_path / "vecnormalize.pkl"), environment(file).venv)
        again = PPO.load(tmp_path / "model.zip", env=loaded, device="cpu")
        if file == encoder[0]:
            learn(again, 8)
        else:
            with pytest.raises(ValueError, match=r"other\.safetensors makes .*give the encoder file"):
                learn(again, 8)


def test_untrained_network(capsys: pytest.CaptureFixture[str]) -> None:
    kwargs = {"features_extractor_class": VanillaExtractor}
    changes = learn(PPO("CnnPolicy", Grid(), n_steps=16, batch_size=16, n_epochs=1, policy_kwargs=kwargs), 32)
    out = capsys.readouterr().out
    assert "VanillaExtractor, source untrained, random weights" in out and "parameters, trained from scratch\n" in out
    assert changes[0] == 0.0 < changes[1]


def test_policy_without_an_encoder_of_ours(capsys: pytest.CaptureFixture[str]) -> None:
    assert learn(PPO("MlpPolicy", Grid(), n_steps=16, batch_size=16, n_epochs=1), 16) == []
    assert "none of sb3_abisim's" in capsys.readouterr().out


def test_the_content_hash_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    env = Grid()
    env.content_hash = "0123abcd"  # type: ignore[attr-defined]
    learn(PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1), 16)
    assert "Content hash of the training environment: 0123abcd\n" in capsys.readouterr().out


def test_stacked_embeddings_are_trained_on(encoder: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    env = VecFrameStack(VecEncodeObservations(DummyVecEnv([Grid]), encoder[0]), 2)
    learn(PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, device="cpu"), 16)
    assert f"Encoder of the environment: VecEncodeObservations, source {encoder[0]}" in capsys.readouterr().out


def test_training_keeps_freed_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[bool] = []
    monkeypatch.setattr("sb3_abisim.rl.callbacks.keep_freed_memory", lambda: calls.append(True))
    policy_kwargs = {"features_extractor_class": VanillaExtractor}
    model = PPO("CnnPolicy", Grid(), n_steps=8, batch_size=8, n_epochs=1, policy_kwargs=policy_kwargs, device="cpu")
    model.learn(8, callback=EncoderCallback())
    assert calls == [True]


class Broken(Grid):
    """Gives one number that is none, at the twentieth step."""

    def __init__(self, where: str, continuous: bool = False) -> None:
        super().__init__(continuous)
        self.where, self.n_steps = where, 0
        if where == "observation":
            self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)

    def _changed(self, observation: Any) -> Any:
        if self.where != "observation":
            return observation
        return np.full(3, np.nan if self.n_steps == 20 else 0, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = super().reset(seed=seed)
        return self._changed(observation), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        observation, reward, _, _, info = super().step(action)
        reward = np.inf if self.where == "reward" and self.n_steps == 20 else reward
        return self._changed(observation), reward, False, False, info


@pytest.mark.parametrize("where", ["reward", "observation"])
@pytest.mark.parametrize("algorithm", [DQN, SAC, PPO])
def test_training_stops_at_a_number_that_is_none(algorithm: type[BaseAlgorithm], where: str) -> None:
    settings: dict[str, Any] = {"n_steps": 32, "batch_size": 32} if algorithm is PPO else {"buffer_size": 50}
    policy = "MlpPolicy"
    if where == "reward":
        settings["policy_kwargs"] = {"features_extractor_class": VanillaExtractor}
        policy = "CnnPolicy"
    model: Any = algorithm(policy, Broken(where, algorithm is SAC), device="cpu", **settings)  # type: ignore[call-arg]
    with pytest.raises(FloatingPointError, match=f"^{where} is NaN or infinite at step 20, and training stops"):
        model.learn(64, callback=EncoderCallback())


class Wrong(VecEnvWrapper):
    """A wrapper of vectors that gives, at the twentieth step, the last observation of an episode as no number."""

    n_steps = 0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        self.n_steps += 1
        if self.n_steps == 20:
            dones[0], infos[0]["terminal_observation"] = True, np.full(3, np.inf, np.float32)
        return observations, rewards, dones, infos


@pytest.mark.parametrize("algorithm", [DQN, SAC, PPO])
def test_training_stops_at_the_last_observation_of_an_episode(algorithm: type[BaseAlgorithm]) -> None:
    settings: dict[str, Any] = {"n_steps": 32, "batch_size": 32} if algorithm is PPO else {"buffer_size": 50}
    env = Wrong(DummyVecEnv([lambda: Broken("observation", algorithm is SAC)]))
    env.venv.envs[0].n_steps = 1000  # type: ignore[attr-defined]  # its own number has been
    model: Any = algorithm("MlpPolicy", env, device="cpu", **settings)  # type: ignore[call-arg]
    with pytest.raises(FloatingPointError, match=r"^last observation of an episode is NaN or infinite at step 20,"):
        model.learn(64, callback=EncoderCallback())


@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_training_stops_at_an_action_that_is_none(algorithm: type[BaseAlgorithm]) -> None:
    settings: dict[str, Any] = {"n_steps": 32, "batch_size": 32} if algorithm is PPO else {"buffer_size": 50}
    model: Any = algorithm("MlpPolicy", Grid(True), device="cpu", **settings)  # type: ignore[call-arg]
    owner, name = (model.policy, "forward") if algorithm is PPO else (model, "_sample_action")
    act = getattr(owner, name)

    def broken(*args: Any, **kwargs: Any) -> Any:
        actions, *rest = act(*args, **kwargs)
        actions[0, 1] = np.nan if model.num_timesteps == 20 else actions[0, 1]
        return (actions, *rest)

    setattr(owner, name, broken)
    with pytest.raises(FloatingPointError, match=r"^action is NaN or infinite at step 21, and training stops"):
        model.learn(64, callback=EncoderCallback())


@pytest.mark.parametrize("algorithm", [DQN, PPO])
def test_training_stops_at_a_loss_or_a_weight_that_is_none(algorithm: type[BaseAlgorithm]) -> None:
    small = {"n_steps": 16, "batch_size": 16} if algorithm is PPO else {"buffer_size": 50, "learning_starts": 4}
    kwargs = {"features_extractor_class": VanillaExtractor}
    model: Any = algorithm("CnnPolicy", Grid(), policy_kwargs=kwargs, device="cpu", **small)  # type: ignore[call-arg]
    train = model.train

    def break_loss(*args: Any, **kwargs: Any) -> None:
        train(*args, **kwargs)
        model.logger.record("train/loss", float("nan"))

    model.train = break_loss
    with pytest.raises(FloatingPointError, match=r"^train/loss is NaN or infinite"):
        model.learn(64, callback=EncoderCallback())

    def break_weight(*args: Any, **kwargs: Any) -> None:
        with th.no_grad():
            next(model.policy.parameters()).fill_(float("nan"))

    model.train = break_weight
    # Whoever sees it first: this callback, the extractor in its next forward, or a distribution of Stable-Baselines3.
    seen = r"^weight .* is NaN or infinite|^embeddings of VanillaExtractor .* are NaN or infinite|invalid values"
    with pytest.raises((FloatingPointError, ValueError), match=seen):
        model.learn(16, callback=EncoderCallback())


def test_an_explained_variance_of_nothing_is_no_mistake() -> None:
    """Of returns that are all equal, Stable-Baselines3 logs NaN."""
    kwargs = {"features_extractor_class": VanillaExtractor}
    model: Any = PPO("CnnPolicy", Grid(), n_steps=8, batch_size=8, policy_kwargs=kwargs, device="cpu")
    train = model.train

    def log_nan() -> None:
        train()
        model.logger.record("train/explained_variance", np.nan)

    model.train = log_nan
    model.learn(24, callback=EncoderCallback())
