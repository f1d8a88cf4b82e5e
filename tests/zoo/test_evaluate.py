"""The final evaluation is in episodes that training has not seen, the same for every model, on every split."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_inputs import write_run
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_abisim import VanillaExtractor
from sb3_abisim.envs.base import SingleEnv
from sb3_abisim.envs.point_maze.distractors import DistractorPointMazeVectorEnv
from sb3_abisim.zoo.evaluate import MODES, evaluate_final

N_TRAINING_ENVS = 8


class Reset:
    """Records the seeds and first observations of environments.

    :param monkeypatch: of the test
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seeds: list[int] = []
        self.layouts: list[bytes] = []
        plain = SingleEnv.reset

        def reset(env: SingleEnv, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            observation, info = plain(env, seed=seed, options=options)
            self.seeds += [] if seed is None else [seed]
            self.layouts.append(observation.tobytes())
            return observation, info

        monkeypatch.setattr(SingleEnv, "reset", reset)


def make_run(folder: Path, env_id: str, seed: int, env_kwargs: dict[str, Any] | None = None) -> Path:
    """A run that has just begun: its environments are reset as rl-zoo3 does, and its model acts with random weights."""
    run = write_run(folder, env_id, "vanilla", seed, [100], np.zeros((1, 2)))
    env = make_vec_env(env_id, N_TRAINING_ENVS, seed=seed, env_kwargs=env_kwargs)
    model = PPO("CnnPolicy", env, seed=seed, policy_kwargs={"features_extractor_class": VanillaExtractor}, device="cpu")
    env.reset()
    model.save(run / f"{env_id}.zip")
    return run


@pytest.mark.parametrize("seed", [0, 4])
def test_episodes_are_not_those_of_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    training = Reset(monkeypatch)
    run = make_run(tmp_path, "Nav2D-v0", seed)
    assert training.seeds == list(range(seed, seed + N_TRAINING_ENVS)) and len(training.layouts) == N_TRAINING_ENVS
    monkeypatch.undo()
    evaluation = Reset(monkeypatch)
    evaluate_final(run, 20)
    # Far from all that people give as --seed, with the copies of an environment counted from it.
    assert evaluation.seeds and min(evaluation.seeds) > 100_000
    assert len(set(evaluation.layouts)) >= 20 and not set(evaluation.layouts) & set(training.layouts)


def test_every_model_meets_the_same_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    met = []
    for seed in (1, 2):
        run = make_run(tmp_path, "Nav2D-v0", seed)
        with pytest.MonkeyPatch.context() as patch:
            # No move before the end, so that episodes end at the same time for both.
            patch.setattr(PPO, "predict", lambda self, obs, *args, **kwargs: (np.zeros(len(obs), np.int64), None))
            evaluation = Reset(patch)
            evaluate_final(run, 5)
        met.append((evaluation.seeds, evaluation.layouts))
    assert met[0] == met[1]


def test_both_modes_on_every_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[tuple[str, str]] = []
    plain = PPO.predict

    def predict(self: PPO, obs: Any, *args: Any, deterministic: bool = False, **kwargs: Any) -> Any:
        shown.append((splits[-1], MODES[0] if deterministic else MODES[1]))
        return plain(self, obs, *args, deterministic=deterministic, **kwargs)

    splits: list[str] = []
    make = DistractorPointMazeVectorEnv.__init__

    def note_split(self: Any, *args: Any, split: str = "train", **kwargs: Any) -> None:
        splits.append(split)
        make(self, *args, split=split, **kwargs)

    run = make_run(tmp_path, "DistractorPointMaze-v0", 0)
    monkeypatch.setattr(PPO, "predict", predict)
    monkeypatch.setattr(DistractorPointMazeVectorEnv, "__init__", note_split)
    with np.load(evaluate_final(run, 2)) as arrays:
        found = {name: arrays[name].shape for name in arrays}
    expected = [(split, mode) for split in ("eval", "train", "clean") for mode in ("deterministic", "stochastic")]
    assert list(dict.fromkeys(shown)) == expected
    assert found == {
        f"{mode}/{split}/{name}": (2,) for split, mode in expected for name in ("results", "ep_lengths", "successes")
    }


def test_a_repeated_evaluation_is_the_same(tmp_path: Path) -> None:
    run = make_run(tmp_path, "Nav2D-v0", 0)
    found = []
    for state in (1, 2):
        np.random.seed(state)
        with np.load(evaluate_final(run, 60)) as arrays:
            found.append({name: arrays[name].tolist() for name in arrays})
    assert found[0] == found[1]
    # Random actions lead to the goal now and then.
    assert min(found[0]["stochastic/standard/ep_lengths"]) < 50


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda run: (run / "Nav2D-v0.zip").unlink(), "holds no final model"),
        (lambda run: (run / "Nav2D-v0" / "args.yml").unlink(), "is no run folder of rl-zoo3"),
    ],
)
def test_a_run_that_has_not_ended_is_refused(tmp_path: Path, change: Any, message: str) -> None:
    run = make_run(tmp_path, "Nav2D-v0", 0)
    with pytest.raises(ValueError, match="n_episodes must be at least 1, got 0"):
        evaluate_final(run, 0)
    change(run)
    with pytest.raises(ValueError, match=message):
        evaluate_final(run, 1)
