"""Imports by any reader: their options, and the report of what was understood."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sb3_abisim
from sb3_abisim import CUT, TERMINATED, TRUNCATED, Segment, import_dataset, register_reader, write_dataset
from sb3_abisim.data.command import main
from sb3_abisim.data.importing import import_report

SHAPE = (3, 5, 4)


def segment(n: int, end: int) -> Segment:
    frames = np.random.default_rng(n).integers(256, size=(n + 1, *SHAPE), dtype=np.uint8)
    return Segment(frames, np.arange(n) % 3, end, {"step": np.arange(n + 1.0), "pair": np.zeros((n + 1, 2), np.int32)})


def read(source: Any, folder: str, **options: Any) -> str:
    ends = [TERMINATED, TERMINATED, TRUNCATED, CUT] if source == "whole" else [CUT]
    segments = [segment(i + 2, end) for i, end in enumerate(ends)]
    said = {"channels": "last", "lossy": "a pencil", "left_out": ["rewards", "smells"]}
    spaces = gym.spaces.Box(0, 255, SHAPE, np.uint8), gym.spaces.Discrete(3)
    return write_dataset(
        folder,
        segments,
        env_id=options.get("env_id", "My-v0"),
        observation_space=spaces[0],
        action_space=spaces[1],
        source={"text": source, **(said if source == "whole" else {})},
    )


def read_strictly(source: str, folder: str, *, env_id: str = "Named-v0") -> str:
    return read("whole", folder, env_id=env_id)


def read_plainly(source: str, folder: str) -> str:
    return read("whole", folder)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    records = sb3_abisim.registry._READERS
    monkeypatch.setattr(records, "by_name", records.all())
    register_reader("test_any", read)
    register_reader("test_strict", read_strictly)
    register_reader("test_plain", read_plainly)


REPORT = """\
  environment   My-v0
  observations  uint8 (3, 5, 4), channels first (last in the source)
  actions       Discrete(3)
  episodes      4: 2 terminated, 1 truncated, 1 cut
  transitions   14
  factors       pair (2,), step
  lossy         yes, a pencil
  left out      rewards; smells"""


def test_an_import_ends_in_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hash = import_dataset("test_any", "whole", tmp_path / "d")
    title = f"{tmp_path / 'd'}: imported (hash {hash[:16]}); rewards were dropped"
    assert capsys.readouterr().out == f"{title}\n{REPORT}\n" == import_report(tmp_path / "d") + "\n"
    main(["import", "test_any", "whole", "-o", str(tmp_path / "command")])
    assert capsys.readouterr().out.splitlines()[1:] == REPORT.splitlines()
    import_dataset("test_any", "whole", tmp_path / "quiet", verbose=0)
    assert not capsys.readouterr().out


def test_what_a_reader_does_not_say_is_not_guessed(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="no episode ends among the 2 transitions"):
        import_dataset("test_any", "part", tmp_path / "d", verbose=0)
    report = import_report(tmp_path / "d")
    assert "lossy         the reader does not say" in report and "left out      the reader does not say" in report
    assert "(3, 5, 4), channels first\n" in report


def test_options_reach_the_reader(tmp_path: Path) -> None:
    main(["import", "test_strict", "x", "-o", str(tmp_path / "a"), "--env", "Other-v0"])
    main(["import", "test_strict", "x", "-o", str(tmp_path / "b")])
    ids = [sb3_abisim.TransitionDataset(tmp_path / name).env_id for name in "ab"]
    assert ids == ["Other-v0", "Named-v0"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["test_strict", "x", "--image-key", "camera"], "reader 'test_strict' takes no image_key; it takes env_id"),
        (["test_plain", "x", "--env", "A-v0"], "reader 'test_plain' takes no env_id; it takes no options"),
        (["absent", "x"], "unknown reader 'absent'; known are arrays, buffer, lerobot, minari"),
    ],
)
def test_options_that_a_reader_does_not_have(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main(["import", *words, "-o", str(tmp_path / "d")])
    assert exit_info.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_help_names_every_reader(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["import", "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    for name, reader in sb3_abisim.registry.readers().items():
        assert name in shown and " ".join(reader.help.split()) in shown
