"""The report of a benchmark: PNG, CSV and one HTML page that needs no other file."""

import csv
import io
import math
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from sb3_abisim._version import __version__
from sb3_abisim.benchmark.report import statistics
from sb3_abisim.benchmark.report.figures import MINUS, plot, split_order, threshold_text
from sb3_abisim.benchmark.report.groups import WITHOUT_SPLITS, Group, split_label
from sb3_abisim.benchmark.report.tables import Comparison, Row, compare
from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.page import png_source, render_page
from sb3_abisim.common.text import spreadsheet_cell
from sb3_abisim.registry import get_traits, methods
from sb3_abisim.zoo.runs import Run, is_deterministic

# Each a table, a figure or both, where there are numbers for it.
PARTS = ("curves", "final", "thresholds", "times", "splits", "aggregates", "profiles", "improvement")
BOUND_SIGNS = {"": "", "<=": "≤ ", ">=": "≥ ", "~": "≈ "}


def report(
    folders: Sequence[str],
    output: str | Path | None = None,
    source: str = "evaluations",
    reference: str | None = None,
    thresholds: Sequence[float | str] | None = None,
    seed: int = 0,
) -> Path:
    """Compare runs and write the report; the same runs and arguments give the same files.

    :param folders: as for :func:`~sb3_abisim.benchmark.report.tables.compare`
    :param output: folder for the files; None for ``report`` in the first of ``folders``
    :param source: "evaluations" or "training"
    :param reference: label of the method that the others are compared with; None takes abisim (or
        abisim,frozen), else the first
    :param thresholds: normalized returns, or methods for their final return; None for the usual ones
    :param seed: of the bootstrap
    :return: the page
    :raises ValueError: if the runs cannot be compared
    """
    folder = Path(output) if output is not None else Path(split_label(folders[0])[1]) / "report"
    comparison = compare(folders, source, reference, thresholds, seed)
    images = plot(comparison)
    page = render(comparison, images)
    folder.mkdir(parents=True, exist_ok=True)
    files = {f"{name}.png": image for name, image in images.items()}
    for name in PARTS:
        rows = getattr(comparison, name, None)
        if rows:
            files[f"{name}.csv"] = _csv(rows)
    files["index.html"] = page.encode()
    for name in {f"{part}.{suffix}" for part in PARTS for suffix in ("csv", "png")} - set(files):
        # Of an earlier report, which does not belong beside this page.
        (folder / name).unlink(missing_ok=True)
    for name, content in files.items():
        write_atomic(folder / name, lambda file, content=content: file.write(content))  # type: ignore[misc]
    return folder / "index.html"


