"""Entries of a zoo YAML."""

import gymnasium as gym
import pytest
import torch as th
from gymnasium.envs.registration import EnvSpec
from torch import nn

from sb3_abisim.rl.extractor_classes import extractor_class
from sb3_abisim.zoo.entries import ENCODING_WRAPPER, encoding_kwargs, hyperparameters_entry, resolve_classes


def test_classes_by_dotted_path() -> None:
    kwargs = {
        "features_extractor_class": "sb3_abisim.SSIExtractor",
        "activation_fn": "torch.nn.ReLU",
        "optimizer_class": "torch.optim.AdamW",
        "net_arch": {"pi": [7]},
    }
    before = dict(kwargs)
    assert resolve_classes(kwargs) == {
        "features_extractor_class": extractor_class("ssi"),
        "activation_fn": nn.ReLU,
        "optimizer_class": th.optim.AdamW,
        "net_arch": {"pi": [7]},
    }
    assert kwargs == before
    assert resolve_classes({"activation_fn": nn.Tanh}) == {"activation_fn": nn.Tanh}
    assert resolve_classes(None) is None
    for path in ("ReLU", "nn.ReLU", "torch.nn.RELU", "sb3_abisim.NobodysExtractor", ""):
        with pytest.raises(ValueError, match=f"cannot import activation_fn '{path}' .*give its dotted path"):
            resolve_classes({"activation_fn": path})


def test_arguments_of_the_encoding_wrapper() -> None:
    for wrapper in (ENCODING_WRAPPER, "sb3_abisim.rl.vec_encode.VecEncodeObservations"):
        entry = {wrapper: {"encoder": "e"}}
        assert encoding_kwargs({"vec_env_wrapper": [{"some.Wrapper": {}}, "other.Wrapper", entry]}) == {"encoder": "e"}
        assert encoding_kwargs({"vec_env_wrapper": entry}) == {"encoder": "e"}
    for none in ({}, {"vec_env_wrapper": None}, {"vec_env_wrapper": ["some.Wrapper"]}):
        assert encoding_kwargs(none) is None


def test_no_default_stands_for_atari(monkeypatch: pytest.MonkeyPatch) -> None:
    """rl-zoo3 looks for an entry of Atari alone, and fails with a KeyError where an algorithm has none."""
    monkeypatch.setitem(gym.registry, "ALE/Toy-v5", EnvSpec("ALE/Toy-v5", "ale_py.env:AtariEnv"))
    assert hyperparameters_entry("ppo", "ALE/Toy-v5")["frame_stack"] == 4
    with pytest.raises(ValueError, match="no hyperparameters of trpo for ALE/Toy-v5; choose another with --algo"):
        hyperparameters_entry("trpo", "ALE/Toy-v5")
