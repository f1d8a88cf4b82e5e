"""rl-zoo3's commands with our methods, in this process and in fresh ones."""

import errno
import gc
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
from zoo_inputs import SMALL, run, write_encoder

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.vec_encode import VecEncodeObservations
from sb3_abisim.zoo import merge
from sb3_abisim.zoo.command import SCRIPTS, for_rl_zoo3
from sb3_abisim.zoo.evaluate import evaluate_final
from sb3_abisim.zoo.manager import MethodExperimentManager
from sb3_abisim.zoo.run_files import read_yaml

exp_manager = importlib.import_module("rl_zoo3.exp_manager")

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("algo", "env_id", "method"),
    [
        ("ppo", "Nav2D-v0", "ssi,frozen"),
        ("ppo", "Nav2D-v0", "ssi,frozen,task_features_dim=8,augment=random_shift"),
        ("dqn", "Nav2D-v0", "drq"),
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
    if method not in ("vanilla", "drq"):
        name, comma, rest = method.partition(",")
        hash = write_encoder(encoder, env_id, name)
        word = f"{name}={encoder}{comma}{rest}"
    common = ["--algo", algo, "--env", env_id, "-f", str(tmp_path), "--num-threads", "1"]
    small = ["--eval-freq", "200", "--eval-episodes", "1", "-params", *SMALL[algo]]
    run(monkeypatch, "train", *common, "-n", "300", "--seed", "1", "--conf-file", word, *small)
    out = capsys.readouterr().out
    state = "frozen" if "frozen" in method else "fine-tuned" if hash else "trained from scratch"
    # One line for each network with a separate encoder.
    assert out.count("Encoder ") == (2 if algo == "sac" else 1)
    assert f"hash {hash}" in out if hash else "random weights" in out
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
    """Its folder, moved elsewhere, with another encoder now under the old name; merged, without any encoder file."""
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
    merge.main(["--algo", "ppo", str(folder / "Nav2D-v0.zip"), "-o", str(tmp_path / "merged.zip")])
    model = PPO.load(tmp_path / "merged.zip", device="cpu")
    assert model.policy.features_extractor.hash == hash
    on_embeddings = PPO.load(folder / "Nav2D-v0.zip", device="cpu")
    observations = np.random.default_rng(0).integers(0, 256, (20, 3, 15, 15), np.uint8)
    with th.no_grad():
        expected = on_embeddings.policy.predict_values(
            model.policy.features_extractor(th.from_numpy(observations) / 255)
        )
        assert th.allclose(model.policy.predict_values(th.from_numpy(observations)), expected, atol=1e-5)
    with pytest.raises(SystemExit):
        merge.main(["--algo", "ppo", str(folder / "Nav2D-v0.zip"), "-e", "mistyped", "-o", str(tmp_path / "x.zip")])
    assert "no encoder file 'mistyped'" in capsys.readouterr().err


def test_flags_in_the_form_of_rl_zoo3() -> None:
    flags = ["--algo", "ppo", "--packages", "a", "b.c", "-n", "-1", "-params", "gamma:0.9", "learning_rate:lin_1e-4"]
    flags += ["ent_coef:1e-3", "train_freq:(1,'episode')", "use_sde:true", "policy_kwargs:{net_arch: [7]}", "a:null"]
    flags += ["--env-kwargs", "split:eval", "path:'a:b'", "--packages=d", "-params=n_steps:5", "-conf", "ssi=x,frozen"]
    words, packages = for_rl_zoo3(flags)
    assert packages == ["a", "b.c", "d"]
    assert words[:4] == ["--algo", "ppo", "-n", "-1"]
    assert words[4:12] == [
        "-params",
        "gamma:0.9",
        "learning_rate:'lin_1e-4'",
        "ent_coef:0.001",
        "train_freq:(1, 'episode')",
        "use_sde:True",
        "policy_kwargs:{'net_arch': [7]}",
        "a:None",
    ]
    assert words[12:] == ["--env-kwargs", "split:'eval'", "path:'a:b'", "-params", "n_steps:5", "-conf", "ssi=x,frozen"]
    for flags, message in (
        (["-params", "gamma"], "-params takes NAME:VALUE words"),
        (["--eval-env-kwargs", "1:2"], "--eval-env-kwargs takes NAME:VALUE words"),
        (["-params", "policy_kwargs.net_arch:[7]"], "-params sets whole hyperparameters.*give policy_kwargs, or write"),
    ):
        with pytest.raises(ValueError, match=message):
            for_rl_zoo3(flags)


def test_values_reach_rl_zoo3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["train", "--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "-n", "16", "--eval-freq", "-1"]
    words += ["--conf-file", "vanilla", "--env-kwargs", "layout:maze", "--packages", "toy_env", "--num-threads", "1"]
    pairs = ["n_envs:1", "n_steps:16", "batch_size:16", "learning_rate:lin_1e-4", "normalize:false"]
    run(monkeypatch, *words, "-params", *pairs)
    out = capsys.readouterr().out
    assert "'learning_rate', 'lin_1e-4'" in out and "env_kwargs={'layout': 'maze'}" in out
    # The run's folder says what has to be imported.
    args = read_yaml(tmp_path / "ppo" / "Nav2D-v0_1" / "Nav2D-v0" / "args.yml")
    assert args["gym_packages"] == ["toy_env"]


# In one word: a pair for the only argument of the callback.
FINE_TUNED = (
    '--env Nav2D-v0 -params callback:{{"sb3_abisim.EncoderCallback":{{"{}":{}}}}} n_envs:2 n_steps:32 batch_size:32'
)


# rl-zoo3 leaves the monitor files open that it had opened before the mistake.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--env Nonsense-v0", "Nonsense-v0 not found in gym registry"),
        ("--env Nav2D-v0 --conf-file abisin", "'abisin' is no YAML or Python file, module or method"),
        ("--env Nav2D-v0 --conf-file abisim=tpyo.safetensors", "no encoder file 'tpyo.safetensors'"),
        ("--env Nav2D-v0 --conf-file abisim=tpyo.safetensors,frozen", "no encoder file 'tpyo.safetensors'"),
        ("--env Nav2D-v0 --conf-file vanilla -params policy_kwargs:{}", "-params policy_kwargs would undo"),
        ("--env Nav2D-v0 --conf-file vanilla -params nonsense:1", "unexpected keyword argument 'nonsense'"),
        ("--env Nav2D-v0 --conf-file vanilla --env-kwargs nonsense:1", "takes no argument 'nonsense'"),
        ("--env Nav2D-v0 -params gamma", "-params takes NAME:VALUE words"),
        ("--env Nav2D-v0 --packages no_such_module", "--packages: cannot import 'no_such_module'"),
        ("--env Nav2D-v0 -i no_such_model.zip", "trained_agent must be a valid path"),
        ("--env Toy-v0 --packages toy_env --conf-file ssi", "no encoder ships for this environment"),
        (f"{FINE_TUNED.format('unfreeze_at', 9)} --conf-file vanilla", "the policy holds no frozen encoder"),
        (f"{FINE_TUNED.format('unfreeze_at', 9)} --conf-file abisim,frozen", "give freeze: true in features_extractor"),
        (f"{FINE_TUNED.format('encoder_lr', 0)} --conf-file vanilla", "encoder_lr must be a number above 0"),
        (f"{FINE_TUNED.format('encoder_lrr', 1)} --conf-file vanilla", "unexpected keyword argument 'encoder_lrr'"),
        (f"{FINE_TUNED.format('encoder_trained_by', 'critic')} --conf-file vanilla", "is for SAC, TD3 and TQC"),
    ],
)
def test_mistakes_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, words: str, message: str
) -> None:
    # An earlier run of this process has begun to train.
    monkeypatch.setattr(MethodExperimentManager, "has_begun", True)
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, "train", "--algo", "ppo", "-f", str(tmp_path), "-n", "64", *words.split(" "))
    assert stopped.value.code == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("sb3-abisim train: error: ") and message in error
    # Here rather than in a later test, which ends with a warning as an error.
    gc.collect()


