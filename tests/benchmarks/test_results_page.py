"""The tables of docs/ say what the committed runs say."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from benchmarks import results_page

RESULTS = results_page.ROOT / "docs" / "results.md"
APPENDIX = results_page.ROOT / "docs" / "results_appendix.md"
OTHERS = results_page.ROOT / "docs" / "others.md"
IMAGES = results_page.ROOT / "docs" / "images"
SPEC = {"runs": ["nav2d_dqn_target"], "reference": "abisim"}


@pytest.mark.parametrize("path", results_page.pages(), ids=lambda path: path.name)
def test_tables_are_those_of_the_committed_runs(path: Path) -> None:
    text = path.read_text()
    assert results_page.fill(text) == text, f"run python -m benchmarks.results_page {path}"


@pytest.mark.parametrize("path", [RESULTS, APPENDIX], ids=lambda path: path.name)
def test_a_page_of_results_types_no_number_that_its_tables_and_commands_lack(path: Path) -> None:
    """Section by section: a number of two digits or more in prose is in a table or a command."""
    free = []
    for section in re.split(r"^## ", path.read_text(), flags=re.MULTILINE)[1:]:
        given = "\n".join(line for line in section.splitlines() if line.startswith(("|", "    ")))
        prose = re.sub(r"<!--.*?-->", "", section, flags=re.DOTALL)
        prose = "\n".join(line for line in prose.splitlines() if not line.startswith(("|", "    ")))
        known = {number.replace(",", "") for number in re.findall(r"\d[\d.,]*\d", given)}
        numbers = re.findall(r"\d[\d.,]*\d", re.sub(r"\]\(.*?\)|`.*?`", "", prose))
        free += [number for number in numbers if number.replace(",", "").rstrip(".") not in known]
    assert not free


def test_figures_are_drawn_from_the_tables_of_their_pages() -> None:
    shown, drawn = set(), []
    for path in (RESULTS, APPENDIX, OTHERS):
        text = path.read_text()
        shown |= set(re.findall(r"\(images/comparison-(.*?)\.png\)", text))
        drawn += [spec["figure"] for match in results_page.TABLE.finditer(text)
                  if "figure" in (spec := yaml.safe_load(match[2]))]  # fmt: skip
    assert len(drawn) == len(set(drawn))
    assert shown == set(drawn) == {path.stem.removeprefix("comparison-") for path in IMAGES.glob("comparison-*.png")}


def test_curves_are_those_of_the_rows_under_their_names(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.figure import Figure

    legends = []
    legend = Figure.legend
    monkeypatch.setattr(
        Figure, "legend", lambda self, *args, **kwargs: legends.append(args) or legend(self, *args, **kwargs)
    )
    rows = {"vanilla": "from scratch", "acro": "ACRO"}
    image = results_page.draw({**SPEC, "reference": "vanilla", "rows": rows, "columns": ["area"]})
    assert image.startswith(b"\x89PNG")
    ((lines, names),) = legends
    assert names == ["from scratch", "ACRO"]
    assert len({line.get_color() for line in lines}) == 2
    assert len(lines[0].axes.lines) == 2, "methods without a row are drawn, too"


def test_a_table_over_comparisons_says_what_was_not_run() -> None:
    one = {"runs": ["nav2d_dqn_target"], "columns": ["return stochastic/standard"], "rows": {"A": "abisim", "S": "ssi"}}
    two = {"runs": ["nav2d_dqn_long"], "columns": [{"area": "mean"}], "rows": {"V": "vanilla", "A": "abisim"}}
    lines = results_page.table({"parts": [one, two]}).splitlines()
    alone = [results_page.table({**p, "rows": {b: a for a, b in p["rows"].items()}}).splitlines() for p in (one, two)]
    assert lines[0] == "| | final return, stochastic | mean |"
    cells = {row[1]: row for row in ([cell.strip() for cell in line.split("|")] for line in lines[2:])}
    assert list(cells) == ["A", "S", "V"]
    assert cells["S"][3] == cells["V"][2] == "not run"
    assert f"| A | {cells['A'][2]} |" in alone[0] and f"| A | {cells['A'][3]} |" in alone[1]
    assert f"| V | {cells['V'][3]} |" in alone[1]
    with pytest.raises(ValueError, match="a table has no figure"):
        results_page.table({"parts": [{**one, "figure": "x"}]})


def test_without_columns_there_is_no_table() -> None:
    text = f"<!-- table\n{yaml.safe_dump({**SPEC, 'figure': 'nav2d'})}-->\n<!-- end -->"
    assert results_page.fill(text) == text


def test_a_wrong_number_in_a_table_is_mended() -> None:
    text = RESULTS.read_text()
    number = re.search(r"\| (-\d+\.\d) ± ", text)[1]
    assert results_page.fill(text.replace(number, "-0.1", 1)) == text


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"columns": ["speed 0.5"]}, "a column is one of .*, got 'speed'"),
        ({"columns": ["area"], "rows": {"dreamer": "Dreamer"}}, "no runs of dreamer; there are abisim"),
        ({"columns": ["area"], "size": 3}, "a table has no size"),
        ({"columns": ["return stochastic/nowhere"]}, "a run of vanilla has no final results of 'stochastic/nowhere'"),
    ],
)
def test_a_table_that_cannot_be_made_says_why(change: dict[str, object], what: str) -> None:
    text = f"<!-- table\n{yaml.safe_dump({**SPEC, **change})}-->\n<!-- end -->"
    with pytest.raises(ValueError, match=what):
        results_page.fill(text)


def test_steps_that_not_all_runs_reach_are_bounds() -> None:
    spec = {
        **SPEC,
        "rows": {"abisim": "A", "acro": "ACRO", "vanilla": "scratch"},
        "columns": ["steps 0.7", "ratio 0.7"],
    }
    lines = results_page.table(spec).splitlines()
    assert lines[2].split("|")[3].strip() == "1"
    assert "runs reach it" in lines[3] or "not within" in lines[3]
    assert "not within 200,000" in lines[4]
    assert lines[4].split("|")[3].strip().startswith(("at most", "neither"))


def test_what_the_commands_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(name: str, kind: str, settings: dict[str, Any], **more: Any) -> None:
        path = tmp_path / "comparison" / "small" / "jobs" / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        job = {"kind": kind, "settings": settings, "output": f"made/{name}.safetensors", **more}
        path.write_text(json.dumps(job))

    monkeypatch.setattr(results_page, "RESULTS", tmp_path)
    monkeypatch.setattr(results_page, "RUNS", tmp_path / "comparison")
    write("data-1", "data", {"n_transitions": 5000}, processor_seconds=12.4, memory_mib=400)
    for seed, (seconds, memory) in enumerate([(10.0, 2000), (20.0, 1500)]):
        settings = {"objective": "ssi", "n_updates": 600, "batch_size": 128, "seed": seed}
        write(f"ssi-{seed}", "encoder", settings, processor_seconds=seconds, memory_mib=memory)
    write("run-1", "run", {"algo": "ppo", "method": "vanilla", "hyperparams": {"n_timesteps": 1000}}, seconds=3.0)
    write("final-1", "final", {"n_episodes": 5}, processor_seconds=99.0)
    encoders = {
        f"files/ssi-{seed}.safetensors": {"curves": {"eval/accuracy": [0.1, reached]}}
        for seed, reached in ((0, 0.5), (1, 0.7))
    }
    encoders["files/other.safetensors"] = {"curves": {"train/loss": [1.0]}}
    (tmp_path / "curves-small.json").write_text(json.dumps({"encoders": encoders}))
    lines = results_page.table({"costs": "small", "curves": "curves-small"}).splitlines()
    assert lines[2] == "| `collect` 5,000 transitions | 12 | 400 |  | 1 |"
    assert re.fullmatch(
        r"\| `pretrain` ssi, 600 updates of 128 \| 15 ± \d+ \| 2,000 \| 0\.60 ± 1\.27 \| 2 \|", lines[3]
    )
    assert lines[4] == "| `train` ppo on vanilla, 1,000 steps |  |  |  | 1 |"
    assert len(lines) == 5
