"""The package of docs/extending.md, run from outside of ours: by import, and by an entry point."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "extending.md"
SMALL_PRETRAIN = ["n_updates:30", "log_interval:10", "batch_size:32"]
SMALL_PPO = ["n_envs:2", "n_steps:32", "batch_size:32", "n_epochs:1"]


def modules() -> dict[str, str]:
    """The page's modules by path."""
    blocks = re.findall(r"```python\n(# (my_package/\w+\.py)\n.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return {path: text for text, path in blocks}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package, as ``PYTHONPATH`` takes it."""
    folder = tmp_path_factory.mktemp("outside")
    for path, text in modules().items():
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_text(text)
    return folder


@pytest.fixture(scope="module")
def plugin(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, and what an installer writes beside it for the page's entry point."""
    declared = re.search(r'\[project\.entry-points\."([\w.]+)"\]\n(\w+) = "(\w+)"', PAGE.read_text(encoding="utf-8"))
    assert declared is not None
    group, name, module = declared.groups()
    folder = tmp_path_factory.mktemp("installed")
    (folder / "my_package").symlink_to(package / "my_package")
    info = folder / "my_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}\n")
    return folder


def run(folder: Path, cwd: Path, *words: str, code: int = 0) -> str:
    path = os.pathsep.join([str(folder), str(ROOT)])
    env = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "sb3_abisim", *words], cwd=cwd, env=env, capture_output=True, text=True
    )  # fmt: skip
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_the_page_has_a_module_for_each_kind() -> None:
    text = "".join(modules().values())
    for name in ("method", "network", "augmentation", "traits", "reader"):
        assert f"register_{name}(" in text


def _single_commands(folder: Path, tmp_path: Path, flags: list[str]) -> None:
    """What the jobs of a benchmark do as well, which get by an entry point what these get by ``--packages``."""
    words = ["--objective", "self_prediction", "--data", "data", "-o", "dot.safetensors"]
    run(folder, tmp_path, "pretrain", *flags, *words, "-params", *SMALL_PRETRAIN)
    card = json.loads((tmp_path / "dot.json").read_bytes())
    assert "train/prediction_error" in card["curves"] and card["features_dim"] == 32
    budget = ["-n", "64", "--eval-freq", "-1", "-f", "logs", "-params", *SMALL_PPO]
    augmented = "self_prediction=dot.safetensors,augment=cutout"
    for spec, label in ((augmented, False), ("self_prediction=dot.safetensors,frozen", True)):
        output = run(folder, tmp_path, "train", "--algo", "ppo", *flags, "--conf-file", spec, *budget)
        assert "Encoder" in output or "callback" not in output
        record = json.loads(max((tmp_path / "logs").glob("ppo/*/*/method.json"), key=os.path.getmtime).read_bytes())
        assert (record["method"], record["frozen"]) == ("self_prediction", label)
        assert record["augment"] == (None if label else "cutout")
        assert record["encoder_hash"]
    run(folder, tmp_path, "analyze", "probes", *flags, "dot.safetensors", "-n", "20", "--images", "figures")
    probes = json.loads((tmp_path / "figures" / "probes-my-Dot-v0.json").read_bytes())
    assert "dot.safetensors" in probes["encoders"]
    run(folder, tmp_path, "analyze", "readouts", *flags, "dot.safetensors", "-n", "60", "-o", "readouts.json")
    (scores,) = json.loads((tmp_path / "readouts.json").read_bytes())["encoders"]["dot.safetensors"]["scores"].values()
    assert list(scores) == ["optimal_action", "blocked_1", "blocked_2", "blocked_3", "blocked_4"]


@pytest.mark.parametrize("by", ["packages", "entry point"])
def test_everything_runs_with_what_a_package_adds(package: Path, plugin: Path, tmp_path: Path, by: str) -> None:
    folder, flag = (package, ["--packages", "my_package"]) if by == "packages" else (plugin, [])
    env = ["--env", "my/Dot-v0"]
    run(folder, tmp_path, "collect", *flag, *env, "-n", "2000", "-o", "data")
    meta = json.loads((tmp_path / "data" / "meta.json").read_bytes())
    assert (meta["env_id"], list(meta["factors"])) == ("my/Dot-v0", ["position"])
    if by == "packages":
        _single_commands(folder, tmp_path, [*flag, *env])
    small = ["--seeds", "0", "--n-transitions", "1000", "-n", "64", "--eval-freq", "32", "--eval-episodes", "1"]
    small += ["--n-eval-envs", "1", "--final-episodes", "1", "--device", "cpu", "-params", *SMALL_PPO]
    small += ["--pretrain-params", *SMALL_PRETRAIN, "--methods", "self_prediction", "vanilla", "-o", "benchmark"]
    run(folder, tmp_path, "benchmark", *flag, *env, *small)
    page = (tmp_path / "benchmark" / "report" / "index.html").read_text(encoding="utf-8")
    assert "self-prediction" in page and "my/Dot-v0" in page


