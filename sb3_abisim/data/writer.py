"""Writes dataset folders so that a kill at any moment loses at most the shard in flight."""

import contextlib
import dataclasses
import io
import itertools
import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim._version import __version__
from sb3_abisim.common.files import LOCK_NAME, file_hash, folder_lock, is_temporary, remove_temporaries, write_atomic
from sb3_abisim.common.spaces import fit_actions, space_to_json
from sb3_abisim.common.vocabulary import current_env_kwargs
from sb3_abisim.data.format import (
    CONFIG_NAME,
    CONTENT_HASH_KEY,
    CUT,
    FORMAT_VERSION,
    HASH_KEY,
    META_NAME,
    TERMINATED,
    TRUNCATED,
    DatasetError,
    array_file,
    array_layout,
    array_names,
    check_meta,
    check_spaces,
    describe_factors,
    from_json_file,
    identity_keys,
    is_shard_file,
    is_shard_manifest,
    make_meta,
    shard_file,
    to_json_bytes,
)

# Of data that was not collected here: a shard ends with the segment that reaches one of them.
SHARD_TRANSITIONS = 8192
SHARD_BYTES = 2**27
_PACKAGES = ("gymnasium", "gymnasium-robotics", "mujoco", "numpy")


@dataclasses.dataclass(frozen=True)
class Segment:
    """An episode, or the part of one that fell into a shard: L transitions between L + 1 frames.

    :param frames: L + 1 arrays of uint8 [C, H, W], or one array of them; None where frames are rendered from factors
    :param actions: [L, ...]
    :param end: TERMINATED, TRUNCATED or CUT
    :param factors: name to L + 1 rows
    """

    frames: Sequence[NDArray[np.uint8]] | NDArray[np.uint8] | None
    actions: NDArray[Any]
    end: int
    factors: dict[str, Any] = dataclasses.field(default_factory=dict)


