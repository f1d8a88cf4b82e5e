"""The encoder file: pretrained weights and everything needed to refuse a wrong use of them.

One safetensors file. Its tensors are the weights (``encoder.*``), the reference batch (a few uint8 observations, and
what the network made of them when it was saved) and the hash. The metadata of safetensors hold one JSON text: format,
network and metadata. (One text, because safetensors writes several in random order.) The hash is the sha256 of the file
with the hash's 32 bytes set to zero, so any changed bit is noticed at load. It protects against damage, not against
forgery. A forged file still runs no code: its network is looked up by name among those that are registered.
"""

import contextlib
import copy
import hashlib
import json
import os
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import safetensors.torch
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors import SafetensorError
from stable_baselines3.common.preprocessing import is_image_space

from sb3_abisim._version import __version__
from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.spaces import space_from_json, space_to_json
from sb3_abisim.common.vocabulary import current_env_kwargs, current_settings
from sb3_abisim.networks.base import Encoder, make_encoder, preprocess
from sb3_abisim.networks.bounded import BoundedTensors
from sb3_abisim.networks.encoder_name import resolve_encoder
from sb3_abisim.registry import import_network, is_import_path, is_known_network, networks

FORMAT = 1
# The embeddings of the reference batch may differ by this fraction of the largest one (other machine, other torch).
REFERENCE_TOLERANCE = 1e-4
MAX_FILE_BYTES = 1 << 30
# A zoo run on a frozen encoder keeps a copy of its file under this name, in its folder <env id> beside config.yml.
RUN_COPY = "encoder.safetensors"

# Names in the file: of the JSON text, its metadata, the dataset's hash in there, and the tensors.
_DOCUMENT_KEY = "sb3_abisim"
_METADATA_KEY = "contract"
_DATASET_HASH_KEY = "dataset_digest"
_HASH_KEY = "digest"
_REFERENCE_KEYS = ("golden.observations", "golden.embeddings")
_WEIGHT_PREFIX = "encoder."
_METADATA_KEYS = {
    "observation_space",
    "action_space",
    "env_id",
    "env_kwargs",
    "objective",
    "settings",
    _DATASET_HASH_KEY,
    "versions",
}
_PREPROCESSING_KEY = "preprocessing"
_HASH_BYTES = 32
_REMEDY = "copy it again from where it came from, or write it again with sb3-abisim pretrain"


class EncoderFileError(ValueError):
    """The file is damaged or is not an encoder file; the message names the path and the remedy."""


@dataclass(frozen=True)
class EncoderFile:
    """A verified encoder file.

    :param path: where it was read
    :param hash: sha256 in hexadecimal of its content
    :param encoder: the network with its weights, on the CPU, in evaluation mode
    :param metadata: observation_space, action_space, env_id, env_kwargs, objective, settings, dataset_hash, versions,
        preprocessing
    """

    path: Path
    hash: str
    encoder: Encoder
    metadata: dict[str, Any]

    def check(self, observation_space: gym.Space[Any], action_space: gym.Space[Any] | None = None) -> None:
        """Refuse spaces other than those of pretraining.

        :param observation_space: the space of the observations to embed
        :param action_space: None leaves it unchecked (an extractor does not know it)
        :raises ValueError: with both sides
        """
        sides = {"observation_space": _describe(observation_space)}
        if action_space is not None and self.metadata["action_space"] is not None:
            sides["action_space"] = space_to_json(action_space)
        for kind, here in sides.items():
            if here != self.metadata[kind]:
                raise ValueError(
                    f"{self.path} was pretrained on {self.metadata['env_id']} with {kind} {self.metadata[kind]}, "
                    f"but is to be used with {here}; use an encoder pretrained for this environment"
                )