def test_a_reader_makes_a_dataset(package: Path, tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (11, 3, 20, 20), dtype=np.uint8)
    np.savez(tmp_path / "episode.npz", observations=frames, actions=np.arange(10) % 4)
    words = ["data", "import", "npz_episode", "episode.npz", "-o", "data"]
    run(package, tmp_path, *words, "--packages", "my_package.reader")
    from sb3_abisim import TransitionDataset

    dataset = TransitionDataset(tmp_path / "data", eval_fraction=0.0)
    assert dataset.n_transitions == 10
    assert np.array_equal(dataset.frames(np.arange(11)), frames)


def test_without_the_package_everything_is_refused_by_name(package: Path, tmp_path: Path) -> None:
    assert "unknown environment 'my/Dot-v0'" in run(
        package, tmp_path, "collect", "--env", "my/Dot-v0", "-n", "9", "-o", "d", code=2
    )
    run(package, tmp_path, "collect", "--packages", "my_package", "--env", "my/Dot-v0", "-n", "500", "-o", "data")
    words = ["pretrain", "--objective", "self_prediction", "--data", "data", "-o", "dot.safetensors"]
    refused = run(package, tmp_path, *words, code=2)
    assert "unknown method 'self_prediction'" in refused and "--packages" in refused
    run(package, tmp_path, *words, "--packages", "my_package", "-params", *SMALL_PRETRAIN)
    refused = run(package, tmp_path, "pretrain", "--objective", "abisim", "--data", "data", "-o", "x.safetensors",
                  "--base", "dot.safetensors", code=2)  # fmt: skip
    assert "tiny" in refused and "--packages" in refused
    assert len(refused.strip().splitlines()[-1]) > 0


def test_a_network_is_named_by_its_import_path(package: Path, tmp_path: Path) -> None:
    """Pretraining imports it because the user names it; the file alone does not have it imported."""
    name, env = "my_package.networks:make_tiny", ["--env", "my/Dot-v0"]
    run(package, tmp_path, "collect", "--packages", "my_package", *env, "-n", "1000", "-o", "data")
    settings = ["-params", *SMALL_PRETRAIN, f"network:{name}", "network_kwargs.width:4"]
    run(package, tmp_path, "pretrain", "--objective", "ssi", "--data", "data", "-o", "dot.safetensors", *settings)
    assert json.loads((tmp_path / "dot.json").read_bytes())["features_dim"] == 32
    words = ["--algo", "ppo", *env, "-n", "64", "--eval-freq", "-1", "-f", "logs", "-params", *SMALL_PPO]
    for spec in ("ssi=dot.safetensors", "ssi=dot.safetensors,frozen"):
        flag = ["--packages", "my_package"]
        if not spec.endswith("frozen"):
            refused = run(package, tmp_path, "train", *flag, *words, "--conf-file", spec, code=2)
            assert f"--packages {name}" in refused
        run(package, tmp_path, "train", *flag, name, *words, "--conf-file", spec)
    # Of the first one, config.yml says which network it is; that file alone has nothing imported, either.
    enjoy = ["enjoy", "--packages", "my_package", name, "--algo", "ppo", *env]
    enjoy += ["-f", "logs", "--no-render", "-n", "9"]
    run(package, tmp_path, *enjoy, "--exp-id", "1")


def test_a_broken_plugin_is_left_out_with_a_warning(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("raise RuntimeError('no such luck')\n")
    info = tmp_path / "broken-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[sb3_abisim.plugins]\nbroken = broken\n")
    output = run(tmp_path, tmp_path, "collect", "--env", "Nav2D-v0", "-n", "64", "-o", "data")
    assert "the plugin broken (broken) cannot be loaded" in output and "no such luck" in output
    assert (tmp_path / "data" / "meta.json").is_file()
