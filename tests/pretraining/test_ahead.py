"""Batches made ahead: the same ones, in the same order, while the one before is learned from."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_abisim import collect, pretrain
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.pretraining import ahead, trainer
from sb3_abisim.pretraining.ahead import make_ahead


def test_the_next_one_is_made_while_one_is_worked_on() -> None:
    asked_for = [threading.Event() for _ in range(4)]

    def items() -> Iterator[int]:
        for n, event in enumerate(asked_for):
            event.set()
            yield n

    for n in make_ahead(items()):
        if n < 3:
            assert asked_for[n + 1].wait(10), n


def test_order_and_errors() -> None:
    def items() -> Iterator[int]:
        yield from range(5)
        raise ValueError("no more")

    coming, seen = make_ahead(items()), []
    with pytest.raises(ValueError, match="no more"):
        seen += list(iter(lambda: next(coming), None))
    assert list(make_ahead(iter(range(7)))) == list(range(7))
    assert list(make_ahead(iter(()))) == []


def test_the_thread_ends_with_the_iterator() -> None:
    before = threading.active_count()
    coming = make_ahead(iter(range(100)))
    assert next(coming) == 0
    assert threading.active_count() == before + 1
    coming.close()
    assert threading.active_count() == before


def test_a_run_is_the_same_to_the_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect("Nav2D-v0", 600, tmp_path / "data", n_envs=4)
    overrides = {"n_updates": 23, "batch_size": 64, "log_interval": 5, "chunk_length": 1}
    settings: dict[str, Any] = {"verbose": 0, "progress_bar": False, "device": "cpu", "config": overrides}
    made_in: set[str] = set()
    whole = trainer.PretrainRun._to_tensors

    def noting(run: Any, batch: Any) -> Any:
        made_in.add(threading.current_thread().name)
        return whole(run, batch)

    monkeypatch.setattr(trainer.PretrainRun, "_to_tensors", noting)
    monkeypatch.setattr(trainer, "gains_from_ahead", lambda *args: True)
    first = pretrain("ssi", tmp_path / "data", tmp_path / "ahead.safetensors", **settings)
    assert any(name.startswith("batches") for name in made_in)
    made_in.clear()
    monkeypatch.setattr(trainer, "gains_from_ahead", lambda *args: False)
    plain = pretrain("ssi", tmp_path / "data", tmp_path / "plain.safetensors", **settings)
    assert made_in == {threading.current_thread().name}
    assert first.read_bytes() == plain.read_bytes()


def test_the_thread_ends_with_a_run_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect("Nav2D-v0", 600, tmp_path / "data", n_envs=4)

    def fail(*args: Any) -> None:
        raise FloatingPointError("no number")

    monkeypatch.setattr(trainer, "gains_from_ahead", lambda *args: True)
    monkeypatch.setattr(trainer.PretrainRun, "_update", fail)
    # What was raised holds on to the loop.
    with pytest.raises(FloatingPointError) as raised:
        pretrain("ssi", tmp_path / "data", tmp_path / "x.safetensors", progress_bar=False, verbose=0, device="cpu")
    assert raised and not [one for one in threading.enumerate() if one.name.startswith("batches")]


def test_a_core_must_be_free(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu = th.device("cpu")
    for n_threads, cores, gains in ((1, {0, 1}, True), (1, {0}, False), (2, {0, 1}, False), (8, set(range(16)), False)):
        monkeypatch.setattr(th, "get_num_threads", lambda n=n_threads: n)
        monkeypatch.setattr(ahead.os, "sched_getaffinity", lambda pid, cores=cores: cores, raising=False)
        assert ahead.gains_from_ahead(cpu, 1) == gains, (n_threads, cores)
        assert not ahead.gains_from_ahead(cpu, len(cores)), "each process has its core"
        assert ahead.gains_from_ahead(th.device("cuda"), 1)


def test_a_dataset_is_read_by_one_thread_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect("Nav2D-v0", 300, tmp_path / "data", n_envs=4)
    dataset = TransitionDataset(tmp_path / "data")
    inside, together = [0], [0]
    rows = dataset._files.rows

    def watched(*args: Any) -> Any:
        inside[0] += 1
        together[0] = max(together[0], inside[0])
        # Long enough for another thread to come in, if it could.
        threading.Event().wait(0.02)
        inside[0] -= 1
        return rows(*args)

    monkeypatch.setattr(dataset._files, "rows", watched)
    threads = [threading.Thread(target=dataset.frames, args=(np.arange(5),)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert together == [1]
