"""Pretraining on datasets of up to ten million transitions: memory, and processor time per transition.

The environment is small on purpose (16 x 16 gray pixels), so that ten million transitions take less than 3 GB of disk,
and so that what a transition costs beside its pixels shows. One command after the other collects the datasets. Then
pretraining processes, one for each size, work in turns; a turn is some updates in the middle of a pass, each of which
reads a batch from all over the data. The memory of a process is the most that it had resident, mapped pages included.
Linux and macOS only. ``make bench``.
"""

import argparse
import json
import multiprocessing
import shutil
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from benchmarks.bench_memory import peak_gigabytes
from benchmarks.bench_pretraining import make_run
from benchmarks.tables import machine, use_one_core, write_page
from sb3_abisim import BatchEnv, EnvTraits, SingleEnv, register_traits

RESULTS = Path(__file__).parent / "results" / "scale.md"
SIZES = (100_000, 1_000_000, 10_000_000)
ENV_ID = "benchmarks/SmallRoom-v0"
SIDE = 16
MOVES = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])


class SmallRoomVectorEnv(BatchEnv):
    """A dot that walks among walls at random places; nothing to reach."""

    def __init__(self, num_envs: int = 1, max_episode_steps: int | None = 50, **kwargs: Any) -> None:
        observation_space = spaces.Box(0, 255, (1, SIDE, SIDE), np.uint8)
        super().__init__(num_envs, observation_space, spaces.Discrete(4), max_episode_steps, **kwargs)
        self._dots = np.zeros((num_envs, 2), dtype=np.int64)
        self._walls = np.zeros((num_envs, SIDE, SIDE), dtype=bool)

    def _reset_envs(self, indices: NDArray[np.int64]) -> None:
        for i in indices:
            generator = self._generators[i]
            self._dots[i] = generator.integers(0, SIDE, 2)
            self._walls[i] = generator.random((SIDE, SIDE)) < 0.2

    def _advance(self, actions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        copies = np.arange(self.num_envs)
        there = np.clip(self._dots + MOVES[actions], 0, SIDE - 1)
        blocked = self._walls[copies, there[:, 0], there[:, 1]]
        self._dots = np.where(blocked[:, None], self._dots, there)
        return np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)

    def _observe(self, indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        pixels = np.where(self._walls[indices], np.uint8(90), np.uint8(0))
        pixels[np.arange(len(indices)), self._dots[indices, 0], self._dots[indices, 1]] = 255
        return pixels[:, None]

    def _render_frame(self, index: int) -> NDArray[np.uint8]:
        return self._observe(np.array([index]))[0].repeat(3, axis=0).transpose(1, 2, 0)

    def factors(self) -> dict[str, NDArray[Any]]:
        """The dot's row and column."""
        return {"position": self._dots.copy()}


class SmallRoomEnv(SingleEnv):
    """One copy."""

    batch_class = SmallRoomVectorEnv


gym.register(ENV_ID, entry_point=SmallRoomEnv, vector_entry_point=SmallRoomVectorEnv, max_episode_steps=50)
register_traits(ENV_ID, EnvTraits(n_transitions=100_000))


def serve_turns(pipe: Any, data: Path) -> None:
    """In a child process: open the dataset and make the first update, then for every number of updates received send
    microseconds of processor time per transition, reading and learning; the peak of memory at 0.

    :param pipe: the process's end of a pipe
    :param data: the dataset's folder
    """
    import resource
    import sys

    use_one_core()
    from sb3_abisim.common.malloc import keep_freed_memory

    keep_freed_memory()
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        run = make_run("ssi", data, None, Path(folder))
        batches = run._batches()
        run._update(next(batches))
        pipe.send(time.process_time() - start)
        while n_updates := pipe.recv():
            reading, start = 0.0, time.process_time()
            for _ in range(n_updates):
                before = time.process_time()
                batch = next(batches)
                reading += time.process_time() - before
                run._update(batch)
            n = n_updates * run.config.batch_size
            pipe.send((1e6 * reading / n, 1e6 * (time.process_time() - start) / n))
        run._log(run._logger(verbose=0), {})
        pipe.send(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9)


def turns(datasets: list[Path], rounds: int, n_updates: int) -> list[dict[str, Any]]:
    """What the processes of :func:`serve_turns` measured, one for each dataset, in turns."""
    context = multiprocessing.get_context("spawn")
    pipes, found = [], []
    for data in datasets:
        pipe, theirs = context.Pipe()
        context.Process(target=serve_turns, args=(theirs, data), daemon=True).start()
        theirs.close()
        pipes.append(pipe)
        found.append({"begin": pipe.recv(), "reading": [], "all": []})
    for _ in range(rounds):
        for pipe, row in zip(pipes, found, strict=True):
            pipe.send(n_updates)
            reading, both = pipe.recv()
            row["reading"].append(reading)
            row["all"].append(both)
    for pipe, row in zip(pipes, found, strict=True):
        pipe.send(0)
        row["peak"] = pipe.recv()
    return found


def collect(n_transitions: int, data: Path) -> tuple[float, float, float]:
    """Collect in a command of its own.

    :return: GB that it had resident at most, microseconds per transition, GB on disk
    """
    start = time.perf_counter()
    words = ["sb3_abisim", "collect", "--packages", "benchmarks.bench_scale", "--env", ENV_ID]
    peak = peak_gigabytes([*words, "-n", str(n_transitions), "-o", str(data)])
    seconds = time.perf_counter() - start
    return peak, 1e6 * seconds / n_transitions, sum(path.stat().st_size for path in data.iterdir()) / 1e9


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_scale", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="transitions (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=9, help="turns of each size (default: %(default)s)")
    parser.add_argument("--updates", type=int, default=40, help="updates per turn (default: %(default)s)")
    parser.add_argument("--data", type=Path, help="keep the datasets here (default: made and removed)")
    args = parser.parse_args(argv)
    use_one_core()
    folder = args.data or Path(tempfile.mkdtemp())
    try:
        datasets = [folder / str(n) for n in args.sizes]
        collected = [collect(n, data) for n, data in zip(args.sizes, datasets, strict=True)]
        found = turns(datasets, args.rounds, args.updates)
    finally:
        if args.data is None:
            shutil.rmtree(folder)
    print(json.dumps(found))
    rows = []
    for n, (peak, cost, size), row in zip(args.sizes, collected, found, strict=True):
        ratios = [here / first for here, first in zip(row["all"], found[0]["all"], strict=True)]
        rows.append(
            f"| {n:,} | {size:.2f} | {peak:.2f} | {cost:.0f} | {row['peak']:.2f} | {row['begin']:.1f} | "
            f"{statistics.median(row['reading']):.1f} | {statistics.median(row['all']):.1f} | "
            f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}) |"
        )
    text = (
        f"`python -m benchmarks.bench_scale` on {machine()}: `ssi` on 16 x 16 gray pixels, batches of 256. Processor "
        f"time in microseconds per transition, medians of {args.rounds} turns of {args.updates} updates each, all "
        "sizes in turns; the ratio is that to the first size in the same round. To begin is to open the dataset, "
        "compare its hashes and make the first update, in seconds of processor time. Sizes and memory are in GB."
    )
    header = [
        "| transitions | dataset | collecting: memory | wall-clock per transition | pretraining: memory | to begin "
        "| reading | reading and learning | ratio |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    write_page(args.output, "Pretraining on large datasets", text, header, rows)


if __name__ == "__main__":
    main()
