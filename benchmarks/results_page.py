"""Fill the tables of docs/ from the committed runs, and draw their curves.

Run ``python -m benchmarks.results_page [PAGE ...]``.

A table stands between two comments. The first says in YAML what it shows, and this script writes what is between::

    <!-- table
    runs: [nav2d_ppo_frozen]                # folders in benchmarks/results/comparison, or LABEL=FOLDER
    source: training                        # or evaluations; of curves, steps and ratios
    reference: goal_progress,frozen         # whose steps are divided in ratios; without it, the first row
    rows: {"ssi,frozen": SSI}               # label of a method: what the table calls it; all methods without it
    columns: [return stochastic/standard, steps 0.5, ratio 0.5]    # none: no table
    figure: nav2d_ppo_frozen                # with --figures, the curves of the rows: docs/images/comparison-*.png
    -->
    <!-- end -->

A column may be ``{COLUMN: HEADER}``. See :data:`COLUMNS` for what there is.

A table over several comparisons has ``parts``, one for each column. Each is a description as above with one of
``columns``, and its ``rows`` lead from what the table calls a method to the label of its runs.

What the commands of a comparison took, and how many actions its encoders predicted::

    <!-- table
    costs: minigrid_fourrooms               # a folder in benchmarks/results/comparison
    curves: curves-MiniGrid-FourRooms-v0    # what `sb3-abisim analyze curves` wrote of its encoders; optional
    -->
    <!-- end -->
"""

import argparse
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from sb3_abisim.benchmark.report import figures, statistics
from sb3_abisim.benchmark.report.groups import Group, group_runs, labeled_runs
from sb3_abisim.benchmark.report.tables import compare, time_to

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
RUNS = RESULTS / "comparison"
IMAGES = ROOT / "docs" / "images"
TABLE = re.compile(r"(<!-- table\n(.*?)-->\n)(.*?)(<!-- end -->)", re.DOTALL)


class Cell(NamedTuple):
    """Where a cell takes its number from.

    :param group: the runs of its row
    :param first: the runs of the reference
    :param argument: what follows the column's name
    """

    group: Group
    first: Group
    argument: str


def _final(cell: Cell, measure: str) -> list[float]:
    """The mean of each run's final episodes.

    :param measure: "results" or "successes"
    :raises ValueError: if a run has none
    """
    arrays = [(run.final() or {}).get(f"{cell.argument}/{measure}") for run in cell.group.runs]
    found = [float(array.mean()) for array in arrays if array is not None]
    if len(found) < len(arrays):
        raise ValueError(f"a run of {cell.group.label} has no final {measure} of {cell.argument!r}")
    return found


def _digits(group: Group) -> int:
    """Behind the point of a return."""
    return 1 if group.high - group.low > 10 else 2


def _plus_minus(values: list[float], digits: int, scale: float = 1.0) -> str:
    mean, half = statistics.mean_and_interval(np.array(values)[:, None] * scale)
    if len(values) == 1:
        return f"{mean[0]:.{digits}f}"
    return f"{mean[0]:.{digits}f} ± {half[0]:.{digits}f}"


def _return(cell: Cell) -> str:
    return _plus_minus(_final(cell, "results"), _digits(cell.group))


def _success(cell: Cell) -> str:
    return _plus_minus(_final(cell, "successes"), 0, 100) + " %"


def _area(cell: Cell) -> str:
    steps, returns = statistics.on_common_steps([(c.steps, c.returns) for c in cell.group.curves])
    return _plus_minus(statistics.area_under_curve(steps, returns).tolist(), _digits(cell.group))


def _steps(cell: Cell) -> str:
    steps, horizon = cell.group.steps_to(cell.group.level(float(cell.argument))), cell.group.horizon
    n_reached = int((~np.isnan(steps)).sum())
    if not n_reached:
        return f"not within {horizon:,}"
    if n_reached < len(steps):
        # Runs that did not get there within their budget would need longer: a bound, without an interval.
        mean = float(np.nan_to_num(steps, nan=horizon).mean())
        return f"over {round(mean, -3):,.0f}: {n_reached} of {len(steps)} runs reach it"
    means, halves = statistics.mean_and_interval(steps[:, None])
    text = f"{round(float(means[0]), -3):,.0f}"
    return text if len(steps) == 1 else f"{text} ± {round(float(halves[0]), -3):,.0f}"


