"""The zoo's commands themselves, in this process and in fresh ones."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import unwrap_vec_wrapper
from torch import nn
from zoo_inputs import SMALL, write_encoder

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl import merge as frozen
from sb3_abisim.rl.vec_encode import VecEncodeObservations
from sb3_abisim.zoo import manager as zoo
from sb3_abisim.zoo.evaluate import evaluate_final

exp_manager = importlib.import_module("rl_zoo3.exp_manager")

ROOT = Path(__file__).resolve().parents[2]


def run(monkeypatch: pytest.MonkeyPatch, *argv: str) -> None:
    monkeypatch.setattr(sys, "argv", [])
    zoo.main(list(argv))


@pytest.mark.parametrize(
    ("algo", "env_id", "method"),
    [
        ("ppo", "Nav2D-v0", "ssi,frozen"),
        ("ppo", "PointMaze-v0", "vanilla"),
        ("dqn", "Nav2D-v0", "abisim"),
        ("ppo", "ContinuousDistractorPointMaze-v0", "beta_vae"),
        ("sac", "ContinuousPointMaze-v0", "abisim"),
    ],
)
def test_train_and_enjoy(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    algo: str,
    env_id: str,
    method: str,
) -> None:
    hash, word, encoder = "", method, tmp_path / "mine.safetensors"
    if method != "vanilla":
        name, comma, frozen = method.partition(",")
        hash = write_encoder(encoder, env_id, name)
        word = f"{name}={encoder}{comma}{frozen}"
    common = ["--algo", algo, "--env", env_id, "-f", str(tmp_path), "--num-threads", "1"]
    small = ["--eval-freq", "200", "--eval-episodes", "1", "-params", *SMALL[algo]]
    run(monkeypatch, "train", *common, "-n", "300", "--seed", "1", "--conf-file", word, *small)
    out = capsys.readouterr().out
    state = "frozen" if method.endswith("frozen") else "trained along"
    # One line for each network with an encoder of its own.
    assert out.count("Encoder ") == (2 if algo == "sac" else 1)
    assert f"digest {hash}" in out if hash else "random weights" in out
    assert state in out and (state == "frozen" or "| encoder/ " in out)
    folder = tmp_path / algo / f"{env_id}_1"
    evaluations = np.load(folder / "evaluations.npz")
    assert evaluations["successes"].shape == (1, 1)
    assert "is_success" in (folder / "0.monitor.csv").read_text().splitlines()[1].split(",")
    # A run folder is complete in itself: the encoder file may be gone.
    encoder.unlink(missing_ok=True)
    run(monkeypatch, "enjoy", *common, "-n", "130", "--no-render")
    assert "Mean reward" in capsys.readouterr().out


def test_a_frozen_run_acts_on_the_encoder_it_was_trained_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Its folder, moved elsewhere, with another encoder now under the old name; fused, without any encoder file."""
    encoder = tmp_path / "mine.safetensors"
    hash = write_encoder(encoder, "Nav2D-v0")
    argv = ["--algo", "ppo", "--env", "Nav2D-v0", "--num-threads", "1"]
    small = ["-n", "64", "--eval-freq", "-1", "-params", *SMALL["ppo"]]
    run(monkeypatch, "train", *argv, "-f", str(tmp_path / "logs"), "--conf-file", f"abisim={encoder},frozen", *small)
    write_encoder(encoder, "Nav2D-v0", "ssi")
    (tmp_path / "logs").rename(tmp_path / "moved")
    seen: list[Any] = []
    rl_zoo3 = importlib.import_module("rl_zoo3")
    make = rl_zoo3.create_test_env

    def create_test_env(*args: Any, **kwargs: Any) -> Any:
        seen.append(make(*args, **kwargs))
        return seen[-1]

    monkeypatch.setattr(rl_zoo3, "create_test_env", create_test_env)
    run(monkeypatch, "enjoy", *argv, "-f", str(tmp_path / "moved"), "-n", "60", "--no-render")
    capsys.readouterr()
    encoding = unwrap_vec_wrapper(seen[0], VecEncodeObservations)
    assert encoding is not None and encoding.encoder_file.hash == hash
    folder = tmp_path / "moved" / "ppo" / "Nav2D-v0_1"
    assert np.load(evaluate_final(folder, 2))["stochastic/standard/results"].shape == (2,)
    frozen.main(["--algo", "ppo", str(folder / "Nav2D-v0.zip"), "-o", str(tmp_path / "fused.zip")])
    model = PPO.load(tmp_path / "fused.zip", device="cpu")
    assert model.policy.features_extractor.hash == hash
    on_embeddings = PPO.load(folder / "Nav2D-v0.zip", device="cpu")
    frames = np.random.default_rng(0).integers(0, 256, (20, 3, 15, 15), np.uint8)
    with th.no_grad():
        expected = on_embeddings.policy.predict_values(model.policy.features_extractor(th.from_numpy(frames) / 255))
        assert th.allclose(model.policy.predict_values(th.from_numpy(frames)), expected, atol=1e-5)
    with pytest.raises(SystemExit):
        frozen.main(["--algo", "ppo", str(folder / "Nav2D-v0.zip"), "-e", "mistyped", "-o", str(tmp_path / "x.zip")])
    assert "no encoder file 'mistyped'" in capsys.readouterr().err


