"""The table that ``make bench`` ends with."""

from pathlib import Path

import pytest

from benchmarks import headline
from benchmarks.tables import read_table

PAGE = """# Speed

Text | with a bar.

| environment | copies | ratio |
|---|---:|---:|
| A | 1 | |
| A | 64 | 3.5 |

| another | table |
|---|---|
"""


def test_a_table_is_read_as_it_is_written() -> None:
    assert read_table(PAGE) == [
        {"environment": "A", "copies": "1", "ratio": ""},
        {"environment": "A", "copies": "64", "ratio": "3.5"},
    ]
    with pytest.raises(ValueError, match="without a table"):
        read_table("# Speed\n")


def test_the_committed_table_is_that_of_the_committed_pages() -> None:
    rows, _ = headline.lines()
    assert [line for line in headline.PAGE.read_text().splitlines() if line.startswith("| ")][1:] == rows, (
        "run python -m benchmarks.headline"
    )


def test_rows_come_from_their_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = headline.Row("waiting", "speed", ("A", "64"), ("copies", "steps/s"), "others", "ratio")
    monkeypatch.setattr(headline, "ROWS", (row, row._replace(page="times"), row._replace(page="later")))
    (tmp_path / "speed.md").write_text(PAGE)
    rows, absent = headline.lines(tmp_path)
    assert rows == ["| waiting | 64 steps/s | others | 3.5 | [speed](speed.md) |"]
    assert absent == ["make times", "python -m benchmarks.bench_later"]


@pytest.mark.parametrize(
    ("change", "what"),
    [({"first": ("B",)}, "has no row B"), ({"ratio": "speedup"}, "has no column speedup, only environment, copies")],
)
def test_a_row_that_is_not_there_is_an_error(
    change: dict[str, object], what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = headline.Row("waiting", "speed", ("A", "64"), ("copies", "steps/s"), "others", "ratio")
    monkeypatch.setattr(headline, "ROWS", (row._replace(**change),))
    (tmp_path / "speed.md").write_text(PAGE)
    with pytest.raises(ValueError, match=what):
        headline.lines(tmp_path)
