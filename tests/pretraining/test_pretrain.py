"""Pretraining and its command: what it writes, and that it refuses what does not fit."""

import json

import numpy as np
import pytest
import torch as th
from gymnasium.spaces import Box, Discrete
from pretrain_inputs import SETTINGS, collect_grids, run

from sb3_abisim.data.collect import collect
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import TERMINATED
from sb3_abisim.data.writer import Segment, write_dataset
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.card import read_card
from sb3_abisim.pretraining.config import PretrainConfig, load_config
from sb3_abisim.pretraining.pretrain import main, pretrain


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return collect_grids(tmp_path_factory)


def test_writes_encoder_card_and_log(data, tmp_path):
    output = run(data, tmp_path / "ssi.safetensors")
    file = load_encoder(str(output))
    assert file.metadata["objective"] == "ssi" and file.metadata["env_id"] == "Nav2D-v0"
    card = json.loads(output.with_suffix(".json").read_text())
    assert card["curves"]["n_updates"] == [5, 10, 15, 20, 25, 30]
    assert card["metrics"]["eval/accuracy"] == card["curves"]["eval/accuracy"][-1]
    assert card["settings"]["batch_size"] == 32
    log = output.with_suffix(".run") / "progress.csv"
    assert len(log.read_text().splitlines()) == 7
    assert not list(output.with_suffix(".run").glob("checkpoint*")), "checkpoints go when the run is over"
    assert list(output.with_suffix(".run").glob("events.out.tfevents*"))


def test_settings_in_a_dictionary_replace_those_of_the_file(data, tmp_path):
    quick = {"n_updates": 2, "batch_size": 16, "objective_kwargs.delta_scale": 2.0}
    output = pretrain("ssi", data, tmp_path / "ssi.safetensors", quick, progress_bar=False, verbose=0)
    settings = load_encoder(output).metadata["settings"]
    expected = load_config("ssi", "Nav2D-v0", quick).as_settings()
    assert {key: settings[key] for key in expected} == expected
    assert settings["objective_kwargs"]["delta_scale"] == 2.0 and settings["objective_kwargs"]["l1_penalty"] == 0.001


def test_abisim_trains_its_base_first(data, tmp_path, monkeypatch):
    small = load_config("ssi", "Nav2D-v0", SETTINGS)
    monkeypatch.setattr("sb3_abisim.pretraining.pretrain.load_config", lambda *args: small)
    output = run(data, tmp_path / "abisim.safetensors", "abisim")
    base = load_encoder(str(tmp_path / "abisim.base.safetensors"))
    metadata = load_encoder(str(output)).metadata
    assert base.metadata["objective"] == "ssi" and metadata["objective"] == "abisim"
    assert metadata["settings"]["base_hash"] == base.hash


def test_no_updates_make_the_control_of_an_encoder(data, tmp_path):
    """Goal progress without an update: the base's convolutions and an untrained layer, standardized."""
    base = run(data, tmp_path / "ssi.safetensors")
    config = {**SETTINGS, "n_updates": 0, "network_kwargs.hidden_dim": 24, "objective_kwargs.n_goals": 4}
    output = tmp_path / "control.safetensors"
    for _ in range(2):  # the second finds it finished
        pretrain("goal_progress", data, output, config, base=str(base), progress_bar=False, verbose=0)
    control, trained = load_encoder(output).encoder, load_encoder(base).encoder
    shared = dict(trained.layers.named_parameters())
    assert shared and all(th.equal(own, shared[n]) for n, own in control.layers.named_parameters() if n in shared)
    dataset = TransitionDataset(data, eval_fraction=SETTINGS.get("eval_fraction", 0.05))
    frames = th.as_tensor(dataset.frames(dataset.valid_starts(split="train"))).float() / 255
    with th.no_grad():
        assert control(frames).shape == (len(frames), 24) and 0.8 < control(frames).var(dim=0).mean() < 1.25
    assert read_card(output.with_suffix(".json"))["metrics"] == {}


