"""Spaces that Stable-Baselines3 does not take, refused before it fails at them, with what helps."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_abisim.common.spaces import is_channels_first
from sb3_abisim.envs.plain_actions import require_plain

_NUMBERS = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary


def check_spaces(env: gym.Env[Any, Any], frame_stack: int | None) -> None:
    """Refuse an environment that Stable-Baselines3 cannot train in.

    :param env: with its wrappers
    :param frame_stack: of the zoo's entry
    :raises ValueError: naming what is wrong, and the remedy
    """
    space = env.observation_space
    require_plain(env.action_space)
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    for stacked, taken in ((False, _NUMBERS), (True, spaces.Box)):
        others = {key: part for key, part in parts.items() if not isinstance(part, taken)}
        if others and (not stacked or (frame_stack or 1) > 1):
            what = "cannot be stacked" if stacked else "have no numbers"
            kept = [key for key in parts if key not in others]
            raise ValueError(
                f"of the observations, {', '.join(f'{key} ({type(part).__name__})' for key, part in others.items())} "
                f"{what}; keep the others only, in collect as here, by env_wrapper "
                f"{{gymnasium.wrappers.FilterObservation: {{filter_keys: {kept}}}}}"
            )
    for key, part in (parts or {"the image": space}).items():
        if isinstance(part, spaces.Box) and part.dtype == np.uint8 and len(part.shape) == 2:
            raise ValueError(
                f"Stable-Baselines3 takes images with channels, and {key} has none: {part}; add them, in collect as "
                f"here, by env_wrapper {{gymnasium.wrappers.ReshapeObservation: {{shape: {[*part.shape, 1]}}}}} or "
                "GrayscaleObservation: {keep_dim: true}"
            )


def check_image_key(space: gym.Space[Any], key: str | None) -> None:
    """Refuse a method that is for another image than the observations have.

    :param space: of the observations
    :param key: of the image in a ``Dict`` that the method is for; None for observations that are one image
    :raises ValueError: naming the images that there are
    """
    if not isinstance(space, spaces.Dict):
        if key is not None:
            raise ValueError(
                f"the image {key!r} is one of a Dict of observations, and these are {space}; leave --image-key out, "
                "and give an encoder that was pretrained on such"
            )
        return
    images = [name for name, part in space.spaces.items() if is_image_space(part)]
    if key not in images:
        wrong = "" if key is None else f"no {key!r}, but "
        raise ValueError(
            f"the observations are a Dict with {wrong}{len(images)} images ({', '.join(images) or 'none'}) in {space}; "
            "choose one with --image-key, in collect as here"
        )


def check_replayed(env: gym.Env[Any, Any], algo: str) -> None:
    """Refuse images with channels last for a replay buffer behind ``VecNormalize``.

    The buffer gets what that wrapper was shown, and rl-zoo3 puts channels first after it.

    :param env: with its wrappers
    :param algo: rl-zoo3's name of the algorithm, for the message
    :raises ValueError: naming the remedy
    """
    space = env.observation_space
    parts = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
    if any(is_image_space(part) and not is_channels_first(part.shape or ()) for part in parts):
        raise ValueError(
            f"the replay buffer of {algo} cannot hold images with channels last behind normalize (VecNormalize); give "
            "-params normalize:False"
        )
