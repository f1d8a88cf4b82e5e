"""Datasets of Minari as others write them."""

import gymnasium as gym
import numpy as np
import pytest

minari = pytest.importorskip("minari")


def make_minari(dataset_id: str, episodes: list[dict], observation_space: gym.Space, **kwargs: object) -> None:
    """A dataset written by somebody else."""
    buffers = [minari.data_collector.EpisodeBuffer(**episode) for episode in episodes]
    space = kwargs.pop("action_space", gym.spaces.Discrete(3))
    with pytest.warns(UserWarning):
        minari.create_dataset_from_buffers(
            dataset_id, buffers, observation_space=observation_space, action_space=space, **kwargs
        )


def episode(frames: np.ndarray, terminated: bool = False, truncated: bool = False, **changes: object) -> dict:
    n = len(frames) - 1
    at_end = np.arange(n) == n - 1
    return {
        "observations": frames,
        "actions": np.arange(n) % 3,
        "rewards": np.ones(n),
        "terminations": at_end & terminated,
        "truncations": at_end & truncated,
        "infos": {},
    } | changes


def make_frames(n: int, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(256, size=(n, *shape), dtype=np.uint8)
