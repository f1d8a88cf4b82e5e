"""Texts of files in Markdown, shown as they are."""

from collections.abc import Iterable, Sequence

from sb3_abisim.common.text import printable

_MARKUP = "\\`*_[]|#~!()"


def inert(text: object) -> str:
    """A text as Markdown: no markup, no HTML, no link.

    :param text: anything; its ``str`` is shown
    """
    shown = printable(str(text)).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # Of an address, Markdown makes a link by itself.
    shown = shown.replace("://", "&#58;//").replace("www.", "www&#46;").replace("@", "&#64;")
    return "".join(f"\\{letter}" if letter in _MARKUP else letter for letter in shown).strip()


def code_block(language: str, lines: Iterable[str]) -> list[str]:
    """Lines as they are, in a fence that is longer than any in them.

    :param language: that they are in; "" for none
    :param lines: of files; control characters are spelled out
    """
    lines = [printable(line) for line in lines]
    fence = "`" * max(3, *(line.count("`") + 1 for line in lines), 3)
    return [f"{fence}{language}", *lines, fence, ""]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table.

    :param head: Markdown, one cell for each column
    :param rows: of Markdown, too; texts of files go through :func:`inert` before
    """
    return ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)] + [""]
