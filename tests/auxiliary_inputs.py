"""What the tests of auxiliary objectives share: an environment whose observations say where they come from, an
objective that records its batches, and small algorithms."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from extractor_inputs import ALGORITHMS, SHARING
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_abisim import registry
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.rl.extractors import VanillaExtractor

SHAPE = (4, 5, 6)
# Lower bound and width of continuous actions.
LOW, WIDTH = 2.0, 3.0
# The channels of an observation.
STEP, EPISODE, ACTION, ENDED = range(4)
CONTINUOUS = ("SAC", "TD3", "TQC")


def action_code(actions: Any) -> NDArray[np.int64]:
    """What an observation says of the action that led to it; a byte."""
    array = np.asarray(actions)
    return np.rint((array - LOW) / WIDTH * 200).astype(np.int64) if array.dtype.kind == "f" else 100 * array


class CountingEnv(gym.Env[Any, Any]):
    """Its four channels hold the step within the episode, the episode's number, the code of the action that led here,
    and whether the episode has ended by itself here. Every fifth action from the start of an episode pays.

    :param continuous: whether actions are a ``Box`` far from -1..1
    :param first: number of the first episode
    :param as_dict: whether the observation is the image of a dictionary
    """

    def __init__(self, continuous: bool = False, first: int = 0, as_dict: bool = False) -> None:
        image = spaces.Box(0, 255, SHAPE, np.uint8)
        self.as_dict = as_dict
        self.observation_space = spaces.Dict({"camera": image, "speed": spaces.Box(-1, 1, (2,))}) if as_dict else image
        self.action_space = spaces.Box(LOW, LOW + WIDTH, (1,)) if continuous else spaces.Discrete(3)
        self._episode = first - 1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._step, self._action, self._ended = 0, 255, False
        self._episode += 1
        self._length = int(self.np_random.integers(1, 9))
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self._step += 1
        self._action = int(action_code(action).item())
        self._ended = self._step == self._length
        return self._observe(), float(np.sum(action) > 2), self._ended, False, {}

    def _observe(self) -> Any:
        values = np.array([self._step, self._episode % 256, self._action, self._ended], np.uint8)
        image = np.broadcast_to(values[:, None, None], SHAPE).copy()
        return {"camera": image, "speed": np.zeros(2, np.float32)} if self.as_dict else image


def make_envs(n_envs: int = 2, limit: int = 5, **kwargs: Any) -> DummyVecEnv:
    """Copies whose episodes have numbers of their own; longer ones are truncated."""
    make: list[Callable[[], Any]] = [
        lambda i=i: gym.wrappers.TimeLimit(CountingEnv(first=128 * i, **kwargs), limit)  # type: ignore[misc]
        for i in range(n_envs)
    ]
    return DummyVecEnv(make)


class Recorder(Objective):
    """Predicts nothing, and keeps every batch."""

    name = "recorder"
    batches: list[TensorBatch] = []

    def __init__(self, encoder: Any, action_space: Any) -> None:
        super().__init__(encoder, action_space)
        self.head = nn.Linear(encoder.features_dim, 1)

    @classmethod
    def check_k(cls, k: Any) -> None:
        pass

    def loss(self, batch: TensorBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        self.batches.append(batch)
        return self.head(self.encoder(batch.obs)).pow(2).mean(), {}


class SequenceRecorder(Recorder):
    """Of all k actions."""

    name = "sequence_recorder"
    reads_action_sequences = True

    def __init__(self, encoder: Any, action_space: Any, k: int) -> None:
        super().__init__(encoder, action_space)


def flat_network(observation_space: gym.Space[Any], width: int = 6) -> nn.Module:
    return nn.Sequential(nn.Flatten(), nn.Linear(int(np.prod(observation_space.shape)), width), nn.Tanh())


# Small, and so that every objective finds what it needs in few steps.
SMALL: dict[str, Any] = {"update_interval": 8, "batch_size": 16}
FEW_GOALS: dict[str, Any] = {"n_goals": 6, "goal_share": 0.1}


def register_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register the objectives and the network "Flat", and let few observations prepare an objective, for one test."""
    registry.networks(), registry.methods()
    monkeypatch.setitem(registry._NETWORKS.by_name, "Flat", registry.Network("Flat", flat_network, None))
    for objective in (Recorder, SequenceRecorder):
        method = registry.Method(
            objective.name, objective, "", objective.__name__ + "Extractor", None, None, "", (), None
        )
        monkeypatch.setitem(registry._METHODS.by_name, objective.name, method)
    monkeypatch.setattr(Recorder, "batches", [])
    monkeypatch.setattr("sb3_abisim.rl.auxiliary.N_PREPARE", 24)
    monkeypatch.setattr("sb3_abisim.rl.auxiliary_trainer.N_PREPARE", 24)


def build(name: str, env: Any = None, other_sharing: bool = False, **kwargs: Any) -> Any:
    """A small algorithm on the network "Flat", from scratch.

    :param other_sharing: whether actor and critic share the extractor where they do not by default, or the reverse
    :param kwargs: of the algorithm; ``features_extractor_kwargs`` and ``optimizer_class`` are of the policy
    """
    algorithm, settings = ALGORITHMS[name]
    policy_kwargs: dict[str, Any] = {
        "features_extractor_class": VanillaExtractor,
        "features_extractor_kwargs": {"network": "Flat"},
        "net_arch": [4],
    }
    if other_sharing:
        policy_kwargs["share_features_extractor"] = SHARING[name]
    if name == "RecurrentPPO":
        policy_kwargs["lstm_hidden_size"] = 4
    for key in ("features_extractor_class", "features_extractor_kwargs", "optimizer_class"):
        if key in kwargs:
            policy_kwargs[key] = kwargs.pop(key)
    env = make_envs(continuous=name in CONTINUOUS) if env is None else env
    kind = "MultiInput" if isinstance(env.observation_space, spaces.Dict) else "Cnn"
    policy = kind + ("LstmPolicy" if name == "RecurrentPPO" else "Policy")
    return algorithm(policy, env, seed=5, device="cpu", policy_kwargs=policy_kwargs, **{**settings, **kwargs})
