"""Reads rows of the array files of a dataset, of which there may be thousands, with as much memory as for a few."""

import itertools
import mmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.arrays import ARRAY_ERRORS
from sb3_abisim.data.format import DatasetError, array_file, array_layout

# Files that stay mapped: a process may have 256 open on macOS. Of the paper's data at most 157 are used at a time.
MAX_OPEN_FILES = 200
# Bytes read between two times at which the mapped pages are given back. The system maps a page's neighbors with it, so
# that up to twenty times as much was resident meanwhile. Pages stay in its cache: reading them again is cheap.
RELEASE_AFTER_BYTES = 16 * 2**20


class ShardFiles:
    """The array files of a dataset.

    :param path: its folder
    :param meta: the content of its meta.json
    """

    def __init__(self, path: Path, meta: dict[str, Any]) -> None:
        self.path, self.meta = path, meta
        self.maps: dict[tuple[str, int], np.memmap[Any, Any]] = {}
        # Of files beyond those: the byte at which their rows begin.
        self._begins: dict[tuple[str, int], int] = {}
        self.bytes_read = 0

    def whole(self, name: str, shard: int) -> NDArray[Any]:
        """One array of a shard, in memory.

        :param name: such as "actions"
        :param shard: its number
        :raises DatasetError: if it is not what the manifest says
        """
        return np.array(self._map(name, shard))

    def rows(self, name: str, shard: int, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Rows of one array of a shard.

        :param name: such as "frames"
        :param shard: its number
        :param rows: ascending, at least one
        :raises DatasetError: if the file is not what the manifest says
        """
        key = name, shard
        if key not in self.maps and len(self.maps) >= MAX_OPEN_FILES:
            return self._read(name, shard, rows)
        if key not in self.maps:
            self.maps[key] = self._map(name, shard)
        # Indexing a plain array is faster than indexing its memory-mapped subclass.
        part: NDArray[Any] = self.maps[key].view(np.ndarray)[rows]
        self.bytes_read += part.nbytes
        if self.bytes_read > RELEASE_AFTER_BYTES:
            self.release_pages()
        return part

    def release_pages(self) -> None:
        """Give mapped pages back, where the platform can."""
        self.bytes_read = 0
        if hasattr(mmap, "MADV_DONTNEED"):
            for array in self.maps.values():
                array._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]

    def _read(self, name: str, shard: int, rows: NDArray[np.int64]) -> NDArray[Any]:
        """The same from a file that does not stay open.

        A batch needs few rows of each of a thousand shards: mapping them anew takes ten times as long as reading.
        """
        key = name, shard
        if key not in self._begins:
            # What the file's header says is compared, once.
            self._begins[key] = self._map(name, shard).offset
        dtype, row_shape = array_layout(self.meta, name)
        part = np.empty((len(rows), *row_shape), dtype)
        # Rows that follow each other, as those of a transition do, are read at once.
        bounds = [0, *(np.flatnonzero(np.diff(rows) != 1) + 1).tolist(), len(rows)]
        path = self.path / array_file(name, shard)
        with open(path, "rb", buffering=0) as file:
            for first, end in itertools.pairwise(bounds):
                file.seek(self._begins[key] + int(rows[first]) * part[0].nbytes)
                if file.readinto(part[first:end]) != part[first:end].nbytes:  # type: ignore[arg-type]
                    raise DatasetError(f"{path} ends early; {repair(self.path, self.meta)}")
        return part

    def _map(self, name: str, shard: int) -> Any:
        path = self.path / array_file(name, shard)
        dtype, row_shape = array_layout(self.meta, name)
        try:
            # Mapped in any case: where a header declares more than the file has, no memory is taken.
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except ARRAY_ERRORS as error:
            raise DatasetError(f"{path} is not an array file of a dataset: {error}") from None
        expected = (self.meta["shards"][shard]["n_frames"], *row_shape)
        if array.dtype != dtype or array.shape != expected:
            raise DatasetError(f"{path} holds {array.dtype} {array.shape}, its manifest says {dtype} {expected}")
        return array


def repair(path: Path, meta: dict[str, Any]) -> str:
    """What to do about a damaged dataset, for messages.

    :param path: its folder
    :param meta: the content of its meta.json
    """
    if meta["source"] is not None:
        return f"remove {path} and make it again from its source, {meta['source']}"
    return (
        "run the command that collected it again, which collects damaged shards anew: sb3-abisim collect "
        f"--env {meta['env_id']} -n {meta['n_transitions']} --seed {meta['seed']} --n-envs {meta['n_envs']} "
        f"-o {path.absolute()}"
        + ("" if not meta["env_kwargs"] else " with its --env-kwargs")
        + ("" if not meta.get("preprocessing") else f" and its preprocessing, {meta['preprocessing']}")
    )
