"""Method specs in environments that no YAML file of this package names: rl-zoo3's entry with another extractor."""

import argparse
import importlib
import json
from pathlib import Path
from typing import Any

import index_env  # noqa: F401  (registers IndexEnv-v0)
import numpy as np
import pytest
import toy_env  # noqa: F401  (registers Toy-v0)
from stable_baselines3.common.vec_env import unwrap_vec_wrapper
from torch import nn
from zoo_inputs import SMALL, run, write_encoder

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.rl.extractor_classes import extractor_class
from sb3_abisim.rl.vec_encode import EncodedBox, VecEncodeObservations
from sb3_abisim.zoo.entries import encoding_kwargs
from sb3_abisim.zoo.evaluate import evaluate_final
from sb3_abisim.zoo.runs import read_run

ExperimentManager: Any = importlib.import_module("rl_zoo3.exp_manager").ExperimentManager


@pytest.fixture
def encoder(tmp_path: Path) -> Path:
    write_encoder(tmp_path / "e.safetensors", "Toy-v0", "ssi")
    return tmp_path / "e.safetensors"


def make(tmp_path: Path, algo: str, env_id: str, config: str | None, **kwargs: Any) -> Any:
    args = argparse.Namespace(conf_file=config)
    return ExperimentManager(args, algo, env_id, str(tmp_path / "logs"), config=config, verbose=0, **kwargs)


def prepared(manager: Any) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    hyperparams, saved = manager.read_hyperparameters()
    return manager, dict(manager._preprocess_hyperparams(hyperparams)[0]), saved


@pytest.mark.parametrize("algo", ["ppo", "dqn"])
def test_the_default_entry_with_another_extractor(tmp_path: Path, encoder: Path, algo: str) -> None:
    _, plain, _ = prepared(make(tmp_path, algo, "Toy-v0", None))
    assert plain["policy"] == "MlpPolicy" and "policy_kwargs" not in plain
    _, kwargs, saved = prepared(make(tmp_path, algo, "Toy-v0", f"ssi={encoder}"))
    expected = {
        "features_extractor_class": extractor_class("ssi"),
        "features_extractor_kwargs": {"encoder": str(encoder)},
    }
    assert kwargs == plain | {"policy": "CnnPolicy", "policy_kwargs": expected}
    assert saved["callback"] == ["sb3_abisim.EncoderCallback"]
    _, kwargs, saved = prepared(make(tmp_path, algo, "Toy-v0", f"ssi={encoder},frozen"))
    assert kwargs == plain | {"policy_kwargs": {}}
    assert encoding_kwargs(saved) == {"encoder": str(encoder), "objective": "ssi"}
    _, kwargs, _ = prepared(make(tmp_path, algo, "Toy-v0", "vanilla"))
    assert kwargs["policy_kwargs"] == {"features_extractor_class": extractor_class("vanilla")}
    # A policy of the user's is theirs.
    theirs = {"policy": "stable_baselines3.ppo.CnnPolicy"}
    _, kwargs, _ = prepared(make(tmp_path, algo, "Toy-v0", "vanilla", hyperparams=theirs))
    assert kwargs["policy"].__name__ == "ActorCriticCnnPolicy"


def test_an_entry_whose_policy_kwargs_are_a_text(tmp_path: Path, encoder: Path) -> None:
    _, plain, plain_saved = prepared(make(tmp_path, "ppo", "CarRacing-v3", None))
    assert isinstance(plain_saved["policy_kwargs"], str) and plain["policy_kwargs"]["activation_fn"] is nn.GELU
    _, kwargs, saved = prepared(make(tmp_path, "ppo", "CarRacing-v3", f"ssi={encoder}"))
    extractor = {
        "features_extractor_class": extractor_class("ssi"),
        "features_extractor_kwargs": {"encoder": str(encoder)},
    }
    assert kwargs["policy_kwargs"] == plain["policy_kwargs"] | extractor
    write_encoder(tmp_path / "of_two.safetensors", "Toy-v0", "ssi", {"frame_stack": 2})
    _, kwargs, frozen = prepared(make(tmp_path, "ppo", "CarRacing-v3", f"ssi={tmp_path / 'of_two.safetensors'},frozen"))
    assert kwargs["policy_kwargs"] == plain["policy_kwargs"] and kwargs["policy"] == "MlpPolicy"
    # Stacked before the encoder, not behind it.
    assert plain_saved["frame_stack"] == 2 and frozen["frame_stack"] is None
    # Whatever stands between environment and encoder is that of the entry.
    keys = ("env_wrapper", "frame_stack", "normalize", "n_envs", "gamma")
    assert {key: saved[key] for key in keys} == {key: plain_saved[key] for key in keys}
    with pytest.raises(ValueError, match="-params policy_kwargs would undo --conf-file ssi"):
        prepared(make(tmp_path, "ppo", "CarRacing-v3", f"ssi={encoder}", hyperparams={"policy_kwargs": {}}))


