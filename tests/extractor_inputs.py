"""What the tests of the extractors share: small algorithms, an environment of random images, encoder files."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib
import stable_baselines3 as sb3
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_abisim import registry
from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import save_encoder
from sb3_abisim.rl.extractors import ActionBisimExtractor

SPACE = spaces.Box(0, 255, (3, 15, 15), np.uint8)
OBSERVATIONS = np.random.default_rng(0).integers(0, 256, (6, 3, 15, 15), np.uint8)

ON_POLICY = {"n_steps": 8}
PPO_LIKE = {**ON_POLICY, "batch_size": 8}
OFF_POLICY = {"buffer_size": 200, "learning_starts": 4, "batch_size": 4, "train_freq": 2}
# A tau that is not a power of two: averaging equal weights by it rounds.
DQN_LIKE = {**OFF_POLICY, "target_update_interval": 2, "tau": 0.3, "exploration_fraction": 1e-9}
ALGORITHMS: dict[str, tuple[Any, dict[str, Any]]] = {
    "PPO": (sb3.PPO, {**PPO_LIKE, "n_epochs": 2}),
    "A2C": (sb3.A2C, ON_POLICY),
    "DQN": (sb3.DQN, DQN_LIKE),
    "SAC": (sb3.SAC, OFF_POLICY),
    "TD3": (sb3.TD3, {**OFF_POLICY, "policy_delay": 1}),
    "QRDQN": (sb3_contrib.QRDQN, DQN_LIKE),
    "TQC": (sb3_contrib.TQC, OFF_POLICY),
    "TRPO": (sb3_contrib.TRPO, {**PPO_LIKE, "n_critic_updates": 1}),
    "RecurrentPPO": (sb3_contrib.RecurrentPPO, {**PPO_LIKE, "n_epochs": 1}),
}
# Algorithms whose actor and critic may share an extractor, with the value that is not their default.
SHARING = {"PPO": False, "A2C": False, "TRPO": False, "RecurrentPPO": False, "SAC": True, "TD3": True, "TQC": True}
VARIANTS = [(name, False) for name in ALGORITHMS] + [(name, True) for name in SHARING]


class RandomImages(gym.Env[Any, Any]):
    """Random image observations; the reward depends on observation and action."""

    def __init__(self, continuous: bool = False, channels_last: bool = False) -> None:
        self.observation_space = spaces.Box(0, 255, (15, 15, 3) if channels_last else (3, 15, 15), np.uint8)
        self.action_space = spaces.Box(-1, 1, (2,)) if continuous else spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation = self._sample()
        return (
            observation,
            float(observation.flat[0]) / 255 + float(np.sum(action)),
            bool(self.np_random.random() < 0.2),
            False,
            {},
        )

    def _sample(self) -> Any:
        return self.np_random.integers(0, 256, self.observation_space.shape, np.uint8)


def batch_norm_network(observation_space: gym.Space[Any], width: int = 4) -> nn.Module:
    """A network whose evaluation and training modes differ."""
    return nn.Sequential(
        nn.Conv2d(3, width, 3, stride=3), nn.BatchNorm2d(width), nn.ReLU(), nn.Flatten(), nn.Linear(25 * width, 6)
    )


def register_batch_norm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register it as "BatchNorm", for one test."""
    registry.networks()
    monkeypatch.setitem(
        registry._NETWORKS.by_name, "BatchNorm", registry.Network("BatchNorm", batch_norm_network, None)
    )


def write(path: Path, network: str | None = None, objective: str = "abisim", **kwargs: Any) -> Path:
    """An encoder file with random weights, and for batch norm random statistics far from its initial ones."""
    th.manual_seed(11)
    encoder = make_encoder(SPACE, network, **kwargs)
    for name, buffer in encoder.named_buffers():
        if "running" in name:
            buffer.uniform_(0.5, 2.0)
    save_encoder(
        path,
        encoder,
        observation_space=SPACE,
        action_space=spaces.Discrete(4),
        env_id="Nav2D-v0",
        env_kwargs={},
        objective=objective,
        settings={},
        dataset_hash="0" * 64,
        reference_observations=OBSERVATIONS[:2],
    )
    return path


def build(
    name: str,
    path: Path | str,
    freeze: bool,
    other_sharing: bool = False,
    more_policy_kwargs: dict[str, Any] | None = None,
    **kwargs: Any,
) -> Any:
    algorithm, settings = ALGORITHMS[name]
    policy_kwargs: dict[str, Any] = {
        "features_extractor_class": ActionBisimExtractor,
        "features_extractor_kwargs": {"encoder": str(path), "freeze": freeze, **kwargs},
        "net_arch": [8],
        "optimizer_kwargs": {"weight_decay": 0.1},
    }
    if other_sharing:
        policy_kwargs["share_features_extractor"] = SHARING[name]
    if name == "RecurrentPPO":
        policy_kwargs["lstm_hidden_size"] = 8
    policy_kwargs |= more_policy_kwargs or {}
    policy = "CnnLstmPolicy" if name == "RecurrentPPO" else "CnnPolicy"
    env = RandomImages(continuous=name in ("SAC", "TD3", "TQC"))
    return algorithm(policy, env, seed=5, device="cpu", policy_kwargs=policy_kwargs, **settings)


def dim(observations: th.Tensor, factor: float = 0.5) -> th.Tensor:
    """An augmentation that is not random."""
    return observations * factor


def narrow(observations: th.Tensor) -> th.Tensor:
    """No augmentation: another shape."""
    return observations[:, :, 1:]
