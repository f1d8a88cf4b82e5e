"""The tables of a report, from run folders alone."""

from pathlib import Path

import numpy as np
import pytest
from benchmark_inputs import STEPS, read_csv, write_run

from sb3_abisim.benchmark.command import main
from sb3_abisim.benchmark.report import statistics
from sb3_abisim.benchmark.report.tables import compare
from sb3_abisim.zoo.runs import read_run

pytestmark = pytest.mark.usefixtures("few_resamples")


def test_curves_hold_mean_and_interval(made: Path) -> None:
    found = [r for r in read_csv(made / "curves.csv") if (r["env_id"], r["method"]) == ("PointMaze-v0", "ssi")]
    by_step = {int(r["steps"]): r for r in found}
    # At 7000 one of two runs has jumped: mean -60, standard deviation 80 / sqrt(2), t quantile for 1 degree 12.7062.
    row = by_step[7000]
    half = 12.7062 * 80 / np.sqrt(2) / np.sqrt(2)
    assert [float(row[key]) for key in ("mean", "low", "high")] == pytest.approx(
        [-60, -60 - half, -60 + half], rel=1e-4
    )
    assert row["n_runs"] == "2" and len(found) == len(STEPS)


def test_thresholds_are_ratios_of_steps(made: Path) -> None:
    table = {(r["env_id"], r["threshold"], r["baseline"]): r for r in read_csv(made / "thresholds.csv")}
    row = table["PointMaze-v0", "0.7", "ssi"]
    # 0.7 of the way from -128 to 0, passed with the third evaluation after the jump (two of -20 do not suffice).
    assert float(row["return"]) == pytest.approx(-38.4)
    assert float(row["steps_reference"]) == 5500 and float(row["steps_baseline"]) == 9000
    assert float(row["ratio"]) == pytest.approx(5500 / 9000) and row["bound"] == ""
    row = table["PointMaze-v0", "0.7", "vanilla"]
    assert (row["reached_reference"], row["reached_baseline"], row["bound"]) == ("2", "0", "<=")
    assert float(row["ratio"]) == pytest.approx(0.55)


def test_where_a_baseline_ends_is_a_threshold(made: Path, logs: Path) -> None:
    table = {(r["env_id"], r["threshold"], r["baseline"]): r for r in read_csv(made / "thresholds.csv")}
    row = table["PointMaze-v0", "vanilla", "vanilla"]
    # Of its last three evaluations, one run has -100, -20, -20, the other -100 throughout. A window with one -20 in it
    # reaches that: at the jump itself.
    assert float(row["return"]) == pytest.approx((-140 / 3 - 100) / 2)
    assert float(row["steps_reference"]) == 3500 and float(row["steps_baseline"]) == (9000 + 10_000) / 2
    assert float(row["ratio"]) == pytest.approx(3500 / 9500) and row["bound"] == "<="
    assert float(row["low"]) <= 3500 / 9500 <= float(row["high"])
    # Any method can be meant; the usual ones go when others are asked for.
    found = compare([str(logs)], thresholds=["ssi"]).thresholds
    assert {(r["threshold"], round(r["return"], 9)) for r in found} == {("ssi", -20.0)}
    with pytest.raises(ValueError, match="a number or one of abisim, ssi, vanilla, got curl"):
        compare([str(logs)], thresholds=[0.5, "curl"])
    assert {r["threshold"] for r in compare([str(logs / "ssi")]).thresholds} == set(), "nothing to compare with"


def test_a_baseline_may_run_for_longer(tmp_path: Path) -> None:
    """What it reaches after the reference's last step counts, and so do all the steps of its censored runs."""
    jumps = {"abisim": ([2000, 3000], 5), "ssi": ([7000, 8000], 10), "vanilla": ([99_000, 99_000], 10)}
    for method, (at, n) in jumps.items():
        for seed, jump in enumerate(at):
            returns = np.where(np.array(STEPS[:n]) >= jump, -20.0, -100.0)[:, None]
            write_run(tmp_path / method, "PointMaze-v0", method, seed, STEPS[:n], returns)
    comparison = compare([str(tmp_path)], thresholds=[0.7])
    found = {r["baseline"]: (r["ratio"], r["bound"], r["horizon_baseline"]) for r in comparison.thresholds}
    assert found == {"ssi": (4500 / 9500, "", 10_000), "vanilla": (4500 / 10_000, "<=", 10_000)}
    assert any("different numbers of steps (abisim 5,000, ssi 10,000" in note for note in comparison.notes)


