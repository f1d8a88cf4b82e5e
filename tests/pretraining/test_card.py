"""The model card: what it says, and that an encoder which has learned nothing is not handed over without a warning."""

import json
import re
import shlex
import warnings

import pytest
from pretrain_inputs import collect_grids, make_run

from sb3_abisim.__main__ import main as sb3_abisim
from sb3_abisim.common.cli import parse_pairs
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.card import read_card, warn_at_chance
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import pretrain
from sb3_abisim.pretraining.trainer import PretrainRun

# Learns nothing.
SETTINGS = {"n_updates": 10, "batch_size": 32, "log_interval": 5, "checkpoint_interval": 5, "learning_rate": 1e-9}

FORM = "objective_kwargs.adaptive:chance_corrected"
QUIET = {"device": "cpu", "progress_bar": False, "verbose": 0}


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


@pytest.mark.parametrize(
    ("objective", "given", "settings"),
    [
        ("ssi", {"l1_penalty": 0.01, "adaptive": "paper", "delta_scale": 1.0},
         f"objective_kwargs.l1_penalty:0.001 objective_kwargs.delta_scale:3.0 {FORM}"),
        ("acro", {"l1_penalty": 0.0, "adaptive": None, "delta_scale": 1.0}, "objective_kwargs.delta_scale:3.0"),
        ("ssi", {"l1_penalty": 0.001, "adaptive": None, "delta_scale": 7.0}, FORM),
        ("ssi", {"l1_penalty": 0.001, "adaptive": "chance_corrected", "delta_scale": 3.0}, ""),
        ("info_nce", {"l1_penalty": 0.1}, "objective_kwargs.l1_penalty:0"),
        ("info_nce", {}, ""),
    ],
)  # fmt: skip
def test_an_embedding_that_collapsed_is_refused_with_the_settings_to_try(
    data, tmp_path, monkeypatch, objective, given, settings
):
    plain = PretrainRun._update

    def collapse(self, batch):
        terms = plain(self, batch)
        for parameter in self.module.encoder.parameters():
            parameter.data.zero_()
        return terms

    monkeypatch.setattr(PretrainRun, "_update", collapse)
    words = "try more updates or another seed" + re.escape(f", or -params {settings} (each with base." * bool(settings))
    output = tmp_path / "e.safetensors"
    with pytest.raises(
        ValueError, match=f"the same for all observations: .*; name another output or remove .*, and {words}"
    ):
        pretrain(objective, data, output, {**SETTINGS, "n_updates": 1, "objective_kwargs": given}, **QUIET)
    assert not output.exists()
    # What it says can be typed.
    config = load_config(objective, "Nav2D-v0", parse_pairs(settings.split(), "-params"))
    assert all(word.partition(":")[0].partition(".")[2] in config.objective_kwargs for word in settings.split())


@pytest.mark.parametrize(("accuracy", "warns"), [(0.24, True), (0.37, True), (0.39, False), (0.95, False)])
def test_what_counts_as_guessing(data, accuracy, warns):
    run = make_run(data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # A hundred actions of the eval split: the standard error of a quarter is 0.043.
        warn_at_chance(run.output, run.module, run.config, [{"n_updates": 10, "eval/accuracy": accuracy}], 100, {})
    assert bool(caught) == warns


@pytest.mark.parametrize(
    ("preprocessing", "advised"), [({}, True), ({"frame_stack": 1}, True), ({"frame_stack": 3}, False)]
)
def test_stacks_are_advised_where_there_are_none(data, preprocessing, advised):
    run = make_run(data)
    with pytest.warns(UserWarning, match="no better than guessing") as caught:
        warn_at_chance(run.output, run.module, run.config, [{"eval/accuracy": 0.2}], 100, preprocessing)
    assert ("One frame may not tell the action" in str(caught[0].message)) == advised
    assert ("collect again with --frame-stack 4" in str(caught[0].message)) == advised


def test_guessing_among_the_keys_of_the_eval_split(data):
    # One in a hundred is far more than one in 256.
    run = make_run(data, "curl", batch_size=256)
    rows = [{"n_updates": 10, "eval/accuracy": 0.03}]
    with pytest.warns(UserWarning, match=r"no better than guessing \(0.01\)"):
        warn_at_chance(run.output, run.module, run.config, rows, 100, {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_at_chance(run.output, run.module, run.config, rows, 2000, {})


def test_the_commands_on_the_card_make_the_same_encoder(data, tmp_path):
    output = run(data, tmp_path / "ssi.safetensors")
    card = json.loads(output.with_suffix(".json").read_text())
    places = {"DATA": str(tmp_path / "data"), "FILE": str(tmp_path / "again.safetensors")}
    for command, more in zip(card["commands"], ([], ["--device", "cpu"]), strict=True):
        program, *words = [places.get(word, word) for word in shlex.split(command)]
        assert program == "sb3-abisim"
        sb3_abisim([*words, *more])
    assert (tmp_path / "again.safetensors").read_bytes() == output.read_bytes()


@pytest.mark.parametrize("content", ['{"precious": true}', "[1, 2]", "3", "not JSON"])
def test_a_file_in_the_place_of_the_card_is_not_replaced(data, tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ValueError, match=r"would replace .*config\.json, which is not one; name another output"):
        run(data, tmp_path / "config.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert (tmp_path / "config.json").read_text() == content


def test_a_card_with_the_names_of_another_version_is_read_as_todays(tmp_path):
    path = tmp_path / "card.json"
    path.write_text(
        json.dumps(
            {
                "settings": {"holdout": 0.1, "objective_kwargs": {"adaptive": "above_chance"}, "base_digest": "b"},
                "dataset": {"digest": "d", "fingerprint": None, "env_kwargs": {"recolour": False}, "n_transitions": 3},
                "metrics": {"n_updates": 4, "test/metric": 2.0},
                "curves": {"n_updates": [2, 4], "test/metric": [3.0, 2.0], "train/contrast": [1.0, 1.0]},
                "n_parameters": 5,
            }
        )
    )
    assert read_card(path) == {
        "settings": {"eval_fraction": 0.1, "objective_kwargs": {"adaptive": "chance_corrected"}, "base_hash": "b"},
        "dataset": {"hash": "d", "content_hash": None, "env_kwargs": {"color_jitter": False}, "n_transitions": 3},
        "metrics": {"n_updates": 4, "eval/metric_loss": 2.0},
        "curves": {"n_updates": [2, 4], "eval/metric_loss": [3.0, 2.0], "train/info_nce": [1.0, 1.0]},
        "n_parameters": 5,
    }


def test_a_new_card_is_read_as_it_was_written(data, tmp_path):
    path = run(data, tmp_path / "ssi.safetensors", learning_rate=1e-3).with_suffix(".json")
    card = json.loads(path.read_text())
    assert read_card(path) == card
    dataset = TransitionDataset(data)
    assert card["dataset"] == {
        "hash": dataset.hash,
        "content_hash": None,
        "env_id": "Nav2D-v0",
        "env_kwargs": {},
        "n_transitions": 2000,
    }


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"settings": 3}'])
def test_a_damaged_card_is_refused(tmp_path, content):
    (tmp_path / "card.json").write_text(content)
    with pytest.raises(ValueError, match=r"model card .*card\.json is damaged .*; copy or pretrain it again"):
        read_card(tmp_path / "card.json")
    with pytest.raises(FileNotFoundError):
        read_card(tmp_path / "absent.json")
