"""What it gains to make the next batch while the present one is learned from: ``make bench``.

The same run takes turns with its batches made ahead by a thread and with each made when it is asked for. The clock on
the wall counts, since the thread uses a second core, with networks on one thread and on as many as there are cores.
"""

import argparse
import contextlib
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

from benchmarks.bench_pretraining import make_run
from benchmarks.tables import write_page

RESULTS = Path(__file__).parent / "results" / "ahead.md"
OBJECTIVES = ("ssi", "abisim")
ENV_IDS = ("Nav2D-v0", "PointMaze-v0", "DistractorPointMaze-v0")
N_TRANSITIONS = 20_000


def seconds(run: Any, batches: Generator[Any, None, None], n_updates: int) -> float:
    """How long some updates take by the clock, after one that is not counted.

    :param run: of pretraining
    :param batches: its batches
    :param n_updates: how many
    """
    with contextlib.closing(batches) as closing:
        run._update(next(closing))
        start = time.perf_counter()
        for _ in range(n_updates):
            run._update(next(closing))
        return time.perf_counter() - start


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    import torch as th

    from sb3_abisim.common.malloc import keep_freed_memory
    from sb3_abisim.data.collect import collect
    from sb3_abisim.pretraining.ahead import make_ahead

    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_ahead", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--env", nargs="+", default=list(ENV_IDS), metavar="ID")
    parser.add_argument("--rounds", type=int, default=9, help="turns of each (default: %(default)s)")
    parser.add_argument("--updates", type=int, default=20, help="updates per turn (default: %(default)s)")
    args = parser.parse_args(argv)
    keep_freed_memory()  # as pretraining does
    rows = []
    for env_id in args.env:
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder) / "data"
            collect(env_id, N_TRANSITIONS, data)
            for objective in OBJECTIVES:
                base = f"{env_id}/ssi" if objective == "abisim" else None
                run = make_run(objective, data, base, Path(folder))
                for n_threads in sorted({1, os.cpu_count() or 1}):
                    th.set_num_threads(n_threads)
                    plain, ahead = [], []
                    for _ in range(args.rounds):
                        plain.append(seconds(run, run._batches(), args.updates))
                        ahead.append(seconds(run, make_ahead(run._batches()), args.updates))
                    ratios = sorted(one / two for one, two in zip(plain, ahead, strict=True))
                    speed = args.updates * run.config.batch_size
                    rows.append(
                        f"| `{objective}`, {env_id} | {n_threads} | {speed / statistics.median(plain):,.0f} "
                        f"| {speed / statistics.median(ahead):,.0f} | {statistics.median(ratios):.2f} "
                        f"| {ratios[0]:.2f} to {ratios[-1]:.2f} |"
                    )
                    print(rows[-1], flush=True)
    text = (
        f"`python -m benchmarks.bench_ahead` on {platform.machine()} with {os.cpu_count()} cores, Python "
        f"{platform.python_version()}: transitions per second by the clock, medians of {args.rounds} turns of "
        f"{args.updates} updates; the ratio is that of the two turns of a round, median and range. Other work on the "
        "machine takes the second core away. Pretraining makes batches ahead where networks have one thread of "
        "several cores, and on a GPU, where nobody has measured it."
    )
    header = [
        "| objective, environment | threads | when asked for | ahead | ratio | range |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    write_page(args.output, "Making batches ahead", text, header, rows)


if __name__ == "__main__":
    main()
