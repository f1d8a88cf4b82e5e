"""Run the cells of a benchmark: what is missing, each as soon as its inputs are there, with one display over all."""

import json
import math
import os
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from tqdm import tqdm

from sb3_abisim._version import __version__
from sb3_abisim.benchmark.jobs.job import is_by_other_code, is_done, kill, launch, marker_path
from sb3_abisim.benchmark.plan import Cell
from sb3_abisim.common.files import folder_lock

REFRESH_SECONDS = 1.0
# Before anything has been measured: seconds per transition, update, step and episode.
_FIRST_GUESS = {"data": 2e-4, "encoder": 2e-2, "run": 1e-3, "final": 5e-2}
_START_SECONDS = 5.0
_N_NAMED = 5


class Engine(Protocol):
    """Where cells run.

    ``n_slots`` is how many of them run at a time.
    """

    n_slots: int

    def submit(self, root: Path, cell: Cell) -> "Future[None]":
        """Run a cell; the future raises :class:`~sb3_abisim.benchmark.jobs.job.CellError` when it fails."""

    def close(self) -> None:
        """Stop what runs, if anything does, and let go of all resources."""


class LocalEngine:
    """Processes on this machine.

    :param n_jobs: cells at a time
    :param threads: of each
    """

    def __init__(self, n_jobs: int, threads: int = 1) -> None:
        if n_jobs < 1:
            raise ValueError(f"n_jobs must be at least 1, got {n_jobs}")
        self.n_slots, self.threads = n_jobs, threads
        self._pool = ThreadPoolExecutor(n_jobs)
        self._processes: list[subprocess.Popen[bytes]] = []
        self._lock, self._closed = threading.Lock(), False

    def submit(self, root: Path, cell: Cell) -> "Future[None]":
        """Run a cell in a program of its own."""
        return self._pool.submit(launch, root, cell.to_json(), self.threads, self._started)

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


def run_cells(root: Path, cells: Sequence[Cell], engine: Engine, progress: bool = True) -> dict[str, str]:
    """Run the cells that are not done; one that fails takes with it only what depends on it.

    :param root: the benchmark's folder; it is created
    :param cells: inputs before what needs them
    :param engine: where; it is closed at the end
    :param progress: show the display on standard error
    :return: title to error of the cells that failed; empty when all are done
    :raises FolderLockedError: when another benchmark writes in the folder
    """
    root.mkdir(parents=True, exist_ok=True)
    try:
        with folder_lock(root):
            return _Run(root, cells, engine, progress).run()
    finally:
        engine.close()


