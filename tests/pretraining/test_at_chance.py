"""An encoder that has learned nothing is not handed over without a word; memory is kept from the start."""

import warnings

import pytest
from pretrain_inputs import collect_grids

from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import pretrain
from sb3_abisim.pretraining.trainer import PretrainRun

# Learns nothing.
SETTINGS = {"n_updates": 10, "batch_size": 32, "log_interval": 5, "checkpoint_interval": 5, "learning_rate": 1e-9}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return collect_grids(tmp_path_factory)


def run(data, output, **settings):
    config = load_config("ssi", "Nav2D-v0", {**SETTINGS, **settings})
    return pretrain("ssi", data, output, config, device="cpu", progress_bar=False, verbose=0)


@pytest.mark.parametrize(("eval_fraction", "name"), [(0.05, "eval/accuracy"), (0.0, "train/accuracy")])
def test_warns_when_nothing_was_learned(data, tmp_path, eval_fraction, name):
    with pytest.warns(UserWarning, match=rf"ssi.safetensors: {name} .* no better than guessing \(0.25\)"):
        output = run(data, tmp_path / "ssi.safetensors", eval_fraction=eval_fraction)
    assert load_encoder(str(output)).metadata["objective"] == "ssi"


@pytest.mark.parametrize(("accuracy", "warns"), [(0.24, True), (0.37, True), (0.39, False), (0.95, False)])
def test_what_counts_as_guessing(data, tmp_path, accuracy, warns):
    # A hundred held-out actions: the standard error of a quarter is 0.043.
    config = load_config("ssi", "Nav2D-v0", SETTINGS)
    pretraining = PretrainRun("ssi", TransitionDataset(data), tmp_path / "x.safetensors", config, None, 0, "cpu")
    pretraining.rows = [{"n_updates": 10, "eval/accuracy": accuracy}]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pretraining._warn_at_chance()
    assert bool(caught) == warns


def test_guessing_among_the_keys_that_are_held_out(data, tmp_path):
    # A hundred or so: one in their number is far more than one in 256.
    config = load_config("curl", "Nav2D-v0", {**SETTINGS, "batch_size": 256})
    pretraining = PretrainRun("curl", TransitionDataset(data), tmp_path / "x.safetensors", config, None, 0, "cpu")
    pretraining.rows = [{"n_updates": 10, "eval/accuracy": 0.03}]
    with pytest.warns(UserWarning, match="no better than guessing"):
        pretraining._warn_at_chance()


def test_pretraining_keeps_freed_memory(data, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr("sb3_abisim.common.malloc.keep_freed_memory", lambda: calls.append(True))
    with pytest.warns(UserWarning, match="guessing"):
        run(data, tmp_path / "ssi.safetensors")
    assert calls
