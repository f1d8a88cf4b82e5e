"""Texts from files of others, made harmless where they are shown: on a terminal, in a spreadsheet, on a page."""

from typing import Any


def printable(text: str, kept: str = "") -> str:
    """A text whose control characters are spelled out, so that a terminal does nothing but show it.

    :param text: any
    :param kept: control characters that stay, such as "\\n"
    """
    return "".join(letter if letter.isprintable() or letter in kept else _spelled(letter) for letter in text)


def _spelled(letter: str) -> str:
    return letter.encode("unicode_escape").decode()


def spreadsheet_cell(value: Any) -> Any:
    """A value of a CSV that no spreadsheet takes for a formula.

    :param value: a number stays; a text that begins as a formula does gets an apostrophe in front
    """
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.lstrip()[:1] in tuple("=+-@\uff1d\uff0b\uff0d\uff20") else text
