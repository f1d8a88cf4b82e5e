"""The command as a user types it."""

import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sb3_abisim.benchmark.command import COMMANDS, main
from sb3_abisim.benchmark.graph import build
from sb3_abisim.benchmark.jobs.source_hash import source_hash
from sb3_abisim.benchmark.plan import Plan
from sb3_abisim.common.files import file_hash

ROOT = Path(__file__).resolve().parents[2]
SMALL = [
    "--env", "Nav2D-v0", "--methods", "ssi", "--seeds", "0", "--n-transitions", "2000", "-n", "2000",
    "--eval-freq", "200", "--eval-episodes", "2", "--n-eval-envs", "2", "--final-episodes", "5",
    "--device", "cpu", "--jobs", "1", "--no-report",
    "--pretrain-params", "n_updates:20", "log_interval:10", "batch_size:64", "--params", "dqn.learning_starts:100",
]  # fmt: skip


def test_dry_run_lists_the_jobs_and_does_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["-o", str(tmp_path / "new"), *SMALL, "--dry-run"])
    out = capsys.readouterr().out
    assert [line.split()[1].split("-")[0] for line in out.splitlines()[::2]] == ["data", "encoder", "run", "final"]
    assert all(line.startswith("missing") for line in out.splitlines()[::2])
    assert "sb3-abisim pretrain --objective ssi --env Nav2D-v0" in out
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--methods", "abisym"], "unknown method 'abisym'"),
        (["--jobs", "0"], "n_jobs must be at least 1, got 0"),
        (["report", "nowhere"], "no run folders of rl-zoo3 below nowhere"),
        (["evaluate", "nowhere"], "nowhere is no run folder of rl-zoo3"),
    ],
)
def test_mistakes_end_with_2(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2 and message in capsys.readouterr().err
    assert not list(tmp_path.glob("**/logs")), "nothing was started"


def test_jobs_of_other_code_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = Plan(methods=("vanilla",), env_ids=("Nav2D-v0",), seeds=(0, 1), final_episodes=0)
    for job, source in zip(build(plan), (source_hash("run"), "other"), strict=True):
        model = tmp_path / job.output / job.output_file
        model.parent.mkdir(parents=True)
        model.write_text("model")
        (tmp_path / "jobs").mkdir(exist_ok=True)
        manifest = {"hash": file_hash(model), "source": source}
        (tmp_path / "jobs" / f"{job.name}.json").write_text(json.dumps(manifest))
    words = ["--env", "Nav2D-v0", "--methods", "vanilla", "--seeds", "0", "1", "2", "--final-episodes", "0"]
    main(["-o", str(tmp_path), *words, "--dry-run"])
    lines = capsys.readouterr().out.splitlines()[::2]
    assert [line.partition("run-")[0].strip() for line in lines] == ["done", "other code", "missing"]


def test_what_the_report_needs_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "rliable" else find_spec(name))
    with pytest.raises(SystemExit):
        main(["-o", str(tmp_path / "new")])
    assert "there is no rliable); run: pip install 'sb3_abisim[benchmark]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_the_whole_graph_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Collect, pretrain, train, evaluate, report, export: each as small as it can be."""
    # Of words that are given twice, the later one holds.
    words = [word for word in SMALL if word != "--no-report"]
    main(["-o", str(tmp_path / "b"), *words, "-n", "400", "--eval-freq", "200", "--final-episodes", "2"])
    err = capsys.readouterr().err
    assert "4 of 4 jobs done, 0 of them before; 0 failed" in err and "warning" not in err
    report = tmp_path / "b" / "report"
    assert {path.name for path in report.iterdir()} == {
        "index.html", "curves.png", "curves.csv", "final.csv", "times.csv",
    }  # fmt: skip
    with open(report / "final.csv", newline="") as file:
        kinds = [(row["method"], row["mode"], row["split"], row["paper"]) for row in csv.DictReader(file)]
    assert kinds == [("ssi", "deterministic", "standard", "-12.613"), ("ssi", "stochastic", "standard", "")]
    main(["export", str(tmp_path / "b"), "-o", str(tmp_path / "copy")])
    main(["report", str(tmp_path / "copy")])
    for path in report.iterdir():
        # The page shows commands, of which the interpreter's folder does not enter the copy.
        expected = path.read_bytes().replace(f"{Path(sys.executable).parent}/".encode(), b"")
        assert (tmp_path / "copy" / "report" / path.name).read_bytes() == expected, path.name
    texts = [path.read_text() for path in (tmp_path / "copy").rglob("*") if path.suffix in (".yml", ".txt", ".json")]
    # Of the run five, manifests, the list of runs and its hashes.
    assert len(texts) == 5 + 4 + 2 and not any(str(tmp_path) in text for text in texts)


