"""README.md: short, its numbers are of the results, and what it tells the reader to type runs."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import sb3_abisim
from sb3_abisim.registry import methods

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PRETRAIN = ["n_updates:20", "base.n_updates:20", "batch_size:32", "log_interval:10"]
SMALL = {"n_updates": 20, "batch_size": 32, "log_interval": 10}
PPO = ["n_envs:2", "n_steps:32", "batch_size:32", "n_epochs:1"]


def run(words: list[str], folder: Path) -> None:
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *words], cwd=folder, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_it_is_one_screen_with_the_two_commands_of_a_checkout() -> None:
    assert len(README.splitlines()) <= 120
    assert "\n    make demo " in README and "\n    make test " in README
    assert f"{{{sb3_abisim.__version__}}}" in README
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == sb3_abisim.__version__


def test_its_numbers_are_those_of_the_results() -> None:
    results = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    found = re.findall(r"[\d.]+ \[[\d., ]+\]|\d{3},\d{3} steps", README)
    assert len(found) == 3
    for number in found:
        assert number in results, number


def test_its_table_has_every_method() -> None:
    for method in methods().values():
        if not method.trained_elsewhere:
            assert re.search(rf"^\|.*`{method.name}`.*`{method.extractor}`", README, re.MULTILINE), method.name


def test_its_three_commands_run(tmp_path: Path) -> None:
    """On an environment that needs no further package, with small budgets."""
    lines = re.findall(r"^ {4}sb3-abisim (.*--packages ale_py.*|pretrain .*)$", README, re.MULTILINE)
    assert [line.split()[0] for line in lines] == ["collect", "pretrain", "train"]
    for line in lines:
        words = shlex.split(line.replace("ALE/Pong-v5 --packages ale_py", "Nav2D-v0").replace("200000", "2000"))
        if words[0] == "pretrain":
            words += ["-params", *PRETRAIN]
        if words[0] == "train":
            words += ["-n", "64", "--eval-freq", "-1", "-params", *PPO]
        run(["-m", "sb3_abisim", *words], tmp_path)
    assert (tmp_path / "logs" / "ppo" / "Nav2D-v0_1" / "Nav2D-v0.zip").is_file()


def test_an_agent_is_trained_and_recorded_by_its_first_commands(tmp_path: Path) -> None:
    lines = re.findall(r"^ {4}sb3-abisim ((?:train|record) .*DistractorPointMaze-v0.*)$", README, re.MULTILINE)
    assert [line.split()[0] for line in lines] == ["train", "record"]
    run(["-m", "sb3_abisim", *shlex.split(lines[0].replace("40960", "64").replace("128", "32"))], tmp_path)
    run(["-m", "sb3_abisim", *shlex.split(lines[1]), "--episodes", "1"], tmp_path)
    assert (tmp_path / "agent.gif").is_file()
    assert lines[0] in (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")


def test_its_python_runs(tmp_path: Path) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len([line for line in block.splitlines() if line]) <= 12
    for text, smaller in (
        ("200_000", "2_000"), ("100_000", "64"), ("PointMaze-v0", "Nav2D-v0"), (", 16)", ", 2)"),
        # Without a base, whose budget is no argument in Python.
        ('pretrain("abisim"', 'pretrain("ssi"'),
        ('"my/abisim.safetensors")', f'"my/abisim.safetensors", {SMALL})'),
        ("policy_kwargs=policy_kwargs", "n_steps=32, batch_size=32, n_epochs=1, policy_kwargs=policy_kwargs"),
    ):  # fmt: skip
        assert text in block
        block = block.replace(text, smaller)
    run(["-c", block], tmp_path)
    assert (tmp_path / "agent.zip").is_file()


@pytest.mark.parametrize("extra", re.findall(r"^([a-z]+) =\n {4}", (ROOT / "setup.cfg").read_text().partition(
    "[options.extras_require]")[2].partition("[tool:pytest]")[0], re.MULTILINE))  # fmt: skip
def test_the_quickstart_names_every_extra(extra: str) -> None:
    table = (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")
    assert re.search(rf"^\|.*`{extra}`.*\|", table, re.MULTILINE)
