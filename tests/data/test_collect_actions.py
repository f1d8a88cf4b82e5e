"""Collecting, reading and pretraining with actions of every kind."""

import json
from pathlib import Path

import action_spaces
import numpy as np
import pytest
from action_spaces import SPACES

from sb3_abisim.common.spaces import space_from_json, space_to_json
from sb3_abisim.data.collect import collect
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.config import PretrainConfig
from sb3_abisim.pretraining.pretrain import pretrain

each_space = pytest.mark.parametrize("kind", SPACES)


@each_space
def test_a_dataset_holds_the_actions_taken(kind: str, tmp_path: Path) -> None:
    collect("ActionEnv-v0", 300, tmp_path / "d", n_envs=3, env_kwargs={"kind": kind})
    dataset, space = TransitionDataset(tmp_path / "d"), SPACES[kind]
    assert dataset.action_space == space and dataset.action_space.dtype == space.dtype
    starts = dataset.valid_starts()
    actions = dataset.actions(starts)
    assert actions.dtype == (np.int64 if kind == "discrete" else space.dtype)
    assert actions.shape == (300, *space.shape)
    shown = action_spaces.shown(space, actions)
    assert np.array_equal(dataset.frames(starts + 1)[:, 0, 0, : shown.shape[1]], shown)
    # All levels of each component occur, the smallest and the largest with equal chance.
    effects = action_spaces.effects(space, actions)
    assert np.abs(effects.mean(axis=0)).max() < 0.3 and effects.min() < -0.9 and effects.max() > 0.9
    sequences = next(dataset.batches(8, k=3, sequences=True)).actions
    assert sequences.shape == (8, 3, *space.shape)


@pytest.mark.parametrize("kind", ["multi_discrete_2d", "multi_binary", "box_2d_float64"])
def test_pretraining(kind: str, tmp_path: Path) -> None:
    collect("ActionEnv-v0", 600, tmp_path / "d", n_envs=3, env_kwargs={"kind": kind})
    config = PretrainConfig(n_updates=60, batch_size=64, log_interval=60, learning_rate=1e-3)
    pretrain("ssi", tmp_path / "d", tmp_path / "e.safetensors", config, verbose=0)
    file = load_encoder(tmp_path / "e.safetensors")
    file.check(TransitionDataset(tmp_path / "d").observation_space, SPACES[kind])
    with pytest.raises(ValueError, match="action_space"):
        file.check(TransitionDataset(tmp_path / "d").observation_space, SPACES["box_scalar"])


@each_space
def test_spaces_survive_json(kind: str) -> None:
    document = json.loads(json.dumps(space_to_json(SPACES[kind])))
    again = space_from_json(document)
    assert again == SPACES[kind] and again.dtype == SPACES[kind].dtype and space_to_json(again) == document
