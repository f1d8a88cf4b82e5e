"""The pretraining loop: what it writes, and that it refuses what does not fit."""

import json
import shlex
import warnings

import pytest
import torch as th
from pretrain_inputs import SETTINGS, collect_grids, run

from sb3_abisim.data.collect import main as collect
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.objectives.inverse import InverseDynamics
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


def test_a_callback_adds_to_the_log_and_changes_nothing_else(data, tmp_path):
    # CURL draws noise; without held-out episodes nothing else changes the mode.
    plain = run(data, tmp_path / "plain.safetensors", "curl", eval_fraction=0.0)
    modes = []

    def callback(encoder):
        modes.append(encoder.training)
        return {"exact/size": encoder(th.rand(2, 3, 15, 15)).abs().sum()}

    output = run(data, tmp_path / "logged.safetensors", "curl", callback, eval_fraction=0.0)
    assert output.read_bytes() == plain.read_bytes()
    assert modes == [False] * 6
    sizes = json.loads(output.with_suffix(".json").read_text())["curves"]["exact/size"]
    assert len(sizes) == 6 and all(size > 0 for size in sizes)
    assert "exact/size" in (output.with_suffix(".run") / "progress.csv").read_text().splitlines()[0].split(",")


def test_the_commands_on_the_card_make_the_same_encoder(data, tmp_path, capsys):
    output = run(data, tmp_path / "ssi.safetensors")
    card = json.loads(output.with_suffix(".json").read_text())
    places = {"DATA": str(tmp_path / "data"), "FILE": str(tmp_path / "again.safetensors")}
    for command, main_function in zip(card["commands"], (collect, main), strict=True):
        words = [places.get(word, word) for word in shlex.split(command)]
        assert words[:2] == ["python", "-m"]
        main_function([*words[3:], *(["--device", "cpu"] if main_function is main else [])])
    assert (tmp_path / "again.safetensors").read_bytes() == output.read_bytes()


def test_abisim_trains_its_base_first(data, tmp_path, monkeypatch):
    small = load_config("ssi", "Nav2D-v0", SETTINGS)
    monkeypatch.setattr("sb3_abisim.pretraining.pretrain.load_config", lambda objective, env_id: small)
    output = run(data, tmp_path / "abisim.safetensors", "abisim")
    base = load_encoder(str(tmp_path / "abisim.base.safetensors"))
    metadata = load_encoder(str(output)).metadata
    assert base.metadata["objective"] == "ssi" and metadata["objective"] == "abisim"
    assert metadata["settings"]["base_hash"] == base.hash


def test_a_base_made_on_the_way_has_the_network_asked_for(data, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "sb3_abisim.pretraining.pretrain.load_config", lambda objective, env_id: PretrainConfig(**SETTINGS)
    )
    output = run(data, tmp_path / "abisim.safetensors", "abisim", **{"network_kwargs.features_dim": 18})
    base = load_encoder(str(tmp_path / "abisim.base.safetensors"))
    assert base.encoder.features_dim == load_encoder(str(output)).encoder.features_dim == 18


def test_mistakes_are_found_before_the_base_is_trained(data, tmp_path):
    with pytest.raises(ValueError, match="objective_kwargs do not fit abisim"):
        run(data, tmp_path / "abisim.safetensors", "abisim", **{"objective_kwargs.gama": 0.9})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", ['{"precious": true}', "[1, 2]", "3", "not JSON"])
def test_a_file_in_the_place_of_the_card_is_not_replaced(data, tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ValueError, match=r"would replace .*config\.json, which is none; name another output"):
        run(data, tmp_path / "config.safetensors", "ssi")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert (tmp_path / "config.json").read_text() == content


def test_what_kills_left_goes(data, tmp_path):
    output = run(data, tmp_path / "ssi.safetensors", "ssi")
    left = [
        tmp_path / "ssi.run" / name for name in ("checkpoint-000000003.safetensors", f".checkpoint-1.{'0a' * 8}.tmp")
    ]
    for path in left:
        path.write_bytes(b"")
    run(data, output, "ssi")
    assert not any(path.exists() for path in left)


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("gpu0", "unknown device 'gpu0'"),
        pytest.param(
            "cuda", "'cuda' is not available", marks=pytest.mark.skipif(th.cuda.is_available(), reason="CUDA is there")
        ),
    ],
)
def test_a_device_that_is_not_there_is_refused(data, tmp_path, device, message):
    config = load_config("ssi", "Nav2D-v0", SETTINGS)
    with pytest.raises(ValueError, match=message):
        pretrain("ssi", data, tmp_path / "ssi.safetensors", config, device=device, progress_bar=False, verbose=0)


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
    ("objective", "k", "message"),
    [("ssi", 2, "use acro"), ("acro", 1, "which is ssi"), ("info_nce", [1, 2], "one length"), ("curl", 3, "single")],
)
def test_refuses_steps_that_the_objective_is_not_made_for(data, tmp_path, objective, k, message):
    with pytest.raises(ValueError, match=message):
        run(data, tmp_path / "x.safetensors", objective, k=k)
    assert not list(tmp_path.iterdir()), "a refused run leaves nothing behind"