@pytest.mark.parametrize("error", [ValueError, TypeError])
def test_errors_of_training_keep_their_traceback(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: type[Exception]
) -> None:
    def collect_rollouts(*_: Any, **__: Any) -> bool:
        raise error("unexpected keyword argument, in training")

    monkeypatch.setattr(PPO, "collect_rollouts", collect_rollouts)
    words = ["--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "-n", "64", "--eval-freq", "-1"]
    with pytest.raises(error, match="in training"):
        run(monkeypatch, "train", *words, "--conf-file", "vanilla", "-params", *SMALL["ppo"])


@pytest.mark.parametrize("is_beneath", [False, True])
def test_a_full_disk_in_the_middle_of_training_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str], is_beneath: bool
) -> None:
    def save(*_: Any, **__: Any) -> None:
        full = OSError(errno.ENOSPC, "No space left on device", "model.zip")
        if is_beneath:
            raise RuntimeError("a writer of PyTorch failed") from full
        raise full

    monkeypatch.setattr(PPO, "save", save)
    words = ["--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "-n", "64", "--eval-freq", "-1"]
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, "train", *words, "--conf-file", "vanilla", "-params", *SMALL["ppo"])
    error = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 1 and not any("Traceback" in line for line in error)
    assert error[-1].startswith("sb3-abisim train: [Errno 28] No space left on device: 'model.zip'; training has")


