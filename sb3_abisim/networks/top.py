"""What RL is given of a network: its embedding or its trunk, and either of them with a layer on top.

In the paper it is the embedding. The trunk is what the last layers get, which make the embedding: more numbers, of
which RL can take others. A layer on top is trained with the rest in pretraining. Without an update it stays as it
begins.
"""

import inspect
from collections.abc import Callable
from typing import Any

import torch as th
from torch import nn

FEATURES = ("embedding", "trunk")


def split_arguments(
    factory: Callable[..., Any], network_kwargs: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The arguments that are for the factory, and those for :func:`with_top`.

    :param factory: of a network; arguments of its own that are called ``features`` or ``hidden_dim`` are its own
    :param network_kwargs: of both
    """
    own = inspect.signature(factory).parameters
    top = {name for name in ("features", "hidden_dim") if name in network_kwargs and name not in own}
    return (
        {name: value for name, value in network_kwargs.items() if name not in top},
        {name: value for name, value in network_kwargs.items() if name in top},
    )


def with_top(
    name: str,
    layers: nn.Module,
    input_shape: tuple[int, ...],
    features: str = "embedding",
    hidden_dim: int | None = None,
) -> nn.Module:
    """The layers of a network up to what RL is given.

    :param name: of the network, for messages
    :param layers: from images to (batch, features_dim)
    :param input_shape: (channels, height, width)
    :param features: "embedding", or "trunk": what the last convolution, linear layer or block of layers gets
    :param hidden_dim: units of a linear layer with ReLU on top; None for none
    :raises ValueError: for other ``features``, a ``hidden_dim`` below 1, or a network whose last layers are not known
    """
    if features not in FEATURES:
        raise ValueError(f"features must be 'embedding' or 'trunk', got {features!r}")
    if hidden_dim is not None and (not isinstance(hidden_dim, int) or hidden_dim < 1):
        raise ValueError(f"hidden_dim must be a whole number of at least 1, or None, got {hidden_dim!r}")
    parts = list(layers) if isinstance(layers, nn.Sequential) else [layers]
    if features == "trunk":
        last = max((i for i, part in enumerate(parts) if _makes_features(part)), default=0)
        if last == 0:
            raise ValueError(
                f"features='trunk' needs a network that is an nn.Sequential of several layers, and {name} is none; "
                "leave it out (features:embedding)"
            )
        parts = [*parts[:last], nn.Flatten()]
    if hidden_dim is not None:
        with th.no_grad(), th.random.fork_rng(devices=[]):
            features_dim = nn.Sequential(*parts)(th.zeros(1, *input_shape)).shape[1]
        parts = [*parts, nn.Linear(features_dim, hidden_dim), nn.ReLU(inplace=True)]
    return nn.Sequential(*parts)


def _makes_features(part: nn.Module) -> bool:
    """Whether a part of a network can be its last layer with weights: norms only scale what is there."""
    return isinstance(part, nn.Linear | nn.Conv2d) or any(True for _ in part.children())
