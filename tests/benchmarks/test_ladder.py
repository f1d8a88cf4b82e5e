"""The agreement of read-outs and returns."""

import json

import numpy as np
import pytest

from benchmarks import ladder
from benchmarks.ladder import correlation, returns_by_encoder


def test_the_correlation_of_ranks_and_its_interval():
    x = np.arange(12.0)
    rho, low, high = correlation(x, x**3)
    assert (rho, low, high) == pytest.approx((1.0, 1.0, 1.0))
    noise = np.random.default_rng(1).permutation(12).astype(float)
    rho, low, high = correlation(x, noise)
    assert low < rho < high and high - low > 0.5


@pytest.fixture()
def runs(tmp_path, monkeypatch):
    for name, hash, value in (("a", "x", -3.0), ("b", "x", -5.0), ("c", "y", -7.0), ("d", None, 0.0), ("e", "z", -6.0)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "final_evaluations.npz").touch()
        (folder / "is").write_text(f"{hash},{value}")

    class Read:
        def __init__(self, folder):
            hash, value = (folder / "is").read_text().split(",")
            self.record = type("Record", (), {"encoder_hash": None if hash == "None" else hash})
            self.value = float(value)

        def final(self):
            # The order on the split "eval" is the opposite.
            return {
                "stochastic/standard/results": np.full(4, self.value),
                "stochastic/eval/results": -np.full(4, self.value),
            }

    monkeypatch.setattr("benchmarks.ladder.read_run", Read)
    return tmp_path


def test_returns_are_means_over_the_runs_of_an_encoder_and_their_absence_is_an_error(runs):
    assert returns_by_encoder([runs]) == {"x": -4.0, "y": -7.0, "z": -6.0}
    assert returns_by_encoder([runs], "eval") == {"x": 4.0, "y": 7.0, "z": 6.0}
    with pytest.raises(ValueError, match="no finished runs with an encoder"):
        returns_by_encoder([runs / "d"])
    with pytest.raises(ValueError, match=r"has no split .clean. but .*; give --splits"):
        returns_by_encoder([runs], "clean")


def test_the_page_has_a_row_for_each_read_out_and_a_pair_of_columns_for_each_split(runs, monkeypatch):
    scores = {"x": (0.9, 0.1), "y": (0.1, 0.3), "z": (0.5, 0.2), "without runs": (0.0, 0.0)}
    encoders = {
        hash: {"hash": hash, "scores": {"train clips": {"optimal_action": a}, "eval clips": {"optimal_action": b}}}
        for hash, (a, b) in scores.items()
    }
    (runs / "readouts.json").write_text(json.dumps({"env_id": "Maze-v0", "encoders": encoders}))
    words = ["ladder", str(runs / "readouts.json"), str(runs), "--splits", "standard", "eval", "-o", str(runs / "x.md")]
    monkeypatch.setattr("sys.argv", words)
    ladder.main()
    page = (runs / "x.md").read_text()
    assert "over 3 encoders of Maze-v0" in page
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:1] == "|"]
    assert rows[0] == ["read-out", "return, standard", "95 % interval", "return, eval", "95 % interval"]
    assert [(row[0], row[1], row[3]) for row in rows[2:]] == [
        ("optimal_action, train clips", "1.00", "-1.00"), ("optimal_action, eval clips", "-1.00", "1.00"),
    ]  # fmt: skip
