"""Runs by environment and method: how they are read, labeled and refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from benchmark_inputs import STEPS, write_run

from sb3_abisim.benchmark.report.groups import split_label
from sb3_abisim.benchmark.report.page import report
from sb3_abisim.benchmark.report.tables import compare
from sb3_abisim.zoo.runs import find_runs, read_run


def test_scan_navs_returns_are_no_costs_of_steps(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path, "ScanNav-v0", "abisim", seed, [100, 200, 300], np.array([[-1.0], [2.0], [5.0]]))
        write_run(tmp_path, "ScanNav-v0", "vanilla", seed, [100, 200, 300], np.array([[-3.0], [-3.0], [-3.0]]))
    made = compare([str(tmp_path)], thresholds=[0.5])
    assert made.thresholds[0]["return"] == 1.0
    assert (made.thresholds[0]["reached_reference"], made.thresholds[0]["reached_baseline"]) == (2, 0)
    assert any("lowest and highest mean return of these runs (-3.0, 5.0)" in note for note in made.notes)


def test_a_run_that_was_stopped_is_named(tmp_path: Path) -> None:
    for seed, n in ((0, 10), (1, 3)):
        write_run(tmp_path, "PointMaze-v0", "abisim", seed, STEPS[:n], np.zeros((n, 2)), n_timesteps=10_000)
    notes = compare([str(tmp_path)]).notes
    assert any("PointMaze-v0_2 ends at step 3,000 of 10,000" in note for note in notes)
    assert not any("PointMaze-v0_1 ends" in note for note in notes)


def test_runs_with_other_networks_are_not_one_method(tmp_path: Path) -> None:
    runs = [write_run(tmp_path, "PointMaze-v0", "abisim", seed, [100], np.zeros((1, 2))) for seed in range(2)]
    config = runs[1] / "PointMaze-v0" / "config.yml"
    config.write_text(
        config.read_text().replace("features_extractor_class", "net_arch: [8]\n      features_extractor_class")
    )
    with pytest.raises(ValueError, match="are both abisim but differ in policy_kwargs"):
        compare([str(tmp_path)])


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
    with pytest.raises(ValueError, match="both abisim with seed 0; compare them under different labels: LABEL=FOLDER"):
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
