"""The report, from run folders alone."""

import csv
import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from benchmark_inputs import write_run
from PIL import Image

from sb3_abisim.benchmark.command import main
from sb3_abisim.benchmark.report import statistics
from sb3_abisim.benchmark.report.figures import MINUS, assign_colors
from sb3_abisim.benchmark.report.page import _verdict, report
from sb3_abisim.benchmark.report.tables import compare, split_label
from sb3_abisim.zoo.runs import find_runs, read_run

STEPS = list(range(1000, 11_000, 1000))
# The step at which a method jumps from -100 to -20, per seed; above the last step it never does.
JUMPS = {"abisim": (3000, 4000), "ssi": (6000, 8000), "vanilla": (9000, 99_000)}
N_EPISODES = 4


def write_all(folder: Path, env_ids: tuple[str, ...] = ("PointMaze-v0", "DistractorPointMaze-v0")) -> Path:
    rng = np.random.default_rng(0)
    for env_id in env_ids:
        for method, jumps in JUMPS.items():
            for seed, jump in enumerate(jumps):
                means = np.where(np.array(STEPS) >= jump, -20.0, -100.0)
                # Episodes differ, their mean is exact.
                noise = rng.normal(size=(len(STEPS), N_EPISODES))
                returns = means[:, None] + noise - noise.mean(axis=1, keepdims=True)
                final = {f"deterministic/{split}": means[-1:] - i for i, split in enumerate(("train", "eval", "clean"))}
                final |= {"stochastic/eval": means[-1:] + 5}
                write_run(folder / method, env_id, method, seed, STEPS, returns,
                          final=final if env_id.startswith("Distractor") else None)  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_all(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module", autouse=True)
def _few_resamples() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statistics, "N_RESAMPLES", 50)  # rliable is slow
        yield


