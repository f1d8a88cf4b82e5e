"""Run folders and exports: a changed bit in any of their results is found, and damage of any kind names its file."""

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_inputs import write_run
from zoo_inputs import SMALL, run

from sb3_abisim.benchmark.command import main as benchmark
from sb3_abisim.benchmark.export import add_hashes, export
from sb3_abisim.benchmark.report.tables import compare
from sb3_abisim.common.hashes import HASHES_NAME
from sb3_abisim.zoo.evaluate import evaluate_final
from sb3_abisim.zoo.run_files import result_names
from sb3_abisim.zoo.runs import find_runs, missing_runs, read_run

STEPS = [100, 200, 300]
ENV_ID = "PointMaze-v0"


def make(folder: Path) -> Path:
    """A benchmark's folder with two runs, without hashes."""
    entries = []
    for method in ("abisim", "vanilla"):
        returns = np.random.default_rng(0).uniform(-100, 0, (len(STEPS), 4))
        made = write_run(folder / "runs" / method, ENV_ID, method, 0, STEPS, returns,
                         final={"deterministic/standard": returns[0], "stochastic/standard": returns[1]})  # fmt: skip
        rows = "".join(f"{-k},{k + 1},{k}.5,{k % 2 == 0}\n" for k in range(30))
        (made / "0.monitor.csv").write_text('#{"t_start": 0.0, "env_id": "PointMaze-v0"}\nr,l,t,is_success\n' + rows)
        output = made.relative_to(folder).as_posix()
        entries.append({"folder": output, "label": method})
        manifest = {"name": f"run-{method}", "output": output, "inputs": [], "seconds": 1.0}
        (folder / "jobs").mkdir(exist_ok=True)
        (folder / "jobs" / f"run-{method}.json").write_text(json.dumps(manifest))
    (folder / "benchmark.json").write_text(json.dumps({"plan": {}, "runs": entries}))
    return folder


def read_all(folder: Path) -> Any:
    """All that a report takes from a folder."""
    found = []
    for made in find_runs(folder):
        curves = made.evaluations(), made.training()
        found.append((made, [curve.returns.tolist() for curve in curves], made.final()))
    return repr(found)


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make(tmp_path_factory.mktemp("benchmark"))
    assert add_hashes(folder) == 3 and add_hashes(folder) == 0
    return folder


