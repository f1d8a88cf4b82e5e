"""Embeddings instead of observations: each is the encoder's, and what Stable-Baselines3 stores is the right one."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import SPACE, RandomImages, register_batch_norm, write
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, VecTransposeImage, unwrap_vec_wrapper

from sb3_abisim.networks import base as networks
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.networks.encoder_name import EncoderNotFoundError
from sb3_abisim.rl import vec_encode
from sb3_abisim.rl.vec_encode import EncodedBox, VecEncodeObservations


class Counter(gym.Env[Any, Any]):
    """Each observation is new: its three channels all hold the number of observations so far."""

    observation_space = SPACE
    action_space = spaces.Discrete(4)

    def __init__(self, length: int, render_mode: str | None = None) -> None:
        self.length, self.shown, self.steps, self.render_mode = length, 0, 0, render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._show(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._show(), float(self.shown), False, self.steps == self.length, {}

    def render(self) -> Any:
        return np.full((4, 4, 3), self.shown, np.uint8)

    def _show(self) -> Any:
        self.shown += 1
        return np.full(SPACE.shape, self.shown, np.uint8)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "e.safetensors")


def counters(**kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda length=length: Monitor(Counter(length, **kwargs)) for length in (3, 5)])


def embedding(path: Path, *shown: int) -> Any:
    """Derived from the network alone, one observation at a time."""
    encoder = load_encoder(path).encoder
    with th.no_grad():
        observations = [th.full((1, *SPACE.shape), number, dtype=th.uint8).float() / 255 for number in shown]
        return th.cat([encoder(observation) for observation in observations]).numpy()


def test_every_observation_is_embedded(path: Path) -> None:
    plain, env = counters(), VecEncodeObservations(counters(), str(path), device="cpu")
    assert env.observation_space.shape == (576,) and env.observation_space.dtype == np.float32
    assert env.action_space == plain.action_space
    observations, embeddings = plain.reset(), env.reset()
    ended = 0
    for _ in range(16):
        assert embeddings.dtype == np.float32 and embeddings.shape == (2, 576)
        shown = [int(observation[0, 0, 0]) for observation in observations]
        assert np.allclose(embeddings, embedding(path, *shown), atol=1e-5)
        observations, rewards, dones, infos = plain.step(np.zeros(2, int))
        embeddings, other_rewards, other_dones, other_infos = env.step(np.zeros(2, int))
        assert np.array_equal(rewards, other_rewards) and np.array_equal(dones, other_dones)
        for info, other in zip(infos, other_infos, strict=True):
            assert info.keys() == other.keys() and info["TimeLimit.truncated"] == other["TimeLimit.truncated"]
            if "terminal_observation" in info:
                ended += 1
                terminal = embedding(path, int(info["terminal_observation"][0, 0, 0]))[0]
                assert np.allclose(other["terminal_observation"], terminal, atol=1e-5)
                assert other["terminal_observation"].shape == (576,)
    assert ended == 8
    # The encoder's numbers tell observations apart far better than the tolerance.
    assert np.abs(embedding(path, 1) - embedding(path, 2)).max() > 1e-3


def test_batch_norm_is_in_evaluation_mode(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    register_batch_norm(monkeypatch)
    path = write(tmp_path / "bn.safetensors", "BatchNorm")
    env = VecEncodeObservations(counters(), str(path), device="cpu")
    assert np.allclose(env.reset(), embedding(path, 1, 1), atol=1e-5)
    assert not any(p.requires_grad for p in env._encoder.parameters())


def test_replay_buffer_holds_terminal_embeddings(path: Path) -> None:
    """next_obs at an episode's end is its last observation, not the first one of the next episode."""
    env = VecEncodeObservations(counters(), str(path), device="cpu")
    model = sb3.DQN("MlpPolicy", env, buffer_size=20, learning_starts=100, device="cpu")
    model.learn(12)
    buffer = model.replay_buffer
    assert buffer.observations.dtype == np.float32 and buffer.observations.shape[2:] == (576,)
    # The first environment's fourth and fifth observations are the end of one episode and the start of the next.
    assert np.allclose(buffer.observations[:4, 0], embedding(path, 1, 2, 3, 5), atol=1e-5)
    assert np.allclose(buffer.next_observations[:4, 0], embedding(path, 2, 3, 4, 6), atol=1e-5)


