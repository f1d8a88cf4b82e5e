"""The privileged observations of Nav2D against a grid solved by hand."""

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.nav2d_marks import N_AROUND, N_CELLS, RADIUS


@pytest.mark.parametrize("env_id", ["Nav2DNeighborhood-v0", "Nav2DGains-v0"])
def test_observations_are_those_of_the_space(env_id: str) -> None:
    env = gym.make(env_id)
    observations = [env.reset(seed=1)[0], *(env.step(action)[0] for action in (0, 1, 2, 3))]
    assert all(observation in env.observation_space for observation in observations)
    assert env.spec.max_episode_steps == 50


def test_gains_are_what_a_move_changes() -> None:
    env = gym.make("Nav2DGains-v0")
    observation, _ = env.reset(seed=3)
    for action in (0, 1, 2, 3) * 5:
        cell = int(np.argmax(observation[:N_CELLS]))
        around, gains = np.split(observation[N_CELLS:], [N_AROUND])
        middle = around.reshape(2 * RADIUS + 1, -1)[RADIUS, RADIUS]
        assert middle < 0, "the agent's own cell is free"
        next_observation, _, ended, *_ = env.step(action)
        moved = int(np.argmax(next_observation[:N_CELLS])) != cell
        assert moved == (gains[action] != 0)
        if ended:
            break
        observation = next_observation