@pytest.fixture(scope="module")
def exported(sealed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(sealed, tmp_path_factory.mktemp("export") / "copy")


@pytest.mark.parametrize("kind", ["sealed", "exported"])
def test_a_flipped_bit_anywhere_is_found(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    shutil.copytree(request.getfixturevalue(kind), tmp_path / "copy")
    draw = random.Random(0)
    files = sorted(path for path in (tmp_path / "copy").rglob("*") if path.is_file())
    assert {path.name for path in files} >= {"benchmark.json", HASHES_NAME, "args.yml", "config.yml", "method.json",
                                             "evaluations.npz", "final_evaluations.npz"}  # fmt: skip
    read_all(tmp_path / "copy")
    for path in files:
        if path.parent.name == "jobs" and kind == "sealed":
            continue  # of a folder in which jobs go on
        whole = path.read_bytes()
        for bit in draw.sample(range(8 * len(whole)), 12):
            damaged = bytearray(whole)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            with pytest.raises(ValueError, match=r"damaged|is not in|is not there") as refused:
                read_all(tmp_path / "copy")
            assert path.name in str(refused.value)
        path.write_bytes(whole)
    read_all(tmp_path / "copy")


def test_files_that_came_and_went(sealed: Path, tmp_path: Path) -> None:
    shutil.copytree(sealed, tmp_path / "copy")
    folder = find_runs(tmp_path / "copy")[0].folder
    (folder / "evaluations.npz").rename(folder / "training.npz")
    with pytest.raises(ValueError, match=r"evaluations\.npz is not there, and .*hashes\.json has its hash; copy it"):
        read_run(folder)
    shutil.copy(folder / "training.npz", folder / "evaluations.npz")
    with pytest.raises(ValueError, match=r"training\.npz is not in .*hashes\.json, added or renamed since"):
        read_run(folder)
    (folder / HASHES_NAME).write_text(json.dumps({"sha256": {"../../x": "0"}}))
    with pytest.raises(ValueError, match="does not list hashes of files below it"):
        read_run(folder)


@pytest.mark.parametrize("seed", range(3))
def test_damage_without_hashes_ends_in_one_sentence(tmp_path: Path, seed: int) -> None:
    folder = make(tmp_path)
    draw = random.Random(seed)
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.parent.name != "jobs"):
        whole = path.read_bytes()
        for _ in range(10):
            damaged = bytearray(whole)
            if draw.random() < 0.5:
                del damaged[draw.randrange(len(whole)) :]
            else:
                for _ in range(3):
                    damaged[draw.randrange(len(whole))] = draw.randrange(256)
            path.write_bytes(damaged)
            try:
                read_all(folder)
            except ValueError as error:
                # A damaged id or folder is named itself.
                assert type(error) is not UnicodeDecodeError and str(folder) in str(error), error
        path.write_bytes(whole)


def index(folder: str, label: Any = "x") -> str:
    return json.dumps({"runs": [{"folder": folder, "label": label}]})


DAMAGES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no npz": ("evaluations.npz", lambda p: p.write_bytes(b"PK"), "damaged or being written"),
    "other arrays": ("evaluations.npz", lambda p: np.savez(p, a=1), "damaged or being written .'timesteps'"),
    "one dimension": ("evaluations.npz", lambda p: np.savez(p, timesteps=[1], results=[1.0]), "do not fit"),
    "falling steps": ("evaluations.npz", lambda p: np.savez(p, timesteps=[2, 1], results=[[1.0], [1]]), "do not rise"),
    "texts": ("evaluations.npz", lambda p: np.savez(p, timesteps=[1], results=[["a"]]), "are no numbers"),
    "NaN": ("evaluations.npz", lambda p: np.savez(p, timesteps=[1], results=[[np.nan, 1]]), "1 returns of 2 that"),
    "infinite": ("final_evaluations.npz", lambda p: np.savez(p, **{"a/b/results": [np.inf]}), "1 returns of 1 that"),
    "a scalar": ("final_evaluations.npz", lambda p: np.savez(p, **{"a/b/results": 1.0}), "is damaged: 'a/b/results'"),
    "no header": ("0.monitor.csv", lambda p: p.write_text("r,l,t\n1,1,1\n"), "line 1: no start time"),
    "NaN reward": ("0.monitor.csv", lambda p: p.write_text('#{"t_start": 0}\nr,l,t\nnan,3,1\n'), "line 3: an episode"),
    "short row": ("0.monitor.csv", lambda p: p.write_text('#{"t_start": 0}\nr,l,t\n1,3\n'), "another number of fields"),
    "no number": ("0.monitor.csv", lambda p: p.write_text('#{"t_start": 0}\nr,l,t\n1,3,x\n'), "could not convert"),
    "a list": ("args.yml", lambda p: p.write_text("- 1\n"), "cannot read .*it holds a list"),
    "no YAML": ("args.yml", lambda p: p.write_text("a: [\n"), "cannot read"),
    "no env": ("args.yml", lambda p: p.write_text("algo: ppo\n"), "was not written by rl_zoo3.train"),
    "not UTF-8": ("config.yml", lambda p: p.write_bytes(b"\xff\xfe"), "cannot read"),
    "a bomb": ("config.yml", lambda p: p.write_text("a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12))), "more than 50000 nodes"),
    "deep": ("config.yml", lambda p: p.write_text("[" * 100_000), "cannot read"),
    "itself": ("config.yml", lambda p: p.write_text("a: &a [*a]\n"), "more than 50000 nodes"),
    "large": ("config.yml", lambda p: p.write_text("#" * 300_000), "more than 262144"),
    "record": ("method.json", lambda p: p.write_text('{"method": 3}'), "method.json is damaged"),
    "deep record": ("method.json", lambda p: p.write_text("[" * 100_000), "method.json is damaged"),
    "index": ("benchmark.json", lambda p: p.write_text("{}"), "benchmark.json is damaged .'runs'"),
    "index of numbers": ("benchmark.json", lambda p: p.write_text('{"runs": [1]}'), "benchmark.json is damaged"),
    "no label": ("benchmark.json", lambda p: p.write_text(index("a", 1)), "is no run with"),
    "above": ("benchmark.json", lambda p: p.write_text(index("a/../../b")), "does not lie below"),
    "elsewhere": ("benchmark.json", lambda p: p.write_text(index("/etc")), "does not lie below"),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_a_damaged_file_is_called(tmp_path: Path, damage: str) -> None:
    folder = make(tmp_path)
    name, change, message = DAMAGES[damage]
    path = next(path for path in sorted(folder.rglob(name)))
    change(path)
    with pytest.raises(ValueError, match=message) as refused:
        read_all(folder)
    assert str(path) in str(refused.value) and "\n" not in str(refused.value)


def test_missing_runs_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make(tmp_path / "benchmark")
    assert missing_runs(folder) == []
    gone = find_runs(folder)[1].folder
    shutil.rmtree(gone)
    name = gone.relative_to(folder).as_posix()
    assert missing_runs(folder) == [name]
    assert f"{folder}: 1 runs of benchmark.json are not there and not compared: {name}." in compare([str(folder)]).notes
    benchmark(["export", str(folder), "-o", str(tmp_path / "copy")])
    assert f"warning: 1 runs of benchmark.json are not there: {name}" in capsys.readouterr().err


def test_a_run_gets_its_hashes_when_it_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "--conf-file", "vanilla", "-n", "100"]
    run(monkeypatch, "train", *words, "--eval-freq", "50", "--num-threads", "1", "-params", *SMALL["ppo"])
    made = read_run(tmp_path / "ppo" / "Nav2D-v0_1")
    listed = json.loads((made.folder / HASHES_NAME).read_bytes())["sha256"]
    assert set(listed) == {"0.monitor.csv", "1.monitor.csv", "evaluations.npz", "Nav2D-v0/args.yml",
                           "Nav2D-v0/config.yml", "Nav2D-v0/command.txt", "Nav2D-v0/method.json",
                           "Nav2D-v0/vecnormalize.pkl"}  # fmt: skip
    evaluate_final(made.folder, 1)
    assert "final_evaluations.npz" in result_names(made.folder) and read_run(made.folder).final()
    # Killed in between: the next call makes it again.
    (made.folder / "final_evaluations.npz").write_bytes(b"half")
    with pytest.raises(ValueError, match=r"final_evaluations\.npz is damaged"):
        read_run(made.folder)
    evaluate_final(made.folder, 1)
    read_run(made.folder)
    (made.folder / "evaluations.npz").write_bytes(b"")
    with pytest.raises(ValueError, match=r"/evaluations\.npz is damaged: its sha256"):
        evaluate_final(made.folder, 1)
