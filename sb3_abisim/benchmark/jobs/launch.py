"""Run one job: ``python -m sb3_abisim.benchmark.jobs.launch`` with the job as a line of JSON on standard input.

An engine starts this program, here or on another machine. It holds standard input open: when the engine dies, however
it dies, the input ends and the command is killed with all that it started, so that no orphan goes on writing.
"""

import contextlib
import json
import os
import platform
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import sb3_abisim
from sb3_abisim._version import __version__
from sb3_abisim.benchmark.jobs.job import command_line, is_done, manifest_path
from sb3_abisim.benchmark.jobs.source_hash import source_hash
from sb3_abisim.common.files import FolderLockedError, file_hash, folder_lock, write_atomic

# A worker that was lost may take this long to die and to let go of its job.
LOCK_PATIENCE_SECONDS = 60.0
LOG_TAIL_LINES = 15


class JobError(RuntimeError):
    """A job's command failed; the message ends with the last lines of its log."""


def launch(
    root: Path,
    job: dict[str, Any],
    threads: int,
    started: Callable[["subprocess.Popen[bytes]"], object] = lambda process: None,
) -> None:
    """Run a job in a separate program and wait for its end.

    :param root: the benchmark's folder
    :param job: what :meth:`~sb3_abisim.benchmark.jobs.job.Job.to_json` gave
    :param threads: for the command's libraries
    :param started: called with the process, so that it can be stopped
    :raises JobError: when it failed
    """
    log = root / "logs" / f"{job['name']}.log"
    log.parent.mkdir(exist_ok=True)
    package = str(Path(sb3_abisim.__file__).resolve().parent.parent)
    # What this process can import, the command can: it runs in another folder. The interpreter adds its folders itself.
    given = [path for path in sys.path if not path.startswith((sys.prefix, sys.base_prefix))]
    path = os.pathsep.join(dict.fromkeys([package, *map(os.path.abspath, given)]))
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(names, str(threads)), "PYTHONPATH": path}
    with open(log, "ab") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "sb3_abisim.benchmark.jobs.launch"],
            cwd=root, env=environment, stdin=subprocess.PIPE, stdout=file, stderr=file, start_new_session=True,
        )  # fmt: skip
    started(process)
    assert process.stdin is not None
    try:
        process.stdin.write(json.dumps(job).encode() + b"\n")
        process.stdin.flush()
    except BrokenPipeError:
        pass  # it has died already; its status says so
    try:
        code = process.wait()
    except BaseException:
        kill(process)
        raise
    process.stdin.close()
    if code:
        kill(process)
        tail = "\n  ".join(log.read_text(errors="replace").splitlines()[-LOG_TAIL_LINES:])
        raise JobError(f"{job['title']} failed (exit status {code}); {log} ends with\n  {tail}")


def kill(process: "subprocess.Popen[bytes]") -> None:
    """End a program that :func:`launch` started, and all that it started.

    :param process: as given to ``started``
    """
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def main() -> None:
    """Run the job that standard input names, in the working directory, which is the benchmark's folder."""
    line = b""
    while not line.endswith(b"\n"):
        line += os.read(0, 1 << 16) or sys.exit("the engine died before it named a job")
    job = json.loads(line)
    threading.Thread(target=_die_with_engine, daemon=True).start()
    root = Path.cwd()
    work = root / "work" / job["name"]
    work.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + LOCK_PATIENCE_SECONDS
    while True:
        try:
            with folder_lock(work):
                _run(root, work, job)
            break
        except FolderLockedError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)
    shutil.rmtree(work, ignore_errors=True)


def _die_with_engine() -> None:
    # Not through sys.stdin, whose lock a thread must not hold when Python ends.
    while os.read(0, 1):
        pass
    os.killpg(os.getpgrp(), signal.SIGKILL)


def _run(root: Path, work: Path, job: dict[str, Any]) -> None:
    if is_done(root, job):
        return  # by a worker that was thought lost
    output = root / job["output"]
    output.parent.mkdir(parents=True, exist_ok=True)
    if job["kind"] == "run":
        if output.exists():
            raise ValueError(f"{output} is there, but not as it was made; move it away, then run the command again")
        # The zoo cannot go on where it was killed.
        for leftover in work.iterdir():
            if leftover.is_dir():
                shutil.rmtree(leftover)
    if job["kind"] == "encoder" and output.is_file() and manifest_path(root, job["name"]).is_file():
        # Not as it was made; pretraining would find it finished and refuse it.
        damaged = output.with_suffix(".damaged")
        output.rename(damaged)
        print(f"{output} is not as it was made; it is now {damaged}", flush=True)
    start, used, source = time.monotonic(), os.times(), source_hash(job["kind"])
    print(f"$ {command_line(job['command'])}", flush=True)
    code = subprocess.run([sys.executable, "-m", *job["command"]], stdin=subprocess.DEVNULL).returncode
    if code:
        sys.exit(code if code > 0 else 1)
    spent = os.times()
    # Like its model, rl-zoo3 names the folder by the id with "-" for "/".
    made = next(work.glob(f"*/{Path(job['output_file']).stem}_1")) if job["kind"] == "run" else output
    content = {
        **job,
        "hash": file_hash(made / job["output_file"]),
        "seconds": round(time.monotonic() - start, 1),
        # Of the command and all that it waited for: it says more where other programs run beside it.
        "processor_seconds": round(sum(spent[2:4]) - sum(used[2:4]), 2),
        "memory_mib": _largest_mib(),
        "source": source,
        "host": socket.gethostname(),
        "versions": {"sb3_abisim": __version__, "python": platform.python_version(), **_versions()},
        "hardware": hardware(),
    }
    manifest = manifest_path(root, job["name"])
    manifest.parent.mkdir(exist_ok=True)
    write_atomic(manifest, lambda file: file.write(json.dumps(content, indent=1).encode()))
    if made != output:
        # After the manifest: a kill in between leaves no folder that would stand in the way.
        made.rename(output)


def _largest_mib() -> int:
    """The most memory that the command, or one of the programs that it waited for, has had."""
    most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return round(most / (2**20 if sys.platform == "darwin" else 2**10))


def _versions() -> dict[str, str]:
    """Of what the numbers rest on."""
    names = ("torch", "numpy", "gymnasium", "mujoco", "stable_baselines3", "sb3_contrib", "rl_zoo3")
    return {name: metadata.version(name) for name in names}


def hardware() -> dict[str, Any]:
    """Processor, how many of them this process may use, and graphics cards."""
    found = None
    with contextlib.suppress(OSError):
        found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    model = found.group(1) if found else platform.machine()
    cards: list[str] = []
    with contextlib.suppress(OSError):
        query = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        answer = subprocess.run(query, capture_output=True, text=True)
        cards = answer.stdout.splitlines() if answer.returncode == 0 else []
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": model, "n_processors": count, "graphics_cards": cards}


if __name__ == "__main__":
    main()
