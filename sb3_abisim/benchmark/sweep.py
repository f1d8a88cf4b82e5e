"""Search pretraining settings by what they do for the agents that are trained on the encoders.

Optuna proposes trials. A trial is an encoder per encoder seed and a run per RL seed, made by the jobs of a benchmark.
Nothing is kept besides the jobs. The sampler is seeded, so that the same command proposes the same trials again, finds
those that are done by the names of their jobs, and goes on where it was stopped. That holds for one version of Optuna,
whose sampler decides.
"""

import csv
import dataclasses
import io
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_abisim.benchmark.graph import build
from sb3_abisim.benchmark.jobs.job import Job, is_done
from sb3_abisim.benchmark.jobs.local import Engine, run_jobs
from sb3_abisim.benchmark.plan import Plan
from sb3_abisim.benchmark.report import statistics
from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.text import spreadsheet_cell
from sb3_abisim.registry import get_objective, methods
from sb3_abisim.zoo.methods import MethodSpec
from sb3_abisim.zoo.run_files import Curve
from sb3_abisim.zoo.runs import read_run

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

METRICS = ("final", "area")
TABLE_NAME = "sweep.csv"
_GRAMMAR = "NAME=LOW..HIGH, NAME=LOW..HIGH:log or NAME=CHOICE|CHOICE"


@dataclasses.dataclass(frozen=True)
class Trial:
    """A proposal and what came of it.

    :param params: setting, with its objective in front, to value
    :param returns: metric of each RL seed; empty if a job failed
    :param encoders: files, relative to the sweep's folder
    """

    number: int
    params: dict[str, Any]
    returns: tuple[float, ...]
    encoders: tuple[str, ...]

    @property
    def value(self) -> float:
        """Mean over the RL seeds; NaN if a job failed."""
        return sum(self.returns) / len(self.returns) if self.returns else math.nan

    @property
    def words(self) -> tuple[str, ...]:
        """For ``--pretrain-params``."""
        return tuple(f"{name}:{value}" for name, value in self.params.items())


def parse_space(words: Sequence[str], objective: str) -> dict[str, "BaseDistribution"]:
    """Read what to search: a range of integers if both ends are, else of numbers, or choices.

    :param words: such as ``objective_kwargs.c=0.5..0.99``, ``learning_rate=1e-4..1e-3:log``,
        ``objective_kwargs.pairs=random|nearest``; ``ssi.batch_size=64..512`` for a setting of the base
    :param objective: whose settings those are that name none
    :return: setting, with its objective in front, to Optuna's distribution
    :raises ValueError: for a word that cannot be read
    """
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    space: dict[str, BaseDistribution] = {}
    for word in words:
        name, equals, values = word.partition("=")
        if name.partition(".")[0] not in methods():
            name = f"{objective}.{name}"
        if name in space:
            raise ValueError(f"{name} is given twice")
        body, log, _ = values.partition(":log")
        low, dots, high = body.partition("..")
        if not equals or name.endswith(".") or values != body + log or not (dots or "|" in values):
            raise ValueError(f"a part of the search space is {_GRAMMAR}, got {word!r}")
        if not dots:
            space[name] = CategoricalDistribution(values.split("|"))
            continue
        try:
            ends: list[Any] = [int(end) if end.lstrip("+-").isdigit() else float(end) for end in (low, high)]
        except ValueError as error:
            raise ValueError(f"a part of the search space is {_GRAMMAR}, got {word!r}") from error
        if not ends[0] < ends[1] or (log and ends[0] <= 0):
            raise ValueError(f"a range rises, and starts above 0 with :log, got {word!r}")
        kind = IntDistribution if all(isinstance(end, int) for end in ends) else FloatDistribution
        space[name] = kind(low=ends[0], high=ends[1], log=bool(log))
    if not space:
        raise ValueError(f"nothing to search; give --space {_GRAMMAR}")
    return space