def test_errors_that_are_no_mistakes_keep_their_traceback(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def setup_experiment(_: Any) -> None:
        raise TypeError("unsupported operand")

    monkeypatch.setattr(MethodExperimentManager, "setup_experiment", setup_experiment)
    with pytest.raises(TypeError, match="unsupported operand"):
        run(monkeypatch, "train", "--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path))


@pytest.mark.parametrize("words", [["train"], ["enjoy"], *(["zoo", name] for name in SCRIPTS)])
def test_help_shows_an_example(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, *words, "--help")
    out = capsys.readouterr().out
    assert not stopped.value.code and f"example: sb3-abisim {' '.join(words)} " in out
    assert "usage: " in out and ("METHOD[=ENCODER][,frozen]" in out) == (words[-1] == "train")


def test_optimize_keeps_the_encoder(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    hash = write_encoder(tmp_path / "mine.safetensors", "Nav2D-v0")
    models: list[Any] = []
    ppo = exp_manager.ALGOS["ppo"]

    class Recorded(ppo):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            models.append(self)

    def sample(*_: Any) -> dict[str, Any]:
        return {"n_steps": 16, "batch_size": 16, "policy_kwargs": {"net_arch": [7], "activation_fn": nn.Tanh}}

    monkeypatch.setitem(exp_manager.ALGOS, "ppo", Recorded)
    monkeypatch.setitem(exp_manager.HYPERPARAMS_SAMPLER, "ppo", sample)
    argv = ["train", "--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "-n", "64", "--no-optim-plots"]
    argv += ["-optimize", "--n-trials", "2", "--n-evaluations", "1", "--num-threads", "1"]
    run(monkeypatch, *argv, "--conf-file", f"abisim={tmp_path / 'mine.safetensors'}")
    assert len(models) == 2
    for model in models:
        assert model.policy.features_extractor.hash == hash
        assert model.policy.mlp_extractor.policy_net[0].out_features == 7
    assert capsys.readouterr().out.count(hash) == 2


def test_unknown_commands(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, "zoo", "trian", "--algo", "ppo")
    assert stopped.value.code == 2 and "unknown command 'trian'; known are train, enjoy" in capsys.readouterr().err
    run(monkeypatch, "zoo")
    assert "A command of rl-zoo3: train, enjoy, record_video" in capsys.readouterr().out


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
    assert f"ActionBisimExtractor, source DistractorPointMaze-v0/abisim, hash {hash}" in done.stdout
    done = _python("-m", "rl_zoo3.enjoy", *argv, "-n", "130", "--no-render", cwd=ROOT)
    assert done.returncode == 0 and "Mean reward: -" in done.stdout, done.stderr


def test_record_video_in_the_checkout(tmp_path: Path) -> None:
    """It imports the manager first, and with it custom_envs, while the manager's module is half done."""
    # Stable-Baselines3 records with it; rl-zoo3 does not ask for it.
    pytest.importorskip("moviepy")
    encoder = tmp_path / "mine.safetensors"
    write_encoder(encoder, "DistractorPointMaze-v0", "ssi")
    argv = ["--algo", "ppo", "--env", "DistractorPointMaze-v0", "-f", str(tmp_path)]
    small = ["-n", "64", "--eval-freq", "-1", "--num-threads", "1", "-params", *SMALL["ppo"]]
    done = _python("-m", "rl_zoo3.train", *argv, "--conf-file", f"ssi={encoder},frozen", *small, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    # The copy in the run's folder is what it needs.
    encoder.unlink()
    done = _python("-m", "rl_zoo3.record_video", *argv, "-n", "20", cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "ppo" / "DistractorPointMaze-v0_1" / "videos").glob("*.mp4"))


def test_plain_commands_elsewhere(tmp_path: Path) -> None:
    encoder = tmp_path / "mine.safetensors"
    hash = write_encoder(encoder, "Nav2D-v0", "ssi")
    argv = ["--algo", "ppo", "--env", "Nav2D-v0", "--gym-packages", "sb3_abisim.zoo", "--num-threads", "1"]
    small = ["-n", "64", "--eval-freq", "-1", "--conf-file", f"ssi={encoder},frozen", "-params", *SMALL["ppo"]]
    done = _python("-m", "rl_zoo3.train", *argv, *small, cwd=tmp_path)
    assert (
        done.returncode == 0 and f"Encoder of the environment: VecEncodeObservations, source {encoder}" in done.stdout
    )
    assert f"hash {hash}" in done.stdout, done.stderr
    encoder.unlink()
    done = _python("-m", "rl_zoo3.enjoy", *argv, "-f", "logs", "-n", "60", "--no-render", cwd=tmp_path)
    assert done.returncode == 0 and "Mean reward" in done.stdout, done.stderr


def test_one_command_elsewhere(tmp_path: Path) -> None:
    argv = ["--algo", "ppo", "--env", "Nav2D-v0", "-n", "64", "--eval-freq", "-1", "--num-threads", "1"]
    argv += ["--conf-file", "vanilla", "-params", *SMALL["ppo"]]
    done = _python("-m", "sb3_abisim", "train", *argv, cwd=tmp_path)
    assert done.returncode == 0 and "Encoder features_extractor: VanillaExtractor" in done.stdout, done.stderr
    folder = tmp_path / "logs" / "ppo" / "Nav2D-v0_1" / "Nav2D-v0"
    assert "-m sb3_abisim train --algo ppo" in (folder / "command.txt").read_text()


def test_install_from_within_the_import_of_the_zoo() -> None:
    """Programs that import ExperimentManager first import custom_envs while that module is half done."""
    code = "from rl_zoo3.exp_manager import ExperimentManager as E; import rl_zoo3.exp_manager as m, rl_zoo3, sys;"
    code += "assert E.__name__ == 'MethodExperimentManager' and m.ExperimentManager is E;"
    code += "assert rl_zoo3.exp_manager is m is sys.modules['rl_zoo3.exp_manager']"
    done = _python("-c", code, cwd=ROOT)
    assert done.returncode == 0, done.stderr