def test_what_other_wrappers_need(path: Path) -> None:
    env = VecEncodeObservations(counters(render_mode="rgb_array"), str(path), device="cpu")
    assert env.seed(3) == [3, 4]
    env.reset()
    assert env.get_attr("length") == [3, 5] and env.env_method("get_wrapper_attr", "shown") == [1, 1]
    env.set_attr("mark", 7)
    assert env.get_attr("mark", indices=1) == [7]
    assert env.env_is_wrapped(Monitor) == [True, True]
    image = env.render()
    assert image is not None and image.shape == (8, 4, 3) and (image == 1).all()
    normalized = VecNormalize(env, norm_obs=False)
    found = unwrap_vec_wrapper(normalized, VecEncodeObservations)
    assert found is env and env.n_parameters == sum(p.numel() for p in networks.make_encoder(SPACE).parameters())
    assert np.allclose(normalized.reset(), embedding(path, 2, 2), atol=1e-5)
    normalized.close()


def test_channels_last(path: Path) -> None:
    """Whoever transposes them, the encoder sees channels first, at the ends of episodes, too."""

    def make() -> DummyVecEnv:
        env = DummyVecEnv([lambda: RandomImages(channels_last=True)])
        env.seed(4)
        return env

    def embed(observation: Any) -> Any:
        with th.no_grad():
            return load_encoder(path).encoder(th.from_numpy(observation.transpose(0, 3, 1, 2)).float() / 255).numpy()

    plain, ended = make(), 0
    envs = [VecEncodeObservations(env, str(path), device="cpu") for env in (make(), VecTransposeImage(make()))]
    observation = plain.reset()
    assert all(np.allclose(env.reset(), embed(observation), atol=1e-5) for env in envs)
    for _ in range(20):
        observation, _, dones, infos = plain.step([0])
        ended += int(dones[0])
        for env in envs:
            embedding, _, _, other_infos = env.step(np.array([0]))
            assert np.allclose(embedding, embed(observation), atol=1e-5)
            if dones[0]:
                expected = embed(infos[0]["terminal_observation"][None])[0]
                assert np.allclose(other_infos[0]["terminal_observation"], expected, atol=1e-5)
    assert ended > 1


def test_refusals(path: Path, tmp_path: Path) -> None:
    with pytest.raises(EncoderNotFoundError, match=r"searched .*mistyped\.safetensors"):
        VecEncodeObservations(counters(), str(tmp_path / "mistyped.safetensors"))
    with pytest.raises(ValueError, match="was trained by 'abisim', not 'ssi'; use ActionBisimExtractor"):
        VecEncodeObservations(counters(), str(path), objective="ssi")
    VecEncodeObservations(counters(), str(path), objective="abisim")
    with pytest.raises(ValueError, match=r"was pretrained on Nav2D-v0.*but is to be used with"):
        VecEncodeObservations(DummyVecEnv([lambda: gym.make("CartPole-v1")]), str(path))


def test_a_model_is_not_continued_on_another_encoder(path: Path, tmp_path: Path) -> None:
    other = write(tmp_path / "other.safetensors", objective="ssi")
    model = sb3.A2C("MlpPolicy", VecEncodeObservations(counters(), str(path)), device="cpu")
    model.save(tmp_path / "model.zip")
    again = sb3.A2C.load(tmp_path / "model.zip", env=VecEncodeObservations(counters(), str(path)), device="cpu")
    assert isinstance(again.observation_space, EncodedBox)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        sb3.A2C.load(tmp_path / "model.zip", env=VecEncodeObservations(counters(), str(other)), device="cpu")
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        again.set_env(VecEncodeObservations(counters(), str(other)))
    assert EncodedBox(3, "ab") == EncodedBox(3, "ab") != EncodedBox(4, "ab")
    assert EncodedBox(3, "ab") != spaces.Box(-np.inf, np.inf, (3,), np.float32)
    assert repr(EncodedBox(3, "ab")) == "EncodedBox(3, hash='ab')"


def test_freed_memory_is_kept(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = []
    monkeypatch.setattr(vec_encode, "keep_freed_memory", lambda: kept.append(True))
    VecEncodeObservations(counters(), str(path))
    assert kept
