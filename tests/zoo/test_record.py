"""Recordings of zoo runs."""

import contextlib
import dataclasses
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from PIL import Image
from stable_baselines3 import PPO
from zoo_inputs import SMALL, run

from sb3_abisim.benchmark.command import main as benchmark
from sb3_abisim.benchmark.export import export
from sb3_abisim.zoo import record as module
from sb3_abisim.zoo.record import MILLISECONDS, N_LAST, main, record
from sb3_abisim.zoo.run_envs import final_model, make_run_env
from sb3_abisim.zoo.runs import find_runs, read_run


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in an environment with a short time limit, in which the agent waits at a corner for its end."""
    logs = tmp_path_factory.mktemp("logs")
    with pytest.MonkeyPatch.context() as patch:
        words = ["--algo", "ppo", "--env", "Nav2D-v0", "-f", str(logs), "--conf-file", "vanilla", "-n", "100"]
        words += ["--env-kwargs", "max_episode_steps:9", "--eval-freq", "-1", "--num-threads", "1"]
        run(patch, "train", *words, "-params", *SMALL["ppo"])
    return logs / "ppo" / "Nav2D-v0_1"


def frames(path: Path) -> list[tuple[int, np.ndarray]]:
    """Milliseconds and content of each frame that differs from the one before."""
    with Image.open(path) as gif:
        shown = []
        for i in range(gif.n_frames):
            gif.seek(i)
            shown.append((gif.info["duration"], np.asarray(gif.convert("RGB"))))
        return shown


def test_every_step_is_shown_and_each_end_stays_for_a_second(run_folder, tmp_path, monkeypatch):
    # Right and left in turns: no two neighboring frames are alike, unless the agent stands between walls.
    turns = iter([2, 3] * 100)
    monkeypatch.setattr(PPO, "predict", lambda *args, **kwargs: (np.array([next(turns)]), None))
    mean_return, success = record(run_folder, tmp_path / "a.gif", n_episodes=2, seed=3)
    shown = frames(tmp_path / "a.gif")
    # Nine steps, each of which costs one.
    assert success in (0.0, 0.5, 1.0) and mean_return == -9 + success
    # Ten frames for nine steps, with the run's time limit; the last one stays.
    assert sum(duration for duration, _ in shown) == 2 * (10 + N_LAST - 1) * MILLISECONDS
    assert sum(duration >= N_LAST * MILLISECONDS for duration, _ in shown) == 2


def test_of_a_long_episode_some_frames_are_left_out(run_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_FRAMES", 4)
    record(run_folder, tmp_path / "a.gif", n_episodes=1)
    # Every third of ten, the last among them.
    assert sum(duration for duration, _ in frames(tmp_path / "a.gif")) == (4 + N_LAST - 1) * MILLISECONDS


def test_an_environment_that_knows_no_success(run_folder, tmp_path, monkeypatch, capsys):
    class Silent(gym.Wrapper):
        def step(self, action):
            return (*super().step(action)[:4], {})

    plain = gym.make
    monkeypatch.setattr(gym, "make", lambda *args, **kwargs: Silent(plain(*args, **kwargs)))
    module.main([str(run_folder), "-o", str(tmp_path / "a.gif"), "--episodes", "1"])
    said = capsys.readouterr().out
    assert "episodes: 1, mean return -9" in said and "successful" not in said
    assert (tmp_path / "a.gif").is_file()


def test_the_same_seed_records_the_same(run_folder, tmp_path):
    first, again, other = (tmp_path / f"{name}.gif" for name in "abc")
    for path, seed in ((first, 5), (again, 5), (other, 6)):
        record(run_folder, path, n_episodes=1, seed=seed)
    assert first.read_bytes() == again.read_bytes() != other.read_bytes()


def test_the_seed_is_that_of_the_actions_too(run_folder, tmp_path, monkeypatch):
    drawn = {}
    for seed in (5, 6):
        numbers = drawn[seed] = []

        def predict(*args, numbers=numbers, **kwargs):
            numbers.append(float(th.rand(())))
            return np.zeros(1, np.int64), None

        monkeypatch.setattr(PPO, "predict", predict)
        record(run_folder, tmp_path / "a.gif", n_episodes=1, seed=seed)
    assert drawn[5][0] != drawn[6][0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere is no run folder of rl-zoo3"),
        (["RUN", "--episodes", "0"], "n_episodes must be at least 1, got 0"),
        (["RUN", "-o", "agent.mp4"], "what is written is a GIF, and agent.mp4 would say otherwise; call it NAME.gif"),
        (["RUN", "--packages", "no_such_module"], "--packages: cannot import 'no_such_module'"),
    ],
)
def test_errors_name_the_value(run_folder, tmp_path, capsys, arguments, message):
    words = [str(run_folder) if word == "RUN" else word for word in arguments]
    with pytest.raises(SystemExit):
        main(["-o", str(tmp_path / "a.gif"), *words])
    assert message in capsys.readouterr().err
    assert not (tmp_path / "a.gif").exists()


@pytest.mark.parametrize(
    ("settings", "normalized"),
    [
        ({"normalize": True}, True),
        ({"normalize": "dict(norm_reward=True)"}, True),
        ({"normalize": "dict(norm_obs=False, norm_reward=True)"}, False),
        ({"normalize": "{'norm_obs': False}"}, False),
        ({"normalize": {"norm_obs": False}}, False),
        ({"normalize": "False"}, False),
    ],
)
def test_means_of_observations_must_be_there(run_folder, settings, normalized):
    """Without them a model would get other observations than in training."""
    changed = dataclasses.replace(read_run(run_folder), settings=settings)
    missing = pytest.raises(ValueError, match=r"normalized observations, and .*vecnormalize\.pkl has none; copy")
    with missing if normalized else contextlib.nullcontext():
        make_run_env(changed, final_model(changed), 1, {}, 0).close()


def test_a_run_that_goes_on_is_refused(run_folder, tmp_path):
    model = run_folder / "Nav2D-v0.zip"
    hidden = model.rename(tmp_path / "hidden.zip")
    try:
        with pytest.raises(ValueError, match=r"holds no final model \(Nav2D-v0.zip\); let the run end first"):
            record(run_folder, tmp_path / "a.gif")
    finally:
        hidden.rename(model)


def test_a_missing_folder_is_reported_before_recording(tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([str(tmp_path / "run"), "-o", str(tmp_path / "absent" / "a.gif")])
    assert stopped.value.code == 2 and "there is no folder" in capsys.readouterr().err


def test_an_environment_in_a_namespace(tmp_path, monkeypatch, capsys):
    """The zoo turns the slash of its id into a dash wherever it names files."""
    gym.register("toy/Grid-v0", entry_point=gym.spec("Nav2D-v0").entry_point, max_episode_steps=9)
    try:
        settings = "policy: CnnPolicy, n_timesteps: 64, n_envs: 2, n_steps: 32, batch_size: 32"
        extractor = "{features_extractor_class: sb3_abisim.VanillaExtractor}"
        (tmp_path / "custom.yml").write_text(f"toy/Grid-v0: {{{settings}, policy_kwargs: {extractor}}}")
        words = ["--algo", "ppo", "--env", "toy/Grid-v0", "-f", str(tmp_path / "logs"), "--eval-freq", "-1"]
        run(monkeypatch, "train", *words, "--conf-file", str(tmp_path / "custom.yml"), "--num-threads", "1")
        folder = tmp_path / "logs" / "ppo" / "toy-Grid-v0_1"
        assert (read_run(folder).env_id, read_run(folder).env_name) == ("toy/Grid-v0", "toy-Grid-v0")
        record(folder, tmp_path / "a.gif", n_episodes=1)
        benchmark(["evaluate", str(folder), "--episodes", "2", "--packages", "sb3_abisim"])
        (copied,) = find_runs(export(tmp_path / "logs", tmp_path / "copy"))
        assert copied.final()["stochastic/standard/results"].shape == (2,) and copied.command
    finally:
        del gym.registry["toy/Grid-v0"]
    with pytest.raises(SystemExit):
        benchmark(["evaluate", str(folder)])
    message = (
        "was trained in toy/Grid-v0, which is not registered here; give the module that registers it with --packages"
    )
    assert message in capsys.readouterr().err