def test_k_has_one_place(data, tmp_path):
    with pytest.raises(ValueError, match=r"objective_kwargs\.k cannot be set; set k itself: k:3"):
        run(data, tmp_path / "x.safetensors", "info_nce", **{"objective_kwargs.k": 3})


@pytest.mark.parametrize("k", [0, 1.5, True, [2, 1], [0, 3], [1, 2, 3], "5"], ids=str)
def test_refuses_k_that_is_no_number_of_steps(k):
    with pytest.raises(ValueError, match="k must be a whole number"):
        PretrainConfig(k=k)


@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_stops_at_numbers_that_are_not_finite(data, tmp_path, monkeypatch, where):
    plain, calls = InverseDynamics.loss, 0

    def broken(self, batch):
        nonlocal calls
        calls += self.training
        loss, terms = plain(self, batch)
        if self.training and calls == 8:
            if where == "loss":
                loss = loss * float("nan")
            else:
                weight = self.encoder.layers[0].weight
                loss = loss + 0.0 * th.sqrt(weight.sum() * 0.0)  # the value is 0, its derivative is not
        return loss, terms

    monkeypatch.setattr(InverseDynamics, "loss", broken)
    with pytest.raises(FloatingPointError, match=f"{where}.* at update 7.*learning_rate"):
        run(data, tmp_path / "ssi.safetensors")
    assert not (tmp_path / "ssi.safetensors").exists()
    assert [path.name for path in (tmp_path / "ssi.run").glob("checkpoint-*")] == ["checkpoint-000000005.safetensors"]


def test_held_out_transitions_are_not_trained_on(data, tmp_path, monkeypatch):
    from sb3_abisim.data.dataset import TransitionDataset

    plain_batches, plain_loss, seen = TransitionDataset.batches, InverseDynamics.loss, []

    def batches(self, *args, part=None, **kwargs):
        for batch in plain_batches(self, *args, part=part, **kwargs):
            seen.append([part])
            yield batch

    def loss(self, batch):
        seen[-1].append("train" if self.training else "test")
        return plain_loss(self, batch)

    monkeypatch.setattr(TransitionDataset, "batches", batches)
    monkeypatch.setattr(InverseDynamics, "loss", loss)
    run(data, tmp_path / "ssi.safetensors", n_updates=10)
    assert seen.count(["train", "train"]) == 10
    assert 0 < seen.count(["test", "test"]) == len(seen) - 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--objective", "ssi", "--env", "PointMaze-v0"], "was collected in Nav2D-v0, not in PointMaze-v0"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "n_update:3"], "n_update"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "objective_kwargs.gamma:3"], "gamma"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "n_updates"], "name:value"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "batch_size:0"], "batch_size"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "n_updates.x:3"], "n_updates"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "eval_fraction:much"], "eval_fraction"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "learning_rate:null"], "learning_rate"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "objective_kwargs:3"], "objective_kwargs"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "-params", "batch_size:5000"], "batch_size"),
        (["--objective", "ssi", "--env", "Nav2D-v0", "--base", "x"], "base encoder belongs to 'abisim'"),
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
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("*.safetensors"))


