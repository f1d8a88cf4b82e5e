"""A job runs in a program of its own, and dies with its engine."""

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sb3_abisim.benchmark.jobs.job import Job, is_done
from sb3_abisim.benchmark.jobs.local import LocalEngine, run_jobs
from sb3_abisim.benchmark.jobs.source_hash import source_hash
from sb3_abisim.common.files import FolderLockedError, folder_lock

ROOT = Path(__file__).resolve().parents[3]


def job(name: str, *inputs: Job, command: tuple[str, ...] = ()) -> Job:
    return Job("encoder", name, {"objective": "ssi", "env_id": "E", "name": name}, inputs, command, f"{name}.zip")


def test_a_job_in_a_program_of_its_own(tmp_path: Path) -> None:
    good = job("good", command=("json.tool", "good.json", "good.zip"))
    (tmp_path / "good.json").write_text("{}")
    bad = job("bad", command=("json.tool", "no_such_file", "bad.zip"))
    engine = LocalEngine(1)
    errors = run_jobs(tmp_path, [bad, good], engine, progress=False)
    assert is_done(tmp_path, good.to_json()) and not is_done(tmp_path, bad.to_json())
    manifest = json.loads((tmp_path / "jobs" / f"{good.name}.json").read_bytes())
    assert manifest["source"] == source_hash("encoder")
    assert 0 < manifest["processor_seconds"] < manifest["seconds"] + 60
    # A program of the standard library, not this process.
    assert 5 < manifest["memory_mib"] < 100
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


def test_a_command_imports_what_the_benchmark_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job runs in the benchmark's folder; modules of --packages may lie where the benchmark was started."""
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "my_tool.py").write_text("import sys; open(sys.argv[1], 'w').write('made')")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.syspath_prepend("")
    made = job("made", command=("my_tool", "made.zip"))
    assert run_jobs(tmp_path / "root", [made], LocalEngine(1), progress=False) == {}
    assert (tmp_path / "root" / "made.zip").read_text() == "made"


def test_a_run_in_an_environment_with_a_namespace(tmp_path: Path) -> None:
    """rl-zoo3 names its folder and model by the id with "-" for "/"."""
    code = "import pathlib, sys\nrun = pathlib.Path(sys.argv[1])\nrun.mkdir(parents=True)\n"
    (tmp_path / "zoo.py").write_text(code + "(run / 'my-Toy-v0.zip').write_text('')\n")
    run = Job("run", "r", {"env_id": "my/Toy-v0"}, (), (), "runs/my-Toy-v0_7", "my-Toy-v0.zip")
    run = dataclasses.replace(run, command=("zoo", f"work/{run.name}/ppo/my-Toy-v0_1"))
    assert run_jobs(tmp_path, [run], LocalEngine(1), progress=False) == {}
    assert (tmp_path / "runs" / "my-Toy-v0_7" / "my-Toy-v0.zip").is_file()


DRIVER = """
import pathlib, sys
from sb3_abisim.benchmark.jobs.launch import launch
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