@pytest.fixture(scope="module")
def made(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report([str(logs)], tmp_path_factory.mktemp("report")).parent


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_curves_hold_mean_and_interval(made: Path) -> None:
    found = [r for r in rows(made / "curves.csv") if (r["env_id"], r["method"]) == ("PointMaze-v0", "ssi")]
    by_step = {int(r["steps"]): r for r in found}
    # At 7000 one of two runs has jumped: mean -60, standard deviation 80 / sqrt(2), t quantile for 1 degree 12.7062.
    row = by_step[7000]
    half = 12.7062 * 80 / np.sqrt(2) / np.sqrt(2)
    assert [float(row[key]) for key in ("mean", "low", "high")] == pytest.approx(
        [-60, -60 - half, -60 + half], rel=1e-4
    )
    assert row["n_runs"] == "2" and len(found) == len(STEPS)


def test_thresholds_are_ratios_of_steps(made: Path) -> None:
    table = {(r["env_id"], r["threshold"], r["baseline"]): r for r in rows(made / "thresholds.csv")}
    row = table["PointMaze-v0", "0.7", "ssi"]
    # 0.7 of the way from -128 to 0, passed with the third evaluation after the jump (two of -20 do not suffice).
    assert float(row["return"]) == pytest.approx(-38.4)
    assert float(row["steps_reference"]) == 5500 and float(row["steps_baseline"]) == 9000
    assert float(row["ratio"]) == pytest.approx(5500 / 9000) and row["bound"] == ""
    row = table["PointMaze-v0", "0.7", "vanilla"]
    assert (row["reached_reference"], row["reached_baseline"], row["bound"]) == ("2", "0", "<=")
    assert float(row["ratio"]) == pytest.approx(0.55)


def test_where_a_baseline_ends_is_a_threshold(made: Path, logs: Path) -> None:
    table = {(r["env_id"], r["threshold"], r["baseline"]): r for r in rows(made / "thresholds.csv")}
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
    """What it reaches after the reference's last step counts, and so do all the steps in which it does not arrive."""
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
    table = {(r["env_id"], r["method"], r["mode"], r["split"]): r for r in rows(made / "final.csv")}
    row = table["PointMaze-v0", "abisim", "deterministic", "last evaluation"]
    assert float(row["mean"]) == pytest.approx(-20)
    assert (float(row["paper"]), float(row["paper_plus_minus"])) == (-30.8, 3.7)
    for i, split in enumerate(("train", "eval", "clean")):
        row = table["DistractorPointMaze-v0", "vanilla", "deterministic", split]
        assert float(row["mean"]) == -60 - i and row["paper"] == ""


def test_aggregates_cover_what_all_methods_share(made: Path) -> None:
    found = {(r["score"], r["method"]): float(r["iqm"]) for r in rows(made / "aggregates.csv")}
    # Two runs in two environments: the IQM is the mean of the middle two of four.
    assert found["final", "abisim"] == pytest.approx((108 / 128 + 107 / 128) / 2)
    assert found["area", "abisim"] > found["area", "ssi"] > found["area", "vanilla"]
    improvement = {r["baseline"]: float(r["probability"]) for r in rows(made / "improvement.csv")}
    # Equal in all runs with ssi; of four pairs with vanilla two are won and two are ties.
    assert improvement == pytest.approx({"ssi": 0.5, "vanilla": 0.75})


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [str(value) for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_page_needs_no_other_file_and_says_how_it_was_evaluated(made: Path) -> None:
    page = Page((made / "index.html").read_text())
    text = re.sub(r"\s+", " ", " ".join(page.words))
    assert len(page.sources) == 6 and all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert "Evaluation is deterministic" in text and f"mean of {N_EPISODES} episodes" in text
    assert "sb3-abisim train --seed 1" in text
    assert "0.61 times the steps of ssi" in text
    assert f"To where vanilla ends, {MINUS}73.33, abisim needs ≤ 0.37 times the steps of vanilla: fewer" in text
    assert f"No run of any method reached {MINUS}12.8 in PointMaze-v0." in text and "none arrived" not in text
    assert "near the lowest" not in text
    for name in ("curves", "thresholds", "splits", "aggregates", "profiles", "improvement"):
        with Image.open(made / f"{name}.png") as picture:
            assert len(picture.convert("RGB").getcolors(1 << 24)) > 10, name


def test_a_method_has_the_same_color_in_every_report() -> None:
    everything = assign_colors(["abisim", "vanilla", "ssi", "acro", "curl", "beta_vae", "info_nce", "mine"])
    assert len(set(everything.values())) == 8
    two = assign_colors(["abisim,frozen", "ssi,frozen"])
    assert (two["abisim,frozen"], two["ssi,frozen"]) == (everything["abisim"], everything["ssi"])
    variants = assign_colors(["abisim=0ff2bc", "abisim=1bd228", "vanilla", "vanilla, 10,000", "ssi"])
    assert len(set(variants.values())) == 5
    assert (variants["vanilla"], variants["ssi"]) == (everything["vanilla"], everything["ssi"])


def test_the_same_runs_give_the_same_files(made: Path, logs: Path, tmp_path: Path) -> None:
    np.random.seed(77)
    report([str(logs)], tmp_path)
    for path in sorted(made.iterdir()):
        assert (tmp_path / path.name).read_bytes() == path.read_bytes(), path.name


def test_scan_navs_returns_are_no_costs_of_steps(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path, "ScanNav-v0", "abisim", seed, [100, 200, 300], np.array([[-1.0], [2.0], [5.0]]))
        write_run(tmp_path, "ScanNav-v0", "vanilla", seed, [100, 200, 300], np.array([[-3.0], [-3.0], [-3.0]]))
    made = compare([str(tmp_path)], thresholds=[0.5])
    assert made.thresholds[0]["return"] == 1.0
    assert (made.thresholds[0]["reached_reference"], made.thresholds[0]["reached_baseline"]) == (2, 0)
    assert any("lowest and highest mean return of these runs (-3.0, 5.0)" in note for note in made.notes)


@pytest.mark.parametrize(
    ("bound", "low", "high", "verdict"),
    [
        ("", 0.2, 0.8, "fewer"), ("<=", 0.2, 0.8, "fewer"), (">=", 0.2, 0.8, "no clear difference"),
        ("", 1.2, 1.8, "more"), (">=", 1.2, 1.8, "more"), ("<=", 1.2, 1.8, "no clear difference"),
        ("~", 0.2, 0.8, "no clear difference"), ("", 0.8, 1.2, "no clear difference"),
    ],
)  # fmt: skip
def test_a_bound_says_less_than_a_number(bound: str, low: float, high: float, verdict: str) -> None:
    assert _verdict({"bound": bound, "low": low, "high": high}) == verdict


def test_a_run_that_was_stopped_is_named(tmp_path: Path) -> None:
    for seed, n in ((0, 10), (1, 3)):
        write_run(tmp_path, "PointMaze-v0", "abisim", seed, STEPS[:n], np.zeros((n, 2)), n_timesteps=10_000)
    notes = compare([str(tmp_path)]).notes
    assert any("PointMaze-v0_2 ends at step 3,000 of 10,000" in note for note in notes)
    assert not any("PointMaze-v0_1 ends" in note for note in notes)


def test_runs_with_other_networks_are_not_one_method(tmp_path: Path) -> None:
    runs = [write_run(tmp_path, "PointMaze-v0", "abisim", seed, [100], np.zeros((1, 2))) for seed in range(2)]
    config = runs[1] / "PointMaze-v0" / "config.yml"
    config.write_text(config.read_text().replace("dict(", "dict(net_arch=[8], ", 1))
    with pytest.raises(ValueError, match="are both abisim but differ in policy_kwargs"):
        compare([str(tmp_path)])


def test_files_of_an_earlier_report_go(logs: Path, tmp_path: Path) -> None:
    report([str(logs)], tmp_path)
    (tmp_path / "mine.csv").write_text("kept")
    report([str(logs / "abisim")], tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert "curves.csv" in names and "mine.csv" in names and not names & {"thresholds.csv", "thresholds.png"}


def test_folders_with_an_equals_sign(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "c=0.5"
    write_run(folder, "PointMaze-v0", "abisim", 0, [100, 200], np.zeros((2, 2)))
    assert report([str(folder)]).parent == folder / "report"
    assert split_label(f"c=half={folder}") == ("c=half", str(folder))
    assert split_label("a=nowhere=b") == ("a", "nowhere=b")
    assert list(compare([f"mine={folder}"]).groups["PointMaze-v0"]) == ["mine"]
    with pytest.raises(ValueError, match="Matplotlib hides what is called '_mine'"):
        compare([f"_mine={folder}"])


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"nonsense"])
def test_evaluations_that_are_being_written(tmp_path: Path, content: bytes) -> None:
    run = write_run(tmp_path, "PointMaze-v0", "abisim", 0, [100], np.zeros((1, 2)))
    (run / "evaluations.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"evaluations\.npz is damaged or being written"):
        compare([str(tmp_path)])


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
    assert "the training episodes themselves" in text and "Evaluation is deterministic" not in text
    assert "No aggregates across environments" in text
    # Two evaluations are there, and what exploring brought is not what the most likely action does.
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


def test_labels(tmp_path: Path) -> None:
    for method in ("abisim", "abisim,frozen", "ssi,freeze", "vanilla"):
        write_run(tmp_path, "PointMaze-v0", method, 0, STEPS, np.zeros((len(STEPS), 1)))
    assert sorted(run.label for run in find_runs(tmp_path)) == ["abisim", "abisim,frozen", "ssi,frozen", "vanilla"]
    groups = compare([f"mine={tmp_path / 'ppo' / 'PointMaze-v0_1'}"], "evaluations", "mine", [0.5]).groups
    assert list(groups["PointMaze-v0"]) == ["mine"]


@pytest.mark.parametrize("method", ["abisim", "abisim,frozen", "abisim,freeze"])
def test_runs_on_encoders_of_several_seeds_are_one_method(tmp_path: Path, method: str) -> None:
    for seed in range(2):
        run = write_run(tmp_path, "PointMaze-v0", method, seed, STEPS, np.zeros((len(STEPS), 1)))
    (groups,) = compare([str(tmp_path)], "evaluations", None, [0.5]).groups.values()
    assert [len(group.runs) for group in groups.values()] == [2]
    # Another wrapper is another method.
    config = run / "PointMaze-v0" / "config.yml"
    text = config.read_text()
    if method == "abisim,frozen":
        config.write_text(text.replace("objective: abisim", "objective: abisim\n          device: cuda"))
        assert config.read_text() != text
        with pytest.raises(ValueError, match="differ in vec_env_wrapper"):
            compare([str(tmp_path)], "evaluations", None, [0.5])


def test_what_a_benchmark_works_on_is_no_run_yet(tmp_path: Path) -> None:
    returns = np.zeros((len(STEPS), 1))
    write_run(tmp_path / "work" / "run-0123456789abcdef", "PointMaze-v0", "ssi", 0, STEPS, returns)
    write_run(tmp_path / "runs", "PointMaze-v0", "ssi", 1, STEPS, returns)
    assert [run.seed for run in find_runs(tmp_path)] == [1]


def test_a_benchmarks_folder_is_read_by_its_index(tmp_path: Path) -> None:
    paths = [write_run(tmp_path, "PointMaze-v0", "ssi", seed, STEPS, np.zeros((len(STEPS), 1))) for seed in range(3)]
    entries = [{"folder": str(path.relative_to(tmp_path)), "label": f"ssi={i}"} for i, path in enumerate(paths[:2])]
    (tmp_path / "benchmark.json").write_text(json.dumps({"runs": entries}))
    assert [(run.label, run.seed) for run in find_runs(tmp_path)] == [("ssi=0", 0), ("ssi=1", 1)]


def test_what_cannot_be_compared_is_refused(tmp_path: Path) -> None:
    returns = np.zeros((len(STEPS), 1))
    with pytest.raises(ValueError, match="no run folders of rl-zoo3 below"):
        compare([str(tmp_path)], "evaluations", "abisim", [0.5])
    write_run(tmp_path, "PointMaze-v0", "abisim", 0, STEPS, returns)
    with pytest.raises(ValueError, match="no runs of the reference 'ssi' among abisim"):
        compare([str(tmp_path)], "evaluations", "ssi", [0.5])
    with pytest.raises(ValueError, match=r"above 0 and up to 1, got \[1\.5\]"):
        compare([str(tmp_path)], "evaluations", "abisim", [0.5, 1.5])
    twin = write_run(tmp_path, "PointMaze-v0", "abisim", 0, STEPS, returns)
    with pytest.raises(ValueError, match="both abisim with seed 0; compare them under names of your own: LABEL=FOLDER"):
        compare([str(tmp_path)], "evaluations", "abisim", [0.5])
    twin.rename(tmp_path / "elsewhere")
    write_run(tmp_path, "PointMaze-v0", "abisim", 1, STEPS, returns, n_timesteps=99)
    with pytest.raises(ValueError, match="differ in n_timesteps"):
        compare([str(tmp_path / "ppo")], "evaluations", "abisim", [0.5])


def test_a_settings_file_cannot_run_code(tmp_path: Path) -> None:
    run = write_run(tmp_path, "PointMaze-v0", "abisim", 0, STEPS, np.zeros((len(STEPS), 1)))
    witness = tmp_path / "witness"
    (run / "PointMaze-v0" / "args.yml").write_text(f"!!python/object/apply:os.mkdir ['{witness}']")
    with pytest.raises(ValueError, match=r"cannot read .*args\.yml"):
        read_run(run)
    assert not witness.exists()


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
