"""What an encoder gained: returns of RL runs that used it, and what probes read from it.

Everything is of this encoder, by its hash; what is of another is refused.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_abisim.benchmark.report.tables import Comparison, compare
from sb3_abisim.common.cli import PROGRAM
from sb3_abisim.common.extras import require_extra
from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.push.markdown import code_block, inert, table

# Of a learning curve, beside its start.
N_CURVE_POINTS = 5


@dataclass(frozen=True)
class Result:
    """A number as the Hub's model index has it.

    :param task: the Hub's name of the task
    :param env_id: where it was measured
    :param split: of the episodes
    :param metric: the Hub's name of the metric, or ours
    :param name: of the metric, for readers
    :param value: the number
    :param half_width: of its 95 % interval; None without one
    :param n_runs: that it is the mean of
    """

    task: str
    env_id: str
    split: str
    metric: str
    name: str
    value: float
    half_width: float | None = None
    n_runs: int = 1


@dataclass(frozen=True)
class Evidence:
    """A part of the card.

    :param section: lines of Markdown
    :param results: for the model index
    """

    section: list[str]
    results: list[Result]


def benchmark_evidence(file: EncoderFile, folder: str) -> Evidence:
    """Returns of the runs of a benchmark, those with this encoder marked, with intervals and commands.

    :param file: the encoder
    :param folder: of the benchmark, or its export
    :raises ValueError: if no run used the encoder, or the runs cannot be compared
    """
    require_extra("benchmark", f"{PROGRAM} push --benchmark", "scipy", "rliable")
    comparison = compare([folder])
    hashes = {
        (env_id, label): [run.record.encoder_hash for run in group.runs if run.record is not None]
        for env_id, methods in comparison.groups.items()
        for label, group in methods.items()
    }
    ours = {key for key, used in hashes.items() if file.hash in used}
    if not ours:
        raise ValueError(f"no run in {folder} used {file.path} ({file.hash}); give the benchmark that did")
    final = [row for row in comparison.final if any(row["env_id"] == env_id for env_id, _ in ours)]
    rows = []
    for row in final:
        key = row["env_id"], row["method"]
        name = f"**{inert(row['method'])}**" if key in ours else inert(row["method"])
        files = str(len(set(hashes[key]) - {None}) or "")
        acting = f"{row['mode']}, {row['split']}"
        rows.append([inert(row["env_id"]), name, inert(acting), _interval(row["mean"], row["half_width"]),
                     str(row["n_runs"]), files])  # fmt: skip
    section = [
        "## Reinforcement learning",
        "",
        "Mean return of the final models, with the half width of the 95 % interval over runs (Student's t). Bold: runs "
        "with this file, or with one of several encoder files of the same method. Other rows are for comparison. "
        "Splits are the environment's, such as `eval` for what training never showed. `frozen` methods leave the "
        "encoder as it is; the others fine-tune it.",
        "",
        *table(["environment", "method", "policy and split", "return", "runs", "encoder files"], rows),
        *_curves(comparison, ours),
        *_notes(comparison),
        *_commands(comparison, file.hash),
    ]
    results = [
        Result("reinforcement-learning", row["env_id"], row["split"], "mean_reward",
               f"mean return of {row['method']}, {row['mode']} policy", row["mean"], _finite(row["half_width"]),
               row["n_runs"])
        for row in final if (row["env_id"], row["method"]) in ours
    ]  # fmt: skip
    return Evidence(section, results)


def _curves(comparison: Comparison, ours: set[tuple[str, str]]) -> list[str]:
    """A few points of each learning curve of this encoder."""
    rows = []
    for env_id, label in sorted(ours):
        points = [row for row in comparison.curves if (row["env_id"], row["method"]) == (env_id, label)]
        for k in sorted({*np.linspace(0, len(points) - 1, N_CURVE_POINTS + 1).round().astype(int).tolist()}):
            row = points[k]
            half = (row["high"] - row["low"]) / 2
            rows.append([inert(env_id), inert(label), f"{row['steps']}", _interval(row["mean"], half)])
    return ["On the way there:", "", *table(["environment", "method", "steps", "return"], rows)]


def _notes(comparison: Comparison) -> list[str]:
    if not comparison.notes:
        return []
    return ["To judge the numbers:", "", *(f"* {inert(note)}" for note in comparison.notes), ""]


def _commands(comparison: Comparison, hash: str) -> list[str]:
    runs = [run for methods in comparison.groups.values() for group in methods.values() for run in group.runs]
    commands = {
        run.command.strip()
        for run in runs
        if run.record is not None and run.record.encoder_hash == hash and run.command
    }
    return ["The runs with this file:", "", *code_block("", sorted(commands))] if commands else []


def probes_evidence(file: EncoderFile, path: str) -> Evidence:
    """What probes read from this encoder.

    :param file: the encoder
    :param path: JSON of ``sb3-abisim analyze probes``
    :raises ValueError: if it has nothing of this encoder, or is something else
    """
    try:
        numbers = json.loads(Path(path).read_bytes())
        env_id, found = str(numbers["env_id"]), None
        for entry in numbers["encoders"].values():
            found = entry if entry["hash"] == file.hash else found
        scores = {} if found is None else _flat(found["scores"])
    except (KeyError, TypeError, AttributeError, RecursionError, ValueError) as error:
        raise ValueError(f"{path} is not the JSON of {PROGRAM} analyze probes ({error!r})") from error
    if found is None:
        raise ValueError(f"{path} has no probes of {file.path} ({file.hash}); run {PROGRAM} analyze probes on it")
    section = [
        "## What can be read from it",
        "",
        f"Probes in {inert(env_id)}: a regression (linear) and a small network (MLP) read parts of the simulator's "
        "state, the factors, from the encoder's numbers. Scores are R² for numbers, the area under the ROC curve "
        "for yes and no, and accuracy for classes.",
        "",
        *table(
            ["split", "factor", "probe", "score"],
            [[*map(inert, key), f"{score:.3f}"] for key, score in scores.items()],
        ),
        *code_block("", [f"{PROGRAM} analyze probes --env {env_id} FILE"]),
    ]
    results = [
        Result("feature-extraction", env_id, split, "probe", f"{factor}, {probe} probe", score)
        for (split, factor, probe), score in scores.items()
    ]
    return Evidence(section, results)


def _flat(scores: Mapping[str, Mapping[str, Mapping[str, float | None]]]) -> dict[tuple[str, str, str], float]:
    """Split, factor and probe to score; what does not vary has none."""
    return {
        (split, factor, probe): float(score)
        for split, factors in scores.items()
        for factor, kinds in factors.items()
        for probe, score in kinds.items()
        if score is not None
    }


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None


def _interval(mean: float, half: float) -> str:
    return f"{mean:.2f}" + (f" ± {half:.2f}" if math.isfinite(half) else ", no interval")
