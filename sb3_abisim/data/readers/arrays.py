"""Episodes as NumPy arrays: an .npz file, a folder of .npy or .npz files, or arrays in memory.

    observations   uint8 [T + 1, ...] of an episode of T steps: channels first, channels last, or gray
    actions        [T, ...]: action t leads from observation t to observation t + 1
    terminations   bool [T], or one for the last step; optional
    truncations    likewise
    episode_ends   integers [E]: after how many actions each of several episodes ends; optional
    factor_NAME    [T + 1, ...]: the state behind each observation, for probes; optional

Several episodes may follow each other in one file. Each step with a termination or a truncation ends one, as do the
``episode_ends``. Every episode has its last observation, so that E episodes of T steps together have T + E
observations. Nothing is unpickled. What a header declares is compared with the file's size before anything is made.
"""

import lzma
import math
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.arrays import ARRAY_ERRORS
from sb3_abisim.common.files import find
from sb3_abisim.common.spaces import fit_actions
from sb3_abisim.data.copies import ImageLayout
from sb3_abisim.data.format import CUT, TERMINATED, TRUNCATED
from sb3_abisim.data.importing import CHANNELS_KEY, LEFT_OUT_KEY, LOSSY_KEY
from sb3_abisim.data.recorded import (
    find_action_space,
    observation_space_of,
    recorded_actions,
    recorded_layout,
    unread_keys,
)
from sb3_abisim.data.writer import Segment, check_folder, write_dataset
from sb3_abisim.registry import register_reader

OBSERVATIONS, ACTIONS = "observations", "actions"
TERMINATIONS, TRUNCATIONS, EPISODE_ENDS = "terminations", "truncations", "episode_ends"
FACTOR_PREFIX = "factor_"
# Arrays of .npz files are read into memory; those of .npy files are mapped.
MAX_UNPACKED_BYTES = 2**29
# Deflate makes nothing smaller than this.
_DEFLATE_RATIO = 1032
_READ_HEADER = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def import_arrays(
    source: Any,
    folder: str | os.PathLike[str],
    *,
    env_id: str | None = None,
    image_key: str | None = None,
    action_space: gym.Space[Any] | None = None,
) -> str:
    """Make a dataset folder of episodes in NumPy arrays.

    :param source: an .npz file; a folder of ``observations.npy``, ``actions.npy`` and so on, or of .npz files, taken in
        the order of their names; or a list of episodes, each a dict of arrays by the names above, whose observations
        may be a dict of arrays, too
    :param folder: new or empty
    :param env_id: recorded with the dataset; one of Gymnasium's registry gives the action space, too
    :param image_key: which of a dict of observations is the image; None for the only one. Others become factors
    :param action_space: of the environment; None for that of ``env_id``, else the smallest one that holds all actions
    :return: the hash of the new dataset
    :raises ValueError: for what is not laid out like this
    """
    check_folder(Path(folder))
    parts, name = _parts(source)
    first = parts[0]
    observation_space = observation_space_of(first[OBSERVATIONS])
    layout = recorded_layout(observation_space, image_key, first.where)
    from_actions = False
    if action_space is None:
        chunks = (np.asarray(part[ACTIONS]) for part in parts)
        action_space, from_actions = find_action_space(env_id, chunks, name)
    left_out = sorted({key for part in parts for key in part.others()}) + unread_keys(observation_space, layout)
    return write_dataset(
        folder,
        (segment for part in parts for segment in part.segments(layout, action_space)),
        env_id=env_id or Path(name).stem,
        observation_space=layout.space,
        action_space=action_space,
        source={
            "arrays": name,
            CHANNELS_KEY: layout.channels,
            LOSSY_KEY: None,
            LEFT_OUT_KEY: left_out,
            "action_space_from_data": from_actions,
        },
    )


