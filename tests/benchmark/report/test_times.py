"""Time to a threshold counts collection and pretraining, and says so where nobody knows them."""

import json
from pathlib import Path

import pytest
from benchmark_inputs import write_all

from sb3_abisim.benchmark.report import times
from sb3_abisim.benchmark.report.page import report
from sb3_abisim.benchmark.report.tables import compare
from sb3_abisim.zoo.runs import find_runs, read_run

pytestmark = pytest.mark.usefixtures("few_resamples")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Runs of 10,000 steps that took 20 minutes each; 3 minutes of collection, 4 and 5 of an encoder and its base."""
    times._manifests.cache_clear()
    write_all(tmp_path / "runs", ("PointMaze-v0",))
    (tmp_path / "jobs").mkdir()
    runs = find_runs(tmp_path / "runs")
    (tmp_path / "benchmark.json").write_text(
        json.dumps(
            {
                "plan": {},
                "runs": [{"folder": r.folder.relative_to(tmp_path).as_posix(), "label": r.label} for r in runs],
            }
        )
    )
    write(tmp_path, "data-0", kind="data", seconds=180)
    write(tmp_path, "encoder-base", kind="encoder", seconds=300, inputs=["data-0"])
    write(tmp_path, "encoder-0", kind="encoder", seconds=240, inputs=["data-0", "encoder-base"])
    for i, run in enumerate(runs):
        output = run.folder.relative_to(tmp_path).as_posix()
        inputs = {"abisim": ["encoder-0"], "ssi": ["encoder-base"], "vanilla": []}[run.label]
        write(tmp_path, f"run-{i}", kind="run", seconds=1200, inputs=inputs, output=output)
        write(tmp_path, f"final-{i}", kind="final", seconds=7, inputs=[f"run-{i}"], output=output)
    return tmp_path


def write(root: Path, name: str, **manifest: object) -> None:
    (root / "jobs" / f"{name}.json").write_text(json.dumps({"name": name, **manifest}))


def test_minutes_from_nothing(root: Path) -> None:
    rows = {(row["method"], row["threshold"]): row for row in compare([str(root)]).times}
    row = rows["abisim", 0.7]
    # Reached after 5,000 and 6,000 of 10,000 steps; the data that encoder and base share is counted once.
    assert row["minutes"] == pytest.approx(3 + 4 + 5 + 20 * 0.55) and row["minutes_before"] == pytest.approx(12)
    assert row["bound"] == "" and row["n_reached"] == row["n_runs"] == 2 and row["low"] < row["minutes"] < row["high"]
    assert rows["ssi", 0.7]["minutes"] == pytest.approx(3 + 5 + 20 * 0.9)
    scratch = rows["vanilla", 0.7]
    assert scratch["minutes"] == pytest.approx(20) and scratch["minutes_before"] == 0
    assert (scratch["bound"], scratch["n_reached"]) == (">=", 0), "no run gets there; all of their time is a bound"


def test_the_page_shows_them(root: Path, tmp_path: Path) -> None:
    page = report([str(root)], tmp_path / "report")
    assert "Time to a threshold" in page.read_text() and (tmp_path / "report" / "times.csv").is_file()


def test_an_encoder_that_was_given_has_no_time(root: Path) -> None:
    run = next(run for run in find_runs(root) if run.label == "abisim")
    manifest = next(path for path in (root / "jobs").glob("run-*.json") if str(run.folder.name) in path.read_text()
                    and "/abisim/" in path.read_text())  # fmt: skip
    content = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**content, "inputs": []}))
    found = times.run_time(run)
    assert found is not None and found.before is None and found.rl == 1200
    assert "abisim" not in {row["method"] for row in compare([str(root)]).times}


def test_what_no_manifest_says_is_not_guessed(root: Path) -> None:
    run = find_runs(root)[0]
    assert times.run_time(run, "processor_seconds") is None, "of an earlier version"
    (root / "jobs" / "data-0.json").unlink()
    times._manifests.cache_clear()
    assert times.run_time(next(r for r in find_runs(root) if r.label == "ssi")).before is None
    (root / "benchmark.json").unlink()
    assert times.run_time(read_run(run.folder)) is None, "a plain run of the zoo"


def test_no_interval_goes_below_nothing(root: Path) -> None:
    """Two runs on machines of different speed: Student's t alone would allow less than no time."""
    for path in (root / "jobs").glob("run-*.json"):
        content = json.loads(path.read_text())
        seconds = 60 if content["output"].endswith("_1") else 60_000
        path.write_text(json.dumps({**content, "seconds": seconds}))
    rows = [row for row in compare([str(root)]).times if row["method"] == "vanilla"]
    assert rows and all(row["low"] == 0 and row["high"] > row["minutes"] for row in rows)
