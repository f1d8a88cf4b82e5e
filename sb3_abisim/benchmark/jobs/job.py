"""A job of a benchmark: one command, named by what determines its output, with a manifest once it is done.

A job's key is a hash over its kind, the package's version, its settings and the keys of its inputs. Two benchmarks
that need the same dataset therefore find the same folder, and a changed setting gives new names to what depends on it
and to nothing else. Changes of code without a change of version do not change the names; the manifests record them
(:mod:`sb3_abisim.benchmark.jobs.source_hash`).

Nothing heavy is imported here: a program that runs jobs needs no PyTorch.
"""

import dataclasses
import hashlib
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_abisim._version import __version__
from sb3_abisim.benchmark.jobs.source_hash import source_hash
from sb3_abisim.common.cli import PROGRAM
from sb3_abisim.common.files import file_hash


@dataclasses.dataclass(frozen=True)
class Job:
    """One command whose output depends on its settings and inputs alone.

    :param kind: "data", "encoder", "run" or "final"
    :param title: what the display calls it
    :param settings: all that determines the output besides the inputs; JSON types
    :param inputs: jobs that must be done first
    :param command: words after ``python -m``, to be run in the benchmark's folder
    :param output: what it makes, relative to the benchmark's folder
    :param output_file: a file of the output whose hash is kept; "" for the output itself
    :param cost: transitions, updates, steps or episodes, whichever it counts in
    :param method: of a run, the plan's method spec that asked for it
    """

    kind: str
    title: str
    settings: dict[str, Any]
    inputs: tuple["Job", ...]
    command: tuple[str, ...]
    output: str
    output_file: str = ""
    cost: int = 1
    method: str = ""

    @property
    def key(self) -> str:
        """16 hexadecimal digits."""
        return job_key(self.kind, self.settings, self.inputs)

    @property
    def name(self) -> str:
        """Kind and key."""
        return f"{self.kind}-{self.key}"

    def to_json(self) -> dict[str, Any]:
        """The fields and the name, in JSON types; inputs by name."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {**fields, "name": self.name, "inputs": [job.name for job in self.inputs]}


def job_key(kind: str, settings: dict[str, Any], inputs: tuple[Job, ...] = (), without_seeds: bool = False) -> str:
    """The hash of all that determines a job.

    :param kind: see :class:`Job`
    :param settings: see :class:`Job`
    :param inputs: see :class:`Job`
    :param without_seeds: the same for jobs that differ in seeds alone
    :return: 16 hexadecimal digits
    """
    if without_seeds:
        settings = {name: value for name, value in settings.items() if name != "seed"}
    sources = [job_key(job.kind, job.settings, job.inputs, without_seeds) for job in inputs]
    content = {"kind": kind, "version": __version__, "settings": settings, "inputs": sources}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def command_line(command: Sequence[str]) -> str:
    """A job's command as a user would type it.

    :param command: words after ``python -m``
    """
    first = [PROGRAM] if command[0] == "sb3_abisim" else ["python", "-m", command[0]]
    return shlex.join([*first, *command[1:]])


def manifest_path(root: Path, name: str) -> Path:
    """The file that a finished job leaves: what it is, and how it was made.

    :param root: the benchmark's folder
    :param name: of the job
    """
    return root / "jobs" / f"{name}.json"


def is_done(root: Path, job: dict[str, Any]) -> bool:
    """Whether the output is there and still what was made.

    :param root: the benchmark's folder
    :param job: what :meth:`Job.to_json` gave
    """
    try:
        manifest = read_manifest(manifest_path(root, job["name"]))
        return bool(manifest.get("hash") == file_hash(root / job["output"] / job["output_file"]))
    except FileNotFoundError:
        return False


def read_manifest(path: Path) -> dict[str, Any]:
    """What a finished job left.

    :param path: see :func:`manifest_path`
    :raises FileNotFoundError: if it has not
    :raises ValueError: for a damaged file
    """
    try:
        manifest = {"name": path.stem, "output": "", "inputs": [], **json.loads(path.read_bytes())}
        texts = [manifest[key] for key in ("name", "output", "hash") if key in manifest]
        if not all(isinstance(text, str) for text in texts) or manifest["name"] != path.stem:
            raise ValueError("its name is not that of the file")
        if not all(isinstance(name, str) for name in manifest["inputs"]):
            raise ValueError("its inputs are no names")
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged ({error!r}); remove it, and its job is done again") from error
    return manifest


def is_by_other_code(root: Path, job: dict[str, Any]) -> bool:
    """Whether a job that is done was made by other code than this; False where its manifest has no hash of the code.

    :param root: the benchmark's folder
    :param job: what :meth:`Job.to_json` gave
    """
    source = read_manifest(manifest_path(root, job["name"])).get("source")
    return source is not None and source != source_hash(job["kind"])
