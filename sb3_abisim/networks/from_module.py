"""An encoder file of any network: one that was trained elsewhere."""

import copy
import os
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.networks.encoder_file import REFERENCE_TOLERANCE, embed, save_encoder

N_REFERENCE = 8


def from_module(
    module: nn.Module,
    observation_space: gym.Space[Any],
    path: str | os.PathLike[str],
    *,
    network: str | None = None,
    network_kwargs: dict[str, Any] | None = None,
    env_id: str = "unknown",
    env_kwargs: dict[str, Any] | None = None,
    action_space: gym.Space[Any] | None = None,
    settings: dict[str, Any] | None = None,
    reference_observations: NDArray[np.uint8] | None = None,
) -> str:
    """Write an encoder file of a network with its weights, of the method "foreign".

    The file holds weights and a name, never code. So the network must be one that can be built again by name: a
    registered one, or one at an import path, ``pkg.module:Factory``.

    :param module: from float images (batch, channels, height, width) in 0..1 to (batch, features_dim); it is left as
        it was
    :param observation_space: uint8 images in 0..255, channels first
    :param path: the file; its folder must exist
    :param network: name of a registered network or ``pkg.module:Factory``, which called with the observation space and
        ``network_kwargs`` gives a module with the same weights by name; None for the class of ``module``
    :param network_kwargs: its keyword arguments, JSON types
    :param env_id: id of the environment, where one is known
    :param env_kwargs: its keyword arguments, JSON types
    :param action_space: of the environment; None leaves it unchecked
    :param settings: what is worth recording of its training, JSON types; a ``seed`` tells encoders apart in reports
    :param reference_observations: a few observations, uint8 (n, channels, height, width); None for random ones
    :return: hash of the content, sha256 in hexadecimal
    :raises ValueError: for a network that cannot be built again by its name, or is another one when built again
    """
    kwargs = dict(network_kwargs or {})
    name = _path_of(module) if network is None else network
    shape = observation_space.shape or ()
    if reference_observations is None:
        reference_observations = np.random.default_rng(0).integers(0, 256, (N_REFERENCE, *shape), np.uint8)
    remedy = "give network='pkg.module:factory' with a function (observation_space, **kwargs) that builds the network"
    with th.random.fork_rng(devices=[]):
        try:
            encoder = make_encoder(observation_space, name, **kwargs)
        except ValueError as error:
            raise ValueError(f"the network cannot be built again by its name: {error}; {remedy}") from error
    original = copy.deepcopy(module).cpu().float().eval()
    into = encoder if isinstance(original, Encoder) else encoder.layers
    try:
        into.load_state_dict(original.state_dict())
    except RuntimeError as error:
        differences = " ".join(str(error).split())
        raise ValueError(f"{name} builds another network than this one: {differences}; {remedy}") from error
    encoder.eval()
    _require_same(name, original, encoder, observation_space, th.from_numpy(reference_observations))
    return save_encoder(
        path,
        encoder,
        observation_space=observation_space,
        action_space=action_space,
        env_id=env_id,
        env_kwargs=env_kwargs or {},
        objective="foreign",
        settings={**(settings or {}), "objective": "foreign"},
        dataset_hash="",
        reference_observations=reference_observations,
    )


def _path_of(module: nn.Module) -> str:
    """The import path of a module's class."""
    if isinstance(module, Encoder):
        raise ValueError(f"this is an Encoder of network {module.spec()['name']!r}; give network= and network_kwargs=")
    name, attribute = type(module).__module__, type(module).__qualname__
    if name == "__main__" or "<" in attribute:
        raise ValueError(
            f"{name}:{attribute} can be imported by no other program; move the class into a module of its own"
        )
    return f"{name}:{attribute}"


@th.no_grad()
def _require_same(
    name: str, module: nn.Module, encoder: Encoder, space: gym.Space[Any], observations: th.Tensor
) -> None:
    """Weights may agree where the computation does not, such as a padding."""
    expected = module(observations.float() / 255)
    actual = embed(encoder, space, observations)
    if not th.allclose(actual, expected, rtol=0.0, atol=REFERENCE_TOLERANCE * float(expected.abs().max()) + 1e-6):
        raise ValueError(f"{name} with these weights computes something else than the module; give its network_kwargs")
