"""Jobs run in order, once, and by one writer at a time."""

import json
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from sb3_abisim.benchmark.jobs.job import Job, read_manifest
from sb3_abisim.benchmark.jobs.launch import JobError
from sb3_abisim.benchmark.jobs.local import LocalEngine, done_share, make_engine, run_jobs
from sb3_abisim.benchmark.jobs.source_hash import source_hash
from sb3_abisim.common.files import FolderLockedError, file_hash, folder_lock, write_atomic


def job(name: str, *inputs: Job, command: tuple[str, ...] = ()) -> Job:
    return Job("encoder", name, {"objective": "ssi", "env_id": "E", "name": name}, inputs, command, f"{name}.zip")


class FakeEngine:
    """Does what the test says, at once."""

    n_slots = 1

    def __init__(self, failing: str = "") -> None:
        self.failing, self.ran, self.closed = failing, [], False

    def submit(self, root: Path, job: Job) -> "Future[None]":
        self.ran.append(job.title)
        future: Future[None] = Future()
        if job.title == self.failing:
            future.set_exception(JobError("broken on purpose"))
            return future
        (root / job.output).write_text(job.title)
        (root / "jobs").mkdir(exist_ok=True)
        manifest = {**job.to_json(), "hash": file_hash(root / job.output), "seconds": 1.0}
        write_atomic(root / "jobs" / f"{job.name}.json", lambda file: file.write(json.dumps(manifest).encode()))
        future.set_result(None)
        return future

    def close(self) -> None:
        self.closed = True


A = job("a")
B = job("b", A)
C = job("c", A)
D = job("d", B, C)
JOBS = [A, B, C, D]


def test_inputs_first_and_a_rerun_does_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    engine = FakeEngine()
    assert run_jobs(tmp_path, JOBS, engine) == {} and engine.closed
    assert engine.ran == ["a", "b", "c", "d"]
    assert "4 of 4 jobs done, 0 of them before; 0 failed" in capsys.readouterr().err
    engine = FakeEngine()
    assert run_jobs(tmp_path, JOBS, engine) == {} and engine.ran == []
    (tmp_path / "c.zip").write_text("damaged")
    (tmp_path / "b.zip").unlink()
    run_jobs(tmp_path, JOBS, engine, progress=False)
    assert engine.ran == ["b", "c"], "nothing but what is not as it was made"


def test_a_failure_takes_with_it_only_what_depends_on_it(tmp_path: Path) -> None:
    engine = FakeEngine(failing="b")
    assert run_jobs(tmp_path, JOBS, engine, progress=False) == {"b": "broken on purpose"}
    assert engine.ran == ["a", "b", "c"]
    engine = FakeEngine()
    assert run_jobs(tmp_path, JOBS, engine, progress=False) == {} and engine.ran == ["b", "d"]


def test_two_writers_are_refused(tmp_path: Path) -> None:
    engine = FakeEngine()
    with folder_lock(tmp_path), pytest.raises(FolderLockedError, match="is being written by process"):
        run_jobs(tmp_path, JOBS, engine, progress=False)
    assert engine.ran == [] and engine.closed


def test_jobs_of_other_code_are_kept_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_jobs(tmp_path, JOBS, FakeEngine(), progress=False)
    sources = {"a": None, "b": source_hash("encoder"), "c": "other", "d": "other"}
    for made in JOBS:
        path = tmp_path / "jobs" / f"{made.name}.json"
        path.write_text(json.dumps(json.loads(path.read_bytes()) | {"source": sources[made.title]}))
    capsys.readouterr()
    engine = FakeEngine()
    run_jobs(tmp_path, JOBS, engine, progress=False)
    assert engine.ran == []
    message = capsys.readouterr().err
    assert message.startswith("warning: 2 of 4 jobs were made by other code of version ")
    assert message.endswith("and are kept: c, d; take another folder to make all again\n")


def test_the_share_that_is_done(tmp_path: Path) -> None:
    encoder = Job("encoder", "e", {}, (), (), "encoders/x.safetensors", cost=200)
    assert done_share(tmp_path, encoder) == 0
    (tmp_path / "encoders" / "x.run").mkdir(parents=True)
    (tmp_path / "encoders" / "x.run" / "progress.csv").write_text("train/loss,train/n_updates\n0.5,20\n0.4,50\n")
    assert done_share(tmp_path, encoder) == 0.25
    run = Job("run", "r", {"env_id": "E"}, (), (), "runs/r", cost=1000)
    folder = tmp_path / "work" / run.name / "ppo" / "E_1"
    folder.mkdir(parents=True)
    (folder / "evaluations.npz").write_bytes(b"PK half written")
    assert done_share(tmp_path, run) == 0
    np.savez(folder / "evaluations.npz", timesteps=[100, 400])
    assert done_share(tmp_path, run) == 0.4


def test_unknown_engines_are_refused() -> None:
    with pytest.raises(ValueError, match="'local' or 'ray', got 'slurm'"):
        make_engine("slurm", 1, 1)
    with pytest.raises(ValueError, match="n_jobs must be at least 1, got 0"):
        LocalEngine(0)


@pytest.mark.parametrize(
    "content", ["", "[1]", "{", '{"hash": 3}', '{"name": "run-b"}', '{"inputs": [1]}', "[" * 100_000]
)
def test_a_damaged_manifest_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "run-a.json").write_text(content)
    with pytest.raises(ValueError, match=r"run-a\.json is damaged .*; remove it, and its job is done again"):
        read_manifest(tmp_path / "run-a.json")
