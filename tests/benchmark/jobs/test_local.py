"""Jobs run in order, once, by one writer at a time, and die with their engine."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from sb3_abisim.benchmark.jobs.job import JobError, is_done
from sb3_abisim.benchmark.jobs.local import LocalEngine, done_share, make_engine, run_jobs
from sb3_abisim.benchmark.jobs.source_hash import source_hash
from sb3_abisim.benchmark.plan import Job
from sb3_abisim.common.files import FolderLockedError, folder_lock, write_atomic

ROOT = Path(__file__).resolve().parents[3]


def job(name: str, *inputs: Job, command: tuple[str, ...] = ()) -> Job:
    return Job("encoder", name, {"objective": "ssi", "env_id": "E", "name": name}, inputs, command, f"{name}.zip")


class FakeEngine:
    """Does what the test says, at once."""

    n_slots = 1

    def __init__(self, failing: str = "") -> None:
        self.failing, self.ran, self.closed = failing, [], False

    def submit(self, root: Path, job: Job) -> "Future[None]":
        from sb3_abisim.common.files import file_hash

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
CELLS = [A, B, C, D]


def test_inputs_first_and_a_rerun_does_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    engine = FakeEngine()
    assert run_jobs(tmp_path, CELLS, engine) == {} and engine.closed
    assert engine.ran == ["a", "b", "c", "d"]
    assert "4 of 4 jobs done, 0 of them before; 0 failed" in capsys.readouterr().err
    engine = FakeEngine()
    assert run_jobs(tmp_path, CELLS, engine) == {} and engine.ran == []
    (tmp_path / "c.zip").write_text("damaged")
    (tmp_path / "b.zip").unlink()
    run_jobs(tmp_path, CELLS, engine, progress=False)
    assert engine.ran == ["b", "c"], "nothing but what is not as it was made"


def test_a_failure_takes_with_it_only_what_depends_on_it(tmp_path: Path) -> None:
    engine = FakeEngine(failing="b")
    assert run_jobs(tmp_path, CELLS, engine, progress=False) == {"b": "broken on purpose"}
    assert engine.ran == ["a", "b", "c"]
    engine = FakeEngine()
    assert run_jobs(tmp_path, CELLS, engine, progress=False) == {} and engine.ran == ["b", "d"]


def test_two_writers_are_refused(tmp_path: Path) -> None:
    engine = FakeEngine()
    with folder_lock(tmp_path), pytest.raises(FolderLockedError, match="is being written by process"):
        run_jobs(tmp_path, CELLS, engine, progress=False)
    assert engine.ran == [] and engine.closed


def test_a_cell_in_a_program_of_its_own(tmp_path: Path) -> None:
    good = job("good", command=("json.tool", "good.json", "good.zip"))
    (tmp_path / "good.json").write_text("{}")
    bad = job("bad", command=("json.tool", "no_such_file", "bad.zip"))
    engine = LocalEngine(1)
    errors = run_jobs(tmp_path, [bad, good], engine, progress=False)
    assert is_done(tmp_path, good.to_json()) and not is_done(tmp_path, bad.to_json())
    manifest = json.loads((tmp_path / "jobs" / f"{good.name}.json").read_bytes())
    assert manifest["source"] == source_hash("encoder")
    assert (
        manifest["versions"]["torch"]
        and manifest["hardware"]["processor"]
        and manifest["hardware"]["n_processors"] >= 1
    )
    log = (tmp_path / "logs" / f"{bad.name}.log").read_text()
    assert "$ python -m json.tool no_such_file bad.zip" in log
    assert list(errors) == ["bad"] and str(tmp_path / "logs" / f"{bad.name}.log") in errors["bad"]


def test_a_damaged_encoder_is_made_again(tmp_path: Path) -> None:
    """Pretraining would refuse to touch it, so it is put aside."""
    one = job("one", command=("json.tool", "--no-ensure-ascii", "one.json", "one.zip"))
    (tmp_path / "one.json").write_text("{}")
    assert run_jobs(tmp_path, [one], LocalEngine(1), progress=False) == {}
    whole = (tmp_path / "one.zip").read_bytes()
    (tmp_path / "one.zip").write_bytes(b"damaged")
    assert run_jobs(tmp_path, [one], LocalEngine(1), progress=False) == {}
    assert (tmp_path / "one.zip").read_bytes() == whole and (tmp_path / "one.damaged").read_bytes() == b"damaged"


def test_cells_of_other_code_are_kept_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_jobs(tmp_path, CELLS, FakeEngine(), progress=False)
    sources = {"a": None, "b": source_hash("encoder"), "c": "other", "d": "other"}
    for made in CELLS:
        path = tmp_path / "jobs" / f"{made.name}.json"
        path.write_text(json.dumps(json.loads(path.read_bytes()) | {"source": sources[made.title]}))
    capsys.readouterr()
    engine = FakeEngine()
    run_jobs(tmp_path, CELLS, engine, progress=False)
    assert engine.ran == []
    message = capsys.readouterr().err
    assert message.startswith("warning: 2 of 4 jobs were made by other code of version ")
    assert message.endswith("and are kept: c, d; take another folder to make all anew\n")


def test_the_share_that_is_done(tmp_path: Path) -> None:
    encoder = Job("encoder", "e", {}, (), (), "encoders/x.safetensors", cost=200)
    assert done_share(tmp_path, encoder) == 0
    (tmp_path / "encoders" / "x.run").mkdir(parents=True)
    (tmp_path / "encoders" / "x.run" / "progress.csv").write_text("train/loss,time/n_updates\n0.5,20\n0.4,50\n")
    assert done_share(tmp_path, encoder) == 0.25
    run = Job("run", "r", {"env_id": "E"}, (), (), "runs/r", cost=1000)
    folder = tmp_path / "work" / run.name / "ppo" / "E_1"
    folder.mkdir(parents=True)
    (folder / "evaluations.npz").write_bytes(b"PK half written")
    assert done_share(tmp_path, run) == 0
    np.savez(folder / "evaluations.npz", timesteps=[100, 400])
    assert done_share(tmp_path, run) == 0.4


DRIVER = """
import pathlib, sys
from sb3_abisim.benchmark.jobs.job import launch
job = {"name": "encoder-0", "kind": "encoder", "title": "t", "settings": {}, "inputs": [], "output_file": "", "cost": 1,
        "output": "never", "command": ["http.server", "0", "--bind", "127.0.0.1"]}
