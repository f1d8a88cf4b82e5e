"""The networks of the paper, one class for each of its environments.

The paper trains on images in -1..+1, so that affine map is their first layer.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.resnet import FEATURES_DIM, resnet18_layers, small_layers
from sb3_abisim.registry import register_network


class PaperEncoder(Encoder):
    """An encoder for one size of image, with any number of channels.

    :param layers: module from float images in -1..1 to (batch, features_dim)
    :param features_dim: size of the embedding
    :param network_kwargs: the constructor's keyword arguments, among them ``n_input_channels``
    :param image_size: height and width; None for those of ``observation_shape``
    """

    # (channels, height, width) that the network is the default for.
    observation_shape: ClassVar[tuple[int, int, int]]

    def __init__(
        self,
        layers: nn.Sequential,
        features_dim: int,
        network_kwargs: dict[str, Any],
        image_size: int | None = None,
    ) -> None:
        size = self.observation_shape[1:] if image_size is None else (image_size, image_size)
        shape = (network_kwargs["n_input_channels"], *size)
        super().__init__(layers, features_dim, type(self).__name__, network_kwargs, shape)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Embed images.

        :param observations: float (batch, channels, height, width) in 0..1
        :return: float (batch, features_dim)
        """
        # 2 x - 1 in one pass over memory.
        inputs = th.add(-1.0, observations, alpha=2.0)
        if th.is_grad_enabled() and not th.compiler.is_exporting():
            # The first convolution would do so forwards and again backwards. The numbers are the same.
            inputs = inputs.contiguous(memory_format=th.channels_last)
        return super().forward(inputs)


class Nav2DEncoder(PaperEncoder):
    """15 x 15 grids to 576 = 64 x 3 x 3 numbers, the size that the paper's inverse model (2 x 576 inputs) implies.

    The paper gives no layers for Nav2D. Here they are 3x3 convolutions with 32, 64, 64 channels and no padding, the
    first with stride 2 (15 -> 7 -> 5 -> 3), and no nonlinearity after the last.

    :param n_input_channels: channels of the observation
    :param features_dim: size of the embedding, 9 for each channel of the last convolution
    :raises ValueError: if ``features_dim`` is not a multiple of 9
    """

    observation_shape = (3, 15, 15)

    def __init__(self, n_input_channels: int = 3, features_dim: int = 576) -> None:
        if features_dim < 1 or features_dim % 9:
            raise ValueError(f"features_dim must be a multiple of 9, got {features_dim!r}")
        layers = nn.Sequential(
            nn.Conv2d(n_input_channels, 32, 3, stride=2),
            nn.ReLU(inplace=True),
            nn.Conv2d(32, 64, 3),
            nn.ReLU(inplace=True),
            nn.Conv2d(64, features_dim // 9, 3),
            nn.Flatten(),
        )
        kwargs = {"n_input_channels": n_input_channels, "features_dim": features_dim}
        super().__init__(layers, features_dim, kwargs)


class PointMazeEncoder(PaperEncoder):
    """64 x 64 images to 32 numbers: the paper's table for Pointmass.

    3x3 convolutions with stride 2 to 8 x 32 x 32 and 16 x 16 x 16, then an 8x8 convolution to 32 x 1 x 1. An 8x8
    kernel does not reduce a 16 x 16 map to 1 x 1. A 2x2 max pooling before it, which the paper does not have, does.

    :param n_input_channels: channels of the observation
    :param features_dim: size of the embedding, 32 in the paper
    """

    observation_shape = (3, 64, 64)

    def __init__(self, n_input_channels: int = 3, features_dim: int = 32) -> None:
        layers = nn.Sequential(
            nn.Conv2d(n_input_channels, 8, 3, stride=2, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(8, 16, 3, stride=2, padding=1),
            # The two commute, and this way round there is a quarter to rectify.
            nn.MaxPool2d(2),
            nn.ReLU(inplace=True),
            nn.Conv2d(16, features_dim, 8),
            nn.Flatten(),
        )
        kwargs = {"n_input_channels": n_input_channels, "features_dim": features_dim}
        super().__init__(layers, features_dim, kwargs)


class ScanNavEncoder(PaperEncoder):
    """128 x 128 RGB-D images to 2048 numbers: a small network for CPUs, which the paper does not have.

    :param n_input_channels: channels of the observation
    """

    observation_shape = (4, 128, 128)

    def __init__(self, n_input_channels: int = 4) -> None:
        layers = small_layers(n_input_channels)
        super().__init__(layers, FEATURES_DIM, {"n_input_channels": n_input_channels})


class ScanNavResNet18(PaperEncoder):
    """RGB-D images to 2048 numbers: the visual encoder of Habitat's PointNav policy, which the paper uses.

    :param n_input_channels: channels of the observation
    :param image_size: its height and width, 64, 128 or 256
    :raises ValueError: for another ``image_size``, at which there would not be 2048 numbers
    """

    observation_shape = (4, 256, 256)

    def __init__(self, n_input_channels: int = 4, image_size: int = 256) -> None:
        if image_size not in (64, 128, 256):
            raise ValueError(f"image_size must be 64, 128 or 256, got {image_size!r}")
        layers = resnet18_layers(n_input_channels, image_size)
        kwargs = {"n_input_channels": n_input_channels, "image_size": image_size}
        super().__init__(layers, FEATURES_DIM, kwargs, image_size)


def _factory(network_class: type[PaperEncoder]) -> Callable[..., PaperEncoder]:
    def make(observation_space: gym.Space[Any], **kwargs: Any) -> PaperEncoder:
        return network_class(**kwargs)

    return make


for _class in (Nav2DEncoder, PointMazeEncoder, ScanNavEncoder, ScanNavResNet18):
    register_network(_class.__name__, _factory(_class), observation_shape=_class.observation_shape)