class _Part:
    """The arrays of one file or dict, by name; each is read when it is asked for.

    :param where: what holds them, for messages
    """

    def __init__(self, where: str) -> None:
        self.where = where

    def names(self) -> list[str]:
        raise NotImplementedError

    def read(self, name: str) -> Any:
        raise NotImplementedError

    def __getitem__(self, name: str) -> Any:
        if name not in self.names():
            raise ValueError(
                f"{self.where} has no {name}, only {', '.join(sorted(self.names())) or 'nothing'}; it needs "
                f"{OBSERVATIONS} and {ACTIONS}"
            )
        return self.read(name)

    def others(self) -> list[str]:
        """Names that mean nothing to this reader."""
        known = (OBSERVATIONS, ACTIONS, TERMINATIONS, TRUNCATIONS, EPISODE_ENDS)
        return [name for name in self.names() if name not in known and not name.startswith(FACTOR_PREFIX)]

    def segments(self, layout: ImageLayout, action_space: gym.Space[Any]) -> Iterator[Segment]:
        """The episodes."""
        observations, actions = self[OBSERVATIONS], recorded_actions(self[ACTIONS], action_space)
        if not actions.ndim or not len(actions):
            raise ValueError(f"{self.where} has actions of shape {actions.shape}; an episode has one step at least")
        terminated, truncated = self._flags(TERMINATIONS, len(actions)), self._flags(TRUNCATIONS, len(actions))
        stops = self._stops(terminated | truncated)
        n_frames = len(actions) + len(stops)
        images, factors = self._rows(layout, observations)
        for name, rows in {OBSERVATIONS: images, **factors}.items():
            if not np.ndim(rows) or len(rows) != n_frames:
                raise ValueError(
                    f"{self.where} has {name} of shape {np.shape(rows)} for {len(actions)} actions in {len(stops)} "
                    f"episodes; it needs {n_frames}, the last one of each episode included"
                )
        if images.dtype != np.uint8:
            raise ValueError(f"{self.where} has observations of {images.dtype}; convert them to uint8 in 0..255")
        begin = 0
        for i, stop in enumerate(stops):
            frames = slice(begin + i, stop + i + 1)
            end = TERMINATED if terminated[stop - 1] else TRUNCATED if truncated[stop - 1] else CUT
            fitted = fit_actions(actions[begin:stop], action_space, self.where)
            yield Segment(
                images[frames], fitted, end, {name: np.asarray(rows[frames]) for name, rows in factors.items()}
            )
            begin = stop

    def _rows(self, layout: ImageLayout, observations: Any) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
        if isinstance(observations, Mapping) != (layout.key is not None):
            raise ValueError(f"{self.where}: observations are a dict in some episodes and not in others; record one")
        try:
            images, factors = layout.images(observations), layout.rests(observations)
        except (ValueError, KeyError) as error:
            raise ValueError(f"{self.where}: {error}; record all episodes alike") from None
        for name in self.names():
            if name.startswith(FACTOR_PREFIX):
                factors[name.removeprefix(FACTOR_PREFIX)] = self[name]
        return images, factors

    def _flags(self, name: str, n: int) -> NDArray[np.bool_]:
        """Per step, whether it is the end of an episode."""
        if name not in self.names():
            return np.zeros(n, bool)
        flags = np.asarray(self[name])
        if not flags.ndim:
            flags = np.arange(n) == (n - 1 if flags else -1)
        if flags.shape != (n,) or not np.isin(flags, (0, 1)).all():
            raise ValueError(
                f"{self.where} has {name} of shape {flags.shape}; it needs a 0 or 1 for each of {n} actions"
            )
        return flags.astype(bool)

    def _stops(self, ended: NDArray[np.bool_]) -> list[int]:
        """After how many actions each episode ends."""
        n = len(ended)
        flagged = set((np.flatnonzero(ended) + 1).tolist())
        if EPISODE_ENDS not in self.names():
            return sorted(flagged | {n})
        stops = np.asarray(self[EPISODE_ENDS])
        if stops.ndim != 1 or stops.dtype.kind not in "iu" or not len(stops):
            raise ValueError(f"{self.where} has {EPISODE_ENDS} of {stops.dtype} {stops.shape}; give whole numbers")
        listed: list[int] = stops.tolist()
        if listed != sorted(set(listed)) or listed[0] < 1 or listed[-1] != n or not flagged <= set(listed):
            raise ValueError(
                f"{self.where} has {EPISODE_ENDS} {listed[:5]}...{listed[-1]} for {n} actions; they must ascend up to "
                "that number, and name every step with a termination or truncation"
            )
        return listed


class _Memory(_Part):
    """Arrays in memory.

    :param arrays: by name
    :param where: what holds them, for messages
    """

    def __init__(self, arrays: Mapping[str, Any], where: str) -> None:
        super().__init__(where)
        self._arrays = arrays

    def names(self) -> list[str]:
        return list(self._arrays)

    def read(self, name: str) -> Any:
        value = self._arrays[name]
        return value if isinstance(value, Mapping) else np.asarray(value)


