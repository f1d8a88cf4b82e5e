"""The notebooks run, with small budgets, and hold what they showed with their own."""

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = {path.stem: path for path in sorted((ROOT / "notebooks").glob("*.ipynb"))}
# Share of each budget: the code is the same, and all of them together take about a minute of one core.
SCALE = "0.02"
MAX_BYTES = 1_500_000
SECONDS = 600
# What may hold a digit in prose: code, commands, and names.
CODE = re.compile(r"^ {4}.*$|`[^`]*`|\b(?:Nav2D|Stable-Baselines3)\b", re.MULTILINE)


def read(name: str) -> Any:
    return nbformat.read(NOTEBOOKS[name], as_version=4)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_it_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SB3_ABISIM_NOTEBOOK_SCALE", SCALE)
    monkeypatch.setenv("SB3_ABISIM_CACHE", str(tmp_path / "cache"))
    notebook = read(name)
    for cell in notebook.cells:
        cell.pop("outputs", None)
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    # In a folder of its own; an exception in a cell is one here.
    NotebookClient(notebook, timeout=SECONDS, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert kinds(notebook) == kinds(read(name)), "another kind of output than the stored one: run the notebook again"


def kinds(notebook: Any) -> list[set[str]]:
    """What each cell puts out: text, and the types of its figures. Warnings are left out, as budgets differ."""
    return [
        {
            kind
            for output in cell.get("outputs", [])
            for kind in (output.get("data") or ({"text"} if output.get("name") == "stdout" else ()))
        }
        for cell in notebook.cells
    ]


def test_there_are_six() -> None:
    assert [name[:2] for name in NOTEBOOKS] == [f"{number}_" for number in range(1, 7)]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_it_is_stored_as_it_ran(name: str) -> None:
    assert NOTEBOOKS[name].stat().st_size < MAX_BYTES
    notebook = read(name)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    text = "".join(output.get("text", "") for output in outputs)
    assert "Warning" not in text and str(ROOT) not in text
    assert any("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_numbers_are_printed_and_not_typed(name: str) -> None:
    prose = [cell.source for cell in read(name).cells if cell.cell_type == "markdown"]
    typed = [line for text in prose for line in CODE.sub("", text).splitlines() if re.search(r"\d", line)]
    assert not typed


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_pages_that_it_names_are_there(name: str) -> None:
    prose = "\n".join(cell.source for cell in read(name).cells if cell.cell_type == "markdown")
    for page in re.findall(r"`(docs/[^`]*)`", prose):
        assert (ROOT / page).is_file(), page