def save_encoder(
    path: str | os.PathLike[str],
    encoder: Encoder,
    *,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any] | None,
    env_id: str,
    env_kwargs: dict[str, Any],
    objective: str,
    settings: dict[str, Any],
    dataset_hash: str,
    reference_observations: NDArray[np.uint8],
    preprocessing: dict[str, Any] | None = None,
) -> str:
    """Write an encoder file; the same arguments and package versions give the same bytes.

    :param path: the file; its folder must exist
    :param encoder: the trained network, on any device; it is left as it was
    :param observation_space: of the environment: uint8 images in 0..255, channels first
    :param action_space: of the environment; None where it is not known
    :param env_id: id of the environment that the data came from
    :param env_kwargs: its keyword arguments, JSON types
    :param objective: short name of the objective, e.g. "ssi"
    :param settings: hyperparameters of the pretraining, JSON types
    :param dataset_hash: hash of the dataset
    :param reference_observations: a few observations, uint8 (n, channels, height, width)
    :param preprocessing: what stood between the environment and these observations, as in a dataset's meta.json
    :return: hash of the content, sha256 in hexadecimal
    :raises ValueError: for weights that are not finite, values that JSON cannot hold, observations that do not fit
    """
    shape = observation_space.shape
    if not is_image_space(observation_space) or shape is None:
        raise ValueError(f"observation_space must be uint8 images in 0..255, channels first, got {observation_space}")
    reference = th.from_numpy(np.array(reference_observations, order="C"))
    if reference.dtype != th.uint8 or tuple(reference.shape[1:]) != shape or len(reference) == 0:
        raise ValueError(
            f"reference_observations must be uint8 (n, *{shape}), got {reference.dtype} {tuple(reference.shape)}"
        )
    document = {
        "format": FORMAT,
        "network": encoder.spec(),
        _METADATA_KEY: {
            "observation_space": _describe(observation_space),
            "action_space": None if action_space is None else space_to_json(action_space),
            "env_id": env_id,
            "env_kwargs": env_kwargs,
            "objective": objective,
            "settings": settings,
            _DATASET_HASH_KEY: dataset_hash,
            "versions": _versions(),
            # Left out where there is none, as in files of before.
            **({_PREPROCESSING_KEY: preprocessing} if preprocessing else {}),
        },
    }
    try:
        text = json.dumps(document, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"env_kwargs and settings must be JSON values ({error}): {env_kwargs}, {settings}") from error
    on_cpu = copy.deepcopy(encoder).cpu().eval()
    tensors = {_WEIGHT_PREFIX + name: value.contiguous() for name, value in on_cpu.state_dict().items()}
    broken = [name for name, value in tensors.items() if not bool(th.isfinite(value).all())]
    if broken:
        raise ValueError(f"weights are not finite, the encoder is not saved: {broken}")
    tensors |= zip(_REFERENCE_KEYS, (reference, embed(on_cpu, observation_space, reference)), strict=True)
    data, hash = _serialize(tensors, text)
    write_atomic(path, lambda file: file.write(data))
    return hash


