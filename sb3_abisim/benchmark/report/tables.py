"""The tables of a report: curves, final returns, steps to a threshold, and aggregates over environments."""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sb3_abisim.benchmark.report import statistics
from sb3_abisim.benchmark.report.groups import Group, group_runs, labeled_runs, missing_notes
from sb3_abisim.benchmark.report.statistics import Floats
from sb3_abisim.benchmark.report.times import run_time

# "Final Performance Evaluation", (mean, what follows +-) of the return; the paper does not say what the latter is.
PAPER = {
    "Nav2D-v0": {
        "abisim": (-14.266, 0.509), "ssi": (-12.613, 1.992), "acro": (-49.436, 0.342), "beta_vae": (-13.880, 2.263),
        "curl": (-44.791, 7.472), "vanilla": (-14.523, 1.560),
    },
    "PointMaze-v0": {
        "abisim": (-30.8, 3.7), "ssi": (-29.7, 3.9), "acro": (-127.9, 0.61), "beta_vae": (-128.4, 0.52),
        "curl": (-128.4, 0.45), "vanilla": (-128.4, 0.052),
    },
}  # fmt: skip
PROFILE_TAUS = np.linspace(0.0, 1.0, 101)
# Normalized returns.
DEFAULT_THRESHOLDS: tuple[float | str, ...] = (0.5, 0.7, 0.9)
# As a normalized return: below it, reaching a threshold says nothing.
NEAR_THE_LOWEST = 0.05
DEFAULT_REFERENCE, FROM_SCRATCH = "abisim", "vanilla"
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """All that a report says, before it is plotted.

    :param groups: environment to method to its runs; the reference first
    :param reference: the method that the others are compared with
    :param source: "evaluations" or "training"
    :param curves: rows env_id, method, steps, mean, low, high, n_runs
    :param final: rows env_id, method, mode, split, mean, half_width, n_runs, paper
    :param thresholds: rows env_id, threshold, return, baseline, ratio, low, high, bound, reached_*, n_*
    :param times: rows env_id, threshold, return, method, minutes, low, high, minutes_before, bound, n_reached, n_runs;
        empty where no run is a job of a benchmark
    :param aggregates: rows score, method, iqm, low, high
    :param profiles: rows method, score, share, low, high
    :param improvement: rows baseline, probability, low, high
    :param notes: what a reader must know to judge the numbers
    """

    groups: dict[str, dict[str, Group]]
    reference: str
    source: str
    curves: list[Row]
    final: list[Row]
    thresholds: list[Row]
    times: list[Row]
    aggregates: list[Row]
    profiles: list[Row]
    improvement: list[Row]
    notes: list[str]


def compare(
    folders: Sequence[str],
    source: str = "evaluations",
    reference: str | None = None,
    thresholds: Sequence[float | str] | None = None,
    seed: int = 0,
) -> Comparison:
    """Read runs and compute everything.

    :param folders: each a folder, or ``LABEL=FOLDER`` to call all runs below it LABEL
    :param source: "evaluations" (the zoo's, during training) or "training" (the training episodes themselves)
    :param reference: label of the method to compare with the others; None takes abisim, frozen or not, else the first
    :param thresholds: normalized returns, between 0 and 1, or labels, for the final return of this method (the mean of
        its last evaluations); None takes 0.5, 0.7, 0.9 and, where there are such runs, vanilla
    :param seed: of the bootstrap
    :raises ValueError: if the runs cannot be compared, with the remedy
    """
    if source not in ("evaluations", "training"):
        raise ValueError(f"source must be 'evaluations' or 'training', got {source!r}")
    bad = [value for value in thresholds or () if not isinstance(value, str) and not 0 < value <= 1]
    if bad or (thresholds is not None and not thresholds):
        raise ValueError(f"thresholds are methods, or normalized returns above 0 and up to 1, got {bad}")
    runs = labeled_runs(folders)
    labels = list(dict.fromkeys(run.label for run in runs))
    if reference is None:
        # "abisim" itself, else "abisim,frozen" or "abisim=...".
        ours = sorted(label for label in labels if re.split("[=,]", label)[0] == DEFAULT_REFERENCE)
        reference = ours[0] if ours else labels[0]
    if reference not in labels:
        raise ValueError(f"no runs of the reference {reference!r} among {', '.join(labels)}; give --reference")
    if thresholds is None:
        thresholds = (*DEFAULT_THRESHOLDS, *((FROM_SCRATCH,) if FROM_SCRATCH in labels else ()))
    unknown = [value for value in thresholds if isinstance(value, str) and value not in labels]
    if unknown:
        raise ValueError(f"a threshold is a number or one of {', '.join(labels)}, got {', '.join(unknown)}")
    notes = missing_notes(folders)
    groups = group_runs(runs, source, reference, notes)
    labels = list(dict.fromkeys(label for methods in groups.values() for label in methods))
    aggregates, profiles, improvement = _across(groups, labels, reference, seed, notes)
    return Comparison(
        groups, reference, source, _curve_rows(groups), _final_rows(groups, notes),
        _threshold_rows(groups, reference, thresholds, seed, notes),
        _time_rows(groups, reference, thresholds), aggregates, profiles, improvement, notes,
    )  # fmt: skip


