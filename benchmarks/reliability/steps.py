"""Random steps in every registered environment: what it declares, twice the same, and copies that go on alike."""

import copy
import math
import pickle
import random
from typing import Any

import gymnasium as gym
import numpy as np

# Shares of all steps, by how fast an environment is.
SHARES = {
    "Nav2D-v0": 0.2, "Nav2DCorridor-v0": 0.15, "Nav2DMaze-v0": 0.15, "Nav2DRandomGoal-v0": 0.1,
    "PointMaze-v0": 0.04, "ContinuousPointMaze-v0": 0.04,
    "PointMazeRandomGoal-v0": 0.04, "ContinuousPointMazeRandomGoal-v0": 0.04,
    "DistractorPointMaze-v0": 0.04, "ContinuousDistractorPointMaze-v0": 0.04,
    "DistractorPointMazeRandomGoal-v0": 0.04, "ContinuousDistractorPointMazeRandomGoal-v0": 0.04,
    "ScanNav-v0": 0.06, "ScanNavPaper-v0": 0.02,
}  # fmt: skip
N_ENVS = 16
_REFUSED = (ValueError, RuntimeError)


def count(n: int, seed: int) -> dict[str, dict[str, Any]]:
    """Step.

    :param n: steps of all environments together, those of a second environment that must give the same not counted
    :param seed: of seeds and actions
    :return: by id: ``steps``, ``breaches`` of what is declared, ``different`` where two should agree, with examples
    """
    from sb3_abisim.envs import ENV_IDS

    if set(SHARES) != set(ENV_IDS):
        raise RuntimeError(f"the shares are of other environments than {ENV_IDS}")
    return {env_id: _count(env_id, max(1, int(share * n)), seed) for env_id, share in SHARES.items()}


class _Row(dict[str, Any]):
    def breach(self, key: str, text: str) -> None:
        self[key] += 1
        if len(self["examples"]) < 5:
            self["examples"].append(text)


def _count(env_id: str, n: int, seed: int) -> dict[str, Any]:
    row = _Row(steps=0, refused=0, breaches=0, different=0, examples=[])
    draw = random.Random(f"{seed} {env_id}")
    # Nine of ten steps in a batch, which is faster.
    n_single = n // 10
    _batch(env_id, n - n_single, draw, row)
    while row["steps"] < n:
        _single(env_id, min(n - row["steps"], 400), draw, row)
    return dict(row)


def _batch(env_id: str, n: int, draw: random.Random, row: _Row) -> None:
    pair = [gym.make_vec(env_id, num_envs=N_ENVS, vectorization_mode="vector_entry_point") for _ in range(2)]
    seed = draw.randrange(2**31)
    first, second = (env.reset(seed=seed)[0] for env in pair)
    space = pair[0].single_observation_space
    pair[0].action_space.seed(seed)
    for turn in range(math.ceil(n / N_ENVS)):
        if turn % 500 == 499:
            # It goes on as a copy of itself.
            pair[1] = pickle.loads(pickle.dumps(pair[1])) if draw.random() < 0.5 else copy.deepcopy(pair[1])
        if turn % 97 == 5:
            _refuses(pair[0], pair[0].action_space, draw, row)
        actions = pair[0].action_space.sample()
        results = [env.step(actions) for env in pair]
        row["steps"] += min(N_ENVS, n - row["steps"])
        observations, rewards, terminated, truncated, _ = results[0]
        first, second = (result[0] for result in results)
        if not _fits(observations, space, N_ENVS):
            row.breach("breaches", f"{env_id}: observations {observations.dtype} {observations.shape} are no {space}")
        if rewards.shape != (N_ENVS,) or not np.isfinite(rewards).all():
            row.breach("breaches", f"{env_id}: rewards {rewards}")
        if terminated.dtype != bool or truncated.dtype != bool or (terminated & truncated).any():
            row.breach("breaches", f"{env_id}: ends {terminated} {truncated}")
        if not (
            np.array_equal(first, second)
            and all(np.array_equal(a, b) for a, b in zip(results[0][1:4], results[1][1:4], strict=True))
        ):
            row.breach("different", f"{env_id}: two batches of seed {seed} differ at step {turn}")
    for env in pair:
        env.close()


def _fits(observations: Any, space: Any, n: int) -> bool:
    return (
        isinstance(observations, np.ndarray)
        and observations.dtype == space.dtype
        and observations.shape == (n, *space.shape)
        and bool((observations >= space.low.min()).all())
        and bool((observations <= space.high.max()).all())
    )


def _single(env_id: str, n: int, draw: random.Random, row: _Row) -> None:
    env: Any = gym.make(env_id)
    seed = draw.randrange(2**31)
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    twin: Any = None
    for turn in range(n):
        if turn % 50 == 20:
            twin = copy.deepcopy(env)
        if turn % 61 == 7:
            _refuses(env, env.action_space, draw, row)
        action = env.action_space.sample()
        observation, reward, terminated, truncated, _ = env.step(action)
        row["steps"] += 1
        if not env.observation_space.contains(observation) or not math.isfinite(reward):
            row.breach("breaches", f"{env_id}: reward {reward} or an observation is not what is declared")
        if twin is not None:
            other, its_reward, *its_ends, _ = twin.step(action)
            if not np.array_equal(observation, other) or reward != its_reward or its_ends != [terminated, truncated]:
                row.breach("different", f"{env_id}: a copy of seed {seed} differs at step {turn}")
        if terminated:
            # After a truncation alone, gymnasium.make's TimeLimit lets it through, and the environment knows of no end.
            try:
                env.step(action)
                row.breach("breaches", f"{env_id}: a step after the end was taken")
            except _REFUSED:
                row["refused"] += 1
        if terminated or truncated:
            observation, _ = env.reset()
            twin = None
            if not env.observation_space.contains(observation):
                row.breach("breaches", f"{env_id}: a first observation is not what is declared")
    env.close()


def _refuses(env: Any, space: Any, draw: random.Random, row: _Row) -> None:
    """An action that is none is refused, and nothing has moved."""
    wrong = draw.choice(
        [
            None,
            np.full(space.shape, 10**6),
            np.full(space.shape, -3.0),
            np.full(space.shape, np.nan),
            np.zeros((7, 7)),
            "a",
        ]
    )
    try:
        env.step(wrong)
        row.breach("breaches", f"{type(env.unwrapped).__name__} took the action {wrong!r}")
    except (*_REFUSED, TypeError, AssertionError):
        row["refused"] += 1
