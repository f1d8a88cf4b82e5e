"""What a dataset folder holds: file names, manifests, hashes. The reader and the writer share it.

    config.json          what identifies the collection, written first
    frames-00000.npy     uint8 [F, C, H, W]: the frames of one segment after another, L + 1 frames for L transitions
    actions-00000.npy    [F, ...]: the action taken at each frame, zero at a segment's last frame
    ends-00000.npy       uint8 [F]: 0 within a segment, else how it ended (INSIDE, TERMINATED, TRUNCATED, CUT)
    factor_X-00000.npy   [F, ...]: the simulator's state behind each frame
    shard-00000.json     sizes and hashes of the shard's files, written after them
    meta.json            everything above in one document, written last: without it the dataset is unfinished

In the format of version 2 there are no frames. They are rendered from the factors when they are read, by the
environment that env_id and env_kwargs name, whose content hash must be the same. All else is as in version 1.

In version 3 episodes run on from shard to shard, within chains of ``shards_per_chain`` shards; where a copy of the
environment goes on follows from the numbers (:func:`continued_segments`). ``preprocessing`` says what stood between the
environment and its frames: ``channels`` ("last" or "none" where they were put first), ``env_wrapper``, ``image_key``,
and ``frame_stack``, which is left to readers: frames are stored once.

A segment is an episode, or the part of one that a shard's end cuts off. All documents are free of times and host names,
so that the same command writes the same bytes.
"""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.common.spaces import action_layout, check_action_space, is_channels_first, space_from_json

FORMAT_VERSION = 1
# Without frames, for environments that can render them from the factors.
RENDERED_FORMAT_VERSION = 2
# With chains of shards, and preprocessing.
CHAINED_FORMAT_VERSION = 3
# Keys of meta.json: hashes of the dataset, of the document, and (also in config.json) of the environment's content.
HASH_KEY, DOCUMENT_HASH_KEY, CONTENT_HASH_KEY = "digest", "checksum", "fingerprint"
CONFIG_NAME = "config.json"
META_NAME = "meta.json"
# Values of the ends array.
INSIDE, TERMINATED, TRUNCATED, CUT = range(4)
# The keys of config.json that a dataset's hash covers; its remaining key, "versions", only informs.
IDENTITY_KEYS = (
    "format_version",
    "env_id",
    "env_kwargs",
    "observation_space",
    "action_space",
    "factors",
    CONTENT_HASH_KEY,
    "policy",
    "seed",
    "n_envs",
    "steps_per_shard",
    "source",
)
# Those that a dataset of CHAINED_FORMAT_VERSION has beside them.
_CHAINED_KEYS = ("shards_per_chain", "preprocessing")
_FACTOR_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_SHARD_FILE = re.compile(r"(frames|actions|ends|factor_[A-Za-z_][A-Za-z0-9_]*)-\d{5,}\.npy|shard-\d{5,}\.json")


class DatasetError(ValueError):
    """A folder is not a finished, undamaged dataset; the message says what is wrong and what to do."""


def identity_keys(document: dict[str, Any]) -> tuple[str, ...]:
    """The keys of config.json that a dataset's hash covers.

    :param document: config.json or meta.json
    """
    chained = document.get("format_version") == CHAINED_FORMAT_VERSION
    return IDENTITY_KEYS + _CHAINED_KEYS if chained else IDENTITY_KEYS


def array_names(identity: dict[str, Any]) -> tuple[str, ...]:
    """The arrays of every shard, in the order of writing.

    :param identity: a document with the keys ``IDENTITY_KEYS``, such as config.json or meta.json
    """
    frames = ("frames",) if holds_frames(identity) else ()
    return *frames, "actions", "ends", *(f"factor_{name}" for name in identity["factors"])


def holds_frames(identity: dict[str, Any]) -> bool:
    """Whether the shards hold frames; if not, they are rendered from the factors.

    :param identity: as for :func:`array_names`
    """
    return bool(identity["format_version"] != RENDERED_FORMAT_VERSION)


def array_file(name: str, shard: int) -> str:
    """The file name of one array of a shard.

    :param name: one of :func:`array_names`
    :param shard: its number, from 0
    """
    return f"{name}-{shard:05d}.npy"


def shard_file(shard: int) -> str:
    """The file name of a shard's manifest.

    :param shard: its number, from 0
    """
    return f"shard-{shard:05d}.json"


