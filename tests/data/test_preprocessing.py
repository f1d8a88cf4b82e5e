"""Observations of other forms: channels last, gray, in a Dict, wrapped; from collecting to an agent."""

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_abisim.__main__ import main
from sb3_abisim.data.collect import collect
from sb3_abisim.data.copies import ImageLayout
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CONFIG_NAME
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.pretrain import pretrain
from sb3_abisim.rl.vec_encode import VecEncodeObservations
from sb3_abisim.zoo.collect import preprocessing_entry

HEIGHT, WIDTH = 64, 64


class FormsEnv(gym.Env[Any, Any]):
    """The same content in many forms: a patch that moves by the action, on noise of the episode."""

    def __init__(self, form: str = "last", render_mode: str | None = None) -> None:
        image = {"first": (3, HEIGHT, WIDTH), "gray": (HEIGHT, WIDTH)}.get(form, (HEIGHT, WIDTH, 3))
        box = spaces.Box(0, 255, image, np.uint8)
        self.form, self.render_mode = form, render_mode
        parts = {"camera": box, "arm-pos": spaces.Box(-1, 9, (2,)), "door": spaces.Discrete(2), "say": spaces.Text(3)}
        if form == "two":
            parts["wrist"] = box
        self.observation_space = spaces.Dict(parts) if form in ("dict", "two") else box
        self.action_space = spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.place, self.n = np.array([20, 30]), 0
        self.noise = self.np_random.integers(100, size=(HEIGHT, WIDTH, 3), dtype=np.uint8)
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.place = np.clip(self.place + [(0, 8), (8, 0), (0, -8), (-8, 0)][int(action)], 0, 55)
        self.n += 1
        return self._observe(), 0.0, self.n == 10, False, {}

    def _observe(self) -> Any:
        image = self.noise.copy()
        image[self.place[0] : self.place[0] + 8, self.place[1] : self.place[1] + 8] = (255, 128, 200)
        if self.form == "first":
            return np.moveaxis(image, -1, 0)
        if self.form == "gray":
            return image[:, :, 0]
        if self.form == "last":
            return image
        vector = np.array([self.n % 2, self.n / 2], np.float32)
        both = {"camera": image, "arm-pos": vector, "door": self.n % 2, "say": "go"}
        return both | ({"wrist": 255 - image} if self.form == "two" else {})


class Darken(gym.ObservationWrapper[Any, Any, Any]):
    """Halves all values."""

    def observation(self, observation: Any) -> Any:
        return observation // 2


gym.register("Forms-v0", entry_point=FormsEnv)
DARKEN = f"{__name__}.Darken"


def frames_of(folder: Path, form: str, **kwargs: Any) -> tuple[TransitionDataset, np.ndarray]:
    collect("Forms-v0", 80, folder, n_envs=2, env_kwargs={"form": form}, **kwargs)
    dataset = TransitionDataset(folder, eval_fraction=0.2)
    return dataset, dataset.frames(np.arange(dataset.n_frames))


def test_every_form_shows_the_same(tmp_path: Path) -> None:
    first, frames = frames_of(tmp_path / "first", "first")
    assert first.preprocessing == {}
    for form, preprocessing in (
        ("last", {"channels": "last"}),
        ("gray", {"channels": "none"}),
        ("dict", {"channels": "last", "image_key": "camera"}),
    ):
        dataset, shown = frames_of(tmp_path / form, form)
        np.testing.assert_array_equal(shown, frames[:, :1] if form == "gray" else frames)
        assert dataset.preprocessing == preprocessing
        assert json.loads((tmp_path / form / CONFIG_NAME).read_bytes())["preprocessing"] == preprocessing


