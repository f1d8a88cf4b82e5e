"""The doctor says what is there, and what is wrong, and executes nothing."""

import base64
import io
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch as th
from packaging.requirements import Requirement
from stable_baselines3 import PPO
from zoo_inputs import SMALL, run, write_encoder

import sb3_abisim
from sb3_abisim import doctor
from sb3_abisim.data.collect import collect
from sb3_abisim.networks.encoder_file import load_encoder

ENV_ID = "Nav2D-v0"


def diagnose(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    code = 0
    try:
        doctor.main(list(words))
    except SystemExit as stop:
        code = int(stop.code or 0)
    said = capsys.readouterr()
    return code, said.out, said.err


def test_the_installation(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SB3_ABISIM_CACHE", str(tmp_path / "cache"))
    code, out, _ = diagnose(capsys)
    assert code == 0 and sb3_abisim.__version__ in out and f"{tmp_path / 'cache'}, writable" in out
    found = {line[2:20].strip(): line[22:] for line in out.splitlines()}
    assert found["torch"] and found["extra plots"] == "installed"
    assert not {"extra tests", "extra all"} & found.keys()


def test_what_is_too_old_or_missing_is_a_fault(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["torch>=999; python_version > '3'", "nosuch>=1", "noextra>=1; extra == 'video'"]
    monkeypatch.setattr(doctor, "requires", lambda name: words)
    code, out, err = diagnose(capsys)
    assert code == 1 and "2 faults" in err
    assert f"needed is {Requirement(words[0]).specifier}" in out and "! nosuch" in out
    assert "noextra is not installed; run: pip install 'sb3_abisim[video]'" in out


def test_an_encoder_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    write_encoder(path, ENV_ID)
    code, out, _ = diagnose(capsys, str(path))
    assert code == 0 and load_encoder(path).hash in out and "loads here          yes" in out and ENV_ID in out
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    code, out, err = diagnose(capsys, str(path))
    assert code == 2 and "loads here" not in out and str(path) in err


def test_a_dataset_is_verified_to_the_last_byte(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    collect(ENV_ID, 300, tmp_path / "d", n_envs=2)
    code, out, _ = diagnose(capsys, str(tmp_path / "d"))
    assert code == 0 and "300 in" in out and "loads here          yes" in out
    shard = next((tmp_path / "d").glob("frames*"))
    data = bytearray(shard.read_bytes())
    data[-1] ^= 1
    shard.write_bytes(data)
    code, _, err = diagnose(capsys, str(tmp_path / "d"))
    assert code == 2 and shard.name in err


def test_a_run_and_its_model(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    write_encoder(tmp_path / "e.safetensors", ENV_ID)
    flags = ["--algo", "ppo", "--env", ENV_ID, "-f", str(tmp_path), "--conf-file", f"abisim={tmp_path}/e.safetensors"]
    run(monkeypatch, "train", *flags, "-n", "64", "--eval-freq", "-1", "-params", *SMALL["ppo"])
    folder = tmp_path / "ppo" / f"{ENV_ID}_1"
    model = folder / f"{ENV_ID}.zip"
    capsys.readouterr()
    hash = load_encoder(tmp_path / "e.safetensors").hash
    for path in (folder, model):
        code, out, _ = diagnose(capsys, str(path))
        assert code == 0 and hash in out and f"{ENV_ID}.zip loads here  yes" in out
    assert "ActionBisimExtractor" in out
    code, out, _ = diagnose(capsys, str(tmp_path / "ppo"))
    assert code == 0 and "1 below" in out and "seeds" in out
    # What a zip pickles is not executed, wherever it lies.
    for place in (model, tmp_path / "alone.zip"):
        booby_trap(model, place, tmp_path / "executed")
        code, out, err = diagnose(capsys, str(place))
        assert not (tmp_path / "executed").exists(), err
    assert code == 0 and "give its run folder" in out
    model.write_bytes(model.read_bytes()[:-100])
    code, out, err = diagnose(capsys, str(folder))
    assert code == 1 and "1 fault," in err and f"! {ENV_ID}.zip loads here" in out
    model.unlink()
    assert diagnose(capsys, str(folder))[0] == 1


@pytest.mark.parametrize("weights", [{"a": th.zeros(1).expand(10**13)}, {"a": 1}, [1]])
def test_weights_that_are_none_are_refused(weights: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    stream = io.BytesIO()
    th.save(weights, stream)
    with zipfile.ZipFile(tmp_path / "m.zip", "w") as archive:
        archive.writestr("data", "{}")
        archive.writestr("policy.pth", stream.getvalue())
    code, out, err = diagnose(capsys, str(tmp_path / "m.zip"))
    assert code == 2 and not out and "no model of Stable-Baselines3" in err


def booby_trap(source: Path, target: Path, mark: Path) -> None:
    class Trap:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(mark),)

    with zipfile.ZipFile(source) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(parts["data"])
    data["policy_kwargs"] = {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(Trap())).decode()}
    parts["data"] = json.dumps(data).encode()
    with zipfile.ZipFile(target, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, part)
    # It is one: Stable-Baselines3 falls into it.
    with pytest.raises(Exception):  # noqa: B017
        PPO.load(target)
    assert mark.is_dir()
    mark.rmdir()


@pytest.mark.parametrize("name", ["setup.cfg", "nothing"])
def test_anything_else_is_refused(name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "setup.cfg").write_text("[metadata]")
    code, out, err = diagnose(capsys, str(tmp_path / name))
    assert code == 2 and not out and name in err