def test_final_table_stands_beside_the_papers(made: Path) -> None:
    table = {(r["env_id"], r["method"], r["mode"], r["split"]): r for r in read_csv(made / "final.csv")}
    row = table["PointMaze-v0", "abisim", "deterministic", "last evaluation"]
    assert float(row["mean"]) == pytest.approx(-20)
    assert (float(row["paper"]), float(row["paper_plus_minus"])) == (-30.8, 3.7)
    for i, split in enumerate(("train", "eval", "clean")):
        row = table["DistractorPointMaze-v0", "vanilla", "deterministic", split]
        assert float(row["mean"]) == -60 - i and row["paper"] == ""


def test_aggregates_cover_what_all_methods_share(made: Path) -> None:
    found = {(r["score"], r["method"]): float(r["iqm"]) for r in read_csv(made / "aggregates.csv")}
    # Two runs in two environments: the IQM is the mean of the middle two of four.
    assert found["final", "abisim"] == pytest.approx((108 / 128 + 107 / 128) / 2)
    assert found["area", "abisim"] > found["area", "ssi"] > found["area", "vanilla"]
    improvement = {r["baseline"]: float(r["probability"]) for r in read_csv(made / "improvement.csv")}
    # Equal in all runs with ssi; of four pairs with vanilla two are won and two are ties.
    assert improvement == pytest.approx({"ssi": 0.5, "vanilla": 0.75})


def test_training_episodes_as_source(tmp_path: Path) -> None:
    run = write_run(tmp_path, "PointMaze-v0", "abisim", 0, STEPS, np.full((len(STEPS), 2), -50.0))
    lines = [
        '#{"t_start": 0, "env_id": "PointMaze-v0"}',
        "r,l,t,is_success",
        *(f"{-100 + i},100,{i}.5,{i >= 50}" for i in range(100)),
    ]
    (run / "0.monitor.csv").write_text("\n".join(lines) + "\n")
    curve = read_run(run).training(n_points=10)
    # 10,000 steps in ten stretches of ten episodes each.
    assert curve.steps.tolist() == STEPS
    assert curve.returns.tolist() == [-95.5 + 10 * i for i in range(10)]
    assert curve.successes is not None and curve.successes.tolist() == [0] * 5 + [1] * 5
    (tmp_path / "logs [1]").mkdir()
    moved = run.rename(tmp_path / "logs [1]" / run.name)
    assert read_run(moved).training(n_points=10).returns.tolist() == curve.returns.tolist()
    main(["report", str(tmp_path), "--source", "training"])
    text = (tmp_path / "report" / "index.html").read_text()
    assert "the training episodes themselves" in text and "is deterministic" not in text
    assert "No aggregates across environments" in text
    # Two evaluations are there, and what exploring brought is not what the deterministic policy does.
    comparison = compare([str(tmp_path)], source="training")
    assert [(row["mode"], row["split"], row["mean"]) for row in comparison.final] == [
        ("deterministic", "last evaluation", -50.0)
    ]
    assert "PointMaze-v0: abisim has no final evaluation; its last evaluation is shown." in comparison.notes
    (moved / "evaluations.npz").unlink()
    (row,) = compare([str(tmp_path)], source="training").final
    assert (row["mode"], row["split"], row["paper"]) == ("stochastic", "end of training", None) and row["mean"] > -10


def test_an_end_where_nothing_was_learned_is_said_to_be_one(tmp_path: Path) -> None:
    for method, value in (("abisim", -40.0), ("vanilla", -127.0)):
        write_run(tmp_path, "PointMaze-v0", method, 0, STEPS, np.full((len(STEPS), 1), value))
    assert any(
        note.startswith("PointMaze-v0: vanilla ends near the lowest return (-127)")
        for note in compare([str(tmp_path)]).notes
    )


def test_reference_is_the_first_method_where_ours_is_not_there(logs: Path) -> None:
    folders = [str(logs / "vanilla"), str(logs / "ssi")]
    assert compare(folders).reference == "vanilla" and compare([*folders, str(logs / "abisim")]).reference == "abisim"
    assert compare([folders[0], f"abisim,frozen={logs / 'ssi'}"]).reference == "abisim,frozen"
    assert compare([f"abisim,frozen={logs / 'ssi'}", f"abisim={logs / 'vanilla'}"]).reference == "abisim"


def test_runs_that_aggregates_leave_out_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "N_RESAMPLES", 20)
    message = "Aggregates take as many runs of a method as it has in each environment, the first ones by seed."
    for method in ("abisim", "vanilla"):
        for env_id in ("Nav2D-v0", "PointMaze-v0"):
            for seed in range(2):
                write_run(tmp_path, env_id, method, seed, STEPS, np.full((len(STEPS), 2), -40.0 - seed))
    assert message not in compare([str(tmp_path)]).notes
    for method in ("abisim", "vanilla"):
        write_run(tmp_path, "Nav2D-v0", method, 2, STEPS, np.full((len(STEPS), 2), -30.0))
    comparison = compare([str(tmp_path)])
    assert message in comparison.notes and {row["n_runs"] for row in comparison.aggregates} == {2}
