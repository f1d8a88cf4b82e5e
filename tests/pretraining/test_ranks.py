"""Several processes pretrain one encoder as one process does, whatever the objective."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch as th
from pretrain_inputs import make_run, run
from ranks_inputs import DEATH, SETTINGS, gradients, objectives, pretrain_one, register, work

from sb3_abisim import registry
from sb3_abisim.data.collect import collect
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.card import read_card
from sb3_abisim.pretraining.ranks import Ranks, processes

N_PROCESSES = 2


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    """What a user would register, for these tests alone."""
    with pytest.MonkeyPatch.context() as patch:
        for records in (registry._METHODS, registry._NETWORKS):
            patch.setattr(records, "by_name", dict(records.by_name))
        register()
        yield


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "nav2d"
    collect("Nav2D-v0", 600, folder, n_envs=2)
    return folder


@pytest.fixture(scope="module")
def folder(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What two processes made of every objective, and of a death."""
    folder = tmp_path_factory.mktemp("ranks")
    run(data, folder / "base.safetensors", n_updates=2)
    context = multiprocessing.get_context("spawn")
    started = [context.Process(target=work, args=(i, N_PROCESSES, data, folder)) for i in range(N_PROCESSES)]
    for process in started:
        process.start()
    for process in started:
        process.join(timeout=240)
    assert [process.exitcode for process in started] == [0, -signal.SIGKILL]
    return folder


def test_every_objective_has_the_curve_of_one_process(data: Path, folder: Path) -> None:
    assert "spread" in objectives() and len(objectives()) >= 8
    for objective in objectives():
        alone = read_card(pretrain_one(objective, data, folder / "one").with_suffix(".json"))["curves"]
        card = read_card(folder / "several" / f"{objective}.json")
        assert card["n_processes"] == N_PROCESSES
        assert "torchrun --nproc-per-node 2 -m sb3_abisim pretrain" in card["commands"][-1]
        assert card["curves"].keys() == alone.keys()
        for name, values in alone.items():
            # Adam turns rounding of small gradients into small steps.
            assert card["curves"][name] == pytest.approx(values, rel=3e-3, abs=3e-5), (objective, name)
        # The loss of the first update comes before any step.
        assert card["curves"]["train/loss"][0] == pytest.approx(alone["train/loss"][0], rel=1e-5), objective
        frames = make_run(data).dataset.frames(range(64))
        embeddings = [load_encoder(folder / which / f"{objective}.safetensors") for which in ("one", "several")]
        with th.no_grad():
            one, several = (file.encoder(th.as_tensor(frames).float() / 255) for file in embeddings)
        assert th.allclose(one, several, atol=0.05 * float(one.abs().max())), objective


def test_gradients_are_those_of_one_process(data: Path, folder: Path) -> None:
    for objective, several in th.load(folder / "gradients.pt", weights_only=True).items():
        alone = gradients(objective, data)
        assert several.keys() == alone.keys()
        for name, gradient in alone.items():
            assert th.allclose(several[name], gradient, rtol=1e-3, atol=1e-5 * float(gradient.abs().max())), (
                objective,
                name,
            )


def test_a_network_that_looks_at_the_whole_batch_is_refused(folder: Path) -> None:
    said = json.loads((folder / "said.json").read_text())["batch_norm"]
    assert "2 processes cannot share the network batch_norm" in said and "one process" in said
    assert not (folder / "refused" / "ssi.run").exists()


def test_after_a_death_one_process_goes_on(data: Path, folder: Path) -> None:
    said = json.loads((folder / "said.json").read_text())["killed"]
    assert "goes on from the last checkpoint" in said
    there = sorted(path.name for path in (folder / "killed" / "ssi.run").glob("checkpoint-*"))
    assert there[-1] == f"checkpoint-{DEATH:09d}.safetensors"
    output = pretrain_one("ssi", data, folder / "killed", n_updates=4)
    resumed = read_card(output.with_suffix(".json"))["curves"]
    whole = read_card(pretrain_one("ssi", data, folder / "whole", n_updates=4).with_suffix(".json"))["curves"]
    assert resumed["train/loss"] == pytest.approx(whole["train/loss"], rel=1e-3)


def test_one_process_is_as_ever() -> None:
    with processes("cpu") as ranks:
        assert (ranks.rank, ranks.size, ranks.is_first) == (0, 1, True)
        ranks.wait()
        ranks.require_equal(3)


def test_positions_that_differ_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_abisim.pretraining.ranks._device_of_backend", lambda: "cpu")
    monkeypatch.setattr(Ranks, "gather", lambda self, rows: th.tensor([3, 4]))
    with pytest.raises(ValueError, match=r"different checkpoints, of \[3, 4\] updates"):
        Ranks(0, 2).require_equal(3)


@pytest.mark.parametrize(
    ("device", "number", "message"),
    [("cuda:1", 0, "GPU of its own, got --device cuda:1"), ("cuda", 2, "process 2 has no GPU of its own among 2")],
)
def test_gpus_that_cannot_be_had(device: str, number: int, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "x")
    monkeypatch.setenv("LOCAL_RANK", str(number))
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "device_count", lambda: 2)
    with pytest.raises(ValueError, match=message), processes(device):
        pass


def _torchrun(data: Path, output: Path) -> list[str]:
    words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(N_PROCESSES)]
    words += ["-m", "sb3_abisim", "pretrain", "--objective", "ssi", "--data", str(data), "-o", str(output)]
    settings = {**SETTINGS, "n_updates": 80, "checkpoint_interval": 5}
    return [*words, "--device", "cpu", "--verbose", "0", "-params", *(f"{k}:{v}" for k, v in settings.items())]


def _children(pid: int) -> dict[int, str]:
    """Pid and rank of the processes that one has started; Linux only."""
    found = {}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        variables = Path(f"/proc/{child}/environ").read_bytes().split(b"\0")
        found |= {int(child): v.decode() for v in variables if v.startswith(b"RANK=")}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_process_ends_torchrun_and_a_rerun_ends_in_the_same_bytes(
    data: Path, tmp_path: Path, rank: int
) -> None:
    environment: dict[str, Any] = {**os.environ, "OMP_NUM_THREADS": "1"}
    whole, killed = (tmp_path / name / "ssi.safetensors" for name in ("whole", "killed"))
    subprocess.run(_torchrun(data, whole), check=True, env=environment, capture_output=True)
    process = subprocess.Popen(_torchrun(data, killed), stderr=subprocess.PIPE, text=True, env=environment)
    deadline = time.monotonic() + 240
    while not list(killed.with_suffix(".run").glob("checkpoint-*")):
        assert process.poll() is None and time.monotonic() < deadline, "the run must reach its first checkpoint"
        time.sleep(0.01)
    os.kill(next(pid for pid, name in _children(process.pid).items() if name == f"RANK={rank}"), signal.SIGKILL)
    _, said = process.communicate(timeout=240)
    assert process.returncode != 0 and "the same command" in said and "last checkpoint" in said, said
    assert not killed.exists()
    subprocess.run(_torchrun(data, killed), check=True, env=environment, capture_output=True)
    for suffix in (".safetensors", ".json"):
        assert whole.with_suffix(suffix).read_bytes() == killed.with_suffix(suffix).read_bytes()
