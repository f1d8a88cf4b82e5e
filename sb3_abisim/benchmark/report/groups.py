"""From run folders to groups: the runs of one method in one environment, and what they have in common."""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_abisim.benchmark.report import statistics
from sb3_abisim.benchmark.report.statistics import Floats
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.registry import get_traits
from sb3_abisim.zoo.run_files import Curve
from sb3_abisim.zoo.runs import INDEX_NAME, Run, find_runs, missing_runs

STANDARD, LAST_EVALUATION, END_OF_TRAINING = "standard", "last evaluation", "end of training"
# What stands in place of a split where there is none.
WITHOUT_SPLITS = (STANDARD, LAST_EVALUATION, END_OF_TRAINING)


@dataclasses.dataclass(frozen=True)
class Group:
    """The runs of one method in one environment.

    :param curves: of each run
    :param finals: of each run, ``<mode>/<split>`` to mean return; empty where no final evaluation was made
    :param low: return that counts as 0
    :param high: return that counts as 1
    """

    env_id: str
    label: str
    runs: list[Run]
    curves: list[Curve]
    finals: list[dict[str, float]]
    low: float
    high: float

    def normalized(self, returns: Any) -> Any:
        """Returns as shares of the way from ``low`` to ``high``."""
        return (returns - self.low) / (self.high - self.low)

    def level(self, share: float) -> float:
        """The return of a normalized one."""
        return self.low + share * (self.high - self.low)

    @property
    def horizon(self) -> int:
        """Up to which step all runs go."""
        return int(min(curve.steps[-1] for curve in self.curves))

    def steps_to(self, level: float) -> Floats:
        """Steps of each run to a return; NaN where it is not reached up to the horizon."""
        return np.array([statistics.steps_to_threshold(c.steps, c.returns, level, self.horizon) for c in self.curves])

    def last(self) -> tuple[str, Floats]:
        """Return of each final model with the deterministic policy.

        :return: mode and split, ``mode/split``, and the returns; of the last evaluations if a run has no final one, of
            the end of training if it has none of those either
        """
        for split in (get_traits(self.env_id).eval_split or "eval", STANDARD):
            name = f"deterministic/{split}"
            if all(name in final for final in self.finals):
                return name, np.array([final[name] for final in self.finals])
        try:
            return f"deterministic/{LAST_EVALUATION}", np.array([run.evaluations().returns[-1] for run in self.runs])
        except ValueError:
            return f"stochastic/{END_OF_TRAINING}", np.array([curve.returns[-1] for curve in self.curves])

    def end(self) -> float:
        """Mean over runs of the last evaluations, as many as :func:`~statistics.steps_to_threshold` averages."""
        return float(np.mean([curve.returns[-statistics.WINDOW :].mean() for curve in self.curves]))


def labeled_runs(folders: Sequence[str]) -> list[Run]:
    """All runs of some folders, under their labels.

    :param folders: each a folder, or ``LABEL=FOLDER`` to call all runs below it LABEL
    :raises ValueError: for a folder without runs, or a label that cannot be one
    """
    runs: list[Run] = []
    for word in folders:
        label, folder = split_label(word)
        if label is not None and label.startswith("_"):
            raise ValueError(f"Matplotlib hides what is called {label!r}; give a label that does not begin with '_'")
        found = find_runs(folder)
        runs += found if label is None else [dataclasses.replace(run, label=label) for run in found]
    return runs


def missing_notes(folders: Sequence[str]) -> list[str]:
    """What of the benchmarks' lists of runs is not there.

    :param folders: as for :func:`labeled_runs`
    :return: a sentence for each folder that lacks some
    """
    notes = []
    for _, folder in map(split_label, folders):
        missing = missing_runs(folder)
        if missing:
            what = f"{len(missing)} runs of {INDEX_NAME} are not there and not compared"
            notes.append(f"{folder}: {what}: {', '.join(missing)}.")
    return notes


def split_label(word: str) -> tuple[str | None, str]:
    """The label and the folder of ``LABEL=FOLDER``; both may hold further "=".

    :param word: a folder, or ``LABEL=FOLDER``
    :return: the label, None for a plain folder, and the folder
    """
    places = [] if Path(word).exists() else [place for place, letter in enumerate(word) if letter == "="]
    for place in places:
        if Path(word[place + 1 :]).exists():
            return word[:place], word[place + 1 :]
    return (word[: places[0]], word[places[0] + 1 :]) if places else (None, word)


