"""A disk that is full when ``train`` saves: what was saved before is still there, whole."""

import contextlib
import json
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from zoo_inputs import SMALL, run

from sb3_abisim.zoo.models import load_model
from sb3_abisim.zoo.run_files import read_yaml
from sb3_abisim.zoo.runs import read_run
from sb3_abisim.zoo.saved_spaces import read_vec_normalize
from sb3_abisim.zoo.whole_files import _is_whole, saves_whole

resource = pytest.importorskip("resource")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="a limit on the size of files stands for a full disk")


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The system refuses to write on, as it does on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    ("callback", "size", "words"),
    [
        (EvalCallback, 100, ["--eval-freq", "32", "--eval-episodes", "1"]),
        (EvalCallback, 20_000, ["--eval-freq", "32", "--eval-episodes", "1"]),
        (CheckpointCallback, 20_000, ["--eval-freq", "-1", "--save-freq", "32"]),
    ],
    ids=["evaluations", "best model", "checkpoints"],
)
def test_train_keeps_what_it_saved_before_the_disk_was_full(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    callback: Any,
    size: int,
    words: list[str],
) -> None:
    on_step = callback._on_step

    def full_at_the_second(self: Any) -> Any:
        if self.num_timesteps < 64:
            return on_step(self)
        self.best_mean_reward = -np.inf
        with files_of_at_most(size):
            return on_step(self)

    monkeypatch.setattr(callback, "_on_step", full_at_the_second)
    words = [*words, "--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "-n", "128", "--num-threads", "1"]
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, "train", *words, "--conf-file", "vanilla", "-params", *SMALL["ppo"])
    error = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 1 and not any("Traceback" in line for line in error)
    assert error[-1].startswith("sb3-abisim train: [Errno 27] ") and error[-1].endswith("; training has stopped")
    folder = tmp_path / "ppo" / "Nav2D-v0_1"
    saved = {path.name for path in folder.iterdir() if path.suffix in (".zip", ".npz", ".tmp")}
    if callback is CheckpointCallback:
        assert saved == {"rl_model_32_steps.zip"}
    else:
        assert saved == {"best_model.zip", "evaluations.npz"}
        # The second evaluation was written where it fitted.
        assert len(np.load(folder / "evaluations.npz")["timesteps"]) == (1 if size == 100 else 2)
    (model,) = (folder / name for name in saved if name.endswith(".zip"))
    assert load_model(model, read_run(folder)).num_timesteps == 32
    assert read_yaml(folder / "Nav2D-v0" / "config.yml")


def test_buffers_and_means_are_replaced_as_a_whole(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gym.make("CartPole-v1")]))
    model = DQN("MlpPolicy", env, buffer_size=2000, learning_starts=10)
    with saves_whole():
        model.learn(20)
        model.save_replay_buffer(tmp_path / "buffer")
        env.save(str(tmp_path / "means.pkl"))
        model.save(tmp_path / "new" / "model")
        contents = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
        model.learn(20)
        with files_of_at_most(300):
            for save in (
                lambda: model.save_replay_buffer(tmp_path / "buffer"),
                lambda: env.save(str(tmp_path / "means.pkl")),
                lambda: model.save(tmp_path / "new" / "model"),
            ):
                with pytest.raises((OSError, RuntimeError)):
                    save()
    assert {path.name for path in contents} == {"buffer.pkl", "means.pkl", "model.zip"}
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == contents
    assert read_vec_normalize(tmp_path / "means.pkl").obs_rms.count > 20
    model.load_replay_buffer(tmp_path / "buffer")
    with zipfile.ZipFile(tmp_path / "new" / "model.zip") as archive:
        assert json.loads(archive.read("data"))["num_timesteps"] == 20


def test_files_that_are_open_and_names_with_other_suffixes(tmp_path: Path) -> None:
    with saves_whole():
        np.savez(tmp_path / "a.b", x=np.ones(2))
        with open(tmp_path / "c", "wb") as file:
            np.savez(file, x=np.ones(3))
    assert np.load(tmp_path / "a.b.npz")["x"].shape == (2,) and np.load(tmp_path / "c")["x"].shape == (3,)


def test_half_a_video_is_told_from_a_whole_one(tmp_path: Path) -> None:
    video_inputs = pytest.importorskip("video_inputs")
    pytest.importorskip("av")
    path = tmp_path / "a.mp4"
    video_inputs.write_video(path)
    content = path.read_bytes()
    assert _is_whole(content)
    for size in (0, 7, 40, len(content) // 2, len(content) - 1):
        assert not _is_whole(content[:size])
    # A length that is none ends, too.
    assert not _is_whole(b"\0\0\0\1mdat" + bytes(20))