def load_encoder(name: str | os.PathLike[str], network: str | None = None) -> EncoderFile:
    """Read and verify an encoder file.

    :param name: as for :func:`resolve_encoder`
    :param network: ``pkg.module:Factory`` of a network that is imported first, for a file that names it
    :return: the encoder with its metadata, under today's names
    :raises sb3_abisim.networks.encoder_name.EncoderNotFoundError: when there is no such file
    :raises EncoderFileError: when a bit has changed, the file is something else, its network is not registered, or its
        reference batch does not agree
    """
    path = resolve_encoder(name)
    if network is not None and is_import_path(network):
        import_network(network)
    if path.stat().st_size > MAX_FILE_BYTES:
        raise EncoderFileError(
            f"{path} has {path.stat().st_size} bytes, more than {MAX_FILE_BYTES}; not an encoder file"
        )
    data = path.read_bytes()
    header = _header(path, data)
    hash = _verify_hash(path, data, header)
    try:
        document = json.loads(header["__metadata__"][_DOCUMENT_KEY])
        found = document["format"]
        if found != FORMAT:
            raise EncoderFileError(
                f"{path} has format {found!r}, this version reads {FORMAT}; install a newer sb3_abisim"
            )
        tensors = safetensors.torch.load(data)
        metadata = document[_METADATA_KEY]
        if set(metadata) - {_PREPROCESSING_KEY} != _METADATA_KEYS:
            raise ValueError(f"the metadata have the keys {sorted(metadata)}, expected {sorted(_METADATA_KEYS)}")
        texts = metadata["env_id"], metadata["objective"], metadata[_DATASET_HASH_KEY]
        mappings = (
            metadata["env_kwargs"],
            metadata["settings"],
            metadata["versions"],
            metadata.get(_PREPROCESSING_KEY, {}),
        )
        if not all(isinstance(text, str) for text in texts) or not all(isinstance(part, dict) for part in mappings):
            raise ValueError("a value of the metadata has the wrong type")
        if metadata["action_space"] is not None:
            space_from_json(metadata["action_space"])
        reference, expected = (tensors.pop(key) for key in _REFERENCE_KEYS)
        if reference.dtype != th.uint8 or list(reference.shape[1:]) != metadata["observation_space"]["shape"]:
            raise ValueError(f"reference batch {tuple(reference.shape)} is not of {metadata['observation_space']}")
        space = spaces.Box(0, 255, tuple(reference.shape[1:]), np.uint8)
        spec = document["network"]
        _require_registered(path, spec["name"])
        encoder = _build(space, spec, tensors)
    except EncoderFileError:
        raise
    except (
        AttributeError, IndexError, KeyError, TypeError, ValueError, RuntimeError, RecursionError, SafetensorError,
        OverflowError, MemoryError, ArithmeticError, AssertionError,
    ) as error:  # fmt: skip
        raise EncoderFileError(f"{path} is not a valid encoder file ({error!r}); {_REMEDY}") from error
    _check_reference(path, embed(encoder, space, reference), expected)
    metadata.setdefault(_PREPROCESSING_KEY, {})
    metadata["dataset_hash"] = metadata.pop(_DATASET_HASH_KEY)
    metadata["settings"] = current_settings(metadata["settings"])
    metadata["env_kwargs"] = current_env_kwargs(metadata["env_kwargs"])
    return EncoderFile(path, hash, encoder, metadata)


@th.no_grad()
def embed(encoder: Encoder, space: gym.Space[Any], observations: th.Tensor) -> th.Tensor:
    """Embed uint8 observations through the preprocessing that SB3 puts before a features extractor, without gradients.

    :param encoder: the network, on the device of the observations
    :param space: the space of one observation
    :param observations: uint8 (batch, channels, height, width)
    :return: float32 (batch, features_dim)
    """
    embeddings: th.Tensor = encoder(preprocess(observations, space))
    return embeddings.float().contiguous()


