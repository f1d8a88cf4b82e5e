"""A run's environments are made again as the zoo made them: wrapped, stacked, embedded."""

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image
from toy_env import LENGTH
from zoo_inputs import SMALL, run

from sb3_abisim.data.collect import collect
from sb3_abisim.pretraining.pretrain import pretrain
from sb3_abisim.rl.vec_encode import EncodedBox
from sb3_abisim.zoo.evaluate import SEED, evaluate_final
from sb3_abisim.zoo.record import MILLISECONDS, N_LAST, record
from sb3_abisim.zoo.run_envs import final_model, make_run_env
from sb3_abisim.zoo.runs import Run, read_run

WRAPPERS = ["toy_env.Invert", "toy_env.Lives"]


@pytest.fixture(scope="module")
def encoder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("encoder")
    collect("Toy-v0", 60, folder / "data", n_envs=2, env_wrapper=WRAPPERS, frame_stack=2)
    config = {"n_updates": 1, "batch_size": 8, "log_interval": 1, "checkpoint_interval": 1, "eval_fraction": 0}
    return pretrain("ssi", folder / "data", folder / "e.safetensors", config, progress_bar=False, verbose=0)


@pytest.fixture(scope="module", params=["", ",frozen"], ids=["fine-tuned", "frozen"])
def zoo_run(tmp_path_factory: pytest.TempPathFactory, encoder: Path, request: pytest.FixtureRequest) -> Run:
    logs = tmp_path_factory.mktemp("logs")
    words = ["--algo", "ppo", "--env", "Toy-v0", "-f", str(logs), "--conf-file", f"ssi={encoder}{request.param}"]
    words += ["-n", "64", "--eval-freq", "-1", "--num-threads", "1", "--packages", "toy_env"]
    with pytest.MonkeyPatch.context() as patch:
        run(patch, "train", *words, "-params", *SMALL["ppo"], f"env_wrapper:{WRAPPERS}", "frame_stack:2")
    return read_run(logs / "ppo" / "Toy-v0_1")


def test_observations_are_those_of_the_run(zoo_run: Run) -> None:
    model = final_model(zoo_run)
    venv = make_run_env(zoo_run, model, 2, {}, SEED)
    env = gym.make("Toy-v0")
    first, _ = env.reset(seed=SEED)
    second = env.step(1)[0]
    stacks = [np.concatenate([np.zeros_like(first), 255 - first]), 255 - np.concatenate([first, second])]
    shown = [venv.reset()[0], venv.step(np.array([1, 1]))[0][0]]
    if isinstance(model.observation_space, EncodedBox):
        stacks = [venv.encode(stack[None])[0] for stack in stacks]  # type: ignore[attr-defined]
    np.testing.assert_allclose(shown, stacks, atol=1e-4)
    venv.close()


def test_evaluated_and_recorded(zoo_run: Run, tmp_path: Path) -> None:
    with np.load(evaluate_final(zoo_run.folder, 3)) as arrays:
        assert arrays["stochastic/standard/ep_lengths"].tolist() == [LENGTH] * 3
    # One episode from its first frame to its end, whatever wrappers call an episode.
    assert record(zoo_run.folder, tmp_path / "a.gif", n_episodes=1).success == 1.0
    with Image.open(tmp_path / "a.gif") as gif:
        duration = sum(gif.seek(i) or gif.info["duration"] for i in range(gif.n_frames))
    assert duration == (LENGTH + N_LAST) * MILLISECONDS


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"env_wrapper": "nobody.knows.Wrapper"},
            r"nobody.knows.Wrapper' of a package .*--packages nobody$",
        ),
        ({"env_wrapper": "os.system"}, "config.yml names 'os.system' as a wrapper, which is no Wrapper"),
        ({"env_wrapper": [{"toy_env.Inverted": {}}]}, "'toy_env.Inverted', which is not there"),
        ({"vec_env_wrapper": "toy_env.Invert"}, "'toy_env.Invert' as a wrapper, which is no VecEnvWrapper"),
        ({"frame_stack": None, "vec_env_wrapper": None}, "was trained on .* but its environment shows"),
    ],
)
def test_a_run_folder_has_no_module_imported(zoo_run: Run, settings: dict[str, Any], message: str) -> None:
    changed = dataclasses.replace(zoo_run, settings={**zoo_run.settings, **settings})
    with pytest.raises(ValueError, match=message):
        make_run_env(changed, final_model(changed), 1, {}, 0)
