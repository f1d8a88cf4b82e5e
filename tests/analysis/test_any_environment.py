"""Figures of an environment that nothing here names: encoders are shown what they were pretrained on."""

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from zoo_inputs import write_encoder

from sb3_abisim.__main__ import main
from sb3_abisim.analysis.figures import load_all
from sb3_abisim.analysis.scenes import eval_settings, preprocessing_of, sample_episodes
from sb3_abisim.data.collect import collect
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.pretrain import pretrain

ENV_ID = "test/Counter-v0"
LENGTH, SIDE = 9, 16


class CounterEnv(gym.Env[Any, Any]):
    """A dictionary of an image, channels last, whose gray level is the step, and the step itself."""

    def __init__(self, gain: int = 1) -> None:
        self.gain = gain
        image = spaces.Box(0, 255, (SIDE, SIDE, 1), np.uint8)
        self.observation_space = spaces.Dict({"camera": image, "step": spaces.Box(0, LENGTH, (1,), np.float32)})
        self.action_space = spaces.MultiDiscrete([2, 3])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.n = 1
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.n += 1
        return self._observe(), 0.0, self.n == LENGTH, False, {}

    def _observe(self) -> Any:
        image = np.full((SIDE, SIDE, 1), self.gain * self.n, np.uint8)
        return {"camera": image, "step": np.float32([self.n])}


class Double(gym.ObservationWrapper[Any, Any, Any]):
    """Twice the gray level."""

    def observation(self, observation: Any) -> Any:
        return {**observation, "camera": 2 * observation["camera"]}


gym.register(ENV_ID, entry_point=CounterEnv)
SETTINGS: dict[str, Any] = {
    "env_kwargs": {"gain": 5},
    "env_wrapper": [f"{__name__}.Double"],
    "frame_stack": 3,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "d"
    collect(ENV_ID, 120, folder, n_envs=2, **SETTINGS)
    return folder


@pytest.fixture(scope="module")
def encoder(data: Path) -> Path:
    config = {"n_updates": 2, "batch_size": 16, "log_interval": 1, "checkpoint_interval": 2}
    return pretrain("ssi", data, data.parent / "e.safetensors", config, progress_bar=False, verbose=0)


def test_samples_are_stacks_of_what_the_wrapper_shows(encoder: Path) -> None:
    files = load_all([str(encoder)], ENV_ID, as_pretrained=True)
    (kwargs,) = eval_settings(ENV_ID, files).values()
    assert kwargs == {"gain": 5}
    samples = sample_episodes(ENV_ID, 6, LENGTH, 0, kwargs, preprocessing_of(files))
    step = samples.factors["step"][:, 0].astype(int)
    assert samples.obs.shape[1:] == (3, SIDE, SIDE) and set(step) == set(range(1, LENGTH))
    for shown, n in ((samples.obs, step), (samples.next_obs, step + 1)):
        levels = np.stack([10 * np.maximum(n - k, 0) for k in (2, 1, 0)], axis=1)
        np.testing.assert_array_equal(shown, np.broadcast_to(levels[:, :, None, None], shown.shape))
    # The same as Stable-Baselines3's.
    venv = VecFrameStack(DummyVecEnv([lambda: Double(CounterEnv(gain=5))]), 3)
    stack = venv.reset()["camera"]
    np.testing.assert_array_equal(np.moveaxis(stack, -1, 1)[0], samples.obs[step == 1][0])


@pytest.mark.parametrize("name", ["neighbors", "probes", "curves", "leak"])
def test_every_general_figure(name: str, encoder: Path, data: Path, tmp_path: Path, capsys: Any) -> None:
    words = ["analyze", name, "--images", str(tmp_path), "-n", "12"]
    words += ["--data", str(data)] if name == "leak" else ["--env", ENV_ID, str(encoder)]
    main(words)
    results = json.loads((tmp_path / f"{name}-test-Counter-v0.json").read_text())
    assert results["env_id"] == ENV_ID and (tmp_path / f"{name}-test-Counter-v0.png").is_file()
    if name == "probes":
        scores = results["encoders"][str(encoder)]["scores"]["eval episodes"]
        assert scores["step"]["linear"] > 0.5


def test_encoders_of_different_observations_are_not_compared(encoder: Path, tmp_path: Path) -> None:
    write_encoder(tmp_path / "plain.safetensors", "Nav2D-v0", "ssi")
    files = {"a": load_encoder(encoder), "b": load_encoder(tmp_path / "plain.safetensors")}
    with pytest.raises(ValueError, match=r"on different observations \(a: .*'frame_stack': 3.*, b: {}\)"):
        preprocessing_of(files)


def test_what_is_shown_without_the_wrapper_of_a_file_is_refused(encoder: Path) -> None:
    with pytest.raises(ValueError, match="but is to be used with"):
        load_all([str(encoder)], ENV_ID)