def test_evaluation_is_in_the_environment_of_training(tmp_path: Path, encoder: Path) -> None:
    in_yaml = {"hyperparams": {"env_kwargs": {"scale": 2.0}}}
    for config, expected in ((f"ssi={encoder}", {"scale": 2.0}), (None, {})):
        manager, _, _ = prepared(make(tmp_path, "ppo", "Toy-v0", config, **in_yaml))
        assert (manager.env_kwargs, manager.eval_env_kwargs) == ({"scale": 2.0}, expected)
    # Registered traits say that there is a split for evaluation.
    for config, expected in ((f"ssi={encoder}", {"split": "eval", "scale": 2.0}), (None, {"split": "eval"})):
        kwargs = in_yaml if config else {}
        manager, _, _ = prepared(make(tmp_path, "ppo", "SplitToy-v0", config, **kwargs))
        assert manager.eval_env_kwargs == expected
    manager, _, _ = prepared(make(tmp_path, "ppo", "SplitToy-v0", None, env_kwargs={"split": "eval", "scale": 3.0}))
    assert manager.env_kwargs == {"split": "eval", "scale": 3.0} and manager.eval_env_kwargs == manager.env_kwargs


def test_what_is_refused(tmp_path: Path, encoder: Path) -> None:
    with pytest.raises(ValueError, match=r"no encoder ships for this environment; .*--conf-file ssi=FILE$"):
        prepared(make(tmp_path, "ppo", "Toy-v0", "ssi"))
    with pytest.raises(ValueError, match=r"--conf-file ssi=FILE,frozen$"):
        prepared(make(tmp_path, "ppo", "Toy-v0", "ssi,frozen"))
    with pytest.raises(ValueError, match="--trial-id would replace policy_kwargs"):
        prepared(make(tmp_path, "ppo", "Toy-v0", f"ssi={encoder}", trial_id=3))
    with pytest.raises(ValueError, match="LinearPolicy is none; choose another algorithm"):
        prepared(make(tmp_path, "ars", "Toy-v0", f"ssi={encoder}"))
    with pytest.raises(ValueError, match="'sssi' is no YAML or Python file, module or method"):
        prepared(make(tmp_path, "ppo", "Toy-v0", "sssi"))


def test_batches_of_other_packages_are_stepped_as_one(tmp_path: Path) -> None:
    for env_id, expected in (("IndexEnv-v0", "BatchedVecEnv"), ("Toy-v0", "DummyVecEnv")):
        manager, _, _ = prepared(make(tmp_path, "ppo", env_id, None, hyperparams={"n_envs": 2}))
        assert manager.vec_env_class.__name__ == expected


@pytest.mark.parametrize("kind", ["fine-tuned", "frozen"])
@pytest.mark.parametrize("algo", ["ppo", "dqn"])
def test_train_enjoy_and_evaluate(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    encoder: Path,
    algo: str,
    kind: str,
) -> None:
    hash = load_encoder(encoder).hash
    spec = f"ssi={encoder}" + ",frozen" * (kind == "frozen")
    common = ["--algo", algo, "--env", "Toy-v0", "-f", str(tmp_path / "logs"), "--packages", "toy_env"]
    common += ["--num-threads", "1"]
    words = ["--conf-file", spec, "-n", "96", "--seed", "1", "--eval-freq", "48", "--eval-episodes", "1"]
    run(monkeypatch, "train", *common, *words, "-params", *SMALL[algo])
    out = capsys.readouterr().out
    assert f"hash {hash}" in out and kind in out
    folder = tmp_path / "logs" / algo / "Toy-v0_1"
    record = json.loads((folder / "Toy-v0" / "method.json").read_text())
    assert record == {
        "method": "ssi",
        "frozen": kind == "frozen",
        "encoder": str(encoder),
        "encoder_hash": hash,
        "preprocessing": {},
        "task_features_dim": 0,
        "augment": None,
        "auxiliary": None,
    }
    assert read_run(folder).label == "ssi" + ",frozen" * (kind == "frozen")
    assert len(np.load(folder / "evaluations.npz")["timesteps"]) == 2
    encoder.unlink()
    run(monkeypatch, "enjoy", *common, "-n", "20", "--no-render")
    assert "Mean reward" in capsys.readouterr().out
    assert np.load(evaluate_final(folder, 2))["stochastic/standard/results"].shape == (2,)


