"""Interruption changes nothing, and what belongs to another run is refused."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch as th
from pretrain_inputs import SETTINGS, collect_grids, run

from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.networks.encoder_file import load_encoder, save_encoder
from sb3_abisim.pretraining.checkpoint import Checkpoints, asks_for_more_updates
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import pretrain
from sb3_abisim.pretraining.trainer import PretrainRun


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return collect_grids(tmp_path_factory)


class Interrupted(Exception):
    pass


def trained(seed=0):
    """A module with a buffer, and an optimizer that has made a step."""
    th.manual_seed(seed)
    module = th.nn.Sequential(th.nn.Linear(2, 3), th.nn.BatchNorm1d(3))
    optimizer = th.optim.Adam(module.parameters(), lr=0.1)
    module(th.rand(4, 2)).pow(2).sum().backward()
    optimizer.step()
    return module, optimizer


def test_a_checkpoint_brings_everything_back(tmp_path: Path) -> None:
    module, optimizer = trained()
    rows = [{"train/loss": 0.5, "n_updates": 3}]
    checkpoints = Checkpoints(tmp_path, {"n_updates": 9, "learning_rate": 1.0, "shape": (1, 2)})
    assert not checkpoints.exist() and checkpoints.restore(module, optimizer) == (0, [])
    checkpoints.save(module, optimizer, 3, rows)
    assert checkpoints.exist() and [path.name for path in tmp_path.iterdir()] == ["checkpoint-000000003.safetensors"]
    expected = th.rand(5)
    other, other_optimizer = trained(seed=1)
    assert checkpoints.restore(other, other_optimizer) == (3, rows)
    assert th.equal(th.rand(5), expected), "the random state"
    assert other.state_dict().keys() == module.state_dict().keys()
    for name, tensor in module.state_dict().items():
        assert th.equal(other.state_dict()[name], tensor), name
    state, again = optimizer.state_dict(), other_optimizer.state_dict()
    assert again["param_groups"] == state["param_groups"] and again["state"].keys() == state["state"].keys()
    for index, values in state["state"].items():
        for name, value in values.items():
            assert th.equal(again["state"][index][name], value), (index, name)


def test_the_newest_one_is_restored_and_the_newest_ones_stay(tmp_path: Path) -> None:
    module, optimizer = trained()
    checkpoints = Checkpoints(tmp_path, {"n_updates": 9, "learning_rate": 1.0})
    (tmp_path / "progress.csv").touch()
    for n_updates in (999, 1000, 20_000):
        checkpoints.save(module, optimizer, n_updates, [])
    assert checkpoints.restore(module, optimizer)[0] == 20_000
    kept = ["checkpoint-000001000.safetensors", "checkpoint-000020000.safetensors", "progress.csv"]
    for keep, there in ((3, kept), (2, kept), (1, kept[1:]), (0, kept[2:])):
        checkpoints.remove(keep=keep)
        assert sorted(path.name for path in tmp_path.iterdir()) == there


def test_the_one_before_a_damaged_one_is_gone_on_from(tmp_path: Path) -> None:
    module, optimizer = trained()
    checkpoints = Checkpoints(tmp_path, {"n_updates": 9, "learning_rate": 1.0})
    for n_updates in (1, 2):
        checkpoints.save(module, optimizer, n_updates, [])
    damaged = tmp_path / "checkpoint-000000002.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"/checkpoint-000000002\.safetensors is damaged; remove it to go on from"):
        checkpoints.restore(module, optimizer)
    damaged.unlink()
    assert checkpoints.restore(module, optimizer)[0] == 1


@pytest.mark.parametrize("there", [8, 9, 10])
def test_a_run_with_more_updates_alone_goes_on(tmp_path: Path, there: int) -> None:
    module, optimizer = trained()
    settings = {"n_updates": there, "learning_rate": 1.0, "batch_size": 4}
    Checkpoints(tmp_path, settings).save(module, optimizer, 5, [])
    assert asks_for_more_updates(settings, {**settings, "n_updates": 9}) == (there < 9)
    if there == 10:
        with pytest.raises(ValueError, match="n_updates: 10 there, 9 here"):
            Checkpoints(tmp_path, {**settings, "n_updates": 9}).restore(module, optimizer)
    else:
        assert Checkpoints(tmp_path, {**settings, "n_updates": 9}).restore(module, optimizer) == (5, [])
    for change in ({"batch_size": 5}, {"learning_rate": "lin_1.0"}):
        with pytest.raises(ValueError, match="other settings"):
            Checkpoints(tmp_path, {**settings, "n_updates": 11, **change}).restore(module, optimizer)


def test_a_checkpoint_of_other_settings_is_refused_with_all_that_differ(tmp_path: Path) -> None:
    module, optimizer = trained()
    Checkpoints(tmp_path, {"a": 1, "b": (1, 2), "c": "x", "learning_rate": 1.0}).save(module, optimizer, 1, [])
    here = {"a": 2, "b": [1, 2], "learning_rate": 1.0, "d": 0.5}
    with pytest.raises(ValueError) as raised:
        Checkpoints(tmp_path, here).restore(module, optimizer)
    assert str(raised.value) == (
        f"{tmp_path}/checkpoint-000000001.safetensors belongs to a run with other settings (a: 1 there, 2 here; "
        "c: 'x' there, None here; d: None there, 0.5 here); choose another output, or remove the file"
    )


@pytest.mark.parametrize(
    ("objective", "stop_at", "chunk_length"),
    [
        ("ssi", 3, 1),
        ("ssi", 29, 1),
        ("ssi", 12, 8),
        ("acro", 12, 1),
        ("beta_vae", 12, 1),
        ("curl", 12, 1),
        ("info_nce", 12, 4),
        ("abisim", 12, 1),
    ],
)
def test_an_interrupted_run_ends_in_the_same_bytes(data, tmp_path, monkeypatch, objective, stop_at, chunk_length):
    kwargs = {}
    base = str(run(data, tmp_path / "base.safetensors"))
    config = load_config(objective, "Nav2D-v0", {**SETTINGS, "chunk_length": chunk_length})
    if objective == "abisim":
        kwargs["base"] = base
    # Different folders, equal names: what is compared must not hold the path.
    outputs = [tmp_path / name / "encoder.safetensors" for name in ("whole", "stopped")]
    pretrain(objective, data, outputs[0], config, device="cpu", progress_bar=False, verbose=0, **kwargs)
    update, count = PretrainRun._update, 0

    def interrupt(self, batch):
        nonlocal count
        count += 1
        if count == stop_at:
            raise Interrupted
        return update(self, batch)

    monkeypatch.setattr(PretrainRun, "_update", interrupt)
    with pytest.raises(Interrupted):
        pretrain(objective, data, outputs[1], config, device="cpu", progress_bar=False, verbose=0, **kwargs)
    assert not outputs[1].exists()
    pretrain(objective, data, outputs[1], config, device="cpu", progress_bar=False, verbose=0, **kwargs)
    # Went on from the checkpoint at the last multiple of 5 before the stop.
    assert count == stop_at + 30 - (stop_at - 1) // 5 * 5
    for suffix in (".safetensors", ".json"):
        assert outputs[0].with_suffix(suffix).read_bytes() == outputs[1].with_suffix(suffix).read_bytes()
    rows = [sorted(p.with_suffix(".run").joinpath("progress.csv").read_text().splitlines()) for p in outputs]
    assert len(rows[0]) == len(rows[1]) == 7


def test_killed_command_goes_on_to_the_same_bytes(data, tmp_path):
    def command(folder):
        words = [f"{k}:{v}" for k, v in {**SETTINGS, "n_updates": 60}.items()]
        return [
            sys.executable,
            "-m",
            "sb3_abisim",
            "pretrain",
            "--objective",
            "ssi",
            "--env",
            "Nav2D-v0",
            "--data",
            str(data),
            "-o",
            str(folder / "ssi.safetensors"),
            "--device",
            "cpu",
            "--verbose",
            "0",
            "-params",
            *words,
        ]

    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run(command(tmp_path / "whole"), check=True, env=environment, capture_output=True)
    process = subprocess.Popen(command(tmp_path / "killed"), env=environment, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("killed/ssi.run/checkpoint-*")):
        assert process.poll() is None and time.monotonic() < deadline, "the run must reach its first checkpoint"
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    subprocess.run(command(tmp_path / "killed"), check=True, env=environment, capture_output=True)
    for name in ("ssi.safetensors", "ssi.json"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes()


def test_finished_run_is_left_alone_and_other_settings_are_refused(data, tmp_path):
    output = run(data, tmp_path / "ssi.safetensors")
    before = output.stat().st_mtime_ns
    run(data, output)
    assert output.stat().st_mtime_ns == before
    with pytest.raises(ValueError, match=r"n_updates of 30, .* has fallen to 0"):
        run(data, output, n_updates=40)
    content = output.read_bytes()
    output.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(ValueError, match=r"ssi\.safetensors .*To have it written again, remove it first"):
        run(data, output)
    output.unlink()
    assert run(data, output).read_bytes() == content


def test_checkpoint_of_other_settings_is_refused(data, tmp_path, monkeypatch):
    monkeypatch.setattr(PretrainRun, "finish", lambda self: None)
    run(data, tmp_path / "ssi.safetensors")
    with pytest.raises(ValueError, match="other settings"):
        run(data, tmp_path / "ssi.safetensors", learning_rate=0.5)


def test_damaged_checkpoint_is_refused(data, tmp_path, monkeypatch):
    monkeypatch.setattr(PretrainRun, "finish", lambda self: None)
    run(data, tmp_path / "ssi.safetensors")
    path = sorted((tmp_path / "ssi.run").glob("checkpoint-*"))[-1]
    content = bytearray(path.read_bytes())
    for position in (3, len(content) // 2, len(content) - 1):
        damaged = bytearray(content)
        damaged[position] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="damaged"):
            run(data, tmp_path / "ssi.safetensors")


@pytest.mark.parametrize(("log_interval", "n_rows", "saved"), [(7, 5, [14, 28]), (30, 1, [30]), (100, 1, [30])])
def test_checkpoints_and_rows_come_whatever_the_intervals(data, tmp_path, monkeypatch, log_interval, n_rows, saved):
    """At the first row after each interval; the last row is at the end."""
    positions, plain = [], PretrainRun.save
    monkeypatch.setattr(PretrainRun, "save", lambda run: positions.append(run.n_updates) or plain(run))
    fixed = {"objective_kwargs.adaptive": None, "objective_kwargs.l1_penalty": 0.25}
    run(data, tmp_path / "e.safetensors", log_interval=log_interval, checkpoint_interval=10, **fixed)
    rows = json.loads((tmp_path / "e.json").read_text())["curves"]
    assert positions == saved and len(rows["n_updates"]) == n_rows and rows["n_updates"][-1] == 30
    assert rows["train/beta"] == [0.25] * n_rows, "means over the updates of a row"


def test_keeps_the_last_two_checkpoints(data, tmp_path, monkeypatch):
    monkeypatch.setattr(PretrainRun, "finish", lambda self: None)
    run(data, tmp_path / "ssi.safetensors")
    names = [path.name for path in sorted((tmp_path / "ssi.run").glob("checkpoint-*"))]
    assert names == ["checkpoint-000000025.safetensors", "checkpoint-000000030.safetensors"]


def test_second_writer_is_refused(data, tmp_path):
    from sb3_abisim.common.files import folder_lock

    (tmp_path / "ssi.run").mkdir()
    with folder_lock(tmp_path / "ssi.run"), pytest.raises(ValueError, match=str(os.getpid())):
        run(data, tmp_path / "ssi.safetensors")


def test_files_from_before_chunks_existed_stay_those_of_the_same_run(data, tmp_path):
    output = run(data, tmp_path / "ssi.safetensors")
    assert "chunk_length" not in load_encoder(str(output)).metadata["settings"]
    with pytest.raises(ValueError, match="chunk_length: None there, 8 here"):
        run(data, output, chunk_length=8)


def old_names(settings):
    """Settings as files held them before they were renamed."""
    names = {"eval_fraction": "holdout", "dataset_hash": "dataset_digest", "delta_scale": "change_weight"}
    values = {"chance_corrected": "above_chance"}
    renamed = {}
    for name, value in settings.items():
        value = old_names(value) if isinstance(value, dict) else value
        renamed[names.get(name, name)] = values.get(value, value) if isinstance(value, str) else value
    return renamed


def test_a_finished_file_with_the_names_of_another_version_is_left_alone(data, tmp_path):
    output = run(data, tmp_path / "ssi.safetensors")
    file, dataset = load_encoder(output), TransitionDataset(data)
    settings = old_names(file.metadata["settings"])
    assert settings["holdout"] == 0.05 and settings["objective_kwargs"]["adaptive"] == "above_chance"
    metadata = {key: file.metadata[key] for key in ("env_id", "env_kwargs", "objective", "dataset_hash")}
    spaces = {"observation_space": dataset.observation_space, "action_space": dataset.action_space}
    frames = dataset.frames([0, 1])
    save_encoder(output, file.encoder, settings=settings, reference_observations=frames, **metadata, **spaces)
    content = output.read_bytes()
    run(data, output)
    assert output.read_bytes() == content
    with pytest.raises(ValueError, match=r"eval_fraction: 0\.05 there, 0\.1 here"):
        run(data, output, eval_fraction=0.1)


def test_a_checkpoint_with_the_names_of_another_version_is_gone_on_from(data, tmp_path, monkeypatch):
    whole = run(data, tmp_path / "whole" / "ssi.safetensors")
    plain = Checkpoints.save

    def interrupt(self, module, optimizer, n_updates, rows):
        old = [
            {name.replace("eval/", "test/").replace("inverse_nll", "prediction"): x for name, x in r.items()}
            for r in rows
        ]
        plain(Checkpoints(self.folder, old_names(self.settings)), module, optimizer, n_updates, old)
        raise Interrupted

    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr(Checkpoints, "save", interrupt)
        run(data, tmp_path / "stopped" / "ssi.safetensors")
    stopped = run(data, tmp_path / "stopped" / "ssi.safetensors")
    for suffix in (".safetensors", ".json"):
        assert stopped.with_suffix(suffix).read_bytes() == whole.with_suffix(suffix).read_bytes()


def forge(path: Path, change: Callable[[dict[str, Any], dict[str, th.Tensor]], None]) -> None:
    """Rewrite a checkpoint with a right hash."""
    content = path.read_bytes()[:-32]
    size = int.from_bytes(content[:8], "little")
    metadata = json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["run"])
    tensors = safetensors.torch.load(content)
    change(metadata, tensors)
    forged = safetensors.torch.save(tensors, {"run": json.dumps(metadata)})
    path.write_bytes(forged + hashlib.sha256(forged).digest())


FORGERIES: dict[str, Callable[[dict[str, Any], dict[str, th.Tensor]], Any]] = {
    "no settings": lambda m, t: m.pop("settings"),
    "settings of a list": lambda m, t: m.update(settings=[1]),
    "no rows": lambda m, t: m.pop("rows"),
    "rows of texts": lambda m, t: m.update(rows=[{"loss": "x"}]),
    "updates before the first": lambda m, t: m.update(n_updates=-1),
    "updates of a text": lambda m, t: m.update(n_updates="9"),
    "no weight": lambda m, t: t.pop("module.0.weight"),
    "a weight too many": lambda m, t: t.update({"module.9.weight": th.ones(2)}),
    "a weight of another shape": lambda m, t: t.update({"module.0.weight": th.ones(2)}),
    "a moment of another shape": lambda m, t: t.update({"optimizer.0.exp_avg": th.ones(7, 7)}),
    "a moment of no weight": lambda m, t: t.update({"optimizer.99.exp_avg": th.ones(2)}),
    "a name of four parts": lambda m, t: t.update({"optimizer.0.a.b": th.ones(2)}),
    "no random state": lambda m, t: t.pop("rng"),
    "a random state of floats": lambda m, t: t.update(rng=th.ones(5)),
}


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_forged_checkpoint_is_one_sentence(forgery: str, tmp_path: Path) -> None:
    module, optimizer = trained()
    checkpoints = Checkpoints(tmp_path, {"n_updates": 9, "learning_rate": 1.0})
    checkpoints.save(module, optimizer, 3, [{"loss": 1.0}])
    (path,) = tmp_path.iterdir()
    forge(path, lambda metadata, tensors: None)
    assert checkpoints.restore(*trained()) == (3, [{"loss": 1.0}])
    forge(path, FORGERIES[forgery])
    with pytest.raises(ValueError, match=r"000000003\.safetensors is no checkpoint of this run \(.*; remove it"):
        checkpoints.restore(*trained())


@pytest.mark.parametrize("content", [b"", b"[" * 10_000, (2**60).to_bytes(8, "little"), b"\x02" + bytes(7) + b"{}"])
def test_a_file_of_something_else_with_a_right_hash(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "checkpoint-000000003.safetensors").write_bytes(content + hashlib.sha256(content).digest())
    with pytest.raises(ValueError, match="is no checkpoint of this run"):
        Checkpoints(tmp_path, {"n_updates": 9, "learning_rate": 1.0}).restore(*trained())
