"""What the tests of datasets share: a small one of index-valued frames."""

from pathlib import Path

import index_env  # noqa: F401  (registers the environment)
import pytest

from sb3_abisim.data import collect as collect_module

N = 420


def collect_index(path: Path) -> Path:
    """Nine shards of a few dozen frames each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collect_module, "SHARD_TRANSITIONS", 48)
        collect_module.collect("IndexEnv-v0", N, path, n_envs=4, seed=3)
    return path
