"""What code made a job, so that jobs made by other code of the same version can be named.

A job's name holds the package's version and not its source: a released version is one thing, and in a checkout every
changed comment would otherwise cost days of training. Instead each job's manifest records a digest of the source that
made it. Jobs that are found with another digest are kept and named in a warning; whoever changed the code knows
whether they still hold, and takes another folder if not.
"""

import functools
import hashlib
from pathlib import Path

import sb3_abisim

PACKAGE = Path(sb3_abisim.__file__).parent
# Enough to tell for data; for all else it is the whole package but what only looks at results. What is new counts.
_COLLECTION = ("envs", "media", "collect.py", "dataset_format.py", "dataset_writer.py")
_READERS = ("analysis", "analyze.py", "benchmark", "demo.py", "tabular.py")
_FINAL = "benchmark/evaluate.py"


@functools.cache
def source_hash(kind: str, package: Path = PACKAGE) -> str:
    """The sha256 of the source that determines what jobs of a kind make, comments included.

    Hyperparameters are not part of it: they are settings, and so part of the jobs' names.

    :param kind: "data", "encoder", "run" or "final"
    :param package: its folder
    """
    sha256 = hashlib.sha256()
    for path in sorted([*package.rglob("*.py"), *package.glob("media/*.npz")]):
        name = path.relative_to(package).as_posix()
        part = name.partition("/")[0]
        counts = part in _COLLECTION if kind == "data" else part not in _READERS
        if counts or (kind == "final" and name == _FINAL):
            sha256.update(f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return sha256.hexdigest()
