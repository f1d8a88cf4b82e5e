"""A features extractor for dictionary observations: an encoder per image, all else passed on."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.rl.augment import Augment
from sb3_abisim.rl.extractors import BaseEncoderExtractor, EncoderExtractor, VanillaExtractor


class CombinedEncoderExtractor(BaseFeaturesExtractor):
    """For ``MultiInputPolicy``: an encoder file for each image, everything else flattened, as SB3's
    ``CombinedExtractor`` does, and all of it in one vector.

    :param observation_space: a dictionary of one level
    :param encoders: image key to encoder file, each as for :class:`~sb3_abisim.rl.extractors.EncoderExtractor`; None
        for a network without pretraining, as :class:`~sb3_abisim.rl.extractors.VanillaExtractor` has it
    :param freeze: True keeps the encoders' weights as they are; False lets the RL algorithm train them
    :param networks: image key to ``network`` and ``network_kwargs`` of its encoder; what is not there is read from the
        file. :func:`~sb3_abisim.rl.policy_kwargs.policy_kwargs` fills it in: saved models then load without the files
    :param untrained: whether images that are not in ``encoders`` are passed on, too, through the default network of
        their size, which RL trains from scratch. They are no encoders to callbacks
    :param task_features_dim: of each image in ``encoders``, as for an extractor of one image; their outputs stand
        behind the embedding of the image
    :param augment: of all images, as for an extractor of one image
    :param augment_kwargs: its keyword arguments
    :raises ValueError: for a space that is no dictionary, an encoder for what is no image, or an image without encoder
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        encoders: Mapping[str, str | None],
        freeze: bool = False,
        networks: Mapping[str, Mapping[str, Any]] | None = None,
        untrained: bool = False,
        task_features_dim: int = 0,
        augment: str | None = None,
        augment_kwargs: dict[str, Any] | None = None,
    ) -> None:
        if not isinstance(observation_space, spaces.Dict):
            raise ValueError(f"observations must be a dictionary, got {observation_space}; use EncoderExtractor")
        images = [key for key, space in observation_space.spaces.items() if is_image_space(space)]
        unknown = [key for key in encoders if key not in images]
        if unknown:
            raise ValueError(
                f"encoders are given for {', '.join(unknown)}, but the images of {observation_space} are "
                f"{', '.join(images) or 'none'}"
            )
        without = [key for key in images if key not in encoders]
        if without and not untrained:
            raise ValueError(
                f"the images {', '.join(without)} have no encoder; name a file for each in encoders, or give "
                "untrained=True for networks that are trained from scratch"
            )
        extras: dict[str, Any] = {"augment": augment, "augment_kwargs": augment_kwargs}
        extractors: dict[str, nn.Module] = {}
        features_dim = 0
        for key, space in observation_space.spaces.items():
            if key in encoders:
                arguments = {**(networks or {}).get(key, {}), "task_features_dim": task_features_dim, **extras}
                extractor = _encoder(space, encoders[key], freeze, arguments)
                extractors[key], size = extractor, extractor.features_dim
            elif key in without:
                network = _untrained(key, space)
                augmented = [] if augment is None else [Augment(space, augment, augment_kwargs)]
                extractors[key], size = nn.Sequential(*augmented, network), network.features_dim
            else:
                extractors[key], size = nn.Flatten(), get_flattened_obs_dim(space)
            features_dim += size
        super().__init__(observation_space, features_dim)
        self.extractors = nn.ModuleDict(extractors)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """Embed images, flatten the rest, and concatenate, in the order of the space.

        :param observations: float (batch, ...) by key, images in 0..1, as SB3 preprocesses them
        :return: float (batch, features_dim)
        """
        return th.cat([extractor(observations[key]) for key, extractor in self.extractors.items()], dim=1)


def _encoder(
    space: gym.Space[Any], encoder: str | None, freeze: bool, arguments: dict[str, Any]
) -> BaseEncoderExtractor:
    if encoder is None:
        return VanillaExtractor(space, **arguments)
    return EncoderExtractor(space, encoder, freeze, **arguments)


def _untrained(key: str, space: gym.Space[Any]) -> Encoder:
    try:
        return make_encoder(space)
    except ValueError as error:
        raise ValueError(
            f"the image {key}: {error}; or keep the others only, by env_wrapper gymnasium.wrappers.FilterObservation"
        ) from error
