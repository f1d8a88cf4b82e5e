"""A copy that is small enough to commit gives the report of the original."""

import json
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from benchmark_inputs import write_run

from sb3_abisim.benchmark.command import main
from sb3_abisim.benchmark.export import export, without_folders
from sb3_abisim.benchmark.report import statistics
from sb3_abisim.benchmark.report.page import report
from sb3_abisim.zoo.runs import find_runs

STEPS = [100, 200, 300, 400]


@pytest.fixture(scope="module", autouse=True)
def _few_resamples() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statistics, "N_RESAMPLES", 20)  # rliable is slow
        yield


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark's folder with what a real one holds, this machine's paths included."""
    root = tmp_path_factory.mktemp("benchmark")
    rng = np.random.default_rng(0)
    entries = []
    for method in ("abisim", "vanilla"):
        for seed in range(2):
            returns = rng.uniform(-100, 0, (len(STEPS), 5))
            final = {f"{mode}/{split}": rng.uniform(-50, 0, 7) for mode in ("deterministic", "stochastic")
                     for split in ("eval", "train", "clean")}  # fmt: skip
            run = write_run(root / "runs" / method, "DistractorPointMaze-v0", method, seed, STEPS, returns, final=final)
            args = run / "DistractorPointMaze-v0" / "args.yml"
            args.write_text(args.read_text().replace(f"- {method}\n", f"- {method}={root}/encoders/e.safetensors\n"))
            command = run / "DistractorPointMaze-v0" / "command.txt"
            command.write_text(f"sb3-abisim train --conf-file abisim=/home/me/e.safetensors --seed {seed}")
            (run / "DistractorPointMaze-v0.zip").write_bytes(bytes(10_000))
            (run / "best_model.zip").write_bytes(bytes(10_000))
            episodes = [
                f"{-int(length)},{length},{k}.5,{k % 2 == 0}" for k, length in enumerate(rng.integers(1, 9, 100))
            ]
            (run / "0.monitor.csv").write_text('#{"t_start": 0.0}\nr,l,t,is_success\n' + "\n".join(episodes) + "\n")
            output = run.relative_to(root).as_posix()
            entries.append({"folder": output, "label": method})
            for kind, inputs in (("run", ["encoder-0"]), ("final", [f"run-{method}{seed}"])):
                manifest = {"name": f"{kind}-{method}{seed}", "output": output, "inputs": inputs, "host": "my-machine",
                          "command": ["-o", f"{root.resolve()}/x", "/opt/venv/bin/python"], "seconds": 3.5}  # fmt: skip
                write_manifest(root, manifest)
    write_manifest(root, {"name": "encoder-0", "output": "encoders/e.safetensors", "inputs": ["data-0"]})
    write_manifest(root, {"name": "data-0", "output": "data/d", "inputs": []})
    write_manifest(root, {"name": "data-1", "output": "data/other", "inputs": []})
    index = {"plan": {"methods": ["abisim=/home/me/e.safetensors", "vanilla"]}, "runs": entries}
    (root / "benchmark.json").write_text(json.dumps(index))
    return root


def write_manifest(root: Path, manifest: dict[str, object]) -> None:
    (root / "jobs").mkdir(exist_ok=True)
    (root / "jobs" / f"{manifest['name']}.json").write_text(json.dumps(manifest))


@pytest.fixture(scope="module")
def copy(original: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("elsewhere") / "results" / "copy"
    main(["export", str(original), "-o", str(output)])
    return output


@pytest.mark.parametrize("source", ["evaluations", "training"])
def test_the_copy_gives_the_same_report(original: Path, copy: Path, tmp_path: Path, source: str) -> None:
    first = report([str(original)], tmp_path / "first", source=source).parent
    second = report([str(copy)], tmp_path / "second", source=source).parent
    names = sorted(path.name for path in first.iterdir())
    assert names == sorted(path.name for path in second.iterdir()) and "splits.png" in names
    for name in names:
        if name != "index.html":  # it shows the commands
            assert (first / name).read_bytes() == (second / name).read_bytes(), name
    pages = [(folder / "index.html").read_text() for folder in (first, second)]
    assert pages[0].replace("/home/me/", "") == pages[1]


def test_nothing_but_what_the_report_reads(copy: Path) -> None:
    names = {path.name for path in copy.rglob("*") if path.is_file() and path.parent.name != "jobs"}
    assert names == {
        "benchmark.json", "args.yml", "config.yml", "command.txt", "evaluations.npz", "final_evaluations.npz",
        "training.npz", "method.json", "hashes.json",
    }  # fmt: skip
    jobs = {path.stem for path in (copy / "jobs").iterdir()}
    assert jobs == {f"{kind}-{method}{seed}" for kind in ("run", "final") for method in ("abisim", "vanilla")
                     for seed in range(2)} | {"encoder-0", "data-0"}  # fmt: skip
    assert json.loads((copy / "jobs" / "run-abisim0.json").read_bytes())["seconds"] == 3.5


def test_nothing_of_this_machine(original: Path, copy: Path) -> None:
    for path in copy.rglob("*"):
        if path.suffix in (".yml", ".json", ".txt"):
            text = path.read_text()
            assert str(original) not in text and "/home" not in text and "my-machine" not in text, path
            assert not re.search(r"[\s=\"]/\w", text), path
    (run, *_) = find_runs(copy)
    assert "abisim=e.safetensors" in run.command
    args = (run.folder / "DistractorPointMaze-v0" / "args.yml").read_text()
    assert "abisim=encoders/e.safetensors" in args and "!!python/object/apply:collections.OrderedDict" in args
    manifest = json.loads((copy / "jobs" / "run-abisim0.json").read_bytes())
    assert manifest["command"] == ["-o", "x", "python"]


def test_without_folders(tmp_path: Path) -> None:
    assert without_folders(f"abisim={tmp_path}/a/b.zip,frozen", tmp_path) == "abisim=a/b.zip,frozen"
    assert without_folders("{'encoder': '/a/b c/d.zip'} /e/f.g", tmp_path) == "{'encoder': 'b c/d.zip'} f.g"
    assert without_folders(r'"/a/M\xFCller/b.zip" "\/a/M\u00fcller/\u00fcb.zip"', tmp_path) == r'"b.zip" "\\u00fcb.zip"'
    untouched = "runs/a/b https://c.d/e !!python/object/apply:f 1 / 2 Nav2D-v0/abisim ../up ~/home"
    assert without_folders(untouched, tmp_path) == untouched


def test_the_arrays_are_the_same_and_smaller(original: Path, copy: Path) -> None:
    for path in copy.glob("**/*evaluations.npz"):
        source = original / path.relative_to(copy)
        with np.load(source) as before, np.load(path) as after:
            assert set(before) == set(after)
            assert all(
                (before[name] == after[name]).all() and before[name].dtype == after[name].dtype for name in after
            )
        assert path.stat().st_size < source.stat().st_size


def test_training_curves_are_kept_to_the_bit(original: Path, copy: Path) -> None:
    for run, kept in zip(find_runs(original), find_runs(copy), strict=True):
        before, after = run.training(), kept.training()
        assert len(before.steps) > 40 and before.successes is not None and after.successes is not None
        assert (before.steps == after.steps).all() and (before.returns == after.returns).all()
        assert (before.successes == after.successes).all()


def test_a_copy_without_training_curves_says_so(copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As copies were before they kept that curve; a copy of a copy keeps what that has."""
    again = export(copy, tmp_path / "again")
    assert len(list(again.glob("**/training.npz"))) == 4
    for path in again.glob("**/training.npz"):
        path.unlink()
        (path.parent / "hashes.json").unlink()
    with pytest.raises(SystemExit) as stopped:
        main(["report", str(export(again, tmp_path / "bare")), "--source", "training"])
    assert stopped.value.code == 2
    assert "holds neither *.monitor.csv nor training.npz; take --source evaluations" in capsys.readouterr().err