def test_the_encoder_stands_behind_the_wrappers_of_the_entry(tmp_path: Path, encoder: Path) -> None:
    """A frozen run builds the model on embeddings, a fine-tuned one on the file's weights."""
    small = {"n_steps": 8, "batch_size": 8}
    model, _ = make(
        tmp_path, "ppo", "Toy-v0", f"ssi={encoder},frozen", hyperparams=small, eval_freq=-1
    ).setup_experiment()
    assert isinstance(model.observation_space, EncodedBox)
    assert unwrap_vec_wrapper(model.env, VecEncodeObservations) is not None
    model.env.close()
    model, _ = make(tmp_path, "ppo", "Toy-v0", f"ssi={encoder}", hyperparams=small, eval_freq=-1).setup_experiment()
    ((_, extractor),) = find_extractors(model.policy)
    assert extractor.hash == load_encoder(encoder).hash
    model.env.close()


def test_embeddings_are_not_stacked(tmp_path: Path, encoder: Path) -> None:
    """rl-zoo3 stacks what comes out of ``vec_env_wrapper``: of a frozen encoder embeddings, not observations."""
    small = {"n_steps": 8, "batch_size": 8}
    single, of_two = f"ssi={encoder},frozen", tmp_path / "of_two.safetensors"
    message = (
        r"frame_stack: {} in pretraining, {} now, which would stack embeddings\); add -params frame_stack:None, or"
    )
    with pytest.raises(ValueError, match=message.format(1, 2)):
        prepared(make(tmp_path, "ppo", "Toy-v0", single, hyperparams={"frame_stack": 2}))
    write_encoder(of_two, "Toy-v0", "ssi", {"frame_stack": 2})
    with pytest.raises(ValueError, match=message.format(2, 3)):
        prepared(make(tmp_path, "ppo", "Toy-v0", f"ssi={of_two},frozen", hyperparams={"frame_stack": 3}))
    # Nor by a YAML file of the user's.
    wrapper = f"{{sb3_abisim.VecEncodeObservations: {{encoder: {encoder}}}}}"
    settings = f"policy: MlpPolicy, n_timesteps: 8, frame_stack: 2, vec_env_wrapper: {wrapper}"
    (tmp_path / "mine.yml").write_text(f"Toy-v0: {{{settings}}}")
    with pytest.raises(ValueError, match=message.format(1, 2)):
        make(tmp_path, "ppo", "Toy-v0", str(tmp_path / "mine.yml"), hyperparams=small, eval_freq=-1).setup_experiment()


def test_wrappers_are_compared_with_those_of_pretraining(tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    small = {"n_steps": 8, "batch_size": 8}
    write_encoder(path, "Toy-v0", "ssi", {"env_wrapper": []})
    wrapped = {**small, "env_wrapper": "toy_env.Invert"}
    for config in (f"ssi={path}", f"ssi={path},frozen"):
        message = r"env_wrapper: \[\] in pretraining, \['toy_env.Invert'\] now\); add -params env_wrapper:None"
        with pytest.raises(ValueError, match=message):
            make(tmp_path, "ppo", "Toy-v0", config, hyperparams=dict(wrapped), eval_freq=-1).setup_experiment()
        model, _ = make(tmp_path, "ppo", "Toy-v0", config, hyperparams=dict(small), eval_freq=-1).setup_experiment()
        model.env.close()


def test_a_file_with_another_network_needs_no_more_words(tmp_path: Path) -> None:
    path = tmp_path / "wide.safetensors"
    hash = write_encoder(path, "Toy-v0", "ssi", features_dim=48)
    small = {"n_steps": 8, "batch_size": 8}
    model, _ = make(tmp_path, "ppo", "Toy-v0", f"ssi={path}", hyperparams=small, eval_freq=-1).setup_experiment()
    ((_, extractor),) = find_extractors(model.policy)
    assert extractor.hash == hash and extractor.features_dim == 48
    model.env.close()