def _curve_rows(groups: dict[str, dict[str, Group]]) -> list[Row]:
    rows = []
    for env_id, methods in groups.items():
        for label, group in methods.items():
            steps, returns = statistics.on_common_steps([(curve.steps, curve.returns) for curve in group.curves])
            mean, half = statistics.mean_and_interval(returns)
            rows += [
                {"env_id": env_id, "method": label, "steps": int(step), "mean": m, "low": m - h, "high": m + h,
                 "n_runs": len(returns)}
                for step, m, h in zip(steps, mean.tolist(), half.tolist(), strict=True)
            ]  # fmt: skip
    return rows


def _final_rows(groups: dict[str, dict[str, Group]], notes: list[str]) -> list[Row]:
    rows = []
    for env_id, methods in groups.items():
        for label, group in methods.items():
            names = sorted(set.intersection(*(set(final) for final in group.finals)))
            values = {name: np.array([final[name] for final in group.finals]) for name in names}
            if not values:
                values = dict([group.last()])
                notes.append(
                    f"{env_id}: {label} has no final evaluation; its {next(iter(values)).split('/')[1]} is shown."
                )
            for name, returns in values.items():
                mode, split = name.split("/")
                mean, half = statistics.mean_and_interval(returns)
                paper = PAPER.get(env_id, {}).get(label) if mode == "deterministic" else None
                rows.append(
                    {"env_id": env_id, "method": label, "mode": mode, "split": split, "mean": float(mean),
                     "half_width": float(half), "n_runs": len(returns), "paper": paper[0] if paper else None,
                     "paper_plus_minus": paper[1] if paper else None}
                )  # fmt: skip
    return rows


def _threshold_rows(
    groups: dict[str, dict[str, Group]], reference: str, thresholds: Sequence[float | str], seed: int, notes: list[str]
) -> list[Row]:
    rows = []
    for env_id, threshold, level in _levels(groups, reference, thresholds):
        methods = groups[env_id]
        if isinstance(threshold, str) and methods[threshold].normalized(level) < NEAR_THE_LOWEST:
            notes.append(
                f"{env_id}: {threshold} ends near the lowest return ({level:.4g}), which takes little to reach."
            )
        steps = {label: group.steps_to(level) for label, group in methods.items()}
        for label in methods:
            if label == reference:
                continue
            pair = methods[reference].horizon, methods[label].horizon
            ratio = statistics.steps_ratio(steps[reference], steps[label], pair, seed)
            rows.append(
                {"env_id": env_id, "threshold": threshold, "return": level, "baseline": label,
                 "ratio": ratio.value, "low": ratio.low, "high": ratio.high, "bound": ratio.bound,
                 "steps_reference": ratio.steps[0], "steps_baseline": ratio.steps[1],
                 "reached_reference": int((~np.isnan(steps[reference])).sum()),
                 "reached_baseline": int((~np.isnan(steps[label])).sum()),
                 "n_reference": len(steps[reference]), "n_baseline": len(steps[label]),
                 "horizon_reference": pair[0], "horizon_baseline": pair[1]}
            )  # fmt: skip
    return rows


def _levels(
    groups: dict[str, dict[str, Group]], reference: str, thresholds: Sequence[float | str]
) -> Iterator[tuple[str, float | str, float]]:
    """Environment, threshold, and the return that it stands for."""
    for env_id, methods in groups.items():
        if reference not in methods:
            continue
        for threshold in thresholds:
            if not isinstance(threshold, str):
                yield env_id, threshold, methods[reference].level(threshold)
            elif threshold in methods:
                yield env_id, threshold, methods[threshold].end()