def is_shard_file(name: str) -> bool:
    """Whether a file name is one that this format gives to an array or a shard's manifest.

    :param name: a file name without its folder
    """
    return _SHARD_FILE.fullmatch(name) is not None


def is_shard_manifest(document: Any, shard: int, identity: dict[str, Any]) -> bool:
    """Whether a JSON value has the form of a shard's manifest and lists exactly the shard's files.

    :param document: what was read
    :param shard: its number, from 0
    :param identity: as for :func:`array_names`
    """
    if not isinstance(document, dict) or set(document) != {"n_transitions", "n_frames", "files"}:
        return False
    files = document["files"]
    if not isinstance(files, dict) or set(files) != {array_file(name, shard) for name in array_names(identity)}:
        return False
    return all(isinstance(entry, dict) and set(entry) == {"bytes", "sha256"} for entry in files.values())


def array_layout(identity: dict[str, Any], name: str) -> tuple[np.dtype[Any], tuple[int, ...]]:
    """The dtype of an array of the dataset and the shape of one of its rows.

    :param identity: as for :func:`array_names`
    :param name: one of :func:`array_names`
    """
    if name == "frames":
        return np.dtype(np.uint8), tuple(identity["observation_space"]["shape"])
    if name == "ends":
        return np.dtype(np.uint8), ()
    if name == "actions":
        return action_layout(space_from_json(identity["action_space"]))
    layout = identity["factors"][name.removeprefix("factor_")]
    return np.dtype(layout["dtype"]), tuple(layout["shape"])