launch(pathlib.Path(sys.argv[1]), job, 1)
"""


def test_a_killed_engine_leaves_no_orphan(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, str(tmp_path)], env=environment)
    try:
        wait_until(lambda: _programs(tmp_path) == 2, "the job's program and its command run")
    finally:
        driver.send_signal(signal.SIGKILL)
        driver.wait()
    wait_until(lambda: _programs(tmp_path) == 0, "both are gone")
    # A dying process has no command line any more a moment before its files are closed.
    wait_until(lambda: _is_free(tmp_path / "work" / "encoder-0"), "the lock is free", seconds=5)


def _is_free(folder: Path) -> bool:
    try:
        with folder_lock(folder):
            return True
    except FolderLockedError:
        return False


def wait_until(condition, what: str, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.1)


def _programs(folder: Path) -> int:
    """How many Python programs work in a folder."""
    count = 0
    for process in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if process.name.isdigit() and os.readlink(process / "cwd") == str(folder.resolve()):
                count += b"python" in (process / "cmdline").read_bytes()
    return count


def test_unknown_engines_are_refused() -> None:
    with pytest.raises(ValueError, match="'local' or 'ray', got 'slurm'"):
        make_engine("slurm", 1, 1)
    with pytest.raises(ValueError, match="n_jobs must be at least 1, got 0"):
        LocalEngine(0)