def test_a_base_made_on_the_way_has_the_network_asked_for(data, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_abisim.pretraining.pretrain.load_config", lambda *args: PretrainConfig(**SETTINGS))
    output = run(data, tmp_path / "abisim.safetensors", "abisim", **{"network_kwargs.features_dim": 18})
    base = load_encoder(str(tmp_path / "abisim.base.safetensors"))
    assert base.encoder.features_dim == load_encoder(str(output)).encoder.features_dim == 18


def test_settings_of_a_base_made_on_the_way(data, tmp_path):
    settings = {**SETTINGS, "base.n_updates": 3, "base.objective_kwargs.l1_penalty": 0.25}
    settings |= {"base.batch_size": 40, "base.log_interval": 1, "base.checkpoint_interval": 1}
    quiet = {"device": "cpu", "progress_bar": False, "verbose": 0}
    output = pretrain("abisim", data, tmp_path / "abisim.safetensors", settings, **quiet)
    base = load_encoder(tmp_path / "abisim.base.safetensors").metadata["settings"]
    assert (base["n_updates"], base["batch_size"]) == (3, 40)
    assert base["objective_kwargs"]["l1_penalty"] == 0.25
    assert load_encoder(output).metadata["settings"]["n_updates"] == SETTINGS["n_updates"]
    # The same again does nothing, others are refused.
    pretrain("abisim", data, output, settings, **quiet)
    with pytest.raises(ValueError, match=r"n_updates"):
        pretrain("abisim", data, output, {**settings, "base.n_updates": 4}, **quiet)


@pytest.mark.parametrize(
    ("objective", "base", "setting", "message"),
    [
        ("ssi", None, "base.n_updates", "base.n_updates is for a base encoder, and 'ssi' builds on none"),
        ("abisim", "b.safetensors", "base.n_updates", "the base encoder is there already, b.safetensors"),
        ("abisim", None, "base.network_kwargs.features_dim", "base has the network .* set network_kwargs.features_dim"),
        ("abisim", None, "base.eval_fraction", "set eval_fraction, or pretrain the base by itself"),
        ("abisim", None, "base.n_update", "unknown pretraining setting n_update; known are"),
        ("goal_progress", None, "base.base.n_updates", "unknown pretraining setting base; known are"),
    ],
)
def test_settings_that_would_not_hold_for_a_base_are_refused(data, tmp_path, objective, base, setting, message):
    with pytest.raises(ValueError, match=message):
        pretrain(objective, data, tmp_path / "a.safetensors", {**SETTINGS, setting: 3}, base=base, device="cpu")
    assert not list(tmp_path.iterdir())


def test_mistakes_are_found_before_the_base_is_trained(data, tmp_path):
    with pytest.raises(ValueError, match="objective_kwargs do not fit abisim"):
        run(data, tmp_path / "abisim.safetensors", "abisim", **{"objective_kwargs.gama": 0.9})
    assert not list(tmp_path.iterdir())


def test_what_kills_left_goes(data, tmp_path):
    output = run(data, tmp_path / "ssi.safetensors", "ssi")
    left = [
        tmp_path / "ssi.run" / name for name in ("checkpoint-000000003.safetensors", f".checkpoint-1.{'0a' * 8}.tmp")
    ]
    for path in left:
        path.write_bytes(b"")
    run(data, output, "ssi")
    assert not any(path.exists() for path in left)


def test_abisim_takes_every_base(data, tmp_path):
    for objective, k in (("acro", [1, 4]), ("info_nce", 2)):
        base = run(data, tmp_path / f"{objective}{k}.safetensors", objective, k=k)
        config = load_config("abisim", "Nav2D-v0", SETTINGS)
        output = tmp_path / f"abisim_{objective}{k}.safetensors"
        pretrain("abisim", data, output, config, base=str(base), device="cpu", progress_bar=False, verbose=0)
        settings = load_encoder(str(output)).metadata["settings"]
        assert settings["base_objective"] == objective
        assert settings["base_hash"] == load_encoder(str(base)).hash


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--objective", "ssi", "--env", "PointMaze-v0"], "was collected in Nav2D-v0, not in PointMaze-v0"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "n_update:3"], "n_update"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "objective_kwargs.gamma:3"], "gamma"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "n_updates"], "-params takes NAME:VALUE"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "batch_size:0"], "batch_size"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "n_updates.x:3"], "n_updates"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "eval_fraction:much"], "eval_fraction"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "learning_rate:null"], "learning_rate"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "objective_kwargs:3"], "objective_kwargs"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "batch_size:5000"], "batch_size"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "--base", "x"], "'ssi' builds on no base encoder, got base='x'"),
        (["--objective", "abisim", "--env", "Nav2D-v0", "--base", "missing.safetensors"], "missing.safetensors"),
        (["--objective", "dino", "--env", "Nav2D-v0"], "dino"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "--seed", "-1"], "seed must be at least 0, got -1"),
        (["--objective", "abisim", "--env", "Nav2D-v0", "-params", "batch_size:5000"], "too few for a batch of 5000"),
        (
            ["--objective", "abisim", "--env", "Nav2D-v0", "-params", "objective_kwargs.n_pairs:1.5"],
            "n_pairs must be a",
        ),
    ],
    ids=str,
)
def test_command_line_mistakes_exit_2(data, tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit) as error:
        main([*arguments, "--data", str(data), "-o", str(tmp_path / "out.safetensors")])
    assert error.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("sb3-abisim pretrain: error: ") and message in line
    assert not list(tmp_path.glob("*.safetensors"))


