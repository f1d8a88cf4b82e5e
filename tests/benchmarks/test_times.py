"""The table of times to a return, and the recipe that makes it."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from benchmarks import times
from benchmarks.results_page import ROOT
from sb3_abisim.benchmark.command import _plan, _run_parser
from sb3_abisim.benchmark.graph import build
from sb3_abisim.zoo.runs import INDEX_NAME
from tests.benchmark_inputs import STEPS, write_run


def _variable(name: str) -> list[str]:
    text = (ROOT / "Makefile").read_text().replace("\\\n", " ")
    return shlex.split(re.search(rf"^{name} := (.*)$", text, re.MULTILINE)[1])


@pytest.mark.parametrize("name", ["TIMES_DISTRACTOR", "TIMES_NAV2D"])
@pytest.mark.parametrize("methods", ["TIMES_PRETRAINED", "TIMES_SCRATCH"])
def test_the_recipe_makes_its_data_and_encoders_itself(name: str, methods: str) -> None:
    args = _run_parser().parse_args([*_variable("TIMES_FLAGS"), *_variable(name), *_variable(methods)])
    jobs = build(_plan(args, args.methods, args.env, args.final_episodes))
    runs = [job for job in jobs if job.kind == "run"]
    assert len(runs) == 3 * 3
    assert (args.n_timesteps == 655_360) == (methods == "TIMES_SCRATCH")
    for run in runs:
        pretrained = run.method.partition(",")[0] in ("abisim", "goal_progress")
        assert [source.kind for source in run.inputs] == ["encoder"] * pretrained
        assert "=" not in run.method.partition(",")[0]
    # Each run has an encoder of its own, so that the seeds differ in everything.
    assert len({run.inputs[0].name for run in runs if run.inputs}) == (2 * 3 if methods == "TIMES_PRETRAINED" else 0)


def _write_job(root: Path, name: str, kind: str, output: str, seconds: float, inputs: tuple[str, ...] = ()) -> None:
    (root / "jobs").mkdir(exist_ok=True)
    manifest = {"kind": kind, "inputs": list(inputs), "output": output, "seconds": 3 * seconds}
    (root / "jobs" / f"{name}.json").write_text(json.dumps(manifest | {"processor_seconds": seconds}))


@pytest.fixture
def benchmark(tmp_path: Path) -> Path:
    (tmp_path / INDEX_NAME).write_text(json.dumps({"runs": []}))
    _write_job(tmp_path, "dataset-0", "dataset", "data", 60.0)
    for method, jumps in (("ssi", (2000, 4000)), ("vanilla", (8000, 99_000))):
        for seed, jump in enumerate(jumps):
            returns = np.where(np.array(STEPS) >= jump, -20.0, -100.0)[:, None]
            run = write_run(tmp_path / "runs" / method, "PointMaze-v0", method, seed, STEPS, returns)
            lines = [f"{value[0]},{1000},{i}" for i, value in enumerate(returns)]
            (run / "0.monitor.csv").write_text('#{"t_start": 0.0}\nr,l,t\n' + "\n".join(lines) + "\n")
            inputs: tuple[str, ...] = ()
            if method == "ssi":
                _write_job(tmp_path, f"encoder-{seed}", "encoder", f"{seed}.safetensors", 120.0, ("dataset-0",))
                inputs = (f"encoder-{seed}",)
            _write_job(tmp_path, f"run-{method}-{seed}", "run", run.relative_to(tmp_path).as_posix(), 600.0, inputs)
    return tmp_path


def test_pretraining_counts_and_runs_that_do_not_arrive_make_a_bound(
    benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times.main([str(benchmark / "runs"), "-o", str(tmp_path / "times.md")])
    ours, scratch = ([cell.strip() for cell in line.split("|")] for line in times.rows([str(benchmark / "runs")]))
    assert (ours[2], ours[4]) == ("`ssi`", "3.0")
    # Of ten minutes, and three before: the curve has three bins in a row above the threshold.
    processor, wall = (float(cell.partition(" ")[0]) for cell in (ours[5], ours[6]))
    assert 3 < processor < 3 + 10 and wall == pytest.approx(3 * processor, abs=0.2)
    assert (scratch[2], scratch[4]) == ("`vanilla`", "0.0")
    assert scratch[5].startswith("over ") and scratch[5].endswith(", 1 of 2 runs")
    # Folders keep their rows, since their runs have other numbers of steps.
    assert len(times.rows([str(benchmark / "runs")] * 2)) == 4
    assert (ours[3], scratch[3]) == (f"{round(STEPS[-1], -3):,}",) * 2
    assert (tmp_path / "times.md").read_text().count("\n| PointMaze-v0 |") == 2
    assert "Time to a return" in capsys.readouterr().out


def test_encoders_of_unknown_cost_are_refused(benchmark: Path) -> None:
    for path in (benchmark / "jobs").glob("encoder-*.json"):
        path.unlink()
    with pytest.raises(ValueError, match="manifests of ssi do not say"):
        times.rows([str(benchmark / "runs")])