def package_versions() -> dict[str, str]:
    """Versions of the packages that determine a dataset's bytes."""
    versions = {"sb3_abisim": __version__}
    for name in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def check_folder(folder: Path) -> None:
    """Refuse to write a dataset into something else.

    :param folder: new, or what the user named
    :raises ValueError: if ``folder`` is a file, or holds files and is not a dataset folder
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; name a folder that is new or empty, or one that this command began")
    if folder.is_dir() and not (folder / CONFIG_NAME).exists():
        others = sorted(p.name for p in folder.iterdir() if p.name != LOCK_NAME and not is_temporary(p.name))
        if others:
            shown = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
            raise ValueError(
                f"{folder} holds something else ({shown}); name a new or empty folder, nothing was changed"
            )


def write_dataset(
    folder: str | os.PathLike[str],
    segments: Iterable[Segment],
    *,
    env_id: str,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    source: Any,
    env_kwargs: dict[str, Any] | None = None,
    policy: str = "unknown",
) -> str:
    """Make a dataset folder of data that something else has recorded.

    :param folder: new or empty
    :param segments: episodes, or parts of them, at least one; an iterator's are in memory shard by shard
    :param env_id: id of the environment that they were recorded in, or any name
    :param observation_space: of one environment: uint8 images in 0..255, channels first
    :param action_space: of one environment: as :func:`~sb3_abisim.common.spaces.check_action_space` asks
    :param source: where they come from, JSON types; not None, which stands for data that was collected here
    :param env_kwargs: keyword arguments of the environment, JSON types
    :param policy: what chose the actions
    :return: the dataset's hash
    :raises ValueError: if anything does not fit
    """
    check_spaces(observation_space, action_space)
    if source is None:
        raise ValueError("source must say where the data comes from, got None")
    try:
        env_kwargs, source = json.loads(json.dumps([env_kwargs or {}, source]))
    except TypeError as error:
        raise ValueError(
            f"env_kwargs and source must be what JSON can hold ({error}): {env_kwargs}, {source}"
        ) from None
    fitting = _fitting(segments, action_space)
    first = next(fitting, None)
    if first is None:
        raise ValueError(f"there are no segments to write into {folder}, from {source!r}")
    identity = {
        "format_version": FORMAT_VERSION,
        "env_id": env_id,
        "env_kwargs": env_kwargs,
        "observation_space": space_to_json(observation_space),
        "action_space": space_to_json(action_space),
        "factors": describe_factors({name: np.asarray(rows) for name, rows in first.factors.items()}),
        CONTENT_HASH_KEY: None,
        "policy": policy,
        "seed": None,
        "n_envs": None,
        "steps_per_shard": None,
        "source": source,
    }
    return write_segments(Path(folder), itertools.chain([first], fitting), identity)


def _fitting(segments: Iterable[Segment], action_space: gym.Space[Any]) -> Iterator[Segment]:
    for number, segment in enumerate(segments):
        actions = fit_actions(segment.actions, action_space, f"segment {number}")
        if not len(actions) or segment.end not in (TERMINATED, TRUNCATED, CUT):
            raise ValueError(
                f"segment {number} has {len(actions)} actions and end {segment.end!r}; it needs one action at least, "
                "and an end that is TERMINATED, TRUNCATED or CUT"
            )
        yield dataclasses.replace(segment, actions=actions)


def write_segments(folder: Path, segments: Iterable[Segment], identity: dict[str, Any]) -> str:
    """Write a whole dataset from segments, in shards of whole segments.

    :param folder: new or empty
    :param segments: at least one; what they raise leaves the dataset unfinished
    :param identity: see :func:`open_writer`
    :return: the dataset's hash
    :raises ValueError: if the folder holds something, or anything does not fit
    """
    check_folder(folder)
    with open_writer(folder, identity) as writer:
        if writer.is_finished:
            raise ValueError(f"{folder} already holds this dataset; name a new folder, or remove it to write it again")
        n_shards = 0
        for group in _grouped(segments):
            writer.write_shard(n_shards, group)
            n_shards += 1
        if not n_shards:
            raise ValueError(f"there are no segments to write into {folder}, from {identity['source']!r}")
        return writer.finish(n_shards)


def _grouped(segments: Iterable[Segment]) -> Iterator[list[Segment]]:
    """Segments in groups of the size of a shard."""
    group: list[Segment] = []
    n_transitions = n_bytes = 0
    for segment in segments:
        group.append(segment)
        n_transitions += len(segment.actions)
        n_bytes += np.asarray(segment.frames).nbytes
        if n_transitions >= SHARD_TRANSITIONS or n_bytes >= SHARD_BYTES:
            yield group
            group, n_transitions, n_bytes = [], 0, 0
    if group:
        yield group


@contextlib.contextmanager
def open_writer(folder: Path, identity: dict[str, Any]) -> Iterator["DatasetWriter"]:
    """Begin a dataset, or go on with one that has the same identity; no other process can write meanwhile.

    :param folder: the dataset's folder, made if absent; a caller that computes before writing calls
        :func:`check_folder` first
    :param identity: the keys :func:`~sb3_abisim.data.format.identity_keys`, in JSON types
    :raises ValueError: if the folder is something else or was begun with another identity, or is being written
    """
    folder.mkdir(parents=True, exist_ok=True)
    with folder_lock(folder):
        check_folder(folder)
        yield DatasetWriter(folder, identity)


class DatasetWriter:
    """The writing side of a dataset folder; made by :func:`open_writer`, which holds the lock.

    :param folder: an existing folder
    :param identity: see :func:`open_writer`
    """

    def __init__(self, folder: Path, identity: dict[str, Any]) -> None:
        self.folder = folder
        remove_temporaries(folder)
        self._config = {key: identity[key] for key in identity_keys(identity)} | {"versions": package_versions()}
        path = folder / CONFIG_NAME
        if path.exists():
            try:
                there = from_json_file(path)
                if set(there) != {*identity_keys(there), "versions"}:
                    raise DatasetError(f"{path} is damaged (its keys are not those of a dataset)")
            except DatasetError as error:
                raise DatasetError(f"{error}; remove {folder} and collect it again") from None
            named = {**there, "env_kwargs": current_env_kwargs(there["env_kwargs"])}
            _require_same(folder, named, self._config, identity_keys(self._config))
            self._require_finished_config(there)
            self._versions_here, self._config = self._config["versions"], there
            if path.read_bytes() != to_json_bytes(there):
                # Damage that means nothing, such as another white space.
                self._write(CONFIG_NAME, to_json_bytes(there))
        else:
            self._versions_here = self._config["versions"]
            self._write(CONFIG_NAME, to_json_bytes(self._config))

    def _require_finished_config(self, config: dict[str, Any]) -> None:
        """Refuse versions that a finished dataset was not made with: nothing else would contradict them."""
        try:
            meta = from_json_file(self.folder / META_NAME)
            check_meta(meta)
        except (OSError, ValueError, KeyError, TypeError):
            return  # there is none, or it is made again
        if config["versions"] != meta["versions"]:
            raise DatasetError(
                f"{self.folder / CONFIG_NAME} is damaged (its versions are not those of {META_NAME}); remove it, and "
                f"copy it from another copy of the dataset, or remove {self.folder} and collect it again"
            )

    @property
    def is_finished(self) -> bool:
        """Whether the folder holds a finished dataset (of any size)."""
        return (self.folder / META_NAME).exists()

    def n_transitions(self) -> int:
        """Transitions in the finished shards."""
        total, shard = 0, 0
        while (manifest := self._manifest(shard)) is not None:
            total, shard = total + int(manifest["n_transitions"]), shard + 1
        return total

    def has_shard(self, shard: int, n_transitions: int) -> bool:
        """Whether a shard is there, undamaged (by sizes and hashes), with that many transitions.

        :param shard: its number, from 0
        :param n_transitions: how many it must hold
        """
        manifest = self._manifest(shard)
        return manifest is not None and manifest["n_transitions"] == n_transitions and self._is_intact(manifest)

    def _is_intact(self, manifest: dict[str, Any]) -> bool:
        for name, entry in manifest["files"].items():
            path = self.folder / name
            if not path.is_file() or path.stat().st_size != entry["bytes"] or file_hash(path) != entry["sha256"]:
                return False
        return True

    def write_shard(self, shard: int, segments: list[Segment]) -> None:
        """Write a shard, in place of the one that may be there.

        :param shard: its number, from 0
        :param segments: its content, at least one
        :raises DatasetError: if the shards there were made with other package versions
        :raises OSError: for a full disk among others; the shard is then absent
        """
        _require_same(self.folder, self._config, {"versions": self._versions_here}, ("versions",))
        # Unfinished from here on, until finish(): first the whole, then this shard.
        (self.folder / META_NAME).unlink(missing_ok=True)
        (self.folder / shard_file(shard)).unlink(missing_ok=True)
        n_transitions = sum(len(segment.actions) for segment in segments)
        n_frames = n_transitions + len(segments)
        files = {}
        for name in array_names(self._config):
            dtype, row_shape = array_layout(self._config, name)
            path = self.folder / array_file(name, shard)
            _write_npy(path, dtype, (n_frames, *row_shape), (_rows(name, dtype, row_shape, s) for s in segments))
            files[path.name] = {"bytes": path.stat().st_size, "sha256": file_hash(path)}
        manifest = {"n_transitions": n_transitions, "n_frames": n_frames, "files": files}
        self._write(shard_file(shard), to_json_bytes(manifest))

    def count_ends(self, n_shards: int) -> NDArray[np.int64]:
        """How often each value stands in the ends of finished shards.

        :param n_shards: of shards 0 to ``n_shards - 1``
        :return: by value, int64 (4,)
        """
        ends = (np.load(self.folder / array_file("ends", k), allow_pickle=False) for k in range(n_shards))
        return sum((np.bincount(array, minlength=CUT + 1) for array in ends), np.zeros(CUT + 1, np.int64))

    def finish(self, n_shards: int) -> str:
        """Write meta.json over shards 0 to ``n_shards - 1``.

        :param n_shards: how many there are, at least 1
        :return: the dataset's hash
        """
        shards = [from_json_file(self.folder / shard_file(k)) for k in range(n_shards)]
        meta = make_meta(self._config, shards)
        wanted = {shard_file(k) for k in range(n_shards)}.union(*(shard["files"] for shard in shards))
        for path in self.folder.iterdir():
            if is_shard_file(path.name) and path.name not in wanted:
                path.unlink()  # a longer collection was killed within this shard
        content, path = to_json_bytes(meta), self.folder / META_NAME
        if not path.exists() or path.read_bytes() != content:
            self._write(META_NAME, content)
        return str(meta[HASH_KEY])

    def _manifest(self, shard: int) -> dict[str, Any] | None:
        try:
            manifest = from_json_file(self.folder / shard_file(shard))
        except (FileNotFoundError, DatasetError):
            return None
        return manifest if is_shard_manifest(manifest, shard, self._config) else None

    def _write(self, name: str, content: bytes) -> None:
        write_atomic(self.folder / name, lambda file: file.write(content), len(content))


def _require_same(folder: Path, there: dict[str, Any], here: dict[str, Any], keys: Sequence[str]) -> None:
    different = [key for key in keys if there.get(key) != here[key]]
    if different:
        sides = "; ".join(f"{key}: {there.get(key)!r} in the folder, {here[key]!r} now" for key in different)
        if different == ["versions"]:
            raise DatasetError(
                f"{folder} was begun with other package versions, which may render other frames ({sides}); "
                "install those versions to continue, or collect into a new folder"
            )
        raise ValueError(f"{folder} was begun with other arguments ({sides}); repeat those, or name a new folder")


def _rows(name: str, dtype: np.dtype[Any], row_shape: tuple[int, ...], segment: Segment) -> NDArray[Any]:
    """The rows of one array for a segment, shape (L + 1, *row_shape)."""
    n_frames = len(segment.actions) + 1
    if name == "frames":
        rows = np.asarray(segment.frames)
    elif name.startswith("factor_"):
        rows = np.asarray(segment.factors[name.removeprefix("factor_")])
    else:
        rows = np.zeros((n_frames, *row_shape), dtype)
        if name == "actions":
            rows[:-1] = segment.actions
        else:
            rows[-1] = segment.end
    if rows.shape != (n_frames, *row_shape) or rows.dtype != dtype:
        raise ValueError(f"{name} must be {dtype} {(n_frames, *row_shape)}, got {rows.dtype} {rows.shape}")
    return rows


def _write_npy(path: Path, dtype: np.dtype[Any], shape: tuple[int, ...], chunks: Iterator[NDArray[Any]]) -> None:
    """An .npy file written in pieces, so that a shard need not be in memory twice."""
    buffer = io.BytesIO()
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, header)
    size = buffer.tell() + dtype.itemsize * math.prod(shape)

    def write(file: BinaryIO) -> None:
        file.write(buffer.getvalue())
        for chunk in chunks:
            file.write(np.ascontiguousarray(chunk).data)
        assert file.tell() == size

    write_atomic(path, write, size)
