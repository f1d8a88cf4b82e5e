"""One table of what users wait for: ``python -m benchmarks.headline``, the last step of ``make bench``.

Each row stands in a page of ``benchmarks/results``, where its two sides were measured in turns within one run. This
script measures nothing.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

from benchmarks.tables import read_table, write_page

RESULTS = Path(__file__).parent / "results"
PAGE = RESULTS / "headline.md"


class Row(NamedTuple):
    """Where a row comes from.

    :param what: is waited for
    :param page: file in ``benchmarks/results``, without ``.md``
    :param first: the first cells of the row there
    :param speed: the column with our number, and its unit
    :param against: what it is compared with
    :param ratio: the column that compares
    """

    what: str
    page: str
    first: tuple[str, ...]
    speed: tuple[str, str]
    against: str
    ratio: str


_STEPS = ("steps/s", "steps/s")
_ENCODED, _PIXELS = ("`VecEncodeObservations`", "steps/s"), "the frozen encoder within the policy"
_BOUND = "Stable-Baselines3 with a free environment and encoder"
ROWS = (
    Row("stepping Distractor PointMaze, 64 copies", "envs", ("DistractorPointMaze-v0", "64"), _STEPS,
        "gymnasium-robotics' PointMaze, rendered by MuJoCo", "ratio"),
    Row("stepping Nav2D, 256 copies", "envs", ("Nav2D-v0", "256"), _STEPS, "plain NumPy per cell", "ratio"),
    Row("pretraining SSI, PointMaze", "pretraining", ("`ssi`, PointMaze-v0",), ("ours", "transitions/s"),
        "a straightforward loop", "ratio"),
    Row("pretraining action-bisimulation, Nav2D", "pretraining", ("`abisim`, Nav2D-v0",), ("ours", "transitions/s"),
        "a straightforward loop", "ratio"),
    Row("PPO on a frozen encoder, Distractor PointMaze", "frozen", ("PPO, DistractorPointMaze-v0",), _ENCODED, _PIXELS,
        "ratio"),
    Row("the same", "frozen", ("PPO, DistractorPointMaze-v0",), _ENCODED, _BOUND, "share of the bound"),
    Row("DQN on a frozen encoder, Nav2D", "frozen", ("DQN, Nav2D-v0",), _ENCODED, _PIXELS, "ratio"),
    Row("the same", "frozen", ("DQN, Nav2D-v0",), _ENCODED, _BOUND, "share of the bound"),
    Row("PPO that fine-tunes, Distractor PointMaze", "malloc", ("DistractorPointMaze-v0",),
        ("`keep_freed_memory`", "steps/s"), "without `keep_freed_memory`", "ratio"),
    Row("PPO from scratch with an auxiliary objective", "auxiliary", ("`ssi`",), ("steps per second", "steps/s"),
        "without one, in more time", "more time than without"),
    Row("from nothing to 70 %, Distractor PointMaze, frozen goal progress", "times",
        ("DistractorPointMaze-v0", "`goal_progress,frozen`"), ("to 70%, processor", "minutes"), "", ""),
    Row("the same, frozen action-bisimulation", "times", ("DistractorPointMaze-v0", "`abisim,frozen`"),
        ("to 70%, processor", "minutes"), "", ""),
    Row("the same, from scratch", "times", ("DistractorPointMaze-v0", "`vanilla`"), ("to 70%, processor", "minutes"),
        "", ""),
)  # fmt: skip
# Pages that `make bench` does not make.
COMMANDS = {"times": "make times"}


def lines(folder: Path = RESULTS) -> tuple[list[str], list[str]]:
    """The rows of the table, and what was not measured yet.

    :param folder: with the pages
    :return: lines of Markdown, and for each absent page the command that makes it
    :raises ValueError: for a page without the row or column
    """
    rows, absent = [], []
    for row in ROWS:
        path = folder / f"{row.page}.md"
        if not path.is_file():
            command = COMMANDS.get(row.page, f"python -m benchmarks.bench_{row.page}")
            absent += [command] * (command not in absent)
            continue
        cells = _find(path, row)
        speed, unit = row.speed
        ratio = cells[row.ratio] if row.ratio else ""
        rows.append(f"| {row.what} | {cells[speed]} {unit} | {row.against} | {ratio} | [{row.page}]({row.page}.md) |")
    return rows, absent


def _find(path: Path, row: Row) -> dict[str, str]:
    for cells in read_table(path.read_text()):
        if tuple(cells.values())[: len(row.first)] == row.first:
            missing = {row.speed[0], row.ratio} - {""} - cells.keys()
            if missing:
                raise ValueError(f"{path} has no column {', '.join(sorted(missing))}, only {', '.join(cells)}")
            return cells
    raise ValueError(f"{path} has no row {' | '.join(row.first)}; measure again, or change benchmarks/headline.py")


def main(argv: list[str] | None = None) -> None:
    """Write and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.headline", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=PAGE, help="Markdown file (default: %(default)s)")
    args = parser.parse_args(argv)
    rows, absent = lines()
    text = (
        "`make bench` ends with this table. The two sides of a row were measured in turns within one run; the page "
        "behind it says how. Speeds of different rows may be of different days: compare ratios. One core."
    )
    header = ["| what | ours | compared with | ratio | page |", "|---|---:|---|---:|---|"]
    tail = (f"Not measured yet: {', '.join(f'`{command}`' for command in absent)}.", "") if absent else ()
    write_page(args.output, "What users wait for", text, header, rows, tail)


if __name__ == "__main__":
    main()
