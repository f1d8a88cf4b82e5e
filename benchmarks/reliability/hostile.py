"""Files from a stranger that would run code, take memory or time, or reach out of their folder."""

import random
import shutil
import warnings
from pathlib import Path
from typing import Any

from benchmarks.reliability.children import MAX_MEGABYTES, MAX_SECONDS, run
from benchmarks.reliability.corpus import Corpus
from benchmarks.reliability.forge import MARKER

_COUNTED = ("n", "refused", "harmless", "executed", "large", "long", "bare", "megabytes")


def count(
    inputs: Path, work: Path, seed: int, n: int | None = None, kinds: tuple[str, ...] = ()
) -> dict[str, dict[str, Any]]:
    """Read every file of the corpus, each in a watched child.

    :param inputs: of :func:`~benchmarks.reliability.inputs.make_all`
    :param work: a new folder
    :param seed: of the choice
    :param n: how many of them, chosen at random; None for all
    :param kinds: of those that are read; none for all
    :return: by kind: ``n``, ``refused``, ``harmless``, and the breaches with examples
    """
    warnings.simplefilter("ignore")
    cases = [case for case in Corpus(inputs).all() if not kinds or case[0] in kinds]
    if n is not None:
        cases = sorted(random.Random(seed).sample(cases, n), key=lambda case: case[:2])
    counts: dict[str, dict[str, Any]] = {}
    for number, (kind, name, case) in enumerate(cases):
        row = counts.setdefault(kind, {**dict.fromkeys(_COUNTED, 0), "seconds": 0.0, "examples": []})
        folder = work / str(number)
        folder.mkdir(parents=True)
        read = case(folder)
        outcome = run(read, folder, watched=True)
        executed = (folder / MARKER).exists() or bool(outcome.acts)
        large, long = outcome.megabytes > MAX_MEGABYTES, outcome.seconds > MAX_SECONDS
        bare = outcome.kind in ("bare", "killed")
        row["n"] += 1
        row["refused"] += outcome.kind == "refused"
        row["harmless"] += outcome.kind == "done"
        row["megabytes"] = max(row["megabytes"], round(outcome.megabytes))
        row["seconds"] = max(row["seconds"], round(outcome.seconds, 1))
        for key, value in (("executed", executed), ("large", large), ("long", long), ("bare", bare)):
            row[key] += value
        if executed or large or long or bare:
            row["examples"].append(f"{name}: {outcome.kind}, {outcome.text[:200]}, {outcome.acts[:3]}")
        shutil.rmtree(folder, ignore_errors=True)
    return counts
