"""What files hold is shown, and does nothing else."""

import argparse

import pytest

from sb3_abisim.common.cli import make_parser, run
from sb3_abisim.common.text import printable, spreadsheet_cell


def test_control_characters_are_spelled_out() -> None:
    assert printable("a\x1b[31mb\x07\r\u202ec ü 漢\n") == "a\\x1b[31mb\\x07\\r\\u202ec ü 漢\\n"
    assert printable("a\nb\x1b", kept="\n") == "a\nb\\x1b"


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", " =1", "\uff1d1"])
def test_formulas_are_texts(text: str) -> None:
    assert spreadsheet_cell(text) == f"'{text}"


def test_other_cells_stay() -> None:
    assert [spreadsheet_cell(value) for value in (-1.5, 3, None, "abisim,frozen", "")] == [
        -1.5,
        3,
        None,
        "abisim,frozen",
        "",
    ]
    assert spreadsheet_cell("\t=1") == "\\t=1" and spreadsheet_cell("a\x00") == "a\\x00"


def test_messages_of_commands(capsys: pytest.CaptureFixture[str]) -> None:
    def fail(args: argparse.Namespace) -> None:
        raise ValueError("no file '\x1b]0;title\x07'")

    with pytest.raises(SystemExit):
        run(make_parser("x", "d", "x"), [], fail)
    assert capsys.readouterr().err == "sb3-abisim x: error: no file '\\x1b]0;title\\x07'\n"
