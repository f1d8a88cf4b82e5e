"""What the tests of the zoo share: an encoder of random weights, and settings small enough for a test."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_abisim.__main__ import main
from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import save_encoder

SMALL = {
    "ppo": ["n_envs:2", "n_steps:32", "batch_size:32"],
    "dqn": ["buffer_size:500", "learning_starts:20"],
    "sac": ["buffer_size:500", "learning_starts:280", "batch_size:8"],
}


def write_encoder(
    path: Path,
    env_id: str,
    objective: str = "abisim",
    preprocessing: dict[str, Any] | None = None,
    **network_kwargs: Any,
) -> str:
    env = gym.make(env_id)
    th.manual_seed(len(path.name))
    return save_encoder(
        path,
        make_encoder(env.observation_space, **network_kwargs),
        observation_space=env.observation_space,
        action_space=env.action_space,
        env_id=env_id,
        env_kwargs={},
        objective=objective,
        settings={},
        dataset_hash="0" * 64,
        reference_observations=np.stack([env.reset(seed=seed)[0] for seed in range(2)]),
        preprocessing=preprocessing,
    )


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    """``sb3-abisim`` with these words, in this process."""
    monkeypatch.setattr(sys, "argv", [])
    main(words)
