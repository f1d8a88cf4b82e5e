"""Trials are jobs: the same command proposes the same ones, and does only what is missing."""

import csv
import dataclasses
import json
import re
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_inputs import write_run
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from sb3_abisim.benchmark import command as command
from sb3_abisim.benchmark.graph import build
from sb3_abisim.benchmark.jobs.job import Job
from sb3_abisim.benchmark.jobs.launch import JobError
from sb3_abisim.benchmark.plan import Plan
from sb3_abisim.benchmark.sweep import best_of, parse_space, sweep
from sb3_abisim.common.files import file_hash

STEPS = [100, 200, 300, 400]
PLAN = Plan(
    methods=("abisim",), env_ids=("Nav2D-v0",), seeds=(0, 1), encoder_seeds=(0, 1), n_timesteps=400, eval_freq=100,
    final_episodes=0,
)  # fmt: skip
SPACE = ["objective_kwargs.c=0.5..0.99", "batch_size=64..512:log"]


class FakeEngine:
    """Writes what a job would; the return falls with the distance of c from 0.8.

    :param stop_after: jobs, then Ctrl-C
    :param fails: which encoder jobs do
    """

    n_slots = 1

    def __init__(self, stop_after: int = 10**9, fails: Callable[[Job], bool] = lambda job: False) -> None:
        self.left, self.fails, self.ran = stop_after, fails, []

    def submit(self, root: Path, job: Job) -> "Future[None]":
        future: Future[None] = Future()
        if self.left == 0:
            future.set_exception(KeyboardInterrupt())
            return future
        self.left -= 1
        self.ran.append(job)
        if job.kind == "encoder" and self.fails(job):
            future.set_exception(JobError("diverged"))
            return future
        (root / job.output).parent.mkdir(parents=True, exist_ok=True)
        if job.kind == "run":
            c, seed = job.inputs[0].settings["objective_kwargs"]["c"], job.settings["seed"]
            returns = np.array([[-50], [-30], [-20], [-10]]) - 100 * abs(c - 0.8) - seed * np.ones((4, 3))
            folder = write_run(root / "fake" / job.key, "Nav2D-v0", "abisim", seed, STEPS, returns, algo="dqn")
            folder.rename(root / job.output)
        elif job.kind == "data":
            (root / job.output).mkdir()
        (root / job.output / job.output_file).write_text(job.name)
        (root / "jobs").mkdir(exist_ok=True)
        manifest = {**job.to_json(), "hash": file_hash(root / job.output / job.output_file), "seconds": 1.0}
        (root / "jobs" / f"{job.name}.json").write_text(json.dumps(manifest))
        future.set_result(None)
        return future

    def close(self) -> None:
        pass


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_space() -> None:
    words = ["objective_kwargs.c=0.5..0.99", "learning_rate=1e-4..1e-3:log", "objective_kwargs.pairs=random|nearest",
             "ssi.batch_size=64..512", "n_updates=1..9:log"]  # fmt: skip
    assert parse_space(words, "abisim") == {
        "abisim.objective_kwargs.c": FloatDistribution(0.5, 0.99),
        "abisim.learning_rate": FloatDistribution(1e-4, 1e-3, log=True),
        "abisim.objective_kwargs.pairs": CategoricalDistribution(["random", "nearest"]),
        "ssi.batch_size": IntDistribution(64, 512),
        "abisim.n_updates": IntDistribution(1, 9, log=True),
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["c"], "NAME=LOW..HIGH, .* got 'c'"),
        (["=1..2"], "NAME=LOW..HIGH, .* got '=1..2'"),
        (["c=1"], "NAME=LOW..HIGH, .* got 'c=1'"),
        (["c=a..b"], "NAME=LOW..HIGH, .* got 'c=a..b'"),
        (["c=1..2:lin"], "NAME=LOW..HIGH, .* got 'c=1..2:lin'"),
        (["c=1..2:logarithmic"], "NAME=LOW..HIGH, .* got 'c=1..2:logarithmic'"),
        (["c=2..1"], "a range rises, .* got 'c=2..1'"),
        (["c=0..1:log"], "starts above 0 with :log, got 'c=0..1:log'"),
        (["c=1..2", "abisim.c=3..4"], "abisim.c is given twice"),
        ([], "nothing to search"),
    ],
)
def test_mistakes_in_the_space(words: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_space(words, "abisim")


def test_trials_and_their_table(tmp_path: Path) -> None:
    trials = sweep(tmp_path, PLAN, SPACE, 12, FakeEngine)
    assert [trial.number for trial in trials] == list(range(12))
    table = rows(tmp_path / "sweep.csv")
    assert list(table[0]) == ["trial", "abisim.objective_kwargs.c", "abisim.batch_size", "final", "final_seed0",
                              "final_seed1", "encoders"]  # fmt: skip
    for trial, row in zip(trials, table, strict=True):
        c, size = trial.params["abisim.objective_kwargs.c"], trial.params["abisim.batch_size"]
        assert 0.5 <= c <= 0.99 and 64 <= size <= 512 and isinstance(size, int)
        # The mean of the last three evaluations: -20 before what c and the seed take.
        assert trial.returns == pytest.approx([-20 - 100 * abs(c - 0.8) - seed for seed in (0, 1)])
        assert float(row["final"]) == pytest.approx(trial.value) == pytest.approx(np.mean(trial.returns))
        files = row["encoders"].split()
        assert len(files) == 2 and all((tmp_path / file).is_file() for file in files)
    best = best_of(trials)
    assert best is not None and best.value == max(trial.value for trial in trials)
    # Told what came out, Optuna comes closer than its first proposals.
    assert min(abs(t.params["abisim.objective_kwargs.c"] - 0.8) for t in trials) < 0.05
    # What it prints makes the same encoders again.
    again = build(dataclasses.replace(PLAN, pretrain_params=best.words))
    assert {c.output for c in again if c.settings.get("objective") == "abisim"} == set(best.encoders)


def test_area_is_the_mean_over_the_course(tmp_path: Path) -> None:
    (trial,) = sweep(tmp_path, dataclasses.replace(PLAN, seeds=(0,)), SPACE, 1, FakeEngine, metric="area")
    c = trial.params["abisim.objective_kwargs.c"]
    assert trial.value == pytest.approx((-40 - 25 - 15) / 3 - 100 * abs(c - 0.8))


@pytest.mark.parametrize("batch", [1, 2])
def test_an_interrupted_sweep_goes_on_as_if_it_had_not_been(batch: int, tmp_path: Path) -> None:
    plan = dataclasses.replace(PLAN, seeds=(0,))
    whole = sweep(tmp_path / "whole", plan, SPACE, 3, FakeEngine, batch=batch)
    # Data, base, and for each trial an encoder and a run: in the midst of the second trial.
    engine = FakeEngine(stop_after=2 + 2 + 1)
    with pytest.raises(KeyboardInterrupt):
        sweep(tmp_path / "part", plan, SPACE, 3, lambda: engine, batch=batch)
    before = {job.name for job in engine.ran}
    engine = FakeEngine()
    assert sweep(tmp_path / "part", plan, SPACE, 3, lambda: engine, batch=batch) == whole
    assert not before & {job.name for job in engine.ran}, "what was done stays done"
    assert (tmp_path / "part" / "sweep.csv").read_bytes() == (tmp_path / "whole" / "sweep.csv").read_bytes()
    # With another seed, other trials.
    assert {t.words for t in sweep(tmp_path / "part", plan, SPACE, 1, FakeEngine, seed=1)} != {whole[0].words}


def test_equal_trials_are_found_again(tmp_path: Path) -> None:
    engine = FakeEngine()
    trials = sweep(tmp_path, PLAN, ["objective_kwargs.pairs=random|nearest"], 6, lambda: engine, batch=3)
    assert len({trial.words for trial in trials}) == 2
    kinds = [job.kind for job in engine.ran]
    # One base per seed; per kind of pairs and seed an encoder and a run.
    assert {kind: kinds.count(kind) for kind in kinds} == {"data": 1, "encoder": 2 + 4, "run": 4}


ARGUMENTS = ["sweep", "--env", "Nav2D-v0", "--seeds", "0", "1", "-n", "400", "--eval-freq", "100", "--n-trials", "4"]


def test_a_trial_that_fails_is_no_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverges(job: Job) -> bool:
        return bool(job.settings["objective"] == "abisim" and job.settings["objective_kwargs"]["c"] > 0.8)

    monkeypatch.setattr(command, "make_engine", lambda *args: FakeEngine(fails=diverges))
    with pytest.raises(SystemExit) as stopped:
        command.main([*ARGUMENTS, "-o", str(tmp_path), "--space", SPACE[0]])
    table = rows(tmp_path / "sweep.csv")
    failed = [row for row in table if float(row["abisim.objective_kwargs.c"]) > 0.8]
    assert 0 < len(failed) < 4 and all(row["final"] == "failed" and row["final_seed0"] == "" for row in failed)
    assert all(float(row["final"]) < 0 for row in table if row not in failed)
    out, err = capsys.readouterr()
    assert stopped.value.code == 1 and f"{len(failed)} trials failed; the logs are in {tmp_path / 'logs'}" in err
    best = max((row for row in table if row not in failed), key=lambda row: float(row["final"]))
    assert f"--pretrain-params abisim.objective_kwargs.c:{best['abisim.objective_kwargs.c']}\n" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--space", "c"], "a part of the search space is"),
        (["--space", "eval_fraction=0.5..1.5"], "eval_fraction must lie in .* got 1.5"),
        (["--space", "objective_kwargs.gamma=1..2"], r"abisim has no objective_kwargs\.gamma"),
        (["--space", "no_setting=1..2"], "unknown pretraining setting no_setting"),
        (["--space", *SPACE, "--method", "vanilla"], "no objective pretrains 'vanilla', only abisim, "),
        (["--space", *SPACE, "--method", "abisim=FILE"], "encoder for each trial; give abisim without =FILE"),
        (["--space", *SPACE, "--batch", "0"], "batch must be at least 1, got 0"),
        (["--space", *SPACE, "--jobs", "0"], "n_jobs must be at least 1, got 0"),
    ],
)
def test_mistakes_end_with_2(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        command.main([*ARGUMENTS, "-o", str(tmp_path / "new"), *words])
    assert stopped.value.code == 2 and re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "new").exists(), "nothing was started"


@pytest.mark.slow
def test_a_real_sweep_and_its_rerun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words: list[Any] = [
        "sweep", "-o", str(tmp_path), "--method", "ssi", "--env", "Nav2D-v0", "--seeds", "0", "--n-trials", "2",
        "--space", "learning_rate=1e-4..1e-3:log", "--n-transitions", "2000", "-n", "600", "--eval-freq", "200",
        "--eval-episodes", "2", "--n-eval-envs", "2", "--device", "cpu", "--jobs", "1",
        "--pretrain-params", "n_updates:20", "log_interval:10", "batch_size:64", "--params", "dqn.learning_starts:100",
    ]  # fmt: skip
    command.main(words)
    table = (tmp_path / "sweep.csv").read_text()
    assert [float(row["final"]) <= 0 for row in rows(tmp_path / "sweep.csv")] == [True, True]
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}
    assert sorted(path.name.split("-")[0] for path in kept) == ["data", "encoder", "encoder", "run", "run"]
    out = capsys.readouterr().out
    command.main(words)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()} == kept
    assert (tmp_path / "sweep.csv").read_text() == table and capsys.readouterr().out == out
