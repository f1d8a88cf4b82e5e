"""The encoders and the small heads that objectives put on them.

An encoder takes what Stable-Baselines3 hands to a features extractor: float images in 0..1, channels first. The paper
trains on -1..+1, so that affine map is the encoder's first layer.
"""

import itertools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.scan_networks import FEATURES_DIM, resnet18_layers, small_layers


class Encoder(nn.Module):
    """A convolutional network from images to an embedding, rebuilt from :meth:`spec` alone.

    Its weights lie in memory with channels last, and so do the activations that torch makes with them: on a CPU the
    layout in which small convolutions are fastest.

    :param layers: module from float images (batch, channels, height, width) in -1..1 to (batch, features_dim)
    :param features_dim: size of the embedding
    :param constructor_kwargs: the constructor arguments of the subclass, JSON types only
    """

    # (channels, height, width) that the subclass is made for.
    observation_shape: tuple[int, int, int]

    def __init__(self, layers: nn.Module, features_dim: int, constructor_kwargs: dict[str, Any]) -> None:
        super().__init__()
        self.layers = layers
        self.features_dim = features_dim
        self._constructor_kwargs = constructor_kwargs
        self.offset: th.Tensor
        self.scale: th.Tensor
        self.register_buffer("offset", th.zeros(features_dim))
        self.register_buffer("scale", th.ones(()))
        self._lay_out(th.channels_last)

    def _lay_out(self, memory_format: th.memory_format) -> None:
        self.to(memory_format=memory_format)  # type: ignore[call-overload]

    def apply(self, fn: Callable[[nn.Module], None]) -> "Encoder":
        """As in torch, whose ``orthogonal_`` (which SB3 initialises with) takes no weights with channels last.

        :param fn: called on every submodule
        """
        self._lay_out(th.contiguous_format)
        super().apply(fn)
        self._lay_out(th.channels_last)
        return self

    def spec(self) -> dict[str, Any]:
        """The architecture as JSON: ``make_encoder(space, spec["name"], **spec["kwargs"])`` builds it again."""
        return {"name": type(self).__name__, "kwargs": dict(self._constructor_kwargs)}

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """(channels, height, width) of the observations that this network takes."""
        n_channels = self._constructor_kwargs.get("n_input_channels", self.observation_shape[0])
        return n_channels, *self.observation_shape[1:]

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Embed images.

        :param observations: float (batch, channels, height, width) in 0..1
        :return: float (batch, features_dim)
        """
        # 2 x - 1 in one pass over memory.
        features: th.Tensor = self.layers(th.add(-1.0, observations, alpha=2.0))
        return (features - self.offset) * self.scale

    @th.no_grad()
    def standardize(self, observations: th.Tensor) -> None:
        """Shift and scale the embedding so that its numbers have mean 0 and, on average, variance 1.

        One factor for all of them: distances between embeddings keep their ratios. Pretraining leaves the scale
        arbitrary (an L1 penalty makes it small, since the head can undo that), but the networks that RL puts on top
        start from weights made for inputs of variance 1.

        :param observations: float (batch, channels, height, width) in 0..1, many enough for a mean
        :raises ValueError: if the embedding is the same for all of them
        """
        # In parts: the first layers' activations are many times as large as the embedding.
        embeddings = th.cat([self(part) for part in th.split(observations, 256)])
        variance = embeddings.var(dim=0, correction=0).mean()
        if not float(variance) > 0:
            raise ValueError("the embedding is the same for all observations: nothing was learned, or it has collapsed")
        self.offset += embeddings.mean(dim=0) / self.scale
        self.scale /= variance.sqrt()


class Nav2DEncoder(Encoder):
    """15 x 15 grids to 576 = 64 x 3 x 3 numbers, the size that the paper's inverse model (2 x 576 inputs) implies.

    The paper gives no layers for Nav2D. Ours: 3x3 convolutions with 32, 64, 64 channels and no padding, the first with
    stride 2 (15 -> 7 -> 5 -> 3), no nonlinearity after the last.

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
        super().__init__(layers, features_dim, {"n_input_channels": n_input_channels, "features_dim": features_dim})


