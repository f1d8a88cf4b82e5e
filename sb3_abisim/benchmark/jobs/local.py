"""Run the jobs of a benchmark: what is missing, each as soon as its inputs are there, with one display over all."""

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from tqdm import tqdm

from sb3_abisim._version import __version__
from sb3_abisim.benchmark.jobs.job import Job, is_by_other_code, is_done, manifest_path, read_manifest
from sb3_abisim.benchmark.jobs.launch import kill, launch
from sb3_abisim.common.arrays import ARRAY_ERRORS
from sb3_abisim.common.files import folder_lock

REFRESH_SECONDS = 1.0
# Before anything has been measured: seconds for a cost of 1, that is a transition, an update, a step, an episode.
_FIRST_GUESS = {"data": 2e-4, "encoder": 2e-2, "run": 1e-3, "final": 5e-2}
_START_SECONDS = 5.0
_N_NAMED = 5


class Engine(Protocol):
    """Where jobs run.

    ``n_slots`` is how many of them run at a time.
    """

    n_slots: int

    def submit(self, root: Path, job: Job) -> "Future[None]":
        """Run a job; the future raises :class:`~sb3_abisim.benchmark.jobs.launch.JobError` when it fails."""

    def close(self) -> None:
        """Stop what runs, if anything does, and let go of all resources."""