@pytest.mark.slow
def test_a_kill_costs_the_job_in_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [sys.executable, "-m", "sb3_abisim", "benchmark", "-o", str(tmp_path), *SMALL]
    driver = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": str(ROOT)})
    deadline = time.monotonic() + 300
    while not list(tmp_path.glob("work/run-*/dqn/*/evaluations.npz")):
        assert time.monotonic() < deadline and driver.poll() is None
        time.sleep(0.1)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}
    assert sorted(path.name.split("-")[0] for path in kept) == ["data", "encoder"]
    main(["-o", str(tmp_path), *SMALL])
    assert all(path.stat().st_mtime_ns == time_ns for path, time_ns in kept.items()), "what was done stays done"
    (log,) = (tmp_path / "logs").glob("run-*.log")
    assert log.read_text().count("$ sb3-abisim train") == 2
    assert "4 of 4 jobs done, 2 of them before; 0 failed" in capsys.readouterr().err
    (run,) = (tmp_path / "runs").glob("Nav2D-v0/ssi-*/dqn/Nav2D-v0_*")
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == list(range(200, 2001, 200))
    final = np.load(run / "final_evaluations.npz")
    assert set(final) == {
        f"{mode}/standard/{name}" for mode in ("deterministic", "stochastic")
        for name in ("results", "ep_lengths", "successes")
    }  # fmt: skip
    assert all(final[name].shape == (5,) for name in final)
    main(["evaluate", str(run), "--episodes", "5"])
    repeated = np.load(run / "final_evaluations.npz")
    assert all((repeated[name] == final[name]).all() for name in final), "every evaluation is the same"
    main(["report", str(tmp_path), "--reference", "ssi"])
    assert (tmp_path / "report" / "index.html").is_file()


def test_an_environment_of_another_package(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each job imports the package; the report shows the splits that its traits name."""
    words = ["--env", "SplitToy-v0", "--packages", "toy_env", "--methods", "vanilla", "--seeds", "0", "--device", "cpu",
             "--jobs", "1", "-n", "64", "--eval-freq", "32", "--eval-episodes", "2", "--n-eval-envs", "2",
             "--final-episodes", "3", "--params", "n_steps:32", "batch_size:16", "n_epochs:1"]  # fmt: skip
    main(["-o", str(tmp_path), *words])
    assert "2 of 2 jobs done, 0 of them before; 0 failed" in capsys.readouterr().err
    with open(tmp_path / "report" / "final.csv", newline="") as file:
        found = [(row["mode"], row["split"]) for row in csv.DictReader(file)]
    assert sorted(found) == [(mode, split) for mode in ("deterministic", "stochastic") for split in ("eval", "train")]
    page = (tmp_path / "report" / "index.html").read_text()
    assert '<th class="n">eval</th><th class="n">train</th>' in page
    assert "lowest and highest mean return of these runs" in page


def test_every_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    for name in COMMANDS:
        words = ["--help"] if name == "run" else [name, "--help"]
        with pytest.raises(SystemExit) as stopped:
            main(words)
        out = capsys.readouterr().out
        assert stopped.value.code == 0 and f"example: sb3-abisim {' '.join(['benchmark', *words[:-1]])} " in out
