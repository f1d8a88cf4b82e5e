"""Spaces as JSON, and what Stable-Baselines3 takes them for."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


def is_channels_first(shape: tuple[int, ...]) -> bool:
    """Stable-Baselines3's rule: the smallest dimension of an image is its channels.

    :param shape: of an image space, three dimensions
    """
    return int(np.argmin(shape)) == 0


def space_to_json(space: gym.Space[Any]) -> dict[str, Any]:
    """A ``Discrete`` or ``Box`` space as JSON types; bounds that are the same everywhere become one number.

    :param space: ``Discrete`` or ``Box``
    """
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if not isinstance(space, spaces.Box):
        raise ValueError(f"only Discrete and Box spaces can be stored, got {space}")
    low, high = (b.flat[0].item() if (b == b.flat[0]).all() else b.tolist() for b in (space.low, space.high))
    return {"type": "Box", "low": low, "high": high, "shape": list(space.shape), "dtype": str(space.dtype)}


def space_from_json(document: dict[str, Any]) -> spaces.Discrete | spaces.Box:
    """The inverse of :func:`space_to_json`.

    :param document: what :func:`space_to_json` returned
    """
    if document["type"] == "Discrete":
        return spaces.Discrete(int(document["n"]), start=int(document["start"]))
    if document["type"] != "Box":
        raise ValueError(f"space type must be Discrete or Box, got {document['type']!r}")
    dtype = np.dtype(document["dtype"])
    low, high = (
        np.broadcast_to(np.asarray(document[side], dtype), document["shape"]).copy() for side in ("low", "high")
    )
    return spaces.Box(low, high, dtype=dtype.type)
