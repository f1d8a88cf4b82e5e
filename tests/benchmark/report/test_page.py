"""The page of a report, its figures and its files."""

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from benchmark_inputs import N_EPISODES
from PIL import Image

from sb3_abisim.benchmark.report.figures import MINUS, assign_colors
from sb3_abisim.benchmark.report.page import _verdict, report

pytestmark = pytest.mark.usefixtures("few_resamples")


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [str(value) for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_page_needs_no_other_file_and_says_how_it_was_evaluated(made: Path) -> None:
    page = Page((made / "index.html").read_text())
    text = re.sub(r"\s+", " ", " ".join(page.words))
    assert len(page.sources) == 6 and all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert "Evaluation during training is deterministic." in text and f"mean of {N_EPISODES} episodes" in text
    assert "Environments with splits are evaluated on the eval split, which training does not show." in text
    assert "sb3-abisim train --seed 1" in text
    assert "0.61 times the steps of ssi" in text
    assert (
        f"To the final return of vanilla ({MINUS}73.33), abisim takes ≤ 0.37 times the steps of vanilla: fewer" in text
    )
    assert f"To 70 % normalized return ({MINUS}38.4), abisim takes 0.61 times the steps of ssi" in text
    unreached = f"No run of any method reached 90 % normalized return ({MINUS}12.8) in PointMaze-v0."
    assert unreached in text and "no run reached it" not in text and "not reached" not in text
    # The final models of Distractor PointMaze with both policies, and on each split, the eval split first.
    assert f"abisim action-bisimulation {MINUS}21.0 ± 0.0 {MINUS}15.0 ± 0.0 2" in text
    assert f"environment method policy eval train clean DistractorPointMaze-v0 abisim deterministic {MINUS}21.0" in text
    assert "near the lowest" not in text
    for name in ("curves", "thresholds", "splits", "aggregates", "profiles", "improvement"):
        with Image.open(made / f"{name}.png") as image:
            assert len(image.convert("RGB").getcolors(1 << 24)) > 10, name


def test_a_method_has_the_same_color_in_every_report() -> None:
    everything = assign_colors(["abisim", "vanilla", "ssi", "acro", "curl", "beta_vae", "info_nce", "mine"])
    assert len(set(everything.values())) == 8
    two = assign_colors(["abisim,frozen", "ssi,frozen"])
    assert (two["abisim,frozen"], two["ssi,frozen"]) == (everything["abisim"], everything["ssi"])
    variants = assign_colors(["abisim=0ff2bc", "abisim=1bd228", "vanilla", "vanilla, 10,000", "ssi"])
    assert len(set(variants.values())) == 5
    assert (variants["vanilla"], variants["ssi"]) == (everything["vanilla"], everything["ssi"])


def test_the_same_runs_give_the_same_files(made: Path, logs: Path, tmp_path: Path) -> None:
    np.random.seed(77)
    report([str(logs)], tmp_path)
    for path in sorted(made.iterdir()):
        assert (tmp_path / path.name).read_bytes() == path.read_bytes(), path.name


@pytest.mark.parametrize(
    ("bound", "low", "high", "verdict"),
    [
        ("", 0.2, 0.8, "fewer"), ("<=", 0.2, 0.8, "fewer"), (">=", 0.2, 0.8, "no clear difference"),
        ("", 1.2, 1.8, "more"), (">=", 1.2, 1.8, "more"), ("<=", 1.2, 1.8, "no clear difference"),
        ("~", 0.2, 0.8, "no clear difference"), ("", 0.8, 1.2, "no clear difference"),
    ],
)  # fmt: skip
def test_a_bound_says_less_than_a_number(bound: str, low: float, high: float, verdict: str) -> None:
    assert _verdict({"bound": bound, "low": low, "high": high}) == verdict


def test_files_of_an_earlier_report_go(logs: Path, tmp_path: Path) -> None:
    report([str(logs)], tmp_path)
    (tmp_path / "mine.csv").write_text("kept")
    report([str(logs / "abisim")], tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert "curves.csv" in names and "mine.csv" in names and not names & {"thresholds.csv", "thresholds.png"}
