"""Auxiliary objectives of zoo runs: the word, the callback, the record, and the command."""

import argparse
import importlib
from pathlib import Path
from typing import Any

import pytest
import yaml
from zoo_inputs import SMALL, run, write_encoder

from sb3_abisim.benchmark.graph import build, run_labels
from sb3_abisim.benchmark.plan import Plan
from sb3_abisim.zoo import manager as manager_module
from sb3_abisim.zoo.auxiliary import auxiliary_of, auxiliary_text, parse_auxiliary, with_auxiliary
from sb3_abisim.zoo.entries import ENCODER_CALLBACK
from sb3_abisim.zoo.methods import MethodSpec, split_options
from sb3_abisim.zoo.models import load_model
from sb3_abisim.zoo.run_files import read_yaml
from sb3_abisim.zoo.runs import read_run

exp_manager = importlib.import_module("rl_zoo3.exp_manager")
assert manager_module


@pytest.mark.parametrize(("text", "kwargs"), [
    ("ssi", {"objective": "ssi"}),
    ("abisim:weight=0.5", {"objective": "abisim", "weight": 0.5}),
    ("acro:k=[1,5]:seed=3", {"objective": "acro", "k": [1, 5], "seed": 3}),
    ("abisim:learning_rate=0.0001:objective_kwargs.c=0.9:objective_kwargs.pairs=nearest", {
        "objective": "abisim", "learning_rate": 1e-4, "objective_kwargs": {"c": 0.9, "pairs": "nearest"},
    }),
    ("goal_progress:base_kwargs.adaptive=null", {"objective": "goal_progress", "base_kwargs": {"adaptive": None}}),
])  # fmt: skip
def test_words_and_arguments(text: str, kwargs: dict[str, Any]) -> None:
    assert parse_auxiliary(text) == kwargs
    assert auxiliary_text(kwargs) == text
    assert parse_auxiliary(auxiliary_text(kwargs)) == kwargs


