"""Upload to a stand-in for the Hub and load back; what is refused."""

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from extractor_inputs import write
from hub_server import TOKEN, Hub, hub_server

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.push.upload import main, repository

# One process for all that talks to the Hub: huggingface_hub reads its address when it is imported.
SCRIPT = r"""
import contextlib, io, json, os, sys, traceback
import torch
from sb3_abisim import load_encoder, policy_kwargs
from sb3_abisim.__main__ import main

def run(step):
    out, err = io.StringIO(), io.StringIO()
    environment, name, *words = step
    os.environ.pop("HF_TOKEN", None)
    os.environ.update(environment)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            if name == "load":
                file = load_encoder(*words)
                return [0, file.hash, str(file.path)]
            if name == "policy_kwargs":
                return [0, policy_kwargs(*words)["features_extractor_kwargs"]["encoder"], ""]
            if name == "spec":
                from sb3_abisim.zoo.methods import MethodSpec
                return [0, MethodSpec.parse(*words).policy_kwargs({})["features_extractor_kwargs"]["encoder"], ""]
            main(words)
        return [0, out.getvalue(), err.getvalue()]
    except SystemExit as stop:
        return [stop.code, out.getvalue(), err.getvalue()]
    except Exception as error:
        return [type(error).__name__, str(error), traceback.format_exc()]

print("ANSWERS", json.dumps([run(step) for step in json.loads(sys.argv[1])]))
"""
ME: dict[str, str] = {"HF_TOKEN": TOKEN}
Answer = tuple[Any, str, str]


def ask(hub_url: str, folder: Path, steps: list[list[Any]]) -> list[Answer]:
    environment = os.environ | {
        "HF_ENDPOINT": hub_url, "HF_HOME": str(folder / "cache"), "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1", "HF_HUB_DISABLE_TELEMETRY": "1",
    }  # fmt: skip
    words = [sys.executable, "-W", "ignore", "-c", SCRIPT, json.dumps(steps)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [tuple(answer) for answer in json.loads(done.stdout.partition("ANSWERS ")[2])]


@pytest.fixture(scope="module")
def talk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Hub, Path, dict[str, Answer]]:
    """What each step ended with."""
    folder = tmp_path_factory.mktemp("push")
    first, second = write(folder / "first.safetensors"), write(folder / "second.safetensors", objective="ssi")
    with hub_server() as hub:
        steps: dict[str, list[Any]] = {
            "no token": [{}, "push", "push", str(first), "me/enc", "--no-evidence"],
            "push": [ME, "push", "push", str(first), "me/enc", "--no-evidence", "--license", "mit"],
            "load": [{}, "load", "hf://me/enc"],
            "push again": [ME, "push", "push", str(second), "me/enc", "--no-evidence"],
            "load again": [{}, "load", "hf://me/enc"],
            "policy_kwargs": [{}, "policy_kwargs", "hf://me/enc"],
            "policy_kwargs of a file": [{}, "policy_kwargs", "hf://me/enc@main/model.safetensors"],
            "spec": [{}, "spec", "ssi=hf://me/enc"],
            "private": [ME, "push", "push", str(first), "me/secret", "--no-evidence", "--private"],
            "load private": [{}, "load", "hf://me/secret"],
            "load private as me": [ME, "load", "hf://me/secret"],
            "already public": [ME, "push", "push", str(first), "me/enc", "--no-evidence", "--private"],
            "of somebody else": [ME, "push", "push", str(first), "you/enc", "--no-evidence"],
            "wrong token": [{"HF_TOKEN": "hf_x"}, "push", "push", str(first), "me/enc", "--no-evidence"],
            "no such revision": [{}, "load", "hf://me/enc@v1"],
            "no such file": [{}, "load", "hf://me/enc/other.safetensors"],
            "export": [{}, "push", "export", "hf://me/absent", "-o", str(folder / "new.pt2")],
        }
        answers = dict(zip(steps, ask(hub.url, folder, list(steps.values())), strict=True))
        commits = list(hub.repositories["me/enc"].commits)
        # The first commit again, by its name, and what the Hub does not keep from executing.
        hub.repositories["me/enc"].commits["f" * 40] = {"model.safetensors": pickle.dumps({"a": 1}), "code.py": b"1/0"}
        more: dict[str, list[Any]] = {
            "load the first": [{}, "load", f"hf://me/enc@{commits[0]}"],
            "load a pickle": [{}, "load", "hf://me/enc"],
        }
        answers |= dict(zip(more, ask(hub.url, folder, list(more.values())), strict=True))
        hub.url = ""
    down: dict[str, list[Any]] = {
        "Hub is down": [ME, "push", "push", str(first), "me/enc", "--no-evidence"],
        "load while it is down": [{}, "load", f"hf://me/enc@{commits[0]}"],
    }
    answers |= dict(zip(down, ask("http://127.0.0.1:9", folder, list(down.values())), strict=True))
    return hub, folder, answers


Talk = tuple[Hub, Path, dict[str, Answer]]


