"""What code made a job, so that jobs made by other code of the same version can be named.

A job's name holds the package's version and not its source: a released version is one thing, and in a checkout every
changed comment would otherwise cost days of training. Instead each job's manifest records a hash of the source that
made it. Jobs that are found with another hash are kept and named in a warning. Whoever changed the code knows whether
they still hold, and takes another folder if not.
"""

import functools
import hashlib
from pathlib import Path

import sb3_abisim

PACKAGE = Path(sb3_abisim.__file__).parent
# What datasets come from; encoders and runs come from the whole package but what only looks at results.
_COLLECTION = (
    "common/grids.py", "common/spaces.py", "data/chains.py", "data/collect.py", "data/copies.py",
    "data/environments.py", "data/format.py", "data/rollout.py", "data/vectorized.py",
    "data/writer.py", "envs/", "media/",
)  # fmt: skip
_EVALUATION = ("zoo/evaluate.py", "zoo/runs.py")
_READERS = ("analysis/", "benchmark/", "demo.py", "zoo/record.py", *_EVALUATION)


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
        counts = name.startswith(_COLLECTION) if kind == "data" else not name.startswith(_READERS)
        if counts or (kind == "final" and name.startswith(_EVALUATION)):
            sha256.update(f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return sha256.hexdigest()
