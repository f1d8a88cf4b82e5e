"""The network of an encoder file, and the one that an extractor's arguments describe."""

import json
from typing import Any

import gymnasium as gym
import torch as th

from sb3_abisim.common.spaces import space_from_json
from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.registry import methods


def network_arguments(file: EncoderFile) -> dict[str, Any]:
    """What an extractor must be given beside ``encoder`` to take a file.

    :param file: the encoder file
    :return: ``network`` and ``network_kwargs``; nothing for the default network of the observation's shape
    """
    space = space_from_json(file.metadata["observation_space"])
    try:
        # The weights drawn here are thrown away; the caller's random numbers must not depend on that.
        with th.random.fork_rng(devices=[]):
            is_default = json_spec(make_encoder(space)) == json_spec(file.encoder)
    except ValueError:
        is_default = False
    return {} if is_default else stored_network(file)


def stored_network(file: EncoderFile) -> dict[str, Any]:
    """The network of a file as arguments of an extractor.

    :param file: the encoder file
    :return: ``network`` and ``network_kwargs``
    """
    stored = json_spec(file.encoder)
    return {"network": stored["name"], "network_kwargs": stored["kwargs"]}


def check_objective(file: EncoderFile, objective: str) -> None:
    """Refuse an encoder that another objective has trained.

    :param file: the encoder file
    :param objective: short name of the objective that is expected, e.g. "ssi"
    :raises ValueError: with both sides
    """
    trained_by = file.metadata["objective"]
    if trained_by != objective:
        known = methods()
        remedy = (
            f"use {known[trained_by].extractor}"
            if trained_by in known
            else f"known methods are {', '.join(known)} (--packages imports what registers others)"
        )
        raise ValueError(f"{file.path} was trained by {trained_by!r}, not {objective!r}; {remedy}")


def build_network(
    observation_space: gym.Space[Any], network: str | None, network_kwargs: dict[str, Any], file: EncoderFile | None
) -> Encoder:
    """The network that the arguments describe, with the file's weights if there is a file."""
    if file is None:
        return make_encoder(observation_space, network, **network_kwargs)
    stored = json_spec(file.encoder)
    hint = f"pass network={stored['name']!r}, network_kwargs={stored['kwargs']} to the extractor"
    try:
        encoder = make_encoder(observation_space, network, **network_kwargs)
    except ValueError as error:
        raise ValueError(f"{error}; to use {file.path}, {hint}") from error
    if json_spec(encoder) != stored:
        raise ValueError(f"{file.path} holds the network {stored}, the extractor builds {json_spec(encoder)}; {hint}")
    encoder.load_state_dict(file.encoder.state_dict())
    return encoder


def read_network(
    file: EncoderFile, network: str | None, network_kwargs: dict[str, Any] | None
) -> tuple[str | None, dict[str, Any] | None]:
    """The file's network where the arguments say nothing else."""
    stored = json_spec(file.encoder)
    agree = network in (None, stored["name"]) and network_kwargs in (None, stored["kwargs"])
    return (stored["name"], stored["kwargs"]) if agree else (network, network_kwargs)


def json_spec(encoder: Encoder) -> dict[str, Any]:
    """The spec as a file gives it back (lists for tuples)."""
    spec: dict[str, Any] = json.loads(json.dumps(encoder.spec()))
    return spec