def _csv(rows: list[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: spreadsheet_cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue().encode()


def render(comparison: Comparison, images: dict[str, bytes]) -> str:
    """The page.

    :param comparison: its numbers
    :param images: name to PNG file
    """
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    sources = {name: png_source(data) for name, data in images.items()}
    labels = list(dict.fromkeys(label for group in comparison.groups.values() for label in group))
    known, names = methods(), [label.removesuffix(",frozen") for label in labels]
    unreached = _unreached(comparison)
    unreached_keys = {(row["env_id"], row["threshold"]) for row in unreached}
    filters: dict[str, Any] = {
        "number": _number,
        "threshold": threshold_text,
        "place": _place,
        "plus_minus": _plus_minus,
        "ratio": _ratio,
        "minutes": _minutes,
    }
    return render_page(
        template,
        filters,
        comparison=comparison,
        images=sources,
        cards=[_card(comparison, env_id) for env_id in comparison.groups],
        thresholds=[row for row in comparison.thresholds if (row["env_id"], row["threshold"]) not in unreached_keys],
        unreached=unreached,
        times=[row for row in comparison.times if row["n_reached"]],
        final=_final_table(comparison),
        splits=_split_table(comparison),
        split_names=list(dict.fromkeys(s for env_id in comparison.groups for s in split_order(comparison, env_id))),
        names={label: known[name].label if name in known else "" for label, name in zip(labels, names, strict=True)},
        acting=_acting(comparison),
        on_eval_split=_on_eval_split(comparison),
        window=statistics.WINDOW,
        n_resamples=statistics.N_RESAMPLES,
        version=__version__,
    )


def _acting(comparison: Comparison) -> str:
    """How the agents acted where the learning curves come from."""
    if comparison.source == "training":
        return "Learning curves show the training episodes themselves, in which the policy is stochastic: it explores."
    states = {env_id: is_deterministic(env_id) for env_id in comparison.groups}
    if all(states.values()):
        text = "Evaluation during training is deterministic."
    else:
        names = {True: "deterministic", False: "stochastic", None: "of unknown kind (not registered here)"}
        parts = ", ".join(f"{names[state]} in {env_id}" for env_id, state in states.items())
        text = f"Evaluation during training is {parts}."
    counts = sorted({run.n_eval_episodes for _, group in _groups(comparison) for run in group.runs})
    return f"{text} Each evaluation is the mean of {' or '.join(map(str, counts))} episodes."


def _on_eval_split(comparison: Comparison) -> bool:
    """Whether there are environments with splits, evaluated by the zoo on another one than that of training."""
    runs = [run for _, group in _groups(comparison) for run in group.runs if get_traits(run.env_id).splits]
    return bool(runs) and not any(
        (run.settings.get("eval_env_kwargs") or {}).keys() & {*get_traits(run.env_id).split_kwargs} for run in runs
    )


def _groups(comparison: Comparison) -> list[tuple[str, Group]]:
    return [(env_id, group) for env_id, groups in comparison.groups.items() for group in groups.values()]


def _card(comparison: Comparison, env_id: str) -> dict[str, Any]:
    """What a reader in a hurry takes away: how soon the reference reaches the final return of a baseline, and how soon
    it reaches the highest threshold that all its runs reached, compared with each baseline."""
    rows = [row for row in comparison.thresholds if row["env_id"] == env_id]
    always = [row for row in rows if row["reached_reference"] == row["n_reference"]]
    parts = {row["threshold"]: [row] for row in rows if row["threshold"] == row["baseline"]}
    if always:
        highest = max(always, key=lambda row: row["return"])["threshold"]
        parts[highest] = [row for row in always if row["threshold"] == highest]
    counts = {len(group.runs) for group in comparison.groups[env_id].values()}
    return {
        "env_id": env_id,
        "n_runs": f"{min(counts)} to {max(counts)}" if len(counts) > 1 else str(min(counts)),
        "parts": [{"row": found[0], "lines": [_sentence(row) for row in found]} for found in parts.values()],
    }


def _unreached(comparison: Comparison) -> list[Row]:
    """One row for each environment and threshold that no run of any method reached."""
    rows: dict[tuple[str, Any], list[Row]] = {}
    for row in comparison.thresholds:
        rows.setdefault((row["env_id"], row["threshold"]), []).append(row)
    return [found[0] for found in rows.values() if not any(math.isfinite(row["ratio"]) for row in found)]


def _sentence(row: Row) -> str:
    if not math.isfinite(row["ratio"]):
        return f"{row['baseline']}: no run reached it"
    return f"{BOUND_SIGNS[row['bound']]}{row['ratio']:.2f} times the steps of {row['baseline']}: {_verdict(row)}"


def _verdict(row: Row) -> str:
    if not math.isfinite(row["low"]):
        return "one run, no interval"
    # Where runs of the baseline are censored, the true ratio is smaller than the interval says; where runs of the
    # reference are, larger.
    if row["high"] < 1 and row["bound"] in ("", "<="):
        return "fewer"
    if row["low"] > 1 and row["bound"] in ("", ">="):
        return "more"
    return "no clear difference"


def _final_table(comparison: Comparison) -> list[dict[str, Any]]:
    """One row per environment and method, with both modes side by side; the eval split where there are splits."""
    table: dict[tuple[str, str], dict[str, Any]] = {}
    for row in comparison.final:
        if row["split"] in split_order(comparison, row["env_id"])[1:]:
            continue
        key = (row["env_id"], row["method"])
        entry = table.setdefault(key, {"env_id": key[0], "method": key[1], "n_runs": row["n_runs"], "paper": None})
        entry[row["mode"]] = (row["mean"], row["half_width"])
        if row["paper"] is not None:
            entry["paper"] = (row["paper"], row["paper_plus_minus"])
    return list(table.values())


def _split_table(comparison: Comparison) -> list[dict[str, Any]]:
    table: dict[tuple[str, str, str], dict[str, Any]] = {}
    for row in comparison.final:
        if row["split"] not in WITHOUT_SPLITS:
            key = (row["env_id"], row["method"], row["mode"])
            entry = table.setdefault(key, dict(zip(("env_id", "method", "mode"), key, strict=True)))
            entry[row["split"]] = (row["mean"], row["half_width"])
    return list(table.values())


def _place(run: Run) -> str:
    """Where a run lies, without what is above: METHOD/ALGO/ENV_NUMBER."""
    return "/".join(run.folder.parts[-3:])


def _number(value: float) -> str:
    return f"{value:,.0f}"


def _plus_minus(pair: tuple[float, float] | None) -> str:
    if pair is None:
        return ""
    mean, half = pair
    text = f"{mean:.1f} ± {half:.1f}" if math.isfinite(half) else f"{mean:.1f}"
    return text.replace("-", MINUS)


def _ratio(row: Row) -> str:
    if not math.isfinite(row["ratio"]):
        return "not reached"
    text = f"{BOUND_SIGNS[row['bound']]}{row['ratio']:.2f}"
    return f"{text} [{row['low']:.2f}, {row['high']:.2f}]" if math.isfinite(row["low"]) else text


def _minutes(row: Row) -> str:
    text = f"{BOUND_SIGNS[row['bound']]}{row['minutes']:.1f}"
    return f"{text} [{row['low']:.1f}, {row['high']:.1f}]" if math.isfinite(row["low"]) else text
