"""Weights & Biases: what is sent, and that nothing depends on it."""

import sys
import types
from pathlib import Path
from typing import Any

import pytest
from pretrain_inputs import SETTINGS, collect_grids
from pretrain_inputs import run as run_pretraining

from sb3_abisim import __version__
from sb3_abisim.pretraining import pretrain as module
from sb3_abisim.pretraining.track import Tracking


class Wandb(types.ModuleType):
    """A stand-in for the package: what it was asked."""

    class Error(Exception):
        pass

    def __init__(self) -> None:
        super().__init__("wandb")
        self.runs: list[dict[str, Any]] = []
        self.fails = False

    def init(self, **kwargs: Any) -> Any:
        if self.fails:
            raise self.Error("No API key configured.\nUse `wandb login`")
        run: dict[str, Any] = {**kwargs, "rows": {}, "exit_code": None}
        self.runs.append(run)
        return types.SimpleNamespace(
            log=lambda row, step: run["rows"].update({step: row}),
            finish=lambda exit_code: run.update(exit_code=exit_code),
        )


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> Wandb:
    stand_in = Wandb()
    stand_in.__spec__ = types.SimpleNamespace()  # type: ignore[assignment]
    monkeypatch.setitem(sys.modules, "wandb", stand_in)
    return stand_in


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return collect_grids(tmp_path_factory)


def words(data: Path, output: Path, *more: str) -> list[str]:
    settings = [f"{name}:{value}" for name, value in SETTINGS.items()]
    return ["--objective", "ssi", "--data", str(data), "-o", str(output), "--device", "cpu", "--verbose", "0",
            "-params", *settings, *more]  # fmt: skip


def test_the_log_is_shown_and_the_file_is_the_same(data: Path, tmp_path: Path, wandb: Wandb) -> None:
    more = ["--track", "--wandb-project-name", "mine", "--wandb-entity", "us", "--wandb-tags", "a", "b"]
    module.main(words(data, tmp_path / "a.safetensors", *more))
    plain = run_pretraining(data, tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == plain.read_bytes()
    (run,) = wandb.runs
    assert (run["project"], run["entity"], run["tags"]) == ("mine", "us", ["a", "b", f"v{__version__}"])
    assert run["name"].startswith("Nav2D-v0__ssi__0__") and run["resume"] == "allow"
    assert run["config"]["env"] == "Nav2D-v0" and run["config"]["batch_size"] == 32 and "command" in run["config"]
    assert run["dir"] == str(tmp_path / "a.run")
    assert list(run["rows"]) == [5, 10, 15, 20, 25, 30] and run["exit_code"] == 0
    assert {"train/loss", "eval/accuracy"} <= set(run["rows"][30])


def test_it_is_off_by_default(data: Path, tmp_path: Path, wandb: Wandb) -> None:
    module.main(words(data, tmp_path / "a.safetensors"))
    assert wandb.runs == []


def test_an_interrupted_run_goes_on_in_its_place(data: Path, tmp_path: Path, wandb: Wandb) -> None:
    def stop(encoder: Any) -> dict[str, float]:
        raise KeyboardInterrupt

    settings = {"device": "cpu", "progress_bar": False, "verbose": 0, "track": Tracking()}
    for callback in (stop, None, None):
        try:
            module.pretrain("ssi", data, tmp_path / "a.safetensors", {**SETTINGS}, callback=callback, **settings)
        except KeyboardInterrupt:
            continue
    # The third finds everything done.
    first, second = wandb.runs
    assert first["id"] == second["id"] and first["project"] == "sb3" and first["entity"] is None
    assert (first["exit_code"], second["exit_code"]) == (1, 0)
    module.pretrain("ssi", data, tmp_path / "b.safetensors", {**SETTINGS}, **settings)
    assert wandb.runs[-1]["id"] != first["id"]


def test_a_base_encoder_has_a_run_of_its_own(data: Path, tmp_path: Path, wandb: Wandb) -> None:
    settings = {"device": "cpu", "progress_bar": False, "verbose": 0, "track": Tracking()}
    small = {"n_updates": 5, "batch_size": 32, "base.n_updates": 5}
    module.pretrain("abisim", data, tmp_path / "a.safetensors", small, **settings)
    assert [run["config"]["objective"] for run in wandb.runs] == ["ssi", "abisim"]


def test_mistakes_are_one_line(data: Path, tmp_path: Path, wandb: Wandb, capsys: pytest.CaptureFixture[str]) -> None:
    cases = {
        "add --track, or leave it out": ["--wandb-tags", "a"],
        "Weights & Biases did not begin (No API key configured. Use `wandb login`); run `wandb login`": ["--track"],
    }
    wandb.fails = True
    for message, more in cases.items():
        with pytest.raises(SystemExit) as stop:
            module.main(words(data, tmp_path / "a.safetensors", *more))
        err = capsys.readouterr().err.strip().splitlines()
        assert stop.value.code == 2 and message in err[-1], err
    assert not (tmp_path / "a.safetensors").exists()
