"""The script that counts faults, at a small scale, and the page of its committed counts."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.reliability.damage import DAMAGES, damaged
from benchmarks.reliability.table import AIMS, HEADING, breaches, page, tables

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_is_that_of_the_committed_counts() -> None:
    found = json.loads((ROOT / "benchmarks" / "results" / "reliability.json").read_bytes())
    text = (ROOT / "docs" / "limits.md").read_text()
    assert text == page(text, found) and HEADING in text
    assert set(found) == set(AIMS) and {part["scale"] for part in found.values()} == {1.0}
    assert sum(row["steps"] for row in found["steps"]["rows"].values()) == 1_000_000
    assert breaches(found) == []


@pytest.mark.skipif(sys.platform != "linux", reason="it forks, and reads /proc")
def test_a_small_run_has_no_breaches(tmp_path: Path) -> None:
    """A process of its own: it forks, which needs one with a single thread."""
    (tmp_path / "r.md").write_text(f"# Head\n\n{HEADING}old tables\n")
    words = ["--seed", "1", "--scale", "0.002", "-o", str(tmp_path / "r.json"), "--page", str(tmp_path / "r.md")]
    words += ["--only", "damage", "hostile", "steps"]
    run = [sys.executable, "-m", "benchmarks.reliability", *words]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-2000:]
    found = json.loads((tmp_path / "r.json").read_bytes())
    assert all(row["n"] >= len(DAMAGES) for row in found["damage"]["rows"].values())
    assert (tmp_path / "r.md").read_text() == f"# Head\n\n{HEADING}{tables(found)}"


def test_what_counts_as_a_breach() -> None:
    row = {"n": 3, "refused": 1, "equal": 1, "silent": 1, "bare": 0, "examples": ["a bit"]}
    assert breaches({"damage": {"rows": {"x": row}}}) == ["damage, x: 1 loaded as other content; a bit"]
    assert breaches({"damage": {"rows": {"x": {**row, "silent": 0}}}}) == []


@pytest.mark.parametrize("how", DAMAGES)
def test_damages_change_a_content(how: str) -> None:
    import random

    draw, whole = random.Random(0), bytes(range(1, 200))
    for _ in range(50):
        changed = damaged(whole, how, draw)
        assert len(changed) < len(whole) if how == "cut" else len(changed) == len(whole)
        assert changed != whole or how == "swap"
