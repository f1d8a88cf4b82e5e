"""Which code a job is the work of."""

import shutil
from pathlib import Path

import pytest

from sb3_abisim.benchmark.jobs.source_hash import PACKAGE, source_hash

KINDS = ("data", "encoder", "run", "final")


@pytest.mark.parametrize(
    ("changed", "kinds"),
    [
        ("envs/nav2d.py", KINDS),
        ("media/photo_pan.npz", KINDS),
        ("common/grids.py", KINDS),
        ("data/collect.py", KINDS),
        ("data/chains.py", KINDS),
        ("data/environments.py", KINDS),
        ("data/rollout.py", KINDS),
        ("data/dataset.py", ("encoder", "run", "final")),
        ("objectives/abisim.py", ("encoder", "run", "final")),
        ("a_new_module.py", ("encoder", "run", "final")),
        ("zoo/manager.py", ("encoder", "run", "final")),
        ("zoo/evaluate.py", ("final",)),
        ("zoo/runs.py", ("final",)),
        ("zoo/record.py", ()),
        ("benchmark/report/page.py", ()),
        ("analysis/plots.py", ()),
        ("README.txt", ()),
    ],
)
def test_what_a_change_reaches(changed: str, kinds: tuple[str, ...], tmp_path: Path) -> None:
    package = shutil.copytree(PACKAGE, tmp_path / "changed", ignore=shutil.ignore_patterns("__pycache__"))
    assert all(source_hash(kind, package) == source_hash(kind) for kind in KINDS), "wherever it lies"
    package = package.rename(tmp_path / "package")
    exists = changed not in ("a_new_module.py", "README.txt")
    assert (package / changed).exists() == exists, "the table of what counts names files that are there"
    with open(package / changed, "ab") as file:
        file.write(b"# a comment\n")
    assert tuple(kind for kind in KINDS if source_hash(kind, package) != source_hash(kind)) == kinds