def group_runs(all_runs: list[Run], source: str, reference: str, notes: list[str]) -> dict[str, dict[str, Group]]:
    """Runs by environment and method, the reference first.

    :param all_runs: of any environments and methods
    :param source: "evaluations" or "training"
    :param reference: label of a method
    :param notes: what a reader must know is added
    :raises ValueError: for runs of one method that differ in more than seeds
    """
    found: dict[str, dict[str, list[Run]]] = {}
    for run in all_runs:
        found.setdefault(run.env_id, {}).setdefault(run.label, []).append(run)
    groups: dict[str, dict[str, Group]] = {}
    # Ours first.
    order = [env_id for env_id in ENV_IDS if env_id in found] + [env_id for env_id in found if env_id not in ENV_IDS]
    for env_id in order:
        runs = [run for method in found[env_id].values() for run in method]
        curves = {run.folder: run.evaluations() if source == "evaluations" else run.training() for run in runs}
        for run in runs:
            _note_unfinished(run, curves[run.folder], notes)
        low, high = _bounds(env_id, runs, list(curves.values()), notes)
        groups[env_id] = {}
        for label in sorted(found[env_id], key=lambda name: name != reference):
            members = sorted(found[env_id][label], key=lambda run: run.seed)
            _check_alike(members)
            finals = [_final_means(run) for run in members]
            groups[env_id][label] = Group(
                env_id, label, members, [curves[run.folder] for run in members], finals, low, high
            )
        budgets = {label: group.runs[0].n_timesteps for label, group in groups[env_id].items()}
        if len(set(budgets.values())) > 1:
            text = ", ".join(f"{label} {budget:,}" for label, budget in budgets.items())
            notes.append(f"{env_id}: the methods were trained for different numbers of steps ({text}).")
        if len({len(group.runs) for group in groups[env_id].values()}) > 1:
            text = ", ".join(f"{label} {len(group.runs)}" for label, group in groups[env_id].items())
            notes.append(f"{env_id}: the methods have different numbers of runs ({text}).")
    return groups


def _note_unfinished(run: Run, curve: Curve, notes: list[str]) -> None:
    """A run that was stopped looks like any other, and its method is compared up to its last step."""
    longest = int(np.diff(curve.steps, prepend=0).max())
    if curve.steps[-1] + 2 * longest < run.n_timesteps:
        notes.append(
            f"{run.env_id}: {run.folder} ends at step {int(curve.steps[-1]):,} of {run.n_timesteps:,}, and no "
            "run of its method is compared beyond; let it end, or leave it out."
        )


def _check_alike(runs: list[Run]) -> None:
    """Runs of one method must differ in seeds alone, or their mean says nothing."""
    hint = "compare them under different labels: LABEL=FOLDER"
    label, there = runs[0].label, runs[0].settings
    for run in runs[1:]:
        names = sorted(name for name in {**there, **run.settings} if there.get(name) != run.settings.get(name))
        if names:
            what = f"{runs[0].folder} and {run.folder} are both {label} but differ in {', '.join(names)}"
            raise ValueError(f"{what}; {hint}")
    for first, second in itertools.pairwise(runs):
        if first.seed == second.seed:
            raise ValueError(f"{first.folder} and {second.folder} are both {label} with seed {first.seed}; {hint}")


def _bounds(env_id: str, runs: list[Run], curves: list[Curve], notes: list[str]) -> tuple[float, float]:
    """The returns that count as 0 and 1: those of the environment, where they are known."""
    traits = get_traits(env_id)
    if traits.return_range is not None and not any(run.env_kwargs.keys() - set(traits.free_kwargs) for run in runs):
        return traits.return_range
    low, high = min(float(c.returns.min()) for c in curves), max(float(c.returns.max()) for c in curves)
    high = high if high > low else low + 1.0
    notes.append(f"{env_id}: normalized by the lowest and highest mean return of these runs ({low:.1f}, {high:.1f}).")
    return low, high


def _final_means(run: Run) -> dict[str, float]:
    ending = "/results"
    final = run.final() or {}
    return {name.removesuffix(ending): float(array.mean()) for name, array in final.items() if name.endswith(ending)}
