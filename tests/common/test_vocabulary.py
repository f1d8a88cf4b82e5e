"""Old names inside files are read as today's, and today's stay as they are."""

import pytest

from sb3_abisim.common.vocabulary import (
    current_dataset,
    current_env_kwargs,
    current_result,
    current_scan_map,
    current_settings,
    current_term,
)

SETTINGS = {
    "run_length": 8,
    "holdout": 0.05,
    "base_digest": "b",
    "dataset_digest": "d",
    "network": None,
    "k": [1, 5],
    "objective_kwargs": {"change_weight": 3.0, "adaptive": "above_chance", "expectation": "behaviour", "pairs": "near"},
}
TODAY = {
    "chunk_length": 8,
    "eval_fraction": 0.05,
    "base_hash": "b",
    "dataset_hash": "d",
    "network": None,
    "k": [1, 5],
    "objective_kwargs": {
        "delta_scale": 3.0,
        "adaptive": "chance_corrected",
        "expectation": "behavior",
        "pairs": "nearest",
    },
}


def test_settings():
    assert current_settings(SETTINGS) == current_settings(TODAY) == TODAY
    # A value is renamed for its setting alone.
    assert current_settings({"name": "near"}) == {"name": "near"}


def test_env_kwargs():
    assert current_env_kwargs({"recolour": False, "split": "eval"}) == {"color_jitter": False, "split": "eval"}


def test_scan_map():
    assert current_scan_map({"metres_per_pixel": 0.05}) == current_scan_map({"meters_per_pixel": 0.05})


def test_dataset():
    old = {"digest": "d", "fingerprint": "f", "env_id": "Nav2D-v0", "env_kwargs": {"recolour": True}}
    today = {"hash": "d", "content_hash": "f", "env_id": "Nav2D-v0", "env_kwargs": {"color_jitter": True}}
    assert current_dataset(old) == current_dataset(today) == today


@pytest.mark.parametrize(
    ("old", "today"),
    [
        ("test/metric", "eval/metric_loss"),
        ("train/prediction", "train/inverse_nll"),
        ("contrast", "info_nce"),
        ("exact/size", "exact/size"),
        ("n_updates", "n_updates"),
    ],
)
def test_terms(old, today):
    assert current_term(old) == current_term(today) == today


def test_results():
    assert current_result("sampled/eval/results") == "stochastic/eval/results"
    assert current_result("deterministic/eval/results") == "deterministic/eval/results"
