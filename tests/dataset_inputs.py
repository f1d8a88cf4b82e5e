"""What the tests of datasets share: a small one of index-valued frames, its files, and a forger's meta.json."""

import hashlib
import json
import os
from pathlib import Path

import index_env  # noqa: F401  (registers the environment)
import pytest

from sb3_abisim.common.files import file_hash
from sb3_abisim.data import chains
from sb3_abisim.data.collect import collect
from sb3_abisim.data.format import META_NAME, make_meta

N = 420


def collect_index(path: Path) -> Path:
    """Nine shards of a few dozen frames each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chains, "SHARD_TRANSITIONS", 48)
        collect("IndexEnv-v0", N, path, n_envs=4, seed=3)
    return path


def tree(folder: str | Path) -> dict[str, str]:
    """Every file of a folder, with its hash."""
    paths = [Path(top) / name for top, _, names in os.walk(folder) for name in names]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def without_hashes(meta: dict) -> dict:
    """What a meta.json holds of config.json."""
    return {k: v for k, v in meta.items() if k not in ("n_transitions", "n_frames", "shards", "digest", "checksum")}


def rewrite_meta(folder: Path, meta: dict) -> None:
    """Make a forger's meta.json: all hashes are right."""
    for shard in meta["shards"]:
        for name, entry in shard["files"].items():
            entry |= {"bytes": (folder / name).stat().st_size, "sha256": file_hash(folder / name)}
    (folder / META_NAME).write_text(json.dumps(make_meta(without_hashes(meta), meta["shards"])))