def sweep(
    root: Path,
    plan: Plan,
    space: Sequence[str],
    n_trials: int,
    make_engine: Callable[[], Engine],
    metric: str = "final",
    batch: int = 1,
    seed: int = 0,
) -> list[Trial]:
    """Search, and write ``sweep.csv`` after each batch.

    :param root: the folder, which may be a benchmark's
    :param plan: one method that is pretrained, one environment, budgets; its ``pretrain_params`` hold for all trials
    :param space: as for :func:`parse_space`
    :param n_trials: how many
    :param make_engine: gives a fresh engine for each batch
    :param metric: "final" (mean of the last evaluations) or "area" (mean of the return over the course of the run)
    :param batch: trials that are proposed at a time: more keep more processors busy, but know less of each other
    :param seed: of the sampler
    :return: all trials in their order
    :raises ValueError: if the arguments do not fit together
    """
    import optuna

    if len(plan.methods) != 1 or len(plan.env_ids) != 1:
        raise ValueError(f"a sweep takes one method and one environment, got {plan.methods} and {plan.env_ids}")
    spec = MethodSpec.parse(plan.methods[0])
    objective = spec.name
    get_objective(objective)
    if spec.encoder is not None:
        raise ValueError(f"a sweep pretrains an encoder for each trial; give {objective} without ={spec.encoder}")
    for name, count in (("n_trials", n_trials), ("batch", batch)):
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")
    if metric not in METRICS:
        raise ValueError(f"metric must be one of {', '.join(METRICS)}, got {metric!r}")
    distributions = parse_space(space, objective)
    for name, distribution in distributions.items():
        for value in _extremes(distribution):
            # Raises for a setting that is not there.
            build(dataclasses.replace(plan, pretrain_params=(*plan.pretrain_params, f"{name}:{value}")))
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    trials: list[Trial] = []
    while len(trials) < n_trials:
        asked = [study.ask(distributions) for _ in range(min(batch, n_trials - len(trials)))]
        proposals = [Trial(trial.number, trial.params, (), ()) for trial in asked]
        plans = [dataclasses.replace(plan, pretrain_params=plan.pretrain_params + trial.words) for trial in proposals]
        graphs = [build(each) for each in plans]
        for trial in proposals:
            print(f"trial {trial.number + 1} of {n_trials}: {' '.join(trial.words)}", file=sys.stderr)
        # Equal trials share their jobs.
        jobs = {job.name: job for graph in graphs for job in graph}
        run_jobs(root, list(jobs.values()), make_engine())
        for optuna_trial, trial, graph in zip(asked, proposals, graphs, strict=True):
            trials.append(_answered(root, trial, graph, metric))
            value = trials[-1].value
            if math.isnan(value):
                study.tell(optuna_trial, state=optuna.trial.TrialState.FAIL)
            else:
                study.tell(optuna_trial, value)
        _write_table(root / TABLE_NAME, trials, plan.seeds, metric)
    return trials


def _extremes(distribution: "BaseDistribution") -> Sequence[Any]:
    return getattr(distribution, "choices", None) or (distribution.low, distribution.high)  # type: ignore[attr-defined]


def best_of(trials: Sequence[Trial]) -> Trial | None:
    """The trial with the highest value, the first of equal ones; None if all failed.

    :param trials: of :func:`sweep`
    """
    return max((trial for trial in trials if trial.returns), key=lambda trial: trial.value, default=None)


def _answered(root: Path, trial: Trial, jobs: list[Job], metric: str) -> Trial:
    runs = [job for job in jobs if job.kind == "run"]
    encoders = tuple(dict.fromkeys(run.inputs[0].output for run in runs))
    if not all(is_done(root, run.to_json()) for run in runs):
        return dataclasses.replace(trial, encoders=encoders)
    returns = tuple(_measure(read_run(root / run.output).evaluations(), metric) for run in runs)
    return dataclasses.replace(trial, returns=returns, encoders=encoders)


def _measure(curve: Curve, metric: str) -> float:
    if metric == "final":
        return float(curve.returns[-statistics.WINDOW :].mean())
    return float(statistics.area_under_curve(curve.steps, np.atleast_2d(curve.returns))[0])


def _write_table(path: Path, trials: list[Trial], seeds: Sequence[int], metric: str) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = list(trials[0].params)
    writer.writerow(["trial", *names, metric, *(f"{metric}_seed{seed}" for seed in seeds), "encoders"])
    for trial in trials:
        returns = trial.returns or [""] * len(seeds)
        value = trial.value if trial.returns else "failed"
        row = [trial.number + 1, *(trial.params[name] for name in names), value, *returns]
        writer.writerow(map(spreadsheet_cell, [*row, " ".join(trial.encoders)]))
    write_atomic(path, lambda file: file.write(text.getvalue().encode()))
