"""The spaces of data that something else has recorded, where readers have to find them out."""

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.common.spaces import ActionSpace, check_action_space
from sb3_abisim.data.copies import LAST, ImageLayout

_REMEDY = "only uint8 images can be imported, so convert them before"


def recorded_layout(space: gym.Space[Any], image_key: str | None, where: str) -> ImageLayout:
    """Where the image is in recorded observations, and how it lies there.

    :param space: of one observation
    :param image_key: which key of a ``Dict`` holds the image; None for the only one that does
    :param where: what was recorded, for messages
    :raises ValueError: if there is no image, or several and no ``image_key``, or it lies in no known way
    """
    try:
        layout = ImageLayout.of(space, image_key, _REMEDY)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    channels, *size = layout.space.shape
    # Stable-Baselines3 would guess and warn.
    if layout.channels == LAST and channels > min(size):
        raise ValueError(
            f"{where}: observations of shape {(*size, channels)} are neither channels first nor channels last; "
            "transpose them before the import"
        )
    return layout


def unread_keys(space: gym.Space[Any], layout: ImageLayout) -> list[str]:
    """Of a ``Dict`` of observations, what becomes neither the image nor a factor, for a report.

    :param space: of one observation
    :param layout: of the space
    """
    read = {*layout.factors.values(), layout.key}
    return (
        [f"observations {key!r}" for key in space.spaces if key not in read] if isinstance(space, spaces.Dict) else []
    )


def observation_space_of(observations: Any) -> gym.Space[Any]:
    """A space that recorded observations lie in.

    :param observations: array [n, ...], or such arrays by key
    """
    if isinstance(observations, Mapping):
        return spaces.Dict({key: observation_space_of(array) for key, array in observations.items()})
    array = np.asarray(observations)
    if array.dtype.kind not in "biuf" or not array.ndim:
        return spaces.Text(1)  # what holds no numbers, and no factor
    if array.dtype == np.uint8 and array.ndim in (3, 4):
        return spaces.Box(0, 255, array.shape[1:], np.uint8)
    if array.dtype.kind == "b":
        return spaces.MultiBinary(array.shape[1:]) if array.ndim > 1 else spaces.Discrete(2)
    low, high = (-np.inf, np.inf) if array.dtype.kind == "f" else (np.iinfo(array.dtype).min, np.iinfo(array.dtype).max)
    return spaces.Box(low, high, array.shape[1:], array.dtype.type)


def find_action_space(env_id: str | None, chunks: Iterable[NDArray[Any]], where: str) -> tuple[ActionSpace, bool]:
    """The action space of an environment that the user names, or the smallest that recorded actions lie in.

    :param env_id: of Gymnasium's registry; None, or another name, where there is none
    :param chunks: arrays [n, ...] of actions, all of one shape and kind
    :param where: what was recorded, for messages
    :return: the space, and whether it follows from the actions alone
    :raises ValueError: for actions that no space holds, or without any action
    """
    if env_id is not None and env_id in gym.registry:
        env = gym.make(env_id)
        space = env.action_space
        env.close()
        check_action_space(space)
        return space, False  # type: ignore[return-value]
    bounds: list[tuple[NDArray[Any], NDArray[Any]]] = []
    first: NDArray[Any] | None = None
    for chunk in chunks:
        # Booleans say themselves what they are.
        chunk = chunk if chunk.dtype.kind == "b" else recorded_actions(chunk)
        if first is None:
            first = chunk
        if chunk.dtype.kind not in "biuf":
            raise ValueError(f"{where} has actions of {chunk.dtype}; record finite numbers")
        if chunk.shape[1:] != first.shape[1:] or chunk.dtype != first.dtype:
            raise ValueError(
                f"{where} has actions of {first.dtype} {first.shape[1:]} and of {chunk.dtype} {chunk.shape[1:]}; "
                "record all of one kind"
            )
        if len(chunk):
            bounds.append((chunk.min(axis=0), chunk.max(axis=0)))
    if first is None or not bounds:
        raise ValueError(f"{where} has no actions; record one at least")
    low, high = np.min([low for low, _ in bounds], axis=0), np.max([high for _, high in bounds], axis=0)
    return _smallest_space(first, low, high, where), True


def _smallest_space(actions: NDArray[Any], low: NDArray[Any], high: NDArray[Any], where: str) -> ActionSpace:
    remedy = "name the environment (--env ID), whose action space then holds"
    kind, shape = actions.dtype.kind, actions.shape[1:]
    if kind == "b":
        return spaces.MultiBinary(shape) if shape not in ((), (1,)) else spaces.Discrete(2)
    if kind in "iu":
        if low.min() < 0:
            raise ValueError(f"{where} has whole numbers for actions, from {low.min()}, not from 0 on; {remedy}")
        if shape in ((), (1,)):
            return spaces.Discrete(int(high.max()) + 1)
        return spaces.MultiDiscrete(high.astype(np.int64) + 1)
    if not np.isfinite([low, high]).all():
        raise ValueError(
            f"{where} has actions of {actions.dtype} from {low} to {high}; record finite numbers, without gaps"
        )
    return spaces.Box(low, high, shape, actions.dtype.type)


def recorded_actions(actions: Any, space: gym.Space[Any] | None = None) -> NDArray[Any]:
    """Recorded actions of a kind that spaces take: booleans as 0 and 1, real numbers in the precision of the space.

    :param actions: array [n, ...]
    :param space: of the actions; None while it is not known, for single precision at least
    """
    array = np.asarray(actions)
    if isinstance(space, spaces.Box) and array.dtype.kind == "f":
        return array.astype(space.dtype)
    if array.dtype.kind == "b":
        return array.astype(np.int8)
    if array.dtype.kind == "f" and array.dtype not in (np.float32, np.float64):
        return array.astype(np.float32)
    return array.astype(array.dtype.newbyteorder("="))