class PointMazeEncoder(Encoder):
    """64 x 64 pictures to 32 numbers: the paper's table for Pointmass.

    3x3 convolutions with stride 2 to 8 x 32 x 32 and 16 x 16 x 16, then an 8x8 convolution to 32 x 1 x 1. An 8x8
    kernel does not reduce a 16 x 16 map to 1 x 1; we put a 2x2 max pooling before it, which does.

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
        super().__init__(layers, features_dim, {"n_input_channels": n_input_channels, "features_dim": features_dim})


class ScanNavEncoder(Encoder):
    """128 x 128 RGB-D pictures to 2048 numbers: a small network for CPUs, ours.

    :param n_input_channels: channels of the observation
    """

    observation_shape = (4, 128, 128)

    def __init__(self, n_input_channels: int = 4) -> None:
        super().__init__(small_layers(n_input_channels), FEATURES_DIM, {"n_input_channels": n_input_channels})


class ScanNavResNet18(Encoder):
    """RGB-D pictures to 2048 numbers: the visual encoder of Habitat's PointNav policy, which the paper uses.

    :param n_input_channels: channels of the observation
    :param image_size: its height and width, 64, 128 or 256
    :raises ValueError: for another ``image_size``, at which there would not be 2048 numbers
    """

    observation_shape = (4, 256, 256)

    def __init__(self, n_input_channels: int = 4, image_size: int = 256) -> None:
        if image_size not in (64, 128, 256):
            raise ValueError(f"image_size must be 64, 128 or 256, got {image_size!r}")
        layers = resnet18_layers(n_input_channels, image_size)
        super().__init__(layers, FEATURES_DIM, {"n_input_channels": n_input_channels, "image_size": image_size})
        self.observation_shape = (n_input_channels, image_size, image_size)


ENCODERS: dict[str, type[Encoder]] = {
    cls.__name__: cls for cls in (Nav2DEncoder, PointMazeEncoder, ScanNavEncoder, ScanNavResNet18)
}


def make_encoder(observation_space: gym.Space[Any], name: str | None = None, **kwargs: Any) -> Encoder:
    """Build an encoder for an observation space.

    :param observation_space: a channels-first image space
    :param name: a key of :data:`ENCODERS`; None takes the one made for the space's shape
    :param kwargs: passed to its constructor
    :raises ValueError: for an unknown name or keyword, or a space that the network does not fit
    """
    shape = observation_space.shape
    if name is None:
        fitting = [key for key, cls in ENCODERS.items() if cls.observation_shape == shape]
        if not fitting:
            known = ", ".join(f"{key} {cls.observation_shape}" for key, cls in ENCODERS.items())
            raise ValueError(f"no default encoder for observations of shape {shape}; known are: {known}")
        name = fitting[0]
    if name not in ENCODERS:
        raise ValueError(f"unknown encoder network {name!r}; known are {sorted(ENCODERS)}")
    try:
        # SB3 turns pictures into float32, whatever torch's default is.
        encoder = ENCODERS[name](**kwargs).float()
    except TypeError as error:
        raise ValueError(f"{name} does not take these arguments: {error}") from error
    if shape != encoder.input_shape:
        raise ValueError(f"{name} takes observations of shape {encoder.input_shape}, got {shape}")
    return encoder


class MLP(nn.Sequential):
    """A multilayer perceptron with ReLU between its linear layers.

    :param dims: sizes of input, hidden layers and output
    """

    def __init__(self, *dims: int) -> None:
        layers: list[nn.Module] = []
        for n_in, n_out in itertools.pairwise(dims):
            layers += [nn.Linear(n_in, n_out), nn.ReLU()]
        super().__init__(*layers[:-1])
