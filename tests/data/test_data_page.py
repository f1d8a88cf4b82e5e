"""Every command and every snippet of "Import" in docs/data.md runs as it stands there."""

import re
import shlex
from pathlib import Path

import pytest
from lerobot_inputs import write_lerobot

from sb3_abisim import TransitionDataset, collect
from sb3_abisim.__main__ import main

ROOT = Path(__file__).resolve().parents[2]


def sections() -> dict[str, str]:
    """The parts of "Import" by their headings."""
    text = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    parts = re.split(r"^### (.+)\n", text[text.index("## Import\n") :], flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path


def run(section: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run all blocks of a section, one after the other, and give what they print."""
    blocks = re.findall(r"^```(python)?\n(.*?)^```", sections()[section], flags=re.MULTILINE | re.DOTALL)
    assert blocks
    for language, text in blocks:
        if language:
            exec(compile(text, section, "exec"), {})
            continue
        for line in text.splitlines():
            words = shlex.split(line)
            assert words[0] in ("sb3-abisim", "pip"), line
            if words[0] == "sb3-abisim":
                main(words[1:])
    return capsys.readouterr().out


def test_every_reader_has_a_section() -> None:
    assert list(sections()) == ["Episodes as NumPy arrays", "Buffers of Stable-Baselines3", "LeRobot", "Minari"]


def test_arrays(capsys: pytest.CaptureFixture[str]) -> None:
    shown = run("Episodes as NumPy arrays", capsys)
    assert TransitionDataset("data/mine").n_transitions == 500
    assert TransitionDataset("data/walk").n_transitions == 50
    assert shown.count("channels first (last in the source)") == 2 and "10: 0 terminated, 10 truncated" in shown


def test_buffers(capsys: pytest.CaptureFixture[str]) -> None:
    shown = run("Buffers of Stable-Baselines3", capsys)
    assert TransitionDataset("data/seen").n_transitions == 300
    assert "environment   PointMaze-v0" in shown


def test_lerobot(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_lerobot(folder / "my_arm")
    # But for the hash: another codec's version would make another one.
    title, *report = run("LeRobot", capsys).splitlines()
    page = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    assert title.startswith("data/arm: imported (hash ") and "\n".join(report) in page


def test_minari(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("minari")
    collect("Nav2D-v0", 100, "data/distractor", n_envs=4)
    shown = run("Minari", capsys)
    assert "environment   Nav2D-v0" in shown and "lossy         no" in shown
