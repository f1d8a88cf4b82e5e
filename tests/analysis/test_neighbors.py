"""Neighbors against brute force, and what they say of encoders that see one thing alone."""

from pathlib import Path

import numpy as np
import pytest
import torch as th
from analysis_inputs import Masked, file_of
from index_env import SHAPE as INDEX_SHAPE

from sb3_abisim.analysis.neighbors import nearest_elsewhere, neighbors, similarity
from sb3_abisim.analysis.scenes import sample_episodes
from sb3_abisim.envs.nav2d import SIZE
from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.encoder_file import EncoderFile

SHAPE = (3, SIZE, SIZE)


def test_nearest_by_brute_force():
    th.manual_seed(0)
    features, episodes = th.rand(40, 3), np.arange(40) // 4
    nearest, distances = nearest_elsewhere(features, episodes)
    for i in range(40):
        table = [float((features[i] - features[j]).abs().sum()) for j in range(40)]
        others = [j for j in range(40) if episodes[j] != episodes[i]]
        assert nearest[i] == min(others, key=lambda j: table[j])
        assert distances[i] == pytest.approx(table[nearest[i]], rel=1e-5)


def test_one_episode_has_no_others():
    with pytest.raises(ValueError, match="at least 2"):
        nearest_elsewhere(th.rand(4, 2), np.zeros(4, dtype=np.int64))


def test_similarity_to_oneself_and_to_others():
    samples = sample_episodes("DistractorPointMaze-v0", 20, 5)
    everyone = np.arange(len(samples))
    assert similarity(samples, everyone) == pytest.approx({"agent": 0.0, "obstacles": 1.0, "same_clip": 1.0})
    # Every clip is shown to some of the episodes; a partner of another one has another place and other surroundings.
    other = similarity(samples, np.roll(everyone, 50))
    assert other["agent"] > 2 and abs(other["obstacles"]) < 0.3 and other["same_clip"] < 0.5


def test_in_a_scan_agents_are_apart_in_the_observation():
    """Apartments lie anywhere in their coordinates; an encoder sees where the agent is in the observation."""
    samples = sample_episodes("ScanNav-v0", 6, 5, env_kwargs={"stop": "auto"})
    partners = np.roll(np.arange(len(samples)), 5)
    seen = samples.factors["agent"] - samples.factors["goal"]
    expected = np.linalg.norm(seen - seen[partners], axis=1).mean()
    found = similarity(samples, partners)
    assert found["agent"] == pytest.approx(expected) and found["same_clip"] is None


def test_encoder_of_one_channel_finds_its_like():
    masks = {"agent": np.zeros(SHAPE), "obstacles": np.zeros(SHAPE)}
    masks["agent"][0], masks["obstacles"][1] = 1, 1
    files = {name: file_of(Masked(mask), SHAPE) for name, mask in masks.items()}
    results = neighbors(files, "Nav2D-v0", 120)
    numbers = results["settings"]["eval layouts"]
    assert numbers["agent"]["agent"] < 0.5 < 3 < numbers["random pairs"]["agent"]
    assert numbers["agent"]["same_clip"] is None
    # Cells right and wrong of a whole layout: its neighbor tells a little of the surroundings, chance nothing.
    assert abs(numbers["random pairs"]["obstacles"]) < 0.1
    shown = results["observations"]["eval layouts"]
    assert (shown["query"][:, 0] == shown["agent"][:, 0]).all(axis=(1, 2)).sum() >= 2


def test_any_image_environment_has_neighbors():
    """Of one without factors, the embeddings alone are compared."""
    layers = Masked(np.ones(INDEX_SHAPE))
    file = EncoderFile(
        Path("nowhere"), "0" * 64, Encoder(layers, 60, "none", {}, INDEX_SHAPE), {"preprocessing": {}, "env_id": ""}
    )
    results = neighbors({"pixels": file}, "PlainEnv-v0", 30)
    (numbers,) = results["settings"].values()
    assert list(results["settings"]) == ["eval episodes"]
    assert numbers["random pairs"] == {"agent": None, "obstacles": None, "same_clip": None}
    assert len(numbers["pixels"]["examples"]["distance"]) == 4 and numbers["pixels"]["agent"] is None
    (shown,) = results["observations"].values()
    # A neighbor has a step number and an episode number like those of the query.
    apart = np.abs(shown["query"].astype(int) - shown["pixels"]).mean()
    assert apart < np.abs(shown["query"].astype(int) - np.roll(shown["query"], 1, axis=0)).mean()
