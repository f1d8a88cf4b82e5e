"""The one command: its list, its start, its mistakes."""

import re
import subprocess
import sys
from importlib import metadata

import pytest

from sb3_abisim import __version__
from sb3_abisim.__main__ import COMMANDS, main, usage
from sb3_abisim.registry import methods

# What takes long to import, and is not needed to answer --help.
HEAVY = ("torch", "stable_baselines3", "rl_zoo3", "matplotlib", "pandas", "scipy", "mujoco")


def test_the_console_script_is_the_command() -> None:
    (script,) = metadata.entry_points(group="console_scripts", name="sb3-abisim")
    assert script.value == "sb3_abisim.__main__:main"


def test_help_lists_every_command_with_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["-h"]):
        main(words)
        assert capsys.readouterr().out.strip() == usage()
    for name in COMMANDS:
        assert re.search(rf"^  {name} ", usage(), re.MULTILINE)
    assert "example: sb3-abisim " in usage()


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_has_help_with_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        main([command, "--help"])
    except SystemExit as stop:
        assert not stop.code
    out = capsys.readouterr().out
    assert f"example: sb3-abisim {command} " in out
    # rl-zoo3 has its own word for it, which `train --help` and `enjoy --help` name.
    assert "--packages" in out or command == "zoo"


def test_help_names_every_objective(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["pretrain", "--help"])
    out = capsys.readouterr().out
    assert not [
        name for name, method in methods().items() if method.is_pretrained and not re.search(rf"\b{name}\b", out)
    ]


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--version"])
    assert capsys.readouterr().out == f"sb3-abisim {__version__}\n"


@pytest.mark.parametrize(("word", "hint"), [("colect", "did you mean collect?"), ("xyz", "known are collect, ")])
def test_an_unknown_command_is_one_line(word: str, hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([word])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and len(err.splitlines()) == 1
    assert f"unknown command {word!r}; {hint}" in err


@pytest.mark.parametrize("words", [["--help"], ["collect", "--help"], ["pretrain", "--help"], ["benchmrk"]])
def test_nothing_heavy_is_imported_for_help(words: list[str]) -> None:
    """Half a second; a timed test would depend on the machine."""
    code = (
        "import sys\nfrom sb3_abisim.__main__ import main\n"
        f"try:\n    main({words!r})\nexcept SystemExit:\n    pass\n"
        f"print('loaded', [name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "loaded []"
