"""A features extractor for dictionary observations: an encoder per image, vectors passed on."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from torch import nn

from sb3_abisim.networks.base import NATURE_SIZE
from sb3_abisim.rl.augment import Augment
from sb3_abisim.rl.extractors import EncoderExtractor


class CombinedEncoderExtractor(BaseFeaturesExtractor):
    """For ``MultiInputPolicy``: an encoder file for each image, everything else flattened, as SB3's
    ``CombinedExtractor`` does, and all of it in one vector.

    :param observation_space: a dictionary of one level
    :param encoders: image key to encoder file, each as for :class:`~sb3_abisim.rl.extractors.EncoderExtractor`
    :param freeze: True keeps the encoders' weights as they are; False lets the RL algorithm train them
    :param networks: image key to ``network`` and ``network_kwargs`` of its encoder; what is not there is read from the
        file. :func:`~sb3_abisim.rl.policy_kwargs.policy_kwargs` fills it in: saved models then load without the files
    :param nature_cnn: whether images without an encoder get SB3's untrained ``NatureCNN``
    :param cnn_output_dim: size of its output, as in SB3
    :param task_features_dim: of each image with an encoder, as for an extractor of one image; their outputs stand
        behind the embedding of the image
    :param augment: of all images, as for an extractor of one image
    :param augment_kwargs: its keyword arguments
    :raises ValueError: for a space that is no dictionary, an encoder for what is no image, or an image without encoder
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        encoders: Mapping[str, str],
        freeze: bool = False,
        networks: Mapping[str, Mapping[str, Any]] | None = None,
        nature_cnn: bool = False,
        cnn_output_dim: int = 256,
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
        if without and not nature_cnn:
            raise ValueError(
                f"the images {', '.join(without)} have no encoder; name a file for each in encoders, or give "
                "nature_cnn=True for Stable-Baselines3's untrained NatureCNN"
            )
        extractors: dict[str, nn.Module] = {}
        features_dim = 0
        for key, space in observation_space.spaces.items():
            extractor: BaseFeaturesExtractor | None = None
            if key in encoders:
                extractor = EncoderExtractor(
                    space,
                    encoders[key],
                    freeze,
                    **(networks or {}).get(key, {}),
                    task_features_dim=task_features_dim,
                    augment=augment,
                    augment_kwargs=augment_kwargs,
                )
            elif key in without:
                if min((space.shape or ())[1:]) < NATURE_SIZE:
                    raise ValueError(
                        f"NatureCNN takes images of at least {NATURE_SIZE} pixels, channels first, but {key} has "
                        f"{space.shape}; pretrain an encoder for it, which may be small"
                    )
                extractor = NatureCNN(space, features_dim=cnn_output_dim)
            extractors[key] = nn.Flatten() if extractor is None else extractor
            if augment is not None and key in without:
                extractors[key] = nn.Sequential(Augment(space, augment, augment_kwargs), extractors[key])
            features_dim += get_flattened_obs_dim(space) if extractor is None else extractor.features_dim
        super().__init__(observation_space, features_dim)
        self.extractors = nn.ModuleDict(extractors)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """Embed images, flatten the rest, and concatenate, in the order of the space.

        :param observations: float (batch, ...) by key, images in 0..1, as SB3 preprocesses them
        :return: float (batch, features_dim)
        """
        return th.cat([extractor(observations[key]) for key, extractor in self.extractors.items()], dim=1)