# The zoo has already opened its monitor files when it wraps the environment.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_mistyped_encoder_stops_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    argv = ["train", "--algo", "dqn", "--env", "Nav2D-v0", "-f", str(tmp_path), "-n", "300", "--eval-freq", "-1"]
    for word in ("abisim=tpyo.safetensors", "abisim=tpyo.safetensors,frozen"):
        with pytest.raises(FileNotFoundError, match=r"no encoder file 'tpyo\.safetensors'"):
            run(monkeypatch, *argv, "--conf-file", word, "-params", *SMALL["dqn"])


def test_optimize_keeps_the_encoder(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    hash = write_encoder(tmp_path / "mine.safetensors", "Nav2D-v0")
    models: list[Any] = []
    ppo = exp_manager.ALGOS["ppo"]

    def make(*args: Any, **kwargs: Any) -> Any:
        models.append(ppo(*args, **kwargs))
        return models[-1]

    def sample(*_: Any) -> dict[str, Any]:
        return {"n_steps": 16, "batch_size": 16, "policy_kwargs": {"net_arch": [7], "activation_fn": nn.Tanh}}

    monkeypatch.setitem(exp_manager.ALGOS, "ppo", make)
    monkeypatch.setitem(exp_manager.HYPERPARAMS_SAMPLER, "ppo", sample)
    argv = ["train", "--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "-n", "64", "--no-optim-plots"]
    argv += ["-optimize", "--n-trials", "2", "--n-evaluations", "1", "--num-threads", "1"]
    run(monkeypatch, *argv, "--conf-file", f"abisim={tmp_path / 'mine.safetensors'}")
    assert len(models) == 2
    for model in models:
        assert model.policy.features_extractor.hash == hash
        assert model.policy.mlp_extractor.policy_net[0].out_features == 7
    assert capsys.readouterr().out.count(hash) == 2


def test_unknown_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        zoo.main(["trian", "--algo", "ppo"])
    assert stopped.value.code == 2 and "train" in capsys.readouterr().err


def _python(*argv: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.run([sys.executable, *argv], cwd=cwd, env=environment, capture_output=True, text=True)


def test_plain_zoo_command_in_the_checkout(tmp_path: Path) -> None:
    """Needs the encoders that ship, like test_shipped_encoders."""
    argv = ["--algo", "ppo", "--env", "DistractorPointMaze-v0", "-f", str(tmp_path), "--num-threads", "1"]
    small = ["-n", "64", "--eval-freq", "-1", "-params", *SMALL["ppo"]]
    done = _python("-m", "rl_zoo3.train", *argv, *small, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert f"Loading hyperparameters from: {ROOT / 'hyperparams' / 'ppo.yml'}" in done.stdout
    hash = load_encoder("DistractorPointMaze-v0/abisim").hash
    assert f"ActionBisimExtractor, source DistractorPointMaze-v0/abisim, digest {hash}" in done.stdout
    done = _python("-m", "rl_zoo3.enjoy", *argv, "-n", "130", "--no-render", cwd=ROOT)
    assert done.returncode == 0 and "Mean reward: -" in done.stdout, done.stderr


def test_zoo_command_elsewhere(tmp_path: Path) -> None:
    argv = ["--algo", "ppo", "--env", "Nav2D-v0", "-n", "64", "--eval-freq", "-1"]
    argv += ["--gym-packages", "sb3_abisim.zoo.manager", "--conf-file", "vanilla", "-params", *SMALL["ppo"]]
    done = _python("-m", "rl_zoo3.train", *argv, cwd=tmp_path)
    assert done.returncode == 0 and "Encoder features_extractor: VanillaExtractor" in done.stdout, done.stderr


def test_install_from_within_the_import_of_the_zoo() -> None:
    """Programs that import ExperimentManager first import custom_envs while that module is half done."""
    code = "from rl_zoo3.exp_manager import ExperimentManager as E; import rl_zoo3.exp_manager as m;"
    code += "assert E.sb3_abisim_installed and m.ExperimentManager is E"
    done = _python("-c", code, cwd=ROOT)
    assert done.returncode == 0, done.stderr