class _Folder(_Part):
    """Files ``NAME.npy`` of a folder, mapped into memory.

    :param path: the folder
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._files = {file.stem: file for file in find(path, "*.npy")}

    def names(self) -> list[str]:
        return list(self._files)

    def read(self, name: str) -> NDArray[Any]:
        path = self._files[name]
        with open(path, "rb") as file:
            _check_header(file, path.stat().st_size, str(path))
        return np.load(path, mmap_mode="r", allow_pickle=False)  # type: ignore[no-any-return]


# What unpacking a member raises; what is wrong with its array has been said before.
_UNPACKING = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, RuntimeError, EOFError, NotImplementedError,
)  # fmt: skip


class _Archive(_Part):
    """An .npz file.

    :param path: the file
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._path = path
        try:
            with zipfile.ZipFile(path) as archive:
                self._members = {
                    member.filename.removesuffix(".npy"): member
                    for member in archive.infolist()
                    if member.filename.endswith(".npy")
                }
        except zipfile.BadZipFile as error:
            raise ValueError(f"{path} is no .npz file ({error}); write it with numpy.savez") from None

    def names(self) -> list[str]:
        return list(self._members)

    def read(self, name: str) -> NDArray[Any]:
        member, where = self._members[name], f"{name} in {self._path}"
        packed = min(member.compress_size, self._path.stat().st_size)
        if member.file_size > MAX_UNPACKED_BYTES:
            raise ValueError(
                f"{where} takes {member.file_size} bytes of memory, more than {MAX_UNPACKED_BYTES}; save it as "
                f"{name}.npy in a folder, where it is not read at once"
            )
        if member.file_size > _DEFLATE_RATIO * packed:
            raise ValueError(
                f"{where} declares {member.file_size} bytes in {packed}; damaged or forged, write it again"
            )
        try:
            with zipfile.ZipFile(self._path) as archive:
                with archive.open(member) as file:
                    _check_header(file, member.file_size, where)
                with archive.open(member) as file:
                    return np.lib.format.read_array(file, allow_pickle=False)
        except _UNPACKING as error:
            raise ValueError(f"{where} cannot be read ({error}); write it again with numpy.savez") from None


def _check_header(file: IO[bytes], size: int, where: str) -> None:
    """Refuse an array that is not as large as it declares, before anything of that size is made."""
    try:
        version = np.lib.format.read_magic(file)
        shape, _, dtype = _READ_HEADER[version](file)
    except ARRAY_ERRORS as error:
        raise ValueError(f"{where} is no array of NumPy's ({error}); write it with numpy.save") from None
    if dtype.hasobject:
        raise ValueError(f"{where} holds Python objects, and to unpickle them can run code; save it as numbers")
    declared = file.tell() + dtype.itemsize * math.prod(shape)
    if min(shape, default=0) < 0 or declared != size:
        raise ValueError(f"{where} declares {dtype} {shape}, {declared} bytes, and has {size}; write it again")


def _parts(source: Any) -> tuple[Sequence[_Part], str]:
    """What holds the arrays, at least one, and a name for all of it."""
    if isinstance(source, Mapping):
        source = [source]
    if not isinstance(source, str | os.PathLike):
        episodes = list(source)
        if not episodes or not all(isinstance(episode, Mapping) for episode in episodes):
            raise ValueError(f"there must be a list of dicts of arrays, one at least, got {len(episodes)} of them")
        return [_Memory(episode, f"episode {i}") for i, episode in enumerate(episodes)], "arrays in memory"
    path = Path(source)
    if path.is_dir():
        archives = find(path, "*.npz")
        single = _Folder(path)
        if archives and single.names():
            raise ValueError(f"{path} holds .npz and .npy files; leave one kind there")
        if not archives and not single.names():
            raise ValueError(f"{path} holds neither .npz files nor {OBSERVATIONS}.npy and {ACTIONS}.npy")
        return [_Archive(file) for file in archives] or [single], path.name
    if path.suffix == ".npy":
        raise ValueError(f"{path} is one array; name the folder that holds {OBSERVATIONS}.npy and {ACTIONS}.npy")
    if not path.is_file():
        raise ValueError(f"{path} is neither a file nor a folder; name an .npz file, or a folder of .npy files")
    return [_Archive(path)], path.name


register_reader("arrays", import_arrays, help="an .npz file, or a folder of .npy or .npz files, with episodes")
