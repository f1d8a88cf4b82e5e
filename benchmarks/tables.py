"""What the benchmarks share: one core, and a page with a table."""

import os
import platform
from pathlib import Path


def use_one_core() -> None:
    """Keep this process on one core and its libraries on one thread; call it before they are imported."""
    os.environ["OMP_NUM_THREADS"] = "1"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def machine() -> str:
    """For the text above a table."""
    return f"one core of {platform.machine()}, Python {platform.python_version()}"


def write_page(
    path: Path, title: str, text: str, header: list[str], rows: list[str], tail: tuple[str, ...] = ()
) -> None:
    """Write and print a page of Markdown.

    :param path: the file; its folder is made
    :param title: of the page
    :param text: what was measured, and how
    :param header: the table's two first lines
    :param rows: the others
    :param tail: lines after the table
    """
    page = "\n".join([f"# {title}", "", text, "", *header, *rows, "", *tail])
    print(page)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page)