def test_too_few_transitions_for_an_eval_split_are_refused_at_once(tmp_path, monkeypatch):
    collect("Nav2D-v0", 12, tmp_path / "data", n_envs=1)
    with pytest.raises(ValueError, match=r"eval split of .*data .eval_fraction 0.05. .* or set eval_fraction:0"):
        run(tmp_path / "data", tmp_path / "abisim.safetensors", "abisim", batch_size=4)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert run(tmp_path / "data", tmp_path / "ssi.safetensors", batch_size=8, eval_fraction=0.0).is_file()
    # The base is trained on the same split, in batches that are no larger.
    config = load_config("abisim", "Nav2D-v0", {**SETTINGS, "batch_size": 8, "eval_fraction": 0.0})
    base = load_config("ssi", "Nav2D-v0", {**SETTINGS, "n_updates": 3})
    monkeypatch.setattr("sb3_abisim.pretraining.pretrain.load_config", lambda *args: base)
    pretrain("abisim", tmp_path / "data", tmp_path / "abisim.safetensors", config, device="cpu", progress_bar=False)
    settings = load_encoder(tmp_path / "abisim.base.safetensors").metadata["settings"]
    assert (settings["batch_size"], settings["eval_fraction"]) == (8, 0.0)


def test_folder_of_someone_else(tmp_path, capsys):
    (tmp_path / "meta.json").write_text("[1, 2]")
    with pytest.raises(SystemExit) as error:
        main(["--objective", "ssi", "--env", "Nav2D-v0", "--data", str(tmp_path), "-o", "x.safetensors"])
    assert error.value.code == 2 and "collect" in capsys.readouterr().err


def test_missing_dataset(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["--objective", "ssi", "--env", "Nav2D-v0", "--data", str(tmp_path), "-o", "x.safetensors"])
    assert "make one with sb3-abisim collect" in capsys.readouterr().err


def test_pretraining_keeps_freed_memory(data, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr("sb3_abisim.common.malloc.keep_freed_memory", lambda: calls.append(True))
    run(data, tmp_path / "ssi.safetensors")
    assert calls


def test_images_that_can_hardly_be_any_are_named(tmp_path):
    draw = np.random.default_rng(0)
    segment = Segment(draw.choice(2, (101, 3, 15, 15)).astype(np.uint8), draw.integers(0, 4, 100), TERMINATED)
    spaces_of = {"observation_space": Box(0, 255, (3, 15, 15), np.uint8), "action_space": Discrete(4)}
    write_dataset(tmp_path / "d", [segment], env_id="Nav2D-v0", source="", **spaces_of)
    settings = {"n_updates": 1, "batch_size": 16, "eval_fraction": 0.0}
    with pytest.warns(UserWarning, match="none of .* observations exceeds 1") as warned:
        pretrain("ssi", tmp_path / "d", tmp_path / "e.safetensors", settings, progress_bar=False, verbose=0)
    assert warned[0].filename == __file__