@pytest.mark.parametrize(("text", "message"), [
    ("sssi", "unknown method 'sssi'; known are"),
    ("", "unknown method ''"),
    ("vanilla", "no objective pretrains 'vanilla'"),
    ("ssi:rate=1", "unknown setting rate; known are weight, learning_rate, update_interval, .*objective_kwargs.NAME"),
    ("ssi:weight.x=1", "unknown setting weight.x"),
    ("ssi:objective_kwargs={}", "unknown setting objective_kwargs; known"),
    ("ssi:weight=-1", "weight must be a number of at least 0"),
    ("ssi:weight=a", "weight must be a number, got 'a'"),
    ("ssi:weight", "unknown method 'ssi:weight'"),
])  # fmt: skip
def test_wrong_words(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_auxiliary(text)


def test_method_specs_take_it() -> None:
    spec = MethodSpec.parse("abisim=a,b.safetensors,auxiliary=abisim:weight=0.50")
    assert spec == MethodSpec("abisim", "a,b.safetensors", auxiliary="abisim:weight=0.5")
    assert MethodSpec.parse("vanilla,auxiliary=ssi") == MethodSpec("vanilla", auxiliary="ssi")
    spec = MethodSpec.parse("ssi,auxiliary=acro:k=[1,5],augment=random_shift")
    assert spec == MethodSpec("ssi", augment="random_shift", auxiliary="acro:k=[1,5]")
    assert spec.suffix == ",augment=random_shift,auxiliary=acro:k=[1,5]"
    assert spec.extractor_options == {"augment": "random_shift"}
    with pytest.raises(ValueError, match="unknown method"):
        MethodSpec.parse("abisim,auxiliary=nothing")
    with pytest.raises(ValueError, match="says auxiliary twice"):
        MethodSpec.parse("abisim,auxiliary=ssi,auxiliary=abisim")


def test_a_frozen_encoder_is_measured_alone() -> None:
    for text in ("abisim,frozen,auxiliary=ssi", "abisim,auxiliary=ssi:weight=2,frozen"):
        with pytest.raises(ValueError, match=r"leave one of the two out, or give weight=0"):
            MethodSpec.parse(text)
    spec = MethodSpec.parse("ssi=f,frozen,auxiliary=ssi:weight=0")
    # In the environment there is nothing to measure.
    assert not spec.embeds_in_env
    assert spec.policy_kwargs({})["features_extractor_kwargs"] == {"encoder": "f", "freeze": True}


def test_behind_a_file_there_is_no_other_option() -> None:
    assert MethodSpec.of_conf_file("mine.yml,auxiliary=ssi") is None
    assert MethodSpec.of_conf_file(",auxiliary=ssi") is None
    assert split_options(",auxiliary=ssi") == ("", {"auxiliary": "ssi"})
    for config in ("mine.yml,auxiliary=ssi,frozen", "mine.yml,frozen", ",frozen"):
        with pytest.raises(ValueError, match="is no method, which frozen need"):
            MethodSpec.of_conf_file(config)


def test_callbacks_of_an_entry() -> None:
    ours = {"sb3_abisim.AuxiliaryObjective": {"objective": "curl", "weight": 2.0}}
    assert auxiliary_of({"callback": ["a.B", ours]}) == "curl:weight=2.0"
    assert auxiliary_of({"callback": "sb3_abisim.AuxiliaryObjective"}) == "ssi"
    assert auxiliary_of({"callback": "a.B"}) is None
    assert auxiliary_of({}) is None
    assert with_auxiliary(["a.B", ours], "ssi") == ["a.B", {"sb3_abisim.AuxiliaryObjective": {"objective": "ssi"}}]
    assert with_auxiliary(None, "ssi") == [{"sb3_abisim.AuxiliaryObjective": {"objective": "ssi"}}]


@pytest.mark.parametrize("config", ["", "vanilla", "mine.yml"])
def test_it_is_added_to_whatever_the_configuration_is(config: str, tmp_path: Path) -> None:
    if config.endswith(".yml"):
        config = str(tmp_path / config)
        entry = {"policy": "CnnPolicy", "n_timesteps": 10, "callback": ENCODER_CALLBACK}
        Path(config).write_text(yaml.safe_dump({"Nav2D-v0": entry}))
    config += ",auxiliary=ssi:weight=0.5"
    args = argparse.Namespace(conf_file=config)
    manager = exp_manager.ExperimentManager(args, "ppo", "Nav2D-v0", str(tmp_path), config=config)
    hyperparams, saved = manager.read_hyperparameters()
    expected = [ENCODER_CALLBACK, {"sb3_abisim.AuxiliaryObjective": {"objective": "ssi", "weight": 0.5}}]
    assert hyperparams["callback"] == saved["callback"] == expected
    manager._preprocess_hyperparams(hyperparams)
    record = manager._make_record()
    assert record.auxiliary == "ssi:weight=0.5"
    method = None if "mine" in config else "vanilla" if "vanilla" in config else "abisim"
    assert record.label == (None if method is None else f"{method},auxiliary=ssi:weight=0.5")


def test_train_continue_and_enjoy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    common = ["--algo", "dqn", "--env", "Nav2D-v0", "-f", str(tmp_path), "--num-threads", "1"]
    words = ["--seed", "1", "--conf-file", "vanilla", "--auxiliary", "ssi:update_interval=8:batch_size=16"]
    small = ["--eval-freq", "-1", "-params", *SMALL["dqn"]]
    run(monkeypatch, "train", *common, *words, "-n", "200", *small)
    assert "Auxiliary objective ssi: trains the encoder of q_net, weight 1" in capsys.readouterr().out
    folder = tmp_path / "dqn" / "Nav2D-v0_1"
    zoo_run = read_run(folder)
    assert zoo_run.label == "vanilla,auxiliary=ssi:batch_size=16:update_interval=8"
    args = read_yaml(folder / "Nav2D-v0" / "args.yml")
    assert args["conf_file"] == "vanilla,auxiliary=ssi:update_interval=8:batch_size=16"
    model = load_model(folder / "Nav2D-v0.zip", zoo_run)
    slot = model.policy.q_net.features_extractor.auxiliary  # type: ignore[union-attr]
    assert slot.saved is not None
    # It goes on where it stopped, by the zoo's own flag.
    seen: list[int] = []
    train = importlib.import_module("sb3_abisim.rl.auxiliary_trainer").AuxiliaryTrainer
    attach = train.attach
    monkeypatch.setattr(train, "attach", lambda self: (attach(self), seen.append(self.n_updates))[0])
    run(monkeypatch, "train", *common, *words, "-n", "100", "-i", str(folder / "Nav2D-v0.zip"), *small)
    assert seen[0] > 15
    assert seen[-1] > seen[0] + 5
    capsys.readouterr()
    run(monkeypatch, "enjoy", *common, "-n", "130", "--no-render")
    assert "Mean reward" in capsys.readouterr().out


@pytest.mark.parametrize(("words", "message"), [
    (["--auxiliary", "sssi"], "unknown method 'sssi'"),
    (["--auxiliary"], "--auxiliary takes a word, such as --auxiliary ssi"),
    (["--auxiliary=ssi", "--auxiliary=curl"], "--auxiliary is given twice, ssi and curl; give one"),
    (["--conf-file", "vanilla,auxiliary=ssi", "--auxiliary", "curl"], "says auxiliary already; leave --auxiliary out"),
    (["-conf", "abisim,frozen", "--auxiliary", "ssi"], "leave one of the two out, or give weight=0"),
    (["--conf-file", "vanilla", "--auxiliary", "ssi:objective_kwargs.wight=1"], "objective_kwargs do not fit ssi"),
])  # fmt: skip
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_mistakes_are_one_line(
    words: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    common = ["--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "--num-threads", "1", "-n", "64"]
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, "train", *common, "-params", *SMALL["ppo"], *words)
    assert stopped.value.code == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("sb3-abisim train: error: ")
    assert message in last


def test_arms_of_a_benchmark(tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    write_encoder(path, "Nav2D-v0")
    methods = ["vanilla", "vanilla,auxiliary=ssi", f"abisim={path},auxiliary=abisim:weight=0.5", f"abisim={path}"]
    plan = Plan(env_ids=("Nav2D-v0",), methods=tuple(methods), seeds=(0,), algo="dqn", final_episodes=0)
    jobs = build(plan)
    runs = [job for job in jobs if job.kind == "run"]
    assert [run_labels(jobs)[job.name] for job in runs] == [
        "vanilla", "vanilla,auxiliary=ssi", "abisim,auxiliary=abisim:weight=0.5", "abisim",
    ]  # fmt: skip
    words = [job.command[job.command.index("--conf-file") + 1] for job in runs]
    assert words == [
        "vanilla", "vanilla,auxiliary=ssi", f"abisim={path},auxiliary=abisim:weight=0.5", f"abisim={path}",
    ]  # fmt: skip
    assert len({job.output.split("/")[2] for job in runs}) == 4
    # Those without one are the jobs of before.
    assert "auxiliary" not in runs[0].settings