@pytest.mark.parametrize("n_workers", [1, 2])
def test_other_keys_are_factors(tmp_path: Path, n_workers: int) -> None:
    dataset, _ = frames_of(tmp_path / "d", "dict", n_workers=n_workers)
    factors = dataset.factors(np.arange(dataset.n_frames))
    assert set(factors) == {"arm_pos", "door"}
    step = (2 * factors["arm_pos"][:, 1]).astype(int)
    begins = np.concatenate([[0], np.flatnonzero(dataset.ends)[:-1] + 1])
    lengths = np.diff(np.append(begins, dataset.n_frames))
    assert step.tolist() == np.concatenate([np.arange(n) for n in lengths]).tolist()
    assert factors["door"].tolist() == (step % 2).tolist()
    assert (factors["arm_pos"].dtype, factors["door"].dtype) == (np.float32, np.int64)


def test_one_of_two_images_is_chosen(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"2 images \(camera, wrist\) .*--image-key"):
        frames_of(tmp_path / "d", "two")
    with pytest.raises(ValueError, match="image_key 'door' is not one of the images"):
        frames_of(tmp_path / "d", "two", image_key="door")
    with pytest.raises(ValueError, match="image_key 'wrist' chooses from a Dict"):
        frames_of(tmp_path / "d", "last", image_key="wrist")
    _, camera = frames_of(tmp_path / "camera", "two", image_key="camera")
    dataset, wrist = frames_of(tmp_path / "wrist", "two", image_key="wrist")
    np.testing.assert_array_equal(wrist, 255 - camera)
    assert dataset.preprocessing["image_key"] == "wrist"


