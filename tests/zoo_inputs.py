"""What the tests of the zoo's side share: an encoder of random weights, and settings small enough for a test."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th

from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import save_encoder

SMALL = {
    "ppo": ["n_envs:2", "n_steps:32", "batch_size:32"],
    "dqn": ["buffer_size:500", "learning_starts:20"],
    "sac": ["buffer_size:500", "learning_starts:280", "batch_size:8"],
}


def write_encoder(path: Path, env_id: str, objective: str = "abisim") -> str:
    env = gym.make(env_id)
    th.manual_seed(len(path.name))
    return save_encoder(
        path,
        make_encoder(env.observation_space),
        observation_space=env.observation_space,
        action_space=env.action_space,
        env_id=env_id,
        env_kwargs={},
        objective=objective,
        settings={},
        dataset_hash="0" * 64,
        reference_observations=np.stack([env.reset(seed=seed)[0] for seed in range(2)]),
    )
