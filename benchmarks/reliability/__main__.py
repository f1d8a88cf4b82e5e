"""Faults on purpose, counted: ``python -m benchmarks.reliability --seed 0``.

It makes all inputs itself: damaged files of every kind that the package writes, files of a stranger, kills and full
disks in the middle of commands, random steps in every environment, and numbers that are none in training. Each part is
kept in ``benchmarks/results/reliability.json`` as soon as it has ended; ``docs/limits.md`` ends with its tables.
``--only`` makes some parts anew, ``--scale 0.01`` is a try of minutes. The exit code is 1 where a count that should be
0 is not.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

from benchmarks.reliability import damage, faults, hostile, inputs, nan, steps
from benchmarks.reliability.table import breaches, page
from benchmarks.tables import machine

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "reliability.json"
PAGE = ROOT / "docs" / "limits.md"
# At a scale of 1.
N_STEPS, N_NAN = 1_000_000, 40
# Imported once, and not in each child.
_MODULES = (
    "rl_zoo3.train", "sb3_abisim.__main__", "sb3_abisim.benchmark.command", "sb3_abisim.benchmark.report.page",
    "sb3_abisim.data.collect", "sb3_abisim.data.command", "sb3_abisim.envs.backgrounds.video_cache",
    "sb3_abisim.envs.scan_nav.mesh", "sb3_abisim.pretraining.trainer", "sb3_abisim.zoo.command", "sb3_abisim.zoo.merge",
    "sb3_abisim.zoo.record",
)  # fmt: skip


def parts(work: Path, seed: int, scale: float) -> dict[str, Callable[[], dict[str, Any]]]:
    """What is counted, by name.

    :param work: a folder that is there
    :param seed: of everything
    :param scale: of all numbers of cases
    """
    made = work / "inputs"

    def with_inputs(count: Callable[[], dict[str, Any]]) -> Callable[[], dict[str, Any]]:
        def counted() -> dict[str, Any]:
            if not made.exists():
                inputs.make_all(made)
            return count()

        return counted

    def damages() -> dict[str, Any]:
        return {
            each.name: damage.count(each, made, work / f"damage-{number}", seed)
            for number, each in enumerate(damage.artifacts(scale))
        }

    def files() -> dict[str, Any]:
        return hostile.count(made, work / "hostile", seed, None if scale >= 1 else max(1, int(scale * 400)))

    def disturbed() -> dict[str, Any]:
        return {
            job.name: faults.count(job, made, work / f"fault-{number}", seed)
            for number, job in enumerate(faults.jobs(scale, made))
        }

    return {
        "damage": with_inputs(damages),
        "hostile": with_inputs(files),
        "faults": with_inputs(disturbed),
        "steps": lambda: steps.count(int(scale * N_STEPS), seed),
        "nan": lambda: nan.count(max(1, int(scale * N_NAN)), work / "nan", seed),
    }


def main(argv: list[str] | None = None) -> int:
    """Count, and write the page.

    :param argv: the program's arguments by default
    :return: the exit code
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reliability", description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="(default: 0)")
    parser.add_argument("--scale", type=float, default=1.0, help="of all numbers of cases (default: 1)")
    parser.add_argument(
        "--only", nargs="+", choices=list(parts(Path(), 0, 1)), help="parts to make anew (default: all)"
    )
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="JSON file (default: %(default)s)")
    parser.add_argument("--page", type=Path, default=PAGE, help="page that ends with its tables (default: %(default)s)")
    args = parser.parse_args(argv)
    for name in _MODULES:
        __import__(name)
    # They start a program the first time, and are asked for whenever a model is saved.
    platform.platform(), platform.processor()
    found: dict[str, Any] = json.loads(args.output.read_bytes()) if args.only and args.output.is_file() else {}
    with tempfile.TemporaryDirectory() as name:
        for part, count in parts(Path(name), args.seed, args.scale).items():
            if args.only and part not in args.only:
                continue
            begin = time.process_time() + sum(os.times()[2:4])
            rows = count()
            seconds = time.process_time() + sum(os.times()[2:4]) - begin
            found[part] = {"seed": args.seed, "scale": args.scale, "seconds": round(seconds), "machine": machine(),
                           "rows": rows}  # fmt: skip
            print(part, json.dumps(rows, indent=1), flush=True)
            args.output.write_text(json.dumps(found, indent=1) + "\n")
    args.page.write_text(page(args.page.read_text(), found))
    failed = breaches(found)
    print("\n".join(failed) or "no breaches")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