def test_push_and_load_back(talk: Talk) -> None:
    hub, folder, answers = talk
    first, second = (load_encoder(folder / f"{name}.safetensors").hash for name in ("first", "second"))
    one, two, *_ = hub.repositories["me/enc"].commits
    for name, commit in (("push", one), ("push again", two)):
        assert answers[name][:2] == (0, f"Uploaded. Whoever names hf://me/enc@{commit} gets this very file\n")
    assert answers["load"][:2] == (0, first) and answers["load again"][:2] == (0, second)
    # A commit stays what it was.
    assert answers["load the first"][:2] == (0, first)
    assert answers["load while it is down"][:2] == (0, first)
    files = hub.repositories["me/enc"].commits[one]
    assert files.keys() == {"model.safetensors", "config.json", "README.md"}
    assert files["model.safetensors"] == (folder / "first.safetensors").read_bytes()
    assert b"license: mit\n" in files["README.md"]


def test_a_name_on_the_hub_gets_its_commit(talk: Talk) -> None:
    hub, _, answers = talk
    second = list(hub.repositories["me/enc"].commits)[1]
    for name in ("policy_kwargs", "policy_kwargs of a file", "spec"):
        assert answers[name][:2] == (0, f"hf://me/enc@{second}"), answers[name]


def test_private_stays_private(talk: Talk) -> None:
    hub, folder, answers = talk
    assert answers["private"][0] == 0 and hub.repositories["me/secret"].private
    assert not hub.repositories["me/enc"].private and len(hub.repositories["me/enc"].commits) == 3
    assert answers["load private"][0] == "EncoderNotFoundError"
    assert answers["load private as me"][:2] == (0, load_encoder(folder / "first.safetensors").hash)


def test_nothing_executes(talk: Talk) -> None:
    assert talk[2]["load a pickle"][0] == "EncoderFileError"
    assert "is a pickle, which is never read" in talk[2]["load a pickle"][1]


@pytest.mark.parametrize(
    ("name", "code", "message"),
    [
        ("no token", 2, "no token of the Hugging Face Hub; log in with `hf auth login`, or set HF_TOKEN"),
        ("already public", 2, "me/enc is there already, and public; leave out --private, or give another name"),
        ("of somebody else", 1, "the Hub did not take you/enc: "),
        ("wrong token", 1, "the Hub did not take me/enc: "),
        ("Hub is down", 1, "the Hub did not take me/enc: "),
        ("export", 2, "hf://me/absent could not be downloaded: "),
    ],
)
def test_mistakes_are_one_line(name: str, code: int, message: str, talk: Talk) -> None:
    answer = talk[2][name]
    assert answer[0] == code, answer
    assert message in answer[2] and len(answer[2].splitlines()) == 1, answer


def test_what_the_hub_does_not_have(talk: Talk) -> None:
    for name in ("no such revision", "no such file"):
        assert talk[2][name][0] == "EncoderNotFoundError" and "could not be downloaded" in talk[2][name][1]


def test_the_files_are_written_instead(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "mine.safetensors")
    main([str(path), "me/enc", "--no-evidence", "-o", str(tmp_path / "new" / "enc")])
    out = f"Wrote model.safetensors, config.json, README.md to {tmp_path}/new/enc; nothing was uploaded\n"
    assert capsys.readouterr().out == out
    assert load_encoder(tmp_path / "new" / "enc" / "model.safetensors").hash == load_encoder(path).hash
    config = json.loads((tmp_path / "new" / "enc" / "config.json").read_text())
    file = load_encoder(path)
    assert config["network"] == file.encoder.spec() and config["hash"] == file.hash
    assert {name: config[name] for name in ("env_id", "objective", "settings")} == {
        "env_id": "Nav2D-v0", "objective": "abisim", "settings": {},
    }  # fmt: skip
    assert config["features_dim"] == file.encoder.features_dim and config["dataset_hash"] == "0" * 64


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["me/enc"], "give --benchmark DIR, --probes JSON or both, or --no-evidence"),
        (["me/enc", "--probes", "x.json", "--no-evidence"], "give --benchmark DIR, --probes JSON or both, or"),
        (["enc", "--no-evidence"], "'enc' is no name on the Hub (one slash); give owner/name"),
        (["me/a/b", "--no-evidence"], "'me/a/b' is no name on the Hub (one slash); give owner/name"),
        (["me/a..b", "--no-evidence"], "'me/a..b' is no name on the Hub (Cannot have -- or .. in repo_id"),
        (["me/enc", "--probes", "x.json"], "No such file or directory: 'x.json'"),
        (["me/enc", "--benchmark", "absent"], "absent"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main([str(write(tmp_path / "mine.safetensors")), *words, "-o", "new"])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and message in err and len(err.splitlines()) == 1, err
    assert not (tmp_path / "new").exists()


def test_a_wrong_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.zip").write_bytes(b"PK\3\4 and so on, for as long as a header of eight bytes")
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path / "model.zip"), "me/enc", "--no-evidence", "-o", str(tmp_path / "new")])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and "a zip archive (a saved SB3 model" in err and len(err.splitlines()) == 1


def test_the_same_encoder_gives_the_same_files(tmp_path: Path) -> None:
    path = write(tmp_path / "mine.safetensors")
    assert repository(str(path), "me/enc") == repository(str(path), "me/enc")