def _time_rows(groups: dict[str, dict[str, Group]], reference: str, thresholds: Sequence[float | str]) -> list[Row]:
    """Wall-clock from nothing to a threshold, of methods whose collection and pretraining the benchmark did, too."""
    rows = []
    for env_id, threshold, level in _levels(groups, reference, thresholds):
        for label, group in groups[env_id].items():
            found = time_to(group, level)
            if found is not None:
                rows.append({"env_id": env_id, "threshold": threshold, "return": level, "method": label, **found})
    return rows


def time_to(group: Group, level: float, clock: str = "seconds") -> Row | None:
    """Time from nothing to a return: collection, pretraining, and the share of the run's time that its steps make.

    Collection and base are counted in each run, although a benchmark makes them once for many.

    :param group: runs of a benchmark, or of an export
    :param level: the return
    :param clock: "seconds" or "processor_seconds"
    :return: minutes (mean), low and high (95 % interval), minutes_before (collection and pretraining), bound (">="
        where runs did not reach it, which count whole), n_reached, n_runs; None where manifests lack it for a run
    """
    times = [run_time(run, clock) for run in group.runs]
    if any(time is None or time.before is None for time in times):
        return None
    before = np.array([time.before for time in times if time is not None], dtype=np.float64) / 60
    rl = np.array([time.rl for time in times if time is not None]) / 60
    steps = group.steps_to(level)
    last = np.array([curve.steps[-1] for curve in group.curves])
    mean, half = statistics.mean_and_interval((before + rl * np.nan_to_num(steps / last, nan=1.0))[:, None])
    return {
        "minutes": float(mean[0]), "low": float(max(mean[0] - half[0], 0.0)), "high": float(mean[0] + half[0]),
        "minutes_before": float(before.mean()), "bound": ">=" if np.isnan(steps).any() else "",
        "n_reached": int((~np.isnan(steps)).sum()), "n_runs": len(steps),
    }  # fmt: skip


def _across(
    groups: dict[str, dict[str, Group]], labels: list[str], reference: str, seed: int, notes: list[str]
) -> tuple[list[Row], list[Row], list[Row]]:
    """IQM, performance profiles and probability of improvement over the environments that all methods have runs in."""
    shared = [env_id for env_id, methods in groups.items() if set(methods) == set(labels)]
    counts = {label: min((len(groups[env_id][label].runs) for env_id in shared), default=0) for label in labels}
    if not shared or min(counts.values()) < 2 or len(labels) < 2:
        notes.append(
            "No aggregates across environments: they need two methods or more, an environment that all of them share, "
            "and two runs of each in it."
        )
        return [], [], []
    if len(shared) < len(groups):
        notes.append(f"Aggregates are over {', '.join(shared)}: the other environments lack runs of some method.")
    if any(len(groups[env_id][label].runs) > counts[label] for env_id in shared for label in labels):
        notes.append("Aggregates take as many runs of a method as it has in each environment, the first ones by seed.")
    finals, areas = {}, {}
    for label in labels:
        members = [groups[env_id][label] for env_id in shared]
        n = counts[label]
        finals[label] = np.stack([group.normalized(group.last()[1])[:n] for group in members], axis=1)
        areas[label] = np.stack(
            [group.normalized(_areas(group, groups[group.env_id]))[:n] for group in members], axis=1
        )
    aggregates = [
        {"score": name, "method": label, "iqm": value, "low": low, "high": high, "n_runs": counts[label]}
        for name, scores in (("final", finals), ("area", areas))
        for label, (value, low, high) in statistics.iqm(scores, seed).items()
    ]
    shares, intervals = statistics.performance_profiles(finals, PROFILE_TAUS, seed)
    profiles = [
        {"method": label, "score": float(tau), "share": float(shares[label][i]), "low": float(intervals[label][0, i]),
         "high": float(intervals[label][1, i])}
        for label in labels for i, tau in enumerate(PROFILE_TAUS)
    ]  # fmt: skip
    baselines = {label: finals[label] for label in labels if label != reference}
    improvement = [
        {"baseline": label, "probability": value, "low": low, "high": high}
        for label, (value, low, high) in statistics.probability_of_improvement(
            finals[reference], baselines, seed
        ).items()
    ]
    return aggregates, profiles, improvement


def _areas(group: Group, methods: dict[str, Group]) -> Floats:
    """Mean return over the course of each run, up to the last step that all methods share."""
    horizon = min(curve.steps[-1] for other in methods.values() for curve in other.curves)
    steps, returns = statistics.on_common_steps([(curve.steps, curve.returns) for curve in group.curves])
    kept = steps <= horizon
    return statistics.area_under_curve(steps[kept], returns[:, kept])
