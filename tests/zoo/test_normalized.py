"""Runs on normalized observations: evaluated, recorded and collected with as Stable-Baselines3 shows them."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize
from zoo_inputs import run

from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.zoo.evaluate import SEED, evaluate_final
from sb3_abisim.zoo.record import record
from sb3_abisim.zoo.run_envs import final_model, make_run_env
from sb3_abisim.zoo.runs import read_run

ENV_ID = "Nav2D-v0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    logs = tmp_path_factory.mktemp("logs")
    custom = logs / "custom.yml"
    custom.write_text(f"{ENV_ID}:\n  policy: MlpPolicy\n  n_timesteps: 256\n  n_envs: 2\n  n_steps: 64\n"
                      "  normalize: true\n  batch_size: 64\n  learning_rate: 0.01\n")  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        words = ["--algo", "ppo", "--env", ENV_ID, "-f", str(logs), "--conf-file", str(custom)]
        run(patch, "train", *words, "--eval-freq", "-1", "--num-threads", "1", "--seed", "5")
    return logs / "ppo" / f"{ENV_ID}_1"


def unpickled(folder: Path, n_envs: int) -> tuple[PPO, VecNormalize]:
    env = VecNormalize.load(str(folder / ENV_ID / "vecnormalize.pkl"), make_vec_env(ENV_ID, n_envs, seed=SEED))
    env.training, env.norm_reward = False, False
    return PPO.load(folder / f"{ENV_ID}.zip", device="cpu"), env


def test_evaluation_is_that_of_the_unpickled_run(folder: Path) -> None:
    model, env = unpickled(folder, 4)
    evaluate_final(folder, 4)
    made = read_run(folder)
    shown = make_run_env(made, final_model(made), 1, {}, 0)
    assert isinstance(shown, VecNormalize) and not (shown.training or shown.norm_reward)
    shown.close()
    found = made.final()
    assert found is not None
    for mode in ("deterministic", "stochastic"):
        set_random_seed(SEED)
        returns, lengths = evaluate_policy(model, env, 4, mode == "deterministic", return_episode_rewards=True)
        env.seed(SEED)
        assert found[f"{mode}/standard/results"].tolist() == returns
        assert found[f"{mode}/standard/ep_lengths"].tolist() == lengths
    env.close()


@pytest.mark.parametrize("normalize", ["true", '"dict(norm_obs=False, norm_reward=True)"'])
def test_plain_evaluation_as_in_the_docs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, normalize: str) -> None:
    """The code of docs/zoo.md gives what this package does."""
    monkeypatch.chdir(tmp_path)
    Path("custom.yml").write_text(
        "PointMaze-v0:\n  policy: CnnPolicy\n  n_timesteps: 64\n  n_envs: 2\n  n_steps: 32\n  batch_size: 32\n"
        f"  n_epochs: 1\n  normalize: {normalize}\n"
        + ("  policy_kwargs: dict(normalize_images=False)\n" if normalize == "true" else "")
    )
    words = ["--algo", "ppo", "--env", "PointMaze-v0", "-f", "logs", "--conf-file", "custom.yml"]
    run(monkeypatch, "train", *words, "--eval-freq", "-1", "--num-threads", "1", "--seed", "5")
    page = (Path(__file__).resolve().parents[2] / "docs" / "zoo.md").read_text()
    (code,) = re.findall(
        r"```python\n(.*?)```", page.split("## A run in plain Stable-Baselines3")[1].split("\n## ")[0], re.S
    )
    scope: dict[str, Any] = {}
    for old, new in (("16, seed=0", f"3, seed={SEED}"), ("env, 100)", "env, 3)")):
        assert old in code
        code = code.replace(old, new)
    exec(code, scope)
    folder = Path("logs/ppo/PointMaze-v0_1")
    made = read_run(folder)
    ours = make_run_env(made, final_model(made), 3, {}, SEED)
    scope["env"].seed(SEED)
    shown = scope["env"].reset()
    assert np.array_equal(shown, ours.reset()) and (shown.min() < 0) == (normalize == "true")
    scope["env"].close(), ours.close()
    evaluate_final(folder, 3)
    found = made.final()
    assert found is not None
    assert scope["mean"] == pytest.approx(found["deterministic/standard/results"].mean(), rel=1e-6)


def test_it_is_recorded(folder: Path, tmp_path: Path) -> None:
    record(folder, tmp_path / "a.gif", 1)
    assert (tmp_path / "a.gif").stat().st_size


def test_it_acts_on_what_it_was_trained_on(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["collect", "--env", ENV_ID, "-n", "100", "--n-envs", "2", "-o", str(tmp_path / "d")]
    run(monkeypatch, *words, "--policy", str(folder))
    dataset, (model, env) = TransitionDataset(tmp_path / "d"), unpickled(folder, 1)
    starts = dataset.valid_starts()
    observations = dataset.frames(dataset.pairs(1, "train")[0])
    assert len(observations)
    normalized = env.normalize_obs(observations)
    expected, plain = (model.predict(each, deterministic=True)[0] for each in (normalized, observations * 1.0))
    assert dataset.actions(starts)[: len(expected)].tolist() == expected.tolist() != plain.tolist()
    env.close()


@pytest.mark.parametrize("harm", ["flipped", "gone", "smaller"])
def test_means_that_are_not_those_of_the_run(folder: Path, tmp_path: Path, harm: str) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    path = copy / ENV_ID / "vecnormalize.pkl"
    if harm == "flipped":
        changed = bytearray(path.read_bytes())
        changed[len(changed) // 2] ^= 1
        path.write_bytes(changed)
    elif harm == "gone":
        path.unlink()
    else:
        (copy / "hashes.json").unlink()
        env = VecNormalize(make_vec_env("CartPole-v1"))
        env.save(str(path))
    message = {"flipped": "vecnormalize.pkl is damaged: its sha256", "gone": "vecnormalize.pkl is not there",
               "smaller": "has means of observations"}  # fmt: skip
    with pytest.raises(ValueError, match=message[harm]):
        evaluate_final(copy, 1)