def describe_factors(factors: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Shape and dtype of one row of each factor, sorted by name.

    :param factors: name to array of shape (rows, ...)
    :raises ValueError: for a name that is no identifier or values that are no numbers
    """
    layout = {n: {"dtype": a.dtype.str, "shape": list(a.shape[1:])} for n, a in sorted(factors.items())}
    check_factor_layout(layout)
    return layout


def check_factor_layout(layout: Any) -> None:
    """Refuse factors whose names cannot be part of a file name, or that hold no numbers.

    :param layout: what :func:`describe_factors` returned, or was read from a file
    :raises ValueError: with the name or dtype
    """
    for name, row in layout.items():
        if not _FACTOR_NAME.fullmatch(name):
            raise ValueError(f"factor names must be made of letters, digits and underscores, got {name!r}")
        if np.dtype(row["dtype"]).kind not in "biuf":
            raise ValueError(f"factor {name!r} must hold numbers, got dtype {row['dtype']}")


def check_spaces(observation_space: gym.Space[Any], action_space: gym.Space[Any]) -> None:
    """Refuse spaces that a dataset cannot hold.

    :param observation_space: of one environment
    :param action_space: of one environment
    :raises ValueError: unless observations are uint8 images, channels first, in 0..255, and actions are as
        :func:`~sb3_abisim.common.spaces.check_action_space` asks
    """
    shape = observation_space.shape or ()
    if not isinstance(observation_space, spaces.Box) or observation_space.dtype != np.uint8 or len(shape) != 3:
        raise ValueError(
            f"observations must be uint8 images of shape (channels, height, width), got {observation_space}"
        )
    if not is_channels_first(shape):
        raise ValueError(
            f"observations must be channels first (channels, height, width), got shape {shape}: register a variant of "
            "the environment wrapped in gymnasium.wrappers.TransformObservation that applies np.moveaxis(obs, -1, 0)"
        )
    if observation_space.low.min() != 0 or observation_space.high.max() != 255:
        raise ValueError(f"observations must be images in 0..255, got {observation_space}")
    check_action_space(action_space)


def to_json_bytes(document: dict[str, Any]) -> bytes:
    """Readable JSON that is the same for equal documents.

    :param document: JSON types, numbers finite
    """
    return (json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def from_json_file(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    :param path: the file
    :raises DatasetError: if the file is damaged
    """
    try:
        document = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is damaged ({error})") from None
    if not isinstance(document, dict):
        raise DatasetError(f"{path} is damaged (no JSON object)")
    return document


def make_meta(config: dict[str, Any], shards: list[dict[str, Any]]) -> dict[str, Any]:
    """The document of a finished dataset.

    :param config: the content of config.json
    :param shards: the shards' manifests, in order
    """
    hashed = {
        "identity": {key: config[key] for key in identity_keys(config)},
        "files": [{name: entry["sha256"] for name, entry in shard["files"].items()} for shard in shards],
    }
    meta = config | {
        "n_transitions": sum(shard["n_transitions"] for shard in shards),
        "n_frames": sum(shard["n_frames"] for shard in shards),
        "shards": shards,
        HASH_KEY: _sha256(hashed),
    }
    # The dataset's hash leaves the versions out; this one covers every character that means something.
    return meta | {DOCUMENT_HASH_KEY: _sha256(meta)}


def check_meta(meta: dict[str, Any]) -> None:
    """Refuse a meta.json that is damaged or of another format.

    :param meta: the content of meta.json
    :raises ValueError: with the reason
    """
    known = FORMAT_VERSION, RENDERED_FORMAT_VERSION, CHAINED_FORMAT_VERSION
    if meta.get("format_version") not in known:
        raise ValueError(f"format version {meta.get('format_version')!r}, this version reads {known}")
    keys = identity_keys(meta)
    if set(meta) != {*keys, "versions", "n_transitions", "n_frames", "shards", HASH_KEY, DOCUMENT_HASH_KEY}:
        raise ValueError("its keys are not those of a dataset")
    check_factor_layout(meta["factors"])
    config = {key: meta[key] for key in (*keys, "versions")}
    if meta["format_version"] == CHAINED_FORMAT_VERSION:
        _check_chained(meta)
    if not all(is_shard_manifest(shard, k, meta) for k, shard in enumerate(meta["shards"])):
        raise ValueError("its list of shards is not one")
    if make_meta(config, meta["shards"]) != meta:
        raise ValueError("its hash does not match")
    _check_values(meta)


# Arrays are made of as many numbers.
_MAX_COPIES = 1 << 20


def _check_values(meta: dict[str, Any]) -> None:
    """A hash says that nothing has changed, not that whoever computed it wrote a dataset."""
    counts = [shard[key] for shard in meta["shards"] for key in ("n_transitions", "n_frames")]
    sizes = [entry["bytes"] for shard in meta["shards"] for entry in shard["files"].values()]
    if not all(type(number) is int and number >= 0 for number in (*counts, *sizes)) or not counts:
        raise ValueError("its numbers of frames and bytes are none")
    if not isinstance(meta["env_id"], str) or not isinstance(meta["env_kwargs"], dict):
        raise ValueError("its environment is none")
    check_spaces(space_from_json(meta["observation_space"]), space_from_json(meta["action_space"]))


def _check_chained(meta: dict[str, Any]) -> None:
    numbers = [meta[key] for key in ("shards_per_chain", "steps_per_shard", "n_envs")]
    stack = meta["preprocessing"].get("frame_stack", 1)
    if not all(type(number) is int and number >= 1 for number in (*numbers, stack)):
        raise ValueError(f"its numbers of chains {numbers} or stacks {stack!r} are none")
    if max(meta["n_envs"], stack) > _MAX_COPIES:
        raise ValueError(f"it has more than {_MAX_COPIES} copies or observations in a stack")


def continued_segments(meta: dict[str, Any], lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which segment of the shard before each segment goes on with: the same copy's last one, or -1 for none.

    :param meta: the content of meta.json
    :param lengths: transitions of each segment, in order
    :return: number of a segment, or -1; whether that one was CUT is left to the caller
    :raises DatasetError: if copies do not begin where segments do
    """
    before = np.full(len(lengths), -1, np.int64)
    if meta["format_version"] != CHAINED_FORMAT_VERSION:
        return before
    begins = np.concatenate([[0], np.cumsum(lengths)])
    total, last_of_copy = 0, np.empty(0, np.int64)
    for k, shard in enumerate(meta["shards"]):
        n, n_envs = shard["n_transitions"], meta["n_envs"]
        kept = n // n_envs + (np.arange(n_envs) < n % n_envs)
        wanted = total + np.concatenate([[0], np.cumsum(kept)])
        edges = np.searchsorted(begins, wanted)
        if not np.array_equal(begins[np.minimum(edges, len(lengths))], wanted):
            raise DatasetError(f"the episode ends of shard {k} contradict the numbers in meta.json; damaged or forged")
        first, last = edges[:-1], edges[1:] - 1
        if k % meta["shards_per_chain"]:
            here = kept > 0
            before[first[here]] = last_of_copy[here]
        total, last_of_copy = total + n, last
    return before


def _sha256(document: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
