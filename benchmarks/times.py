"""Minutes from nothing to a trained agent, by method: ``make times``, or ``python -m benchmarks.times FOLDER ...``.

Each folder is that of a benchmark whose jobs collected the data and pretrained the encoders, or an export of it. A
run's time is that of collection and pretraining, and the share of the run's that its steps to the threshold make.
Collection and base are counted in each run, although a benchmark makes them once for many. A run that does not get
there counts with all its time, and the mean is then a bound. Returns are those of the training episodes.

Processor time of jobs with one thread is what a clock shows on a core that has nothing else to do. Wall-clock stands
beside it, and says little where the machine had other work.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.tables import write_page
from sb3_abisim.benchmark.report.groups import Group, group_runs, labeled_runs
from sb3_abisim.benchmark.report.tables import time_to

RESULTS = Path(__file__).parent / "results" / "times.md"
THRESHOLDS = (0.5, 0.7)
CLOCKS = {"processor_seconds": "processor", "seconds": "wall-clock"}


def rows(folders: list[str], thresholds: tuple[float, ...] = THRESHOLDS) -> list[str]:
    """The lines of the table.

    :param folders: of benchmarks or exports
    :param thresholds: normalized returns
    :raises ValueError: for runs whose jobs do not say how long they and what they were made of took
    """
    lines = []
    # One after the other: what does not arrive has more steps, in a folder of its own.
    for folder in folders:
        runs = labeled_runs([folder])
        for env_id, groups in group_runs(runs, "training", runs[0].label, []).items():
            for label, group in groups.items():
                cells = [env_id, f"`{label}`", f"{round(group.horizon, -3):,}", _before(group)]
                cells += [_minutes(group, level, clock) for level in thresholds for clock in CLOCKS]
                lines.append("| " + " | ".join([*cells, str(len(group.runs))]) + " |")
    return lines


def header(thresholds: tuple[float, ...] = THRESHOLDS) -> list[str]:
    """The table's first two lines.

    :param thresholds: normalized returns
    """
    names = [f"to {level:.0%}, {name}" for level in thresholds for name in CLOCKS.values()]
    return [
        "| environment | method | steps, about | data and encoder, processor | " + " | ".join(names) + " | runs |",
        "|---|---|" + "---:|" * (len(names) + 3),
    ]


def _before(group: Group) -> str:
    found = time_to(group, group.level(THRESHOLDS[0]), "processor_seconds")
    if found is None:
        raise ValueError(
            f"the manifests of {group.label} do not say how long data and encoders took; give a benchmark's folder "
            "whose methods are given without =FILE"
        )
    return f"{found['minutes_before']:.1f}"


def _minutes(group: Group, threshold: float, clock: str) -> str:
    found = time_to(group, group.level(threshold), clock)
    if found is None:
        return "unknown"
    half = (found["high"] - found["minutes"]) if found["n_runs"] > 1 else np.nan
    text = f"{found['minutes']:.1f}" + (f" ± {half:.1f}" if np.isfinite(half) else "")
    if not found["bound"]:
        return text
    return f"over {text}" + (f", {found['n_reached']} of {found['n_runs']} runs" if found["n_reached"] else "")


def main(argv: list[str] | None = None) -> None:
    """Read the folders, write and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.times", description=__doc__)
    parser.add_argument("folders", nargs="+", help="benchmarks, or exports of them")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    args = parser.parse_args(argv)
    text = (
        "`make times`: minutes from nothing to a normalized return of the training episodes, with collection and "
        "pretraining, mean ± half the 95 % interval over runs (Student's t). One job at a time, each on one thread. "
        'Processor time is what a clock shows on a core that has nothing else to do. "Over": runs that did not get '
        "there count with all their time."
    )
    write_page(args.output, "Time to a return", text, header(), rows(args.folders))


if __name__ == "__main__":
    main()