def reference_batch(file: EncoderFile) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The observations in an encoder file, and their embeddings.

    :param file: what :func:`load_encoder` returned
    :return: uint8 (n, channels, height, width), and float32 (n, features_dim)
    """
    tensors = safetensors.torch.load_file(file.path)
    observations, embeddings = (tensors[key].numpy() for key in _REFERENCE_KEYS)
    return observations, embeddings


def _describe(observation_space: gym.Space[Any]) -> dict[str, Any]:
    return {**space_to_json(observation_space), "channel_order": "CHW"}


def _versions() -> dict[str, str]:
    packages = ("torch", "stable_baselines3", "gymnasium", "safetensors", "numpy")
    return {"sb3_abisim": __version__, **{package: version(package) for package in packages}}


def _serialize(tensors: dict[str, th.Tensor], text: str) -> tuple[bytes, str]:
    blank = safetensors.torch.save({**tensors, _HASH_KEY: th.zeros(_HASH_BYTES, dtype=th.uint8)}, {_DOCUMENT_KEY: text})
    header_size = int.from_bytes(blank[:8], "little")
    start = 8 + header_size + json.loads(blank[8 : 8 + header_size])[_HASH_KEY]["data_offsets"][0]
    sha256 = hashlib.sha256(blank)
    return blank[:start] + sha256.digest() + blank[start + _HASH_BYTES :], sha256.hexdigest()


def _header(path: Path, data: bytes) -> dict[str, Any]:
    """The JSON header of a safetensors file, read before the library sees the data."""
    end = 8 + int.from_bytes(data[:8], "little")
    try:
        if not 8 < end <= len(data):
            raise ValueError("no header of a safetensors file, or cut short")
        header = json.loads(data[8:end])
        if not isinstance(header, dict):
            raise ValueError("the header is not a JSON object")
    except (ValueError, RecursionError) as error:
        kind = "damaged or not an encoder file"
        if data.startswith(b"PK"):
            kind = "a zip archive (a saved SB3 model, or a torch file), not an encoder file"
        elif data.startswith(b"\x80"):
            kind = "a pickle, which is never read, not an encoder file"
        raise EncoderFileError(f"{path} is {kind} ({error}); {_REMEDY}") from error
    return header


def _verify_hash(path: Path, data: bytes, header: dict[str, Any]) -> str:
    try:
        entry = header[_HASH_KEY]
        start, stop = entry["data_offsets"]
        start, stop = (8 + int.from_bytes(data[:8], "little") + int(offset) for offset in (start, stop))
        stored = data[start:stop]
        if entry["dtype"] != "U8" or len(stored) != _HASH_BYTES:
            raise ValueError
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise EncoderFileError(f"{path} has no valid hash: not an encoder file, or damaged; {_REMEDY}") from error
    actual = hashlib.sha256(data[:start] + bytes(_HASH_BYTES) + data[stop:])
    if actual.digest() != stored:
        raise EncoderFileError(
            f"{path} is damaged: its content has sha256 {actual.hexdigest()}, not {stored.hex()} as it was written; "
            f"{_REMEDY}"
        )
    return actual.hexdigest()


def _require_registered(path: Path, name: Any) -> None:
    if not isinstance(name, str):
        return
    if is_import_path(name) and name not in networks():
        raise EncoderFileError(
            f"{path} names the network {name!r}, which is imported only if you name it. If you trust it, add "
            f"--packages {name} to the command, or network={name!r} in Python"
        )
    if not is_known_network(name):
        raise EncoderFileError(
            f"{path} names the network {name!r}, which is not registered; known are {', '.join(networks())}. If you "
            "trust the package that registers it, name it with --packages on the command line, or import it"
        )


def _build(space: spaces.Box, network: dict[str, Any], tensors: dict[str, th.Tensor]) -> Encoder:
    name, kwargs = network["name"], network["kwargs"]
    if not isinstance(name, str) or not isinstance(kwargs, dict):
        raise ValueError(f"network must be a name with keyword arguments, got {network}")
    weights = {key.removeprefix(_WEIGHT_PREFIX): tensors[key] for key in tensors if key.startswith(_WEIGHT_PREFIX)}
    # The weights sampled here are overwritten at once; the caller's random numbers must not depend on that.
    with th.random.fork_rng(devices=[]):
        blueprint = None
        # First without memory: arguments from a damaged or hostile file could ask for terabytes. Some networks cannot
        # be built like that.
        with contextlib.suppress(RuntimeError, ValueError), th.device("meta"):
            blueprint = make_encoder(space, name, **kwargs)
        if blueprint is not None:
            _require_fit(blueprint, weights)
        with BoundedTensors(sum(weight.nbytes for weight in weights.values())):
            encoder = make_encoder(space, name, **kwargs)
    _require_fit(encoder, weights)
    encoder.load_state_dict(weights)
    encoder.is_pretrained = True
    return encoder.eval()


def _require_fit(encoder: Encoder, weights: dict[str, th.Tensor]) -> None:
    promised, stored = (
        {key: (tuple(value.shape), value.dtype) for key, value in tensors.items()}
        for tensors in (encoder.state_dict(), weights)
    )
    if promised != stored:
        raise ValueError(f"weights {stored} do not fit the network {encoder.spec()}, which has {promised}")


def _check_reference(path: Path, actual: th.Tensor, expected: th.Tensor) -> None:
    if actual.shape != expected.shape or expected.dtype != th.float32:
        raise EncoderFileError(f"{path}: the reference embeddings have shape {tuple(expected.shape)}; {_REMEDY}")
    error, scale = float((actual - expected).abs().max()), float(expected.abs().max())
    # Written so that NaN fails as well.
    if not error <= REFERENCE_TOLERANCE * scale + 1e-6:
        raise EncoderFileError(
            f"{path}: the network embeds the reference batch differently than when it was saved (largest difference "
            f"{error:.3g}, embeddings up to {scale:.3g}); install the versions named in its metadata, or pretrain again"
        )