def _ratio(cell: Cell) -> str:
    if cell.group.label == cell.first.label:
        return "1"
    pair = cell.first, cell.group
    first, steps = (group.steps_to(group.level(float(cell.argument))) for group in pair)
    ratio = statistics.steps_ratio(first, steps, (pair[0].horizon, pair[1].horizon))
    if np.isnan(ratio.value):
        return "neither reaches it"
    prefix = {"": "", "<=": "at most ", ">=": "at least ", "~": "about "}[ratio.bound]
    interval = "" if np.isnan(ratio.low) else f" [{ratio.low:.2f}, {ratio.high:.2f}]"
    return f"{prefix}{ratio.value:.2f}{interval}"


def _minutes(cell: Cell) -> str:
    found = time_to(cell.group, cell.group.level(float(cell.argument)), "processor_seconds")
    if found is None:
        return "unknown"
    bound, half = ("over " if found["bound"] else ""), (found["high"] - found["low"]) / 2
    return f"{bound}{found['minutes']:.1f}" + (f" ± {half:.1f}" if np.isfinite(half) else "")


def _runs(cell: Cell) -> str:
    return str(len(cell.group.runs))


def _episodes(argument: str) -> str:
    mode, split = argument.split("/")
    return mode if split == "standard" else f"{mode}, {split}"


def _percent(argument: str) -> str:
    return f"{float(argument):.0%}".replace("%", " %")


# Name: what it writes, and its header; both take what follows the name.
COLUMNS: dict[str, tuple[Callable[[Cell], str], Callable[[str], str]]] = {
    "return": (_return, lambda argument: f"final return, {_episodes(argument)}"),
    "success": (_success, lambda argument: f"success, {_episodes(argument)}"),
    "area": (_area, lambda argument: "mean return of the run"),
    "steps": (_steps, lambda argument: f"steps to {_percent(argument)}"),
    "ratio": (_ratio, lambda argument: f"ratio of steps to {_percent(argument)}"),
    "minutes": (_minutes, lambda argument: f"minutes of processor time to {_percent(argument)}"),
    "runs": (_runs, lambda argument: "runs"),
}


def table(spec: dict[str, Any]) -> str:
    """One table.

    :param spec: see the module
    :return: lines of Markdown; none without columns
    :raises ValueError: for an unknown key, column or row, with what there is
    """
    if "costs" in spec:
        return costs(**spec)
    parts = spec.get("parts")
    _check_keys(spec, {"parts"} if parts else {"runs", "source", "reference", "rows", "columns", "figure"})
    if parts is None:
        header, rows = _columns(spec)
    else:
        header, rows = [], {}
        for place, part in enumerate(parts):
            _check_keys(part, {"runs", "source", "reference", "rows", "columns"})
            names = {label: name for name, label in part["rows"].items()}
            more, found = _columns({**part, "rows": names})
            header += more
            for name, cells in found.items():
                row = rows.setdefault(name, [])
                row += ["not run"] * (place - len(row)) + cells
        rows = {name: cells + ["not run"] * (len(header) - len(cells)) for name, cells in rows.items()}
    if not header:
        return ""
    lines = ["| | " + " | ".join(header) + " |", "|---|" + "---:|" * len(header)]
    return "\n".join(lines + [f"| {name} | " + " | ".join(cells) + " |" for name, cells in rows.items()])


def _check_keys(spec: dict[str, Any], known: set[str]) -> None:
    unknown = spec.keys() - known
    if unknown:
        raise ValueError(f"a table has no {', '.join(sorted(unknown))}")


def _columns(spec: dict[str, Any]) -> tuple[list[str], dict[str, list[str]]]:
    """The header, and the cells of each row."""
    columns = [next(iter(c.items())) if isinstance(c, dict) else (c, None) for c in spec.get("columns", ())]
    parts = [(*column.partition(" ")[::2], header) for column, header in columns]
    for name, _, _ in parts:
        if name not in COLUMNS:
            raise ValueError(f"a column is one of {', '.join(COLUMNS)}, got {name!r}")
    if not parts:
        return [], {}
    runs = labeled_runs([_folder(word) for word in spec["runs"]])
    rows = spec.get("rows") or {run.label: run.label for run in runs}
    first = spec.get("reference", next(iter(rows)))
    (groups,) = group_runs(runs, spec.get("source", "evaluations"), first, []).values()
    missing = {first, *rows} - groups.keys()
    if missing:
        raise ValueError(f"no runs of {', '.join(sorted(missing))}; there are {', '.join(groups)}")
    cells = {
        shown: [COLUMNS[name][0](Cell(groups[label], groups[first], argument)) for name, argument, _ in parts]
        for label, shown in rows.items()
    }
    return [header or COLUMNS[name][1](argument) for name, argument, header in parts], cells


