"""Numbers that are none, at any step of training and in any place: training must stop before it ends."""

import random
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.reliability.children import kind_of, run

N_STEPS = 96
VALUES = (float("nan"), float("inf"), float("-inf"))
PLACES = ("reward", "observation", "action", "weight", "loss", "embedding")
# By algorithm: module, and arguments under which it learns within so many steps.
_ON_POLICY = {"n_steps": 32, "batch_size": 16}
_OFF_POLICY = {"buffer_size": 100, "learning_starts": 16, "batch_size": 8}
ALGORITHMS: dict[str, tuple[str, dict[str, Any], bool]] = {
    "PPO": ("stable_baselines3", _ON_POLICY, False),
    "A2C": ("stable_baselines3", {"n_steps": 8}, True),
    "DQN": ("stable_baselines3", _OFF_POLICY, False),
    "SAC": ("stable_baselines3", _OFF_POLICY, True),
    "TD3": ("stable_baselines3", _OFF_POLICY, True),
    "DDPG": ("stable_baselines3", _OFF_POLICY, True),
    "QRDQN": ("sb3_contrib", _OFF_POLICY, False),
    "TQC": ("sb3_contrib", _OFF_POLICY, True),
    "TRPO": ("sb3_contrib", _ON_POLICY, True),
    "RecurrentPPO": ("sb3_contrib", _ON_POLICY, False),
}


class Broken(gym.Env[Any, Any]):
    """Vectors and rewards, one of which is no number from a step on."""

    def __init__(self, continuous: bool, place: str, value: float, at: int) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32) if continuous else gym.spaces.Discrete(3)
        self.place, self.value, self.at, self.n_steps = place, value, at, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.n_steps += 1
        is_now = self.n_steps == self.at
        reward = self.value if is_now and self.place == "reward" else 1.0
        return self._observe(is_now), reward, self.n_steps % 20 == 0, False, {}

    def _observe(self, is_now: bool = False) -> Any:
        observation = self.np_random.standard_normal(3).astype(np.float32)
        if is_now and self.place == "observation":
            observation[self.n_steps % 3] = self.value
        return observation


def _model(name: str, place: str, value: float, at: int) -> Any:
    import importlib

    module, kwargs, continuous = ALGORITHMS[name]
    policy = "MlpLstmPolicy" if name == "RecurrentPPO" else "MlpPolicy"
    env = Broken(continuous, place, value, at)
    return getattr(importlib.import_module(module), name)(policy, env, seed=0, device="cpu", **kwargs)


def _break_at(model: Any, place: str, value: float, at: int, draw: random.Random) -> Any:
    """A callback that breaks what lies in the model, at a step."""
    import torch as th
    from stable_baselines3.common.callbacks import BaseCallback

    class Break(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps != at:
                return True
            with th.no_grad():
                if place == "weight":
                    parameter = draw.choice([p for p in model.policy.parameters() if p.requires_grad])
                    parameter.view(-1)[draw.randrange(parameter.numel())] = value
            return True

    if place == "action":
        predict = model.policy.forward if hasattr(model, "rollout_buffer") else model._sample_action

        def broken(*args: Any, **kwargs: Any) -> Any:
            actions, *rest = predict(*args, **kwargs)
            # Counted after the step that this action is for.
            if model.num_timesteps >= at - 1:
                actions = actions.clone() if isinstance(actions, th.Tensor) else actions.copy()
                actions.reshape(-1)[0] = value
            return (actions, *rest)

        setattr(*((model.policy, "forward") if hasattr(model, "rollout_buffer") else (model, "_sample_action")), broken)
    if place == "loss":
        train = model.train

        def logged(*args: Any, **kwargs: Any) -> Any:
            result = train(*args, **kwargs)
            if model.num_timesteps >= at:
                names = [name for name in model.logger.name_to_value if name.startswith("train/") and "loss" in name]
                if names:
                    model.logger.name_to_value[draw.choice(names)] = value
            return result

        model.train = logged
    return Break()


def _case(name: str, place: str, value: float, at: int, seed: int) -> str:
    """Whether training was stopped, and how."""
    from sb3_abisim.rl.callbacks import EncoderCallback

    warnings.simplefilter("ignore")
    model = _model(name, place, value, at)
    breaks = _break_at(model, place, value, at, random.Random(seed))
    try:
        model.learn(N_STEPS, callback=[breaks, EncoderCallback()])
    except Exception as error:
        return f"caught {kind_of(error)} {type(error).__name__}: {error}"[:300]
    return "trained to the end"


def count(n: int, work: Path, seed: int) -> dict[str, dict[str, Any]]:
    """Break numbers, in one child for each algorithm.

    :param n: times for each algorithm and each place
    :param work: a new folder
    :param seed: of steps and values
    :return: by algorithm: ``n``, ``caught`` and ``missed``, with examples of the latter
    """
    work.mkdir(parents=True)
    rows: dict[str, dict[str, Any]] = {}
    for name, (_, _, continuous) in ALGORITHMS.items():
        outcome = run(lambda name=name, continuous=continuous: _count(name, continuous, n, seed), work, seconds=3600)  # type: ignore[misc]
        if outcome.kind != "done":
            raise RuntimeError(f"{name}: {outcome.text}")
        rows[name] = outcome.value
    return rows


def _count(name: str, continuous: bool, n: int, seed: int) -> dict[str, Any]:
    draw = random.Random(f"{seed} {name}")
    row: dict[str, Any] = {"n": 0, "caught": 0, "missed": 0, "examples": []}
    for place in ("reward", "observation", "action", "weight", "loss"):
        if place == "action" and not continuous:
            continue  # integers
        for _ in range(n):
            value = draw.choice(VALUES) if place != "action" else VALUES[0]
            at = draw.randint(1, N_STEPS - 40 if place == "loss" else N_STEPS)
            told = _case(name, place, value, at, draw.randrange(2**31))
            row["n"] += 1
            is_caught = told.startswith("caught")
            row["caught"] += is_caught
            row["missed"] += not is_caught
            if not is_caught and len(row["examples"]) < 8:
                row["examples"].append(f"{name}, {place} {value} at step {at}: {told}")
    return row
