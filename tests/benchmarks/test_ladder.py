"""The agreement of read-outs and returns."""

import numpy as np
import pytest

from benchmarks.ladder import correlation, returns_by_encoder


def test_the_correlation_of_ranks_and_its_interval():
    x = np.arange(12.0)
    rho, low, high = correlation(x, x**3)
    assert (rho, low, high) == pytest.approx((1.0, 1.0, 1.0))
    noise = np.random.default_rng(1).permutation(12).astype(float)
    rho, low, high = correlation(x, noise)
    assert low < rho < high and high - low > 0.5


def test_returns_are_means_over_the_runs_of_an_encoder_and_their_absence_is_an_error(tmp_path, monkeypatch):
    for name, hash, value in (("a", "x", -3.0), ("b", "x", -5.0), ("c", "y", -7.0), ("d", None, 0.0)):
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
            return {"stochastic/standard/results": np.full(4, self.value)}

    monkeypatch.setattr("benchmarks.ladder.read_run", Read)
    assert returns_by_encoder([tmp_path]) == {"x": -4.0, "y": -7.0}
    with pytest.raises(ValueError, match="no finished runs with an encoder"):
        returns_by_encoder([tmp_path / "d"])