def costs(costs: str, curves: str | None = None) -> str:
    """A table of the commands of a comparison: processor time, memory, and the accuracy of encoders.

    :param costs: a folder of :data:`RUNS`
    :param curves: stem of a file in :data:`RESULTS` with the curves of its encoders
    :return: lines of Markdown
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for path in sorted((RUNS / costs / "jobs").glob("*.json")):
        job = json.loads(path.read_bytes())
        if job["kind"] in _COMMANDS:
            groups.setdefault(_COMMANDS[job["kind"]](job["settings"]), []).append(job)
    encoders = json.loads((RESULTS / f"{curves}.json").read_bytes())["encoders"] if curves else {}
    accuracy = {
        Path(name).stem: one["curves"]["eval/accuracy"][-1]
        for name, one in encoders.items()
        if "eval/accuracy" in one["curves"]
    }
    lines = ["| command | processor seconds | MiB | `eval/accuracy` | jobs |", "|---|---:|---:|---:|---:|"]
    for name, jobs in sorted(groups.items()):
        memory = [job["memory_mib"] for job in jobs if "memory_mib" in job]
        reached = [accuracy[stem] for job in jobs if (stem := Path(job["output"]).stem) in accuracy]
        seconds = [job["processor_seconds"] for job in jobs if "processor_seconds" in job]
        cells = [
            _plus_minus(seconds, 0) if seconds else "",
            f"{max(memory):,}" if memory else "",
            _plus_minus(reached, 2) if reached else "",
            str(len(jobs)),
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


# By kind of a job, what a table calls its command; in the order of the commands.
_COMMANDS: dict[str, Callable[[dict[str, Any]], str]] = {
    "data": lambda settings: f"`collect` {settings['n_transitions']:,} transitions",
    "encoder": lambda settings: (
        f"`pretrain` {settings['objective']}, {settings['n_updates']:,} updates of {settings['batch_size']:,}"
    ),
    "run": lambda settings: (
        f"`train` {settings['algo']} on {settings['method']}, {settings['hyperparams']['n_timesteps']:,} steps"
    ),
}


def _folder(word: str) -> str:
    label, equals, folder = word.rpartition("=")
    return f"{label}{equals}{RUNS / folder}"


def fill(page: str) -> str:
    """A page with all of its tables made again.

    :param page: its text
    :raises ValueError: for a table that cannot be made; the message holds its description
    """

    def write(match: re.Match[str]) -> str:
        try:
            lines = table(yaml.safe_load(match[2]))
            return match[1] + (f"\n{lines}\n\n" if lines else "") + match[4]
        except (ValueError, KeyError) as error:
            raise ValueError(f"{error}, in the table\n{match[2]}") from error

    return TABLE.sub(write, page)


def draw(spec: dict[str, Any]) -> bytes:
    """The curves of a table's rows, under the names that they have there.

    :param spec: see the module
    :return: a PNG file
    """
    folders = [_folder(word) for word in spec["runs"]]
    rows = spec.get("rows") or {run.label: run.label for run in labeled_runs(folders)}
    comparison = compare(folders, spec.get("source", "evaluations"), spec.get("reference", next(iter(rows))), [0.5])
    return figures.plot_curves(comparison, rows)


def pages() -> list[Path]:
    """The pages of docs/ that have such tables."""
    return [path for path in sorted((ROOT / "docs").rglob("*.md")) if TABLE.search(path.read_text())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "pages", type=Path, nargs="*", help="pages of Markdown (default: those of docs/)", default=pages()
    )
    parser.add_argument("--figures", action="store_true", help="draw the curves as well")
    args = parser.parse_args()
    for path in args.pages:
        path.write_text(fill(path.read_text()))
        for match in TABLE.finditer(path.read_text()) if args.figures else ():
            spec = yaml.safe_load(match[2])
            if "figure" in spec:
                (IMAGES / f"comparison-{spec['figure']}.png").write_bytes(draw(spec))


if __name__ == "__main__":
    main()
