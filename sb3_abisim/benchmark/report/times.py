"""How long a run took, with the collection and the pretraining before it: from the manifests of a benchmark's jobs."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

from sb3_abisim.benchmark.jobs.job import read_manifest
from sb3_abisim.common.files import find
from sb3_abisim.zoo.runs import INDEX_NAME, Run


@dataclasses.dataclass(frozen=True)
class RunTime:
    """Seconds by a clock.

    :param before: collection and pretraining; None if the encoder's file was given, so that nobody knows
    :param rl: the whole run, with its evaluations and the start of Python
    """

    before: float | None
    rl: float


def run_time(run: Run, clock: str = "seconds") -> RunTime | None:
    """How long a run took.

    :param run: of a benchmark's folder, or of an export
    :param clock: the manifests' "seconds" (wall-clock) or "processor_seconds" (of all processes)
    :return: None where no manifest says it
    :raises ValueError: for a damaged manifest
    """
    root = next((folder for folder in run.folder.resolve().parents if (folder / INDEX_NAME).is_file()), None)
    if root is None:
        return None
    manifests = _manifests(root)
    place = run.folder.resolve().relative_to(root).as_posix()
    # The final evaluation's output lies in the same folder.
    found = (manifest for manifest in manifests.values() if manifest["output"] == place)
    job = next((manifest for manifest in found if manifest.get("kind") == "run"), None)
    if job is None or clock not in job:
        return None
    names = list(job["inputs"])
    for name in names:  # grows while it is walked
        names += [source for source in manifests.get(name, {}).get("inputs", ()) if source not in names]
    jobs = [manifests.get(name, {}) for name in names]
    is_whole = all(clock in found for found in jobs)
    given = run.record is not None and run.record.encoder_hash is not None and not jobs
    return RunTime(sum(found[clock] for found in jobs) if is_whole and not given else None, job[clock])


@functools.cache
def _manifests(root: Path) -> dict[str, dict[str, Any]]:
    return {path.stem: read_manifest(path) for path in find(root / "jobs", "*.json")}