def test_too_little_to_hold_out_is_told_at_once(tmp_path, monkeypatch):
    collect(["--env", "Nav2D-v0", "-n", "12", "-o", str(tmp_path / "data"), "--n-envs", "1"])
    with pytest.raises(ValueError, match=r"no segment held out of .*data .holdout 0.05. .* or set eval_fraction:0"):
        run(tmp_path / "data", tmp_path / "abisim.safetensors", "abisim", batch_size=4)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    assert run(tmp_path / "data", tmp_path / "ssi.safetensors", batch_size=8, eval_fraction=0.0).is_file()
    # The base is trained on the same part, in batches that are no larger.
    config = load_config("abisim", "Nav2D-v0", {**SETTINGS, "batch_size": 8, "eval_fraction": 0.0})
    base = load_config("ssi", "Nav2D-v0", {**SETTINGS, "n_updates": 3})
    monkeypatch.setattr("sb3_abisim.pretraining.pretrain.load_config", lambda *args: base)
    pretrain("abisim", tmp_path / "data", tmp_path / "abisim.safetensors", config, device="cpu", progress_bar=False)
    settings = load_encoder(tmp_path / "abisim.base.safetensors").metadata["settings"]
    assert (settings["batch_size"], settings["eval_fraction"]) == (8, 0.0)


def test_numbers_without_a_dot(data, tmp_path):
    """YAML 1.1 takes 1e-4 for a text, users of the zoo do not."""
    from sb3_abisim.common.cli import parse_overrides

    words = ["learning_rate:1e-4", "objective_kwargs.l1_penalty:2e-3", "learning_rate:lin_1e-3"]
    assert parse_overrides(words[:2]) == {"learning_rate": 1e-4, "objective_kwargs.l1_penalty": 2e-3}
    assert parse_overrides(words[2:]) == {"learning_rate": "lin_1e-3"}
    # As a card's commands write them.
    assert parse_overrides(['objective_kwargs:{"a": 5e-05, "b": [1e-4, "x"]}']) == {
        "objective_kwargs": {"a": 5e-5, "b": [1e-4, "x"]}
    }


def test_folder_of_someone_else(tmp_path, capsys):
    (tmp_path / "meta.json").write_text("[1, 2]")
    with pytest.raises(SystemExit) as error:
        main(["--objective", "ssi", "--env", "Nav2D-v0", "--data", str(tmp_path), "-o", "x.safetensors"])
    assert error.value.code == 2 and "collect" in capsys.readouterr().err


def test_weights_that_are_not_finite_are_never_saved(data, tmp_path, monkeypatch):
    plain = InverseDynamics.after_step

    def broken(self):
        plain(self)
        with th.no_grad():
            self.encoder.layers[0].weight[0, 0, 0, 0] = float("inf")

    monkeypatch.setattr(InverseDynamics, "after_step", broken)
    with pytest.raises(FloatingPointError, match=r"weights.* at update 0"):
        run(data, tmp_path / "ssi.safetensors", log_interval=1, checkpoint_interval=1)
    assert not list((tmp_path / "ssi.run").glob("checkpoint-*"))


def test_missing_dataset(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["--objective", "ssi", "--env", "Nav2D-v0", "--data", str(tmp_path), "-o", "x.safetensors"])
    assert "sb3_abisim.data.collect" in capsys.readouterr().err


def test_learning_rate_schedule():
    config = PretrainConfig(n_updates=100, learning_rate="lin_0.002")
    assert [config.learning_rate_at(n) for n in (0, 50, 75)] == [0.002, 0.001, 0.0005]
    assert PretrainConfig(n_updates=100, learning_rate=0.3).learning_rate_at(99) == 0.3
    for wrong in ("cos_0.1", "lin_x", "lin_0", 0.0):
        with pytest.raises(ValueError, match=str(wrong)):
            PretrainConfig(learning_rate=wrong)


def test_learning_rate_reaches_the_optimizer(data, tmp_path, monkeypatch):
    seen = []
    step = th.optim.Adam.step
    monkeypatch.setattr(
        th.optim.Adam, "step", lambda self, *args: (seen.append(self.param_groups[0]["lr"]), step(self, *args))
    )
    run(data, tmp_path / "ssi.safetensors", n_updates=4, learning_rate="lin_0.4")
    assert seen == pytest.approx([0.4, 0.3, 0.2, 0.1])


@pytest.mark.parametrize("objective", ["ssi", "abisim"])
def test_every_yaml_entry_is_valid(objective):
    import yaml

    from sb3_abisim.common.paths import resource_path

    entries = yaml.safe_load((resource_path("hyperparams") / "pretrain" / f"{objective}.yml").read_text())
    for env_id in entries:
        assert load_config(objective, env_id) == PretrainConfig.from_mapping(entries[env_id])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_config(objective, "Unknown-v0") == PretrainConfig.from_mapping(entries["default"])
    changed = load_config(objective, "Nav2D-v0", {"objective_kwargs.tau": 0.5, "k": 3})
    assert changed.objective_kwargs["tau"] == 0.5 and changed.k == 3
