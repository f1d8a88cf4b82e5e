"""Encoders: networks from image observations to embeddings, built by name.

An encoder takes what Stable-Baselines3 hands to a features extractor: float images in 0..1, channels first.
"""

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import preprocess_obs
from torch import nn

from sb3_abisim.networks.top import split_arguments, with_top
from sb3_abisim.registry import get_network, import_network, is_import_path, networks

# The least side of images for the network "nature".
NATURE_SIZE = 36


class Encoder(nn.Module):
    """A network from images to an embedding, rebuilt from :meth:`spec` alone.

    Its weights lie in memory with channels last, and so do the activations that torch makes with them: on a CPU the
    layout in which small convolutions are fastest.

    :param layers: module from float images (batch, channels, height, width) in 0..1 to (batch, features_dim)
    :param features_dim: size of the embedding
    :param name: of the network in the registry
    :param network_kwargs: keyword arguments of its factory, JSON types only
    :param input_shape: (channels, height, width) of the observations
    """

    # Whether the weights come from an encoder file.
    is_pretrained = False

    def __init__(
        self,
        layers: nn.Module,
        features_dim: int,
        name: str,
        network_kwargs: dict[str, Any],
        input_shape: tuple[int, ...],
    ) -> None:
        super().__init__()
        self.layers = layers
        self.features_dim = features_dim
        self.input_shape = input_shape
        self._name, self._network_kwargs = name, network_kwargs
        self.offset: th.Tensor
        self.scale: th.Tensor
        self.register_buffer("offset", th.zeros(features_dim))
        self.register_buffer("scale", th.ones(()))
        set_memory_format(self, th.channels_last)

    def apply(self, fn: Callable[[nn.Module], None]) -> "Encoder":
        """As in torch, whose ``orthogonal_`` (which SB3 initializes with) takes no weights with channels last.

        Does nothing to weights that come from a file: whoever initializes an agent would overwrite them.

        :param fn: called on every submodule
        """
        if self.is_pretrained:
            return self
        set_memory_format(self, th.contiguous_format)
        super().apply(fn)
        set_memory_format(self, th.channels_last)
        return self

    def put_on_top(self, **top: Any) -> None:
        """Give RL something else of this network, before it has been trained.

        :param top: ``features`` and ``hidden_dim`` of :func:`~sb3_abisim.networks.top.with_top`
        """
        self.layers = with_top(self._name, self.layers, self.input_shape, **top)
        # Only what differs from the plain network is named, so that equal networks have equal specs.
        plain = {"features": "embedding", "hidden_dim": None}
        self._network_kwargs |= {name: value for name, value in top.items() if value != plain[name]}
        self.features_dim = find_features_dim(self._name, self.layers, self.input_shape)
        self.offset = th.zeros(self.features_dim)
        set_memory_format(self, th.channels_last)

    def warm_start(self, other: "Encoder") -> int:
        """Take the weights of all layers that another network has, too.

        :param other: any
        :return: number of weights taken
        """
        own, theirs = self._parts().state_dict(), other._parts().state_dict()
        shared = {key: theirs[key] for key in own if key in theirs and theirs[key].shape == own[key].shape}
        self._parts().load_state_dict(own | shared)
        return sum(tensor.numel() for tensor in shared.values())

    def _parts(self) -> nn.Sequential:
        """The layers; those of any other module as the first part, as they are under a layer on top."""
        return self.layers if isinstance(self.layers, nn.Sequential) else nn.Sequential(self.layers)

    def spec(self) -> dict[str, Any]:
        """The architecture as JSON: ``make_encoder(space, spec["name"], **spec["kwargs"])`` builds it again."""
        return {"name": self._name, "kwargs": dict(self._network_kwargs)}

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Embed images.

        :param observations: float (batch, channels, height, width) in 0..1
        :return: float (batch, features_dim)
        """
        features: th.Tensor = self.layers(observations)
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


def set_memory_format(module: nn.Module, memory_format: th.memory_format) -> None:
    """Change the order in memory of the weights of 2-d convolutions, in place.

    :param module: any; unlike ``Module.to``, this leaves weights of other dimensions alone instead of refusing them
    :param memory_format: ``torch.channels_last`` or ``torch.contiguous_format``
    """
    for tensor in (*module.parameters(), *module.buffers()):
        if tensor.dim() == 4:
            tensor.data = tensor.data.contiguous(memory_format=memory_format)


def preprocess(observations: th.Tensor | NDArray[np.uint8], observation_space: gym.Space[Any]) -> th.Tensor:
    """Observations as encoders take them, by the preprocessing that SB3 puts before a features extractor.

    :param observations: uint8 (batch, channels, height, width)
    :param observation_space: of one observation
    :return: float32 in 0..1, of the same shape, device and memory format
    """
    inputs = preprocess_obs(th.as_tensor(observations), observation_space)
    assert isinstance(inputs, th.Tensor)
    return inputs


def make_encoder(observation_space: gym.Space[Any], name: str | None = None, **kwargs: Any) -> Encoder:
    """Build an encoder for an observation space.

    :param observation_space: a channels-first image space
    :param name: of a registered network, or ``pkg.module:Factory``, which is imported: never a name that only a file
        holds; None takes :func:`default_network`
    :param kwargs: keyword arguments of its factory, and ``features`` and ``hidden_dim``, which every network takes
        (:mod:`sb3_abisim.networks.top`)
    :raises ValueError: for an unknown name or keyword, or a space that the network does not fit
    """
    shape = observation_space.shape
    if shape is None or len(shape) != 3:
        raise ValueError(f"observations must be images (channels, height, width), got {observation_space}")
    if name is None:
        name = default_network(shape)
    if is_import_path(name):
        import_network(name)
    factory = get_network(name).factory
    own_kwargs, top = split_arguments(factory, kwargs)
    try:
        module = factory(observation_space, **own_kwargs)
    except TypeError as error:
        parameters = list(inspect.signature(factory).parameters.values())[1:]
        names = ", ".join(one.name for one in parameters if one.kind is not one.VAR_KEYWORD)
        takes = f"; it takes {names}" if names else ""
        raise ValueError(
            f"{name} does not take these arguments ({error}){takes}; correct network_kwargs, or leave them out"
        ) from error
    if not isinstance(module, Encoder):
        module = Encoder(module, find_features_dim(name, module, shape), name, own_kwargs, shape)
    # SB3 turns observations into float32, whatever torch's default is.
    encoder: Encoder = module.float()
    if shape != encoder.input_shape:
        raise ValueError(
            f"{name} takes observations of shape {encoder.input_shape}, got {shape}; name another network, such as "
            f"{generic_network(shape)}"
        )
    if top:
        encoder.put_on_top(**top)
    return encoder


def default_network(shape: tuple[int, ...]) -> str:
    """The network for observations of a shape when none is named.

    :param shape: (channels, height, width)
    :return: the one registered for this shape; else "nature", or "small" for images under 36 pixels
    :raises ValueError: for images with channels last
    """
    for name, network in networks().items():
        if network.observation_shape == shape:
            return name
    if shape[2] < min(shape[:2]):
        raise ValueError(
            f"observations of shape {shape} have their channels last, encoders take them first; wrap the environment "
            "in Stable-Baselines3's VecTransposeImage, or name a network"
        )
    return generic_network(shape)


def generic_network(shape: tuple[int, ...]) -> str:
    """The network for any number of channels and any size.

    :param shape: (channels, height, width)
    :return: "nature", or "small" for images under 36 pixels
    """
    return "nature" if min(shape[1:]) >= NATURE_SIZE else "small"


def require_size(name: str, observation_space: gym.Space[Any], size: int) -> tuple[int, int, int]:
    """Refuse images that are too small for a network.

    :param name: of the network
    :param observation_space: images, channels first
    :param size: its least height and width
    :return: (channels, height, width)
    :raises ValueError: for smaller images
    """
    n_channels, height, width = observation_space.shape or ()
    if min(height, width) < size:
        other = "" if name == "small" else "name another network, such as small, or "
        raise ValueError(
            f"{name} takes images of at least {size} x {size} pixels, got {height} x {width}; "
            f"{other}enlarge the images by a wrapper"
        )
    return n_channels, height, width


def find_features_dim(name: str, module: nn.Module, shape: tuple[int, ...]) -> int:
    """Size of a module's output, found out by a forward pass that changes nothing in it.

    :param name: of the network, for messages
    :param module: from float images (batch, channels, height, width) to (batch, features_dim)
    :param shape: (channels, height, width)
    :raises ValueError: if it does not take them, or gives something else
    """
    tensor = next(iter((*module.parameters(), *module.buffers())), th.zeros(()))
    mode = module.training
    try:
        with th.no_grad(), th.random.fork_rng(devices=[]):
            output = module.eval()(th.zeros((1, *shape), device=tensor.device, dtype=tensor.dtype))
    except (RuntimeError, ValueError, TypeError, IndexError) as error:
        raise ValueError(f"the network {name} does not take observations of shape {shape}: {error}") from error
    finally:
        module.train(mode)
    if not isinstance(output, th.Tensor) or output.dim() != 2:
        what = tuple(output.shape) if isinstance(output, th.Tensor) else type(output).__name__
        raise ValueError(f"the network {name} must give a tensor (batch, features_dim), got {what}; end it in Flatten")
    return int(output.shape[1])
