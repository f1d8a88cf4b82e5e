"""What the tests of the objectives share: a small encoder, transitions on a line, a training loop."""

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn

from sb3_abisim.networks.heads import MLP
from sb3_abisim.networks.paper import PaperEncoder
from sb3_abisim.objectives.base import Objective, TensorBatch

DISCRETE = gym.spaces.Discrete(3)
CONTINUOUS = gym.spaces.Box(-1, 1, (2,), np.float32)


class LineEncoder(PaperEncoder):
    """Vectors instead of images, for speed."""

    observation_shape = (1, 1, 4)

    def __init__(self, features_dim: int = 5, hidden_dim: int = 16) -> None:
        layers = nn.Sequential(nn.Flatten(), MLP(4, hidden_dim, features_dim))
        super().__init__(layers, features_dim, {"n_input_channels": 1, "features_dim": features_dim})


@th.no_grad()
def change_weights(module: nn.Module, seed: int = 4) -> None:
    """Add noise to every weight, so that a module differs from the one that it was copied from."""
    generator = th.Generator().manual_seed(seed)
    for parameter in module.parameters():
        parameter.add_(0.5 * th.randn(parameter.shape, generator=generator))


def make_batch(action_space, n=256, seed=0, noise=0.0):
    """s is random, s' is s moved by the action along its first numbers; the other numbers are sampled anew."""
    generator = th.Generator().manual_seed(seed)
    s = th.rand(n, 1, 1, 4, generator=generator)
    s_next = s.clone()
    s_next[..., 2:] = th.rand(n, 1, 1, 2, generator=generator)
    if isinstance(action_space, gym.spaces.Discrete):
        actions = th.randint(0, 3, (n,), generator=generator)
        s_next[:, 0, 0, 0] += 0.2 * (actions - 1)
    else:
        actions = 2 * th.rand(n, 2, generator=generator) - 1
        s_next[:, 0, 0, :2] += 0.2 * actions
    return TensorBatch.of(s, actions, s_next)


def hidden_dims(head: nn.Module) -> list[int]:
    """Sizes of the layers of a head but for the last."""
    return [layer.out_features for layer in head.modules() if isinstance(layer, nn.Linear)][:-1]


def loss_without_values(objective: Objective, batch: TensorBatch) -> set[str]:
    """Devices of the loss and its terms for inputs on the device "meta".

    Such tensors have no values, but mixing them with others of a dimension or more fails as on a GPU.
    """
    obs, actions, next_obs = (tensor.to("meta") for tensor in (batch.obs, batch.actions, batch.next_obs))
    loss, terms = objective.to("meta").loss(TensorBatch.of(obs, actions, next_obs))
    return {tensor.device.type for tensor in (loss, *terms.values())}


def fit(objective: Objective, batch: TensorBatch, n_updates: int = 250) -> Objective:
    optimizer = th.optim.Adam(objective.parameters(), lr=5e-3)
    for _ in range(n_updates):
        loss, _ = objective.loss(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        objective.after_step()
    return objective.eval()
