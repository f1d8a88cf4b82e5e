"""Backbones of timm (extra ``[timm]``): the networks ``timm/NAME``, such as ``timm/resnet18``.

An encoder does inside what timm's transforms do outside: it resizes observations to the backbone's input size and
normalizes them with its mean and standard deviation. All three are written into the encoder file, so that another
version of timm changes nothing. Weights are random, or those of a safetensors file that the user names. Nothing is
downloaded.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import safetensors.torch
import torch as th
from safetensors import SafetensorError
from torch import nn
from torch.nn.functional import interpolate

from sb3_abisim.common.extras import needs_extra
from sb3_abisim.networks.base import Encoder, find_features_dim
from sb3_abisim.registry import register_network_family

FAMILY = "timm"
# Of input_size: a damaged or hostile file could ask for terabytes.
MAX_SIDE = 2048
# As timm registers them. Its other forms of names ("hf-hub:...", "local-dir:...") load what a name says.
_NAME = re.compile(r"\w+(\.\w+)?", re.ASCII)


class Backbone(nn.Module):
    """A backbone behind its transforms.

    :param network: from normalized images to (batch, features_dim)
    :param input_size: height and width that it takes
    :param mean: of each channel, in 0..1
    :param std: of each channel
    """

    mean: th.Tensor
    std: th.Tensor

    def __init__(self, network: nn.Module, input_size: Sequence[int], mean: Sequence[float], std: Sequence[float]):
        super().__init__()
        self.network = network
        self._input_size = list(input_size)
        # They follow from the arguments, which the encoder file holds.
        self.register_buffer("mean", th.tensor(mean).reshape(1, -1, 1, 1), persistent=False)
        self.register_buffer("std", th.tensor(std).reshape(1, -1, 1, 1), persistent=False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Embed images.

        :param observations: float (batch, channels, height, width) in 0..1, of any height and width
        :return: float (batch, features_dim)
        """
        size = list(observations.shape[2:])
        if size != self._input_size:
            shrinks = any(side > wanted for side, wanted in zip(size, self._input_size, strict=True))
            observations = interpolate(observations, self._input_size, mode="bilinear", antialias=shrinks)
        features: th.Tensor = self.network((observations - self.mean) / self.std)
        return features


def make_timm(
    member: str,
    observation_space: gym.Space[Any],
    input_size: Sequence[int] | None = None,
    mean: Sequence[float] | None = None,
    std: Sequence[float] | None = None,
    weights: str | None = None,
) -> Encoder:
    """A backbone of timm without its classifier.

    :param member: its name in timm, with or without a tag, such as ``resnet18`` or ``resnet18.a1_in1k``
    :param observation_space: images, channels first, any number of channels
    :param input_size: height and width that observations are resized to; None for what timm trained it with
    :param mean: of each channel, in 0..1, or of red, green and blue, which then repeat; None for what timm trained it
        with
    :param std: of each channel, as ``mean``
    :param weights: a safetensors file of timm with this backbone's weights; None for random ones. The encoder file
        holds the weights, not this name
    :raises ValueError: for an unknown name, or weights, sizes or numbers that do not fit
    :raises ImportError: without timm, naming the command that installs it
    """
    timm = _import_timm(member)
    if not _NAME.fullmatch(member) or not timm.is_model(member):
        raise ValueError(f"timm {timm.__version__} has no model {member!r}; timm.list_models() names those that it has")
    n_channels, *_ = shape = observation_space.shape or ()
    config = timm.get_pretrained_cfg(member)
    size = list(config.input_size[1:] if input_size is None else input_size)
    if len(size) != 2 or not all(type(side) is int and 0 < side <= MAX_SIDE for side in size):
        raise ValueError(f"input_size must be a height and a width of at most {MAX_SIDE}, got {input_size}")
    numbers = {
        "mean": _per_channel("mean", config.mean if mean is None else mean, n_channels),
        "std": _per_channel("std", config.std if std is None else std, n_channels),
    }
    if not all(value > 0 for value in numbers["std"]):
        raise ValueError(f"std must be above 0, got {std}")
    # Transformers are built for one size.
    fixed = {"img_size": tuple(size)} if config.fixed_input_size else {}
    network = timm.create_model(member, pretrained=False, num_classes=0, in_chans=n_channels, **fixed)
    if weights is not None:
        _load_weights(timm, network, Path(weights), n_channels)
    backbone, name = Backbone(network, size, **numbers), f"{FAMILY}/{member}"
    return Encoder(
        backbone, find_features_dim(name, backbone, shape), name, {"input_size": size, **numbers}, tuple(shape)
    )


def _import_timm(member: str) -> ModuleType:
    try:
        with needs_extra("timm", f"the network {FAMILY}/{member}"):
            import timm
    except RuntimeError as error:
        raise ImportError(
            f"timm cannot be imported ({error}); install the torchvision that belongs to torch {th.__version__}, from "
            "where torch was installed from"
        ) from error
    module: ModuleType = timm
    return module


def _per_channel(name: str, values: Sequence[float], n_channels: int) -> list[float]:
    """One number for each channel: those of RGB repeat in stacks of RGB, and else their average is taken."""
    numbers = [float(value) for value in values]
    if len(numbers) == n_channels:
        return numbers
    if len(numbers) != 3:
        raise ValueError(f"{name} must have {n_channels} numbers, one for each channel, or 3, got {numbers}")
    return numbers * (n_channels // 3) if n_channels % 3 == 0 else [sum(numbers) / 3] * n_channels


def _load_weights(timm: ModuleType, network: nn.Module, path: Path, n_channels: int) -> None:
    """Weights of a file, those of the first layer for another number of channels, without the classifier's."""
    try:
        weights = safetensors.torch.load_file(path)
    except (OSError, SafetensorError) as error:
        raise ValueError(f"weights {path} cannot be read as safetensors ({error}); no other format is read") from error
    config: Any = network.pretrained_cfg
    for name in _names(config.get("first_conv")):
        key = f"{name}.weight"
        if key in weights and n_channels != 3:
            weights[key] = timm.models.adapt_input_conv(n_channels, weights[key])
    classifier = tuple(f"{name}." for name in _names(config.get("classifier")))
    weights = {key: value for key, value in weights.items() if not (classifier and key.startswith(classifier))}
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(f"weights {path} are not those of this backbone: {' '.join(str(error).split())}") from error


def _names(names: Any) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names or ())


register_network_family(FAMILY, make_timm)