def test_plain_zoo_logs_and_refusals(tmp_path: Path, copy: Path) -> None:
    run = write_run(tmp_path / "logs", "PointMaze-v0", "ssi", 0, STEPS, np.zeros((len(STEPS), 2)))
    output = export(tmp_path / "logs", tmp_path / "copy")
    assert [(found.label, found.seed) for found in find_runs(output)] == [("ssi", 0)]
    with pytest.raises(ValueError, match="copy is there; remove it, or name another folder"):
        export(tmp_path / "logs", output)
    with pytest.raises(ValueError, match="no run folders of rl-zoo3 below"):
        export(tmp_path / "nothing", tmp_path / "other")
    np.savez(run / "evaluations.npz", timesteps=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=r"evaluations\.npz is damaged .*object"):
        export(tmp_path / "logs", tmp_path / "pickled")
    assert not list(tmp_path.glob("*pickled*"))


def test_folders_with_spaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a command without quotes only what is known tells where such a path ends."""
    here = tmp_path / "my home" / "work"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    assert without_folders(f"-f {here}/logs {here}/e.zip", tmp_path / "logs") == "-f logs e.zip"


def test_a_run_in_which_no_episode_ended(tmp_path: Path) -> None:
    run = write_run(tmp_path / "logs", "PointMaze-v0", "ssi", 0, STEPS, np.zeros((len(STEPS), 2)))
    (run / "0.monitor.csv").write_text('#{"t_start": 0.0}\nr,l,t,is_success\n')
    (copied,) = find_runs(export(tmp_path / "logs", tmp_path / "copy"))
    assert len(copied.evaluations().steps) == len(STEPS) and not (copied.folder / "training.npz").exists()


@pytest.mark.parametrize("text", [
    json.dumps({"a": "/home/" + "Müller-漢字é/" * 40 + "x y/" * 40}),
    '"/' + "\\xe4bc" * 5000,
    "/" + "\\u6f22" * 5000 + " /",
    "/" + "漢" * 50_000 + "'",
    "/a" * 20_000 + "/ ",
])  # fmt: skip
def test_long_paths_take_no_time(text: str, tmp_path: Path) -> None:
    start = time.process_time()
    without_folders(text, tmp_path)
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize("name", ["../elsewhere/ppo/A_1", "/elsewhere/ppo/A_1", "runs/../../elsewhere/ppo/A_1"])
def test_nothing_is_written_outside(original: Path, tmp_path: Path, name: str) -> None:
    """The list of runs leads above the folder; the run that it names is there."""
    root = tmp_path / "in" / "benchmark"
    shutil.copytree(original, root)
    run = next(path.parents[1] for path in root.rglob("args.yml"))
    shutil.copytree(run, (root / name.replace("runs/../", "").lstrip("/")).resolve())
    (root / "benchmark.json").write_text(json.dumps({"runs": [{"folder": name, "label": "x"}]}))
    before = {*tmp_path.rglob("*")}
    with pytest.raises(ValueError, match=r"benchmark\.json is damaged .*does not lie below it"):
        export(root, tmp_path / "out" / "copy")
    assert {*tmp_path.rglob("*")} == before


def test_a_link_is_not_replaced(original: Path, tmp_path: Path) -> None:
    (tmp_path / "copy").symlink_to(tmp_path / "absent")
    with pytest.raises(ValueError, match="is there; remove it"):
        export(original, tmp_path / "copy")
    assert (tmp_path / "copy").is_symlink()


def test_names_do_nothing_but_name(original: Path, tmp_path: Path) -> None:
    """HTML, formulas and mathematics in labels; control characters in commands."""
    shutil.copytree(original, tmp_path / "b")
    index = json.loads((tmp_path / "b" / "benchmark.json").read_bytes())
    labels = {"abisim": "=HYPERLINK($x^$)", "vanilla": "<script>alert(1)</script>"}
    for entry in index["runs"]:
        entry["label"] = labels[entry["label"]]
    (tmp_path / "b" / "benchmark.json").write_text(json.dumps(index))
    for path in (tmp_path / "b").rglob("command.txt"):
        path.write_text("train \x1b]0;title\x07 </pre><script>")
    page = report([str(tmp_path / "b")], tmp_path / "report")
    text = page.read_text()
    assert "<script>" not in text and "&lt;script&gt;alert" in text
    assert not [letter for letter in text if not letter.isprintable() and letter != "\n"] and "\\x1b]0;title" in text
    for path in page.parent.glob("*.csv"):
        assert not re.search(r"(^|,|\")[=@]", path.read_text(), re.MULTILINE), path
    assert "'=HYPERLINK" in (page.parent / "curves.csv").read_text()
    index["runs"][0]["label"] = "a\x1bb"
    (tmp_path / "b" / "benchmark.json").write_text(json.dumps(index))
    with pytest.raises(ValueError, match="is no run with its label"):
        find_runs(tmp_path / "b")