class _Run:
    def __init__(self, root: Path, cells: Sequence[Cell], engine: Engine, progress: bool) -> None:
        self.root, self.cells, self.engine, self.progress = root, cells, engine, progress
        self.done = {cell.name for cell in cells if is_done(root, cell.to_json())}
        self.running: dict[Future[None], tuple[Cell, float]] = {}
        self.waiting = [cell for cell in cells if cell.name not in self.done]
        self.errors: dict[str, str] = {}
        self.failed: set[str] = set()
        self.rates = _measured_rates(root, cells)
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
            state = f"{len(self.done)} of {len(self.cells)} cells done, {n_kept} of them before"
            print(f"{state}; {len(self.errors)} failed", file=sys.stderr)
        return self.errors

    def _warn_of_other_code(self) -> None:
        kept = [cell for cell in self.cells if cell.name in self.done]
        titles = [cell.title for cell in kept if is_by_other_code(self.root, cell.to_json())]
        if titles:
            names = ", ".join(titles[:_N_NAMED]) + (f" and {len(titles) - _N_NAMED} more" if titles[_N_NAMED:] else "")
            what = f"{len(titles)} of {len(self.cells)} cells were made by other code of version {__version__}"
            print(f"warning: {what} and are kept: {names}; take another folder to make all anew", file=sys.stderr)

    def _submit_ready(self) -> None:
        for cell in list(self.waiting):
            names = {source.name for source in cell.inputs}
            if names & self.failed:
                self.failed.add(cell.name)
                self.waiting.remove(cell)
            elif names <= self.done and len(self.running) < self.engine.n_slots:
                self.running[self.engine.submit(self.root, cell)] = (cell, time.monotonic())
                self.waiting.remove(cell)

    def _finish(self, future: "Future[None]") -> None:
        cell, start = self.running.pop(future)
        error = future.exception()
        if error is None:
            self.done.add(cell.name)
            self.rates[_rate_name(cell)] = (time.monotonic() - start) / cell.units
        elif isinstance(error, Exception):
            self.failed.add(cell.name)
            self.errors[cell.title] = str(error)
            tqdm.write(f"{cell.title} failed: {error}", file=sys.stderr)
        else:
            raise error

    def _show(self) -> None:
        now, left, spent = time.monotonic(), 0.0, 0.0
        for cell, start in self.running.values():
            share = done_share(self.root, cell)
            if share > 0.02:
                self.rates[_rate_name(cell)] = (now - start) / share / cell.units
            else:
                # It leaves no trace yet. One that takes longer than expected is never taken for done.
                share = min(0.9, (now - start) / self._seconds(cell))
            left += self._seconds(cell) * (1 - share)
            spent += self._seconds(cell) * share
        left += sum(self._seconds(cell) for cell in self.waiting)
        spent += sum(self._seconds(cell) for cell in self.cells if cell.name in self.done)
        self.bar.n = spent / (spent + left) if spent + left else 1.0
        slots = max(1, min(self.engine.n_slots, len(self.running) + len(self.waiting)))
        hours, minutes = divmod(math.ceil(left / slots / 60), 60)
        clock = f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"
        names = ", ".join(cell.title for cell, _ in list(self.running.values())[:2])
        state = f"{len(self.done)}/{len(self.cells)} cells, about {clock} left"
        more = f", +{len(self.running) - 2}" if len(self.running) > 2 else ""
        self.bar.set_description_str(f"{state}; {names}{more}" if names else state)

    def _seconds(self, cell: Cell) -> float:
        rate = self.rates.get(_rate_name(cell))
        return _START_SECONDS + cell.units * _FIRST_GUESS[cell.kind] if rate is None else cell.units * rate


def _rate_name(cell: Cell) -> str:
    """Cells of one name take about equally long per unit."""
    source = cell.inputs[0] if cell.kind == "final" else cell
    name = source.settings.get("objective", source.settings.get("algo", ""))
    return f"{cell.kind} {source.settings['env_id']} {name}"


def _measured_rates(root: Path, cells: Sequence[Cell]) -> dict[str, float]:
    rates = {}
    for cell in cells:
        path = marker_path(root, cell.name)
        if path.is_file():
            rates[_rate_name(cell)] = json.loads(path.read_bytes())["seconds"] / cell.units
    return rates


def done_share(root: Path, cell: Cell) -> float:
    """How much of a running cell is done, from what it has written.

    :param root: the benchmark's folder
    :param cell: one that runs
    :return: 0 to 1; 0 where it leaves no trace
    """
    try:
        if cell.kind == "encoder":
            lines = (root / cell.output).with_suffix(".run").joinpath("progress.csv").read_text().splitlines()
            column = lines[0].split(",").index("time/n_updates")
            return min(1.0, float(lines[-1].split(",")[column]) / cell.units)
        if cell.kind == "run":
            (path,) = (root / "work" / cell.name).glob("*/*/evaluations.npz")
            return min(1.0, float(np.load(path)["timesteps"][-1]) / cell.units)
    except (OSError, ValueError, IndexError, EOFError, zipfile.BadZipFile):
        pass  # not begun, or read while it was written
    return 0.0


def default_jobs(threads: int) -> int:
    """As many cells as the processors that this process may use have room for.

    :param threads: of each
    """
    return max(1, len(os.sched_getaffinity(0)) // threads) if hasattr(os, "sched_getaffinity") else 1


def make_engine(name: str, n_jobs: int | None, threads: int, **ray_options: Any) -> Engine:
    """The engine of a name.

    :param name: "local" or "ray"
    :param n_jobs: cells at a time; None for as many as there is room for
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