def test_a_wrapper_is_applied_and_recorded(tmp_path: Path) -> None:
    _, plain = frames_of(tmp_path / "plain", "last")
    dataset, dark = frames_of(tmp_path / "dark", "last", env_wrapper=DARKEN)
    np.testing.assert_array_equal(dark, plain // 2)
    assert dataset.preprocessing == {"channels": "last", "env_wrapper": [DARKEN]}
    with pytest.raises(ValueError, match=r"begun with other arguments .*preprocessing"):
        frames_of(tmp_path / "dark", "last")
    with pytest.raises(ValueError, match=r"uint8 images .*with env_wrapper .*--env-wrapper takes the place"):
        frames_of(tmp_path / "d", "last", env_wrapper="gymnasium.wrappers.FlattenObservation")
    with pytest.raises(ValueError, match=r"env_wrapper \['no.such.Wrapper'\] cannot be imported"):
        frames_of(tmp_path / "d", "last", env_wrapper="no.such.Wrapper")


@pytest.mark.parametrize(
    ("space", "remedy"),
    [
        (spaces.Box(0, 1, (64, 64, 3), np.float32), "RescaleObservation.*DtypeObservation"),
        (spaces.Box(-np.inf, np.inf, (64, 64, 3), np.float32), "AddRenderObservation"),
        (spaces.Box(0, 1, (64,), np.float32), "AddRenderObservation"),
        (spaces.Box(0, 255, (4,), np.uint8), "AddRenderObservation"),
        (spaces.Box(0, 10, (7, 7, 3), np.uint8), "DtypeObservation.*RescaleObservation.*DtypeObservation"),
        (spaces.Text(5), "AddRenderObservation"),
    ],
    ids=str,
)
def test_what_is_no_image_is_refused_with_the_remedy(space: gym.Space[Any], remedy: str) -> None:
    with pytest.raises(ValueError, match=f"uint8 images .*{remedy}"):
        ImageLayout.of(space)


def test_the_zoo_entry_of_an_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert preprocessing_entry("Forms-v0") == {}
    mine = tmp_path / "mine.yml"
    mine.write_text(
        f"Forms-v0:\n  env_wrapper: {DARKEN}\n  frame_stack: 2\n  env_kwargs: {{form: last}}\n  n_envs: 3\n"
    )
    words = ["collect", "--env", "Forms-v0", "-n", "40", "--n-envs", "2", "--conf-file", str(mine), "-o"]
    main([*words, str(tmp_path / "d")])
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.preprocessing == {"channels": "last", "env_wrapper": [DARKEN], "frame_stack": 2}
    assert dataset.env_kwargs == {"form": "last"}
    main([*words, str(tmp_path / "e"), "--frame-stack", "1", "--env-kwargs", "form:first"])
    dataset = TransitionDataset(tmp_path / "e")
    assert dataset.preprocessing == {"env_wrapper": [DARKEN]}
    main([*words, str(tmp_path / "f"), "--frame-stack", "1", "--env-wrapper", "none"])
    assert TransitionDataset(tmp_path / "f").preprocessing == {"channels": "last"}
    with pytest.raises(ValueError, match="has no entry Other-v0, only Forms-v0"):
        preprocessing_entry("Other-v0", str(mine))


@pytest.mark.parametrize("frame_stack", [1, 3])
def test_from_channels_last_to_an_agent(tmp_path: Path, frame_stack: int) -> None:
    from stable_baselines3.common.vec_env import VecFrameStack

    from sb3_abisim import SSIExtractor

    frames_of(tmp_path / "d", "last", frame_stack=frame_stack)
    config = {"n_updates": 2, "batch_size": 8, "log_interval": 2, "checkpoint_interval": 2}
    if frame_stack > 1:
        config["network"] = "Stacked"
        _register_stacked()
    path = pretrain("ssi", tmp_path / "d", tmp_path / "e.safetensors", config, progress_bar=False, verbose=0)
    file = load_encoder(path)
    expected = {"channels": "last", "env_wrapper": []} | ({"frame_stack": frame_stack} if frame_stack > 1 else {})
    assert file.metadata["preprocessing"] == expected
    assert file.metadata["observation_space"]["shape"] == [3 * frame_stack, HEIGHT, WIDTH]
    venv = DummyVecEnv([lambda: gym.make("Forms-v0")])
    stacked = VecFrameStack(DummyVecEnv([lambda: gym.make("Forms-v0")]), frame_stack) if frame_stack > 1 else venv
    kwargs = {"features_extractor_class": SSIExtractor, "features_extractor_kwargs": {"encoder": str(path)}}
    if frame_stack > 1:
        kwargs["features_extractor_kwargs"]["network"] = "Stacked"
    model = PPO("CnnPolicy", stacked, n_steps=16, batch_size=16, n_epochs=1, policy_kwargs=kwargs)
    model.learn(16)
    # Frozen: the wrapper stacks single observations, and gives what the encoder gives of SB3's stacks.
    frozen = VecEncodeObservations(DummyVecEnv([lambda: gym.make("Forms-v0")]), str(path), device="cpu")
    venv = VecFrameStack(DummyVecEnv([lambda: gym.make("Forms-v0")]), frame_stack)
    venv.seed(3)
    frozen.seed(3)
    shown, embedded = venv.reset(), frozen.reset()
    for _ in range(12):
        expected_embedding = frozen.encode(np.moveaxis(shown, -1, 1).copy())
        np.testing.assert_allclose(embedded, expected_embedding, atol=1e-4)
        shown, _, _, infos = venv.step(np.array([1]))
        embedded, _, _, other = frozen.step(np.array([1]))
        if "terminal_observation" in infos[0]:
            last = np.moveaxis(infos[0]["terminal_observation"], -1, 0)[None].copy()
            np.testing.assert_allclose(other[0]["terminal_observation"], frozen.encode(last)[0], atol=1e-4)
    PPO("MlpPolicy", frozen, n_steps=16, batch_size=16, n_epochs=1).learn(16)


def _register_stacked() -> None:
    from torch import nn

    from sb3_abisim.registry import networks, register_network

    if "Stacked" not in networks():
        register_network(
            "Stacked",
            lambda space: nn.Sequential(nn.Conv2d(space.shape[0], 4, 8, 8), nn.Flatten(), nn.Linear(256, 16)),
        )
