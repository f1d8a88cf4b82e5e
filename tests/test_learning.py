"""Slow: a shipped encoder does for PPO what it is made for."""

import pytest
from stable_baselines3.common.monitor import load_results

from sb3_abisim.__main__ import main

N_TIMESTEPS = 60_000
RANDOM_RETURN = -102  # of uniform actions in PointMaze-v0, mean over 2,000 episodes
GOOD_RETURN = -60


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["PointMaze-v0", "DistractorPointMaze-v0"])
def test_ppo_learns_on_a_frozen_encoder(tmp_path, env_id):
    command = f"train --algo ppo --env {env_id} --conf-file abisim,frozen -n {N_TIMESTEPS} --seed 0 --verbose 0"
    faster = "-params n_envs:16 n_steps:128 batch_size:256 n_epochs:4 learning_rate:3e-4"
    main([*command.split(), "--eval-freq", "-1", "-f", str(tmp_path), *faster.split()])
    episodes = load_results(str(tmp_path / "ppo" / f"{env_id}_1")).sort_values("t")
    first, last = episodes["r"][:100].mean(), episodes["r"][-200:].mean()
    assert first < RANDOM_RETURN + 25, "training starts near the return of random actions"
    assert last > GOOD_RETURN, last
