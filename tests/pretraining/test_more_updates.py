"""A finished run that is given more updates."""

from pathlib import Path
from typing import Any

import pytest
from pretrain_inputs import collect_grids, run

from sb3_abisim.pretraining.card import read_card
from sb3_abisim.pretraining.trainer import PretrainRun

CONSTANT = {"learning_rate": 1e-3}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return collect_grids(tmp_path_factory)


@pytest.mark.parametrize("objective", ["ssi", "curl"])
def test_it_ends_in_the_bytes_of_a_run_that_had_them_from_the_start(data: Path, tmp_path: Path, objective: str) -> None:
    """CURL has a target network and random augmentations; 33 is no row of the log, 60 is in the second epoch."""
    output = tmp_path / "e.safetensors"
    run(data, output, objective, n_updates=33, keep_checkpoint=True, **CONSTANT)
    assert [path.name for path in tmp_path.glob("e.run/checkpoint-*")] == ["checkpoint-000000033.safetensors"]
    short = output.read_bytes()
    run(data, output, objective, n_updates=70, **CONSTANT)
    run(data, tmp_path / "whole.safetensors", objective, n_updates=70, **CONSTANT)
    assert output.read_bytes() == (tmp_path / "whole.safetensors").read_bytes() != short
    assert read_card(output.with_suffix(".json"))["settings"]["n_updates"] == 70
    assert not list(tmp_path.glob("e.run/checkpoint-*"))


def test_the_first_file_does_not_depend_on_keeping(data: Path, tmp_path: Path) -> None:
    for name, keep in (("a", True), ("b", False)):
        run(data, tmp_path / f"{name}.safetensors", keep_checkpoint=keep, **CONSTANT)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_killed_while_it_goes_on(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = tmp_path / "e.safetensors"
    run(data, output, n_updates=30, keep_checkpoint=True, **CONSTANT)
    update = PretrainRun._update

    def killed(self: PretrainRun, batch: Any) -> Any:
        if self.n_updates == 47:
            raise KeyboardInterrupt
        return update(self, batch)

    monkeypatch.setattr(PretrainRun, "_update", killed)
    with pytest.raises(KeyboardInterrupt):
        run(data, output, n_updates=60, keep_checkpoint=True, **CONSTANT)
    monkeypatch.setattr(PretrainRun, "_update", update)
    run(data, output, n_updates=60, keep_checkpoint=True, **CONSTANT)
    run(data, tmp_path / "whole.safetensors", n_updates=60, **CONSTANT)
    assert output.read_bytes() == (tmp_path / "whole.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("first", "then", "message"),
    [
        (CONSTANT, {}, "n_updates of 30, and no checkpoint was kept in .*choose another output .*--keep-checkpoint"),
        (
            {"learning_rate": "lin_0.001", "keep_checkpoint": True}, {},
            "n_updates of 30, at whose end its learning_rate lin_0.001 has fallen to 0.*another output",
        ),
        ({**CONSTANT, "keep_checkpoint": True}, {"n_updates": 20}, "n_updates: 30 there, 20 here"),
        ({**CONSTANT, "keep_checkpoint": True}, {"batch_size": 16}, "batch_size: 32 there, 16 here"),
    ],
    ids=["not kept", "falling rate", "fewer", "other settings"],
)  # fmt: skip
def test_refused(data: Path, tmp_path: Path, first: Any, then: Any, message: str) -> None:
    output = tmp_path / "e.safetensors"
    run(data, output, **first)
    before = output.read_bytes()
    with pytest.raises(ValueError, match=message):
        run(data, output, **{**first, "n_updates": 60, **then})
    assert output.read_bytes() == before
