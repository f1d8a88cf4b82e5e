"""Spaces as JSON, what Stable-Baselines3 takes them for, and the actions that a space holds."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

# What actions can be; observations are a Box.
MAX_SPACE_SIZE = 1 << 25
ActionSpace = spaces.Discrete | spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary


def is_channels_first(shape: tuple[int, ...]) -> bool:
    """Stable-Baselines3's rule: the smallest dimension of an image is its channels.

    :param shape: of an image space, three dimensions
    """
    return int(np.argmin(shape)) == 0


def is_float_image_space(space: gym.Space[Any]) -> bool:
    """Whether observations are images of floats between declared bounds, which no encoder takes as they are.

    :param space: of observations
    """
    return is_bounded_image_space(space) and np.dtype(space.dtype).kind == "f"


def is_bounded_image_space(space: gym.Space[Any]) -> bool:
    """Whether observations are images of any numbers between declared bounds.

    :param space: of observations
    """
    return isinstance(space, spaces.Box) and len(space.shape) == 3 and 0 not in space.shape and space.is_bounded()


def space_to_json(space: gym.Space[Any]) -> dict[str, Any]:
    """A space as JSON types; bounds of a ``Box`` that are the same everywhere become one number.

    :param space: ``Discrete``, ``Box``, ``MultiDiscrete`` or ``MultiBinary``
    :raises ValueError: for another space
    """
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        sides = {"nvec": space.nvec.tolist(), "start": space.start.tolist()}
        return {"type": "MultiDiscrete", **sides, "dtype": str(space.dtype)}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": space.n if isinstance(space.n, int) else [int(n) for n in space.n]}
    if not isinstance(space, spaces.Box):
        raise ValueError(f"only Discrete, Box, MultiDiscrete and MultiBinary spaces can be stored, got {space}")
    low, high = (b.flat[0].item() if (b == b.flat[0]).all() else b.tolist() for b in (space.low, space.high))
    return {"type": "Box", "low": low, "high": high, "shape": list(space.shape), "dtype": str(space.dtype)}


def space_from_json(document: dict[str, Any]) -> ActionSpace:
    """The inverse of :func:`space_to_json`.

    :param document: what :func:`space_to_json` returned
    :raises ValueError: for another type, or more than ``MAX_SPACE_SIZE`` numbers: bounds are arrays, which few letters
        in a file could make as large as they like
    """
    size = document["shape"] if document["type"] == "Box" else document.get("n") or 1
    shape = [size] if isinstance(size, int) else list(size)
    if document["type"] in ("Box", "MultiBinary") and not 0 < math.prod(int(n) for n in shape) <= MAX_SPACE_SIZE:
        raise ValueError(f"a space of {shape} numbers is empty, or larger than {MAX_SPACE_SIZE}")
    if document["type"] == "Discrete":
        return spaces.Discrete(int(document["n"]), start=int(document["start"]))
    if document["type"] == "MultiDiscrete":
        dtype = np.dtype(document["dtype"]).type
        return spaces.MultiDiscrete(document["nvec"], dtype=dtype, start=document["start"])
    if document["type"] == "MultiBinary":
        return spaces.MultiBinary(document["n"])
    if document["type"] != "Box":
        raise ValueError(f"space type must be Discrete, Box, MultiDiscrete or MultiBinary, got {document['type']!r}")
    dtype = np.dtype(document["dtype"])
    low, high = (
        np.broadcast_to(np.asarray(document[side], dtype), document["shape"]).copy() for side in ("low", "high")
    )
    return spaces.Box(low, high, dtype=dtype.type)


def check_action_space(space: gym.Space[Any]) -> None:
    """Refuse actions that cannot be sampled, stored or predicted.

    :param space: of one environment
    :raises ValueError: unless it is ``Discrete``, ``MultiDiscrete``, ``MultiBinary`` or a bounded ``Box`` of floats
    """
    if 0 in (space.shape or ()):
        raise ValueError(f"actions must hold a number at least, got {space}; give the environment one to choose")
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return
    if not isinstance(space, spaces.Box) or np.dtype(space.dtype).kind != "f":
        raise ValueError(
            f"actions must be Discrete, MultiDiscrete, MultiBinary or a Box of floats, got {space}; wrap the "
            "environment in gymnasium.wrappers.TransformAction"
        )
    if not space.is_bounded("both"):
        raise ValueError(
            f"uniformly random actions need bounds, got {space}; rescale it with a wrapper "
            "(gymnasium.wrappers.RescaleAction takes a bounded one, TransformAction any)"
        )
    if (space.low > space.high).any():
        raise ValueError(f"actions have a lower bound above the upper one, {space}; exchange them")


def action_layout(space: gym.Space[Any]) -> tuple[np.dtype[Any], tuple[int, ...]]:
    """The dtype of stored actions and the shape of one.

    :param space: one that :func:`check_action_space` takes
    """
    if isinstance(space, spaces.Discrete):
        return np.dtype(np.int64), ()
    assert space.shape is not None
    return np.dtype(space.dtype), space.shape


def sample_actions(space: gym.Space[Any], shape: tuple[int, ...], generator: np.random.Generator) -> NDArray[Any]:
    """Uniformly random actions.

    :param space: one that :func:`check_action_space` takes
    :param shape: how many
    :param generator: moved on
    :return: (*shape, *shape of an action)
    """
    (dtype, row_shape), (low, high) = action_layout(space), _action_bounds(space)
    size = (*shape, *row_shape)
    if dtype.kind == "f":
        return generator.uniform(low, high, size=size).astype(dtype)
    return generator.integers(low, high + 1, size=size, dtype=np.int64).astype(dtype)


def fit_actions(actions: Any, space: gym.Space[Any], where: str) -> NDArray[Any]:
    """Actions as a dataset holds them.

    :param actions: of one segment, [L, *shape of an action], for ``Discrete`` also [L, 1]; of any integers for a space
        of integers, of its own dtype for a ``Box``
    :param space: of one environment
    :param where: of what they are, for messages
    :return: the same of the dtype of :func:`action_layout`
    :raises ValueError: if they are not in the action space
    """
    array = np.asarray(actions)
    (dtype, row_shape), (low, high) = action_layout(space), _action_bounds(space)
    if not row_shape and array.size == len(array):
        array = array.reshape(len(array))
    kinds = array.dtype == dtype if dtype.kind == "f" else array.dtype.kind in "iu"
    if not kinds or array.shape[1:] != row_shape or not ((array >= low) & (array <= high)).all():
        raise ValueError(f"{where} has actions ({array.dtype}, {array.shape}) that are not in the action space {space}")
    return array if dtype.kind == "f" else array.astype(dtype)


def executed_actions(space: gym.Space[Any], stored: NDArray[Any], scaled: bool, clipped: bool) -> NDArray[Any]:
    """The actions that the environments got, of those that Stable-Baselines3's buffers hold.

    :param space: of one action
    :param stored: (..., number of components)
    :param scaled: whether those of a ``Box`` lie in -1..1, as off-policy algorithms store them
    :param clipped: whether the environments got those of a ``Box`` clipped to its bounds, as on-policy algorithms do
    :return: (..., *shape of an action)
    """
    stored = stored.reshape(*stored.shape[:-1], *(space.shape or ()))
    if not isinstance(space, spaces.Box):
        return stored
    if scaled:
        stored = space.low + 0.5 * (stored.astype(np.float64) + 1.0) * (space.high.astype(np.float64) - space.low)
    # Rounding may lead out of the bounds.
    return (np.clip(stored, space.low, space.high) if clipped or scaled else stored).astype(space.dtype)


def _action_bounds(space: gym.Space[Any]) -> tuple[Any, Any]:
    """The smallest and the largest action, both in the space: numbers or arrays."""
    if isinstance(space, spaces.Discrete):
        return int(space.start), int(space.start + space.n - 1)
    if isinstance(space, spaces.MultiDiscrete):
        return space.start.astype(np.int64), (space.start + space.nvec - 1).astype(np.int64)
    if isinstance(space, spaces.MultiBinary):
        return 0, 1
    assert isinstance(space, spaces.Box)
    return space.low, space.high
