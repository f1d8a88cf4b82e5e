"""Frames of datasets that hold none: rendered from the factors by the environment that was collected in.

A dataset may come from a stranger. Nothing is made of what its files name except a registered
:class:`~sb3_abisim.envs.base.BatchEnv`, through its constructor, with keyword arguments that are JSON values.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.files import is_of_system
from sb3_abisim.common.spaces import space_to_json
from sb3_abisim.common.vocabulary import current_env_kwargs
from sb3_abisim.data.format import CONTENT_HASH_KEY, DatasetError, describe_factors
from sb3_abisim.envs.base import BatchEnv, batch_class


def make_render_fn(path: Path, meta: dict[str, Any]) -> Callable[[dict[str, NDArray[Any]]], NDArray[np.uint8]]:
    """The function from factors to frames of a dataset.

    :param path: the dataset's folder, for messages
    :param meta: the content of its meta.json
    :return: :meth:`~sb3_abisim.envs.base.BatchEnv.render_factors` of an environment like the one collected in
    :raises DatasetError: if it is no registered ``BatchEnv``, cannot be made, or shows something else than then
    """
    env_id, env_kwargs = meta["env_id"], current_env_kwargs(meta["env_kwargs"])
    creator = batch_class(env_id)
    if creator is None:
        raise DatasetError(
            f"{path} holds no frames, and {env_id!r}, which would render them, is not registered here or is no "
            "BatchEnv; --packages imports what registers it, or ask the dataset's author for one with frames"
        )
    spec = gym.spec(env_id)
    try:
        env = creator(num_envs=1, **{**spec.kwargs, **env_kwargs})
    except (TypeError, ValueError, OSError, MemoryError) as error:
        if is_of_system(error):
            raise
        raise DatasetError(
            f"{path} holds no frames, and {env_id} with {env_kwargs}, which renders them, cannot be made: {error}; "
            "scan files must lie where they lay at collection (relative paths start from the current folder)"
        ) from error
    assert isinstance(env, BatchEnv)
    if not env.renders_factors:
        raise DatasetError(
            f"{path} holds no frames, and {env_id} does not render any from factors; its meta.json is damaged or forged"
        )
    here: dict[str, Any] = {
        "observation_space": space_to_json(env.single_observation_space),
        "action_space": space_to_json(env.single_action_space),
        "factors": describe_factors(env.factors()),
        CONTENT_HASH_KEY: getattr(env, "content_hash", None),
    }
    if here[CONTENT_HASH_KEY] != meta[CONTENT_HASH_KEY]:
        then, now = (str(document[CONTENT_HASH_KEY])[:16] for document in (meta, here))
        raise DatasetError(
            f"the scenes that {path} was collected in have changed (env_kwargs {env_kwargs}: content hash {then} at "
            f"collection, {now} now), and its frames are rendered from them; bring the same scan files and package "
            "version back, or collect again into a new folder"
        )
    for key in ("observation_space", "action_space", "factors"):
        if here[key] != meta[key]:
            raise DatasetError(f"{path} has {key} {meta[key]}, but {env_id} with {env_kwargs} has {here[key]}")
    return env.render_factors