class LocalEngine:
    """Processes on this machine.

    :param n_jobs: jobs at a time
    :param threads: of each
    """

    def __init__(self, n_jobs: int, threads: int = 1) -> None:
        if n_jobs < 1:
            raise ValueError(f"n_jobs must be at least 1, got {n_jobs}")
        self.n_slots, self.threads = n_jobs, threads
        self._pool = ThreadPoolExecutor(n_jobs)
        self._processes: list[subprocess.Popen[bytes]] = []
        self._lock, self._closed = threading.Lock(), False

    def submit(self, root: Path, job: Job) -> "Future[None]":
        """Run a job in a separate program."""
        return self._pool.submit(launch, root, job.to_json(), self.threads, self._started)

    def _started(self, process: "subprocess.Popen[bytes]") -> None:
        with self._lock:
            self._processes.append(process)
            if self._closed:
                kill(process)

    def close(self) -> None:
        """Kill what runs."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._closed = True
            for process in self._processes:
                if process.poll() is None:
                    kill(process)
        self._pool.shutdown()


def run_jobs(root: Path, jobs: Sequence[Job], engine: Engine, progress: bool = True) -> dict[str, str]:
    """Run the jobs that are not done; one that fails takes with it only what depends on it.

    :param root: the benchmark's folder; it is created
    :param jobs: inputs before what needs them
    :param engine: where; it is closed at the end
    :param progress: show the display on standard error
    :return: title to error of the jobs that failed; empty when all are done
    :raises FolderLockedError: when another benchmark writes in the folder
    """
    root.mkdir(parents=True, exist_ok=True)
    try:
        with folder_lock(root):
            return _Run(root, jobs, engine, progress).run()
    finally:
        engine.close()


class _Run:
    def __init__(self, root: Path, jobs: Sequence[Job], engine: Engine, progress: bool) -> None:
        self.root, self.jobs, self.engine, self.progress = root, jobs, engine, progress
        self.done = {job.name for job in jobs if is_done(root, job.to_json())}
        self.running: dict[Future[None], tuple[Job, float]] = {}
        self.waiting = [job for job in jobs if job.name not in self.done]
        self.errors: dict[str, str] = {}
        self.failed: set[str] = set()
        self.rates = _measured_rates(root, jobs)
        self.bar = tqdm(
            total=1.0, disable=not progress, bar_format="{percentage:3.0f}%|{bar:20}| {desc}", mininterval=0
        )

    def run(self) -> dict[str, str]:
        n_kept = len(self.done)
        self._warn_of_other_code()
        try:
            self._show()
            self._submit_ready()
            while self.running:
                finished, _ = wait(self.running, timeout=REFRESH_SECONDS, return_when=FIRST_COMPLETED)
                for future in finished:
                    self._finish(future)
                self._submit_ready()
                self._show()
        finally:
            self.bar.close()
        if self.progress:
            state = f"{len(self.done)} of {len(self.jobs)} jobs done, {n_kept} of them before"
            print(f"{state}; {len(self.errors)} failed", file=sys.stderr)
        return self.errors

    def _warn_of_other_code(self) -> None:
        kept = [job for job in self.jobs if job.name in self.done]
        titles = [job.title for job in kept if is_by_other_code(self.root, job.to_json())]
        if titles:
            names = ", ".join(titles[:_N_NAMED]) + (f" and {len(titles) - _N_NAMED} more" if titles[_N_NAMED:] else "")
            what = f"{len(titles)} of {len(self.jobs)} jobs were made by other code of version {__version__}"
            print(f"warning: {what} and are kept: {names}; take another folder to make all again", file=sys.stderr)

    def _submit_ready(self) -> None:
        for job in list(self.waiting):
            names = {source.name for source in job.inputs}
            if names & self.failed:
                self.failed.add(job.name)
                self.waiting.remove(job)
            elif names <= self.done and len(self.running) < self.engine.n_slots:
                self.running[self.engine.submit(self.root, job)] = (job, time.monotonic())
                self.waiting.remove(job)

    def _finish(self, future: "Future[None]") -> None:
        job, start = self.running.pop(future)
        error = future.exception()
        if error is None:
            self.done.add(job.name)
            self.rates[_rate_name(job)] = (time.monotonic() - start) / job.cost
        elif isinstance(error, Exception):
            self.failed.add(job.name)
            self.errors[job.title] = str(error)
            tqdm.write(f"{job.title} failed: {error}", file=sys.stderr)
        else:
            raise error

    def _show(self) -> None:
        now, left, spent = time.monotonic(), 0.0, 0.0
        for job, start in self.running.values():
            share = done_share(self.root, job)
            if share > 0.02:
                self.rates[_rate_name(job)] = (now - start) / share / job.cost
            else:
                # It leaves no trace yet. One that takes longer than expected is never taken for done.
                share = min(0.9, (now - start) / self._seconds(job))
            left += self._seconds(job) * (1 - share)
            spent += self._seconds(job) * share
        left += sum(self._seconds(job) for job in self.waiting)
        spent += sum(self._seconds(job) for job in self.jobs if job.name in self.done)
        self.bar.n = spent / (spent + left) if spent + left else 1.0
        slots = max(1, min(self.engine.n_slots, len(self.running) + len(self.waiting)))
        hours, minutes = divmod(math.ceil(left / slots / 60), 60)
        clock = f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"
        names = ", ".join(job.title for job, _ in list(self.running.values())[:2])
        state = f"{len(self.done)}/{len(self.jobs)} jobs, about {clock} left"
        more = f", +{len(self.running) - 2}" if len(self.running) > 2 else ""
        self.bar.set_description_str(f"{state}; {names}{more}" if names else state)

    def _seconds(self, job: Job) -> float:
        rate = self.rates.get(_rate_name(job))
        return _START_SECONDS + job.cost * _FIRST_GUESS[job.kind] if rate is None else job.cost * rate


def _rate_name(job: Job) -> str:
    """Jobs of one name take about equally long for their cost."""
    source = job.inputs[0] if job.kind == "final" else job
    name = source.settings.get("objective", source.settings.get("algo", ""))
    return f"{job.kind} {source.settings['env_id']} {name}"


def _measured_rates(root: Path, jobs: Sequence[Job]) -> dict[str, float]:
    rates = {}
    for job in jobs:
        path = manifest_path(root, job.name)
        if path.is_file():
            seconds = read_manifest(path).get("seconds")
            if isinstance(seconds, int | float):
                rates[_rate_name(job)] = seconds / job.cost
    return rates


def done_share(root: Path, job: Job) -> float:
    """How much of a running job is done, from what it has written.

    :param root: the benchmark's folder
    :param job: one that runs
    :return: 0 to 1; 0 where it leaves no trace
    """
    try:
        if job.kind == "encoder":
            lines = (root / job.output).with_suffix(".run").joinpath("progress.csv").read_text().splitlines()
            column = lines[0].split(",").index("train/n_updates")
            return min(1.0, float(lines[-1].split(",")[column]) / job.cost)
        if job.kind == "run":
            (path,) = (root / "work" / job.name).glob("*/*/evaluations.npz")
            return min(1.0, float(np.load(path)["timesteps"][-1]) / job.cost)
    except (OSError, *ARRAY_ERRORS):
        pass  # not begun, or read while it was written
    return 0.0


def default_jobs(threads: int) -> int:
    """As many jobs as the processors that this process may use have room for.

    :param threads: of each
    """
    return max(1, len(os.sched_getaffinity(0)) // threads) if hasattr(os, "sched_getaffinity") else 1


def make_engine(name: str, n_jobs: int | None, threads: int, **ray_options: Any) -> Engine:
    """The engine of a name.

    :param name: "local" or "ray"
    :param n_jobs: jobs at a time; None for as many as there is room for
    :param threads: of each
    :param ray_options: more arguments of :class:`~sb3_abisim.benchmark.jobs.ray.RayEngine`
    :raises ValueError: for another name
    """
    if name == "local":
        return LocalEngine(default_jobs(threads) if n_jobs is None else n_jobs, threads)
    if name == "ray":
        from sb3_abisim.benchmark.jobs.ray import RayEngine

        return RayEngine(n_jobs, threads, **ray_options)
    raise ValueError(f"engine must be 'local' or 'ray', got {name!r}")
