"""What the benchmarks share: one core, and a page with a table."""

import itertools
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
    core = f"one core of {platform.machine()}, Python {platform.python_version()}"
    # Other work also costs processor time: it takes caches and memory.
    return (
        f"{core}, load average {os.getloadavg()[0]:.0f} on {os.cpu_count()} cores"
        if hasattr(os, "getloadavg")
        else core
    )


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


def read_table(page: str) -> list[dict[str, str]]:
    """The first table of a page of Markdown.

    :param page: its text
    :return: of each row, header to cell
    :raises ValueError: for a page without a table
    """
    lines = page.splitlines()
    start = next((i for i, line in enumerate(lines) if line.startswith("|---")), None)
    if start is None:
        raise ValueError("a page without a table")
    table = itertools.takewhile(lambda line: line.startswith("|"), lines[start - 1 :])
    header, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    return [dict(zip(header, row, strict=True)) for row in rows]
