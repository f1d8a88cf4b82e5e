"""PLY as a container: its header, and its elements as arrays; in text, and in binary of either byte order."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import Budget, SceneError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1_000_000  # bytes


@dataclass
class Property:
    """A number of each entry, or a list of them.

    :param name: of it
    :param dtype: of its numbers
    :param counted_by: type of a list's length, or None
    """

    name: str
    dtype: np.dtype[Any]
    counted_by: np.dtype[Any] | None = None


@dataclass
class Element:
    """Entries of one kind.

    :param name: such as "vertex"
    :param count: of entries
    :param properties: as the header lists them
    :param columns: numbers by property, (count,)
    :param lists: by property, all lists one after the other, and the length of each, (count,)
    """

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)
    columns: dict[str, NDArray[Any]] = field(default_factory=dict)
    lists: dict[str, tuple[NDArray[Any], NDArray[np.int64]]] = field(default_factory=dict)


def read_ply(path: Path, data: bytes, budget: Budget) -> tuple[list[str], dict[str, Element]]:
    """The comments and the elements of a PLY file.

    :param path: for messages
    :param data: its content
    :param budget: counts what its header declares
    :raises SceneError: for a file that is damaged, or longer or shorter than it says
    """
    order, comments, elements, begin = _header(path, data)
    for element in elements:
        budget.add("vertices", element.count)
        least = sum((p.counted_by or p.dtype).itemsize for p in element.properties) if order != "=" else 1
        if element.count * max(least, 1) > len(data) - begin:
            raise SceneError(
                f"{path} is truncated: it declares {element.count} entries of {element.name} in {len(data) - begin} "
                "bytes; download it again"
            )
    reader = _Text(path, data[begin:]) if order == "=" else _Binary(path, data, begin)
    for element in elements:
        reader.read(element)
    reader.finish()
    return comments, {element.name: element for element in elements}


def _header(path: Path, data: bytes) -> tuple[str, list[str], list[Element], int]:
    end = re.search(rb"(?:^|\n|\r)end_header[ \t]*(\r\n|\n|\r)", data[:_MAX_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise SceneError(f"{path} cannot be read (it has no PLY header); download or export it again")
    order, comments, elements = None, [], []
    for line in data[: end.start()].decode("utf-8", errors="surrogateescape").splitlines()[1:]:
        words = line.split()
        if not words or words[0] == "obj_info":
            continue
        if words[0] == "comment":
            comments.append(line.split(None, 1)[1] if len(words) > 1 else "")
        elif words[0] == "format" and len(words) == 3 and words[1] in _ORDERS and words[2] == "1.0":
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit():
            elements.append(Element(words[1], int(words[2])))
        elif words[0] == "property" and elements and order is not None:
            elements[-1].properties.append(_property(path, line, words, order))
        else:
            raise SceneError(f"{path} has the line {line[:80]!r} in its header, which is not PLY 1.0; export it again")
    names = [e.name for e in elements] + [f"{e.name}.{p.name}" for e in elements for p in e.properties]
    if order is None or len(set(names)) < len(names):
        raise SceneError(f"{path} has no format, or twice the same name, in its header; export it again")
    return order, comments, elements, end.end()


def _property(path: Path, line: str, words: list[str], order: str) -> Property:
    types = words[2:4] if words[1] == "list" and len(words) == 5 else words[1:2] if len(words) == 3 else ["?"]
    if not all(name in _TYPES for name in types):
        raise SceneError(f"{path} has the line {line[:80]!r} in its header, which is not PLY 1.0; export it again")
    dtypes = [np.dtype(order + _TYPES[name]) for name in types]
    return Property(words[-1], dtypes[-1], dtypes[0] if len(dtypes) == 2 else None)


class _Text:
    def __init__(self, path: Path, data: bytes) -> None:
        self._path, self._words, self._at = path, data.split(), 0
        if b"_" in data:  # Python takes 1_0 for ten, other programs for one
            raise SceneError(f"{path} has what is not a number (a '_'); download or export it again")

    def _take(self, n: int) -> list[bytes]:
        words = self._words[self._at : self._at + n]
        if len(words) < n:
            raise SceneError(f"{self._path} is truncated: it ends within its data; download it again")
        self._at += n
        return words

    def read(self, element: Element) -> None:
        if not any(p.counted_by for p in element.properties):
            n = len(element.properties)
            rows = np.array(self._take(n * element.count)).reshape(element.count, n)
            for k, each in enumerate(element.properties):
                element.columns[each.name] = _numbers(self._path, rows[:, k], each.dtype)
            return
        found: dict[str, list[bytes]] = {p.name: [] for p in element.properties}
        lengths: dict[str, list[int]] = {p.name: [] for p in element.properties if p.counted_by}
        words, at = self._words, self._at
        try:
            for _ in range(element.count):
                for p in element.properties:
                    n = 1
                    if p.counted_by:
                        n = int(words[at])
                        if not 0 <= n <= len(words) - at:
                            raise SceneError(f"{self._path} has a list of {n} numbers; download or export it again")
                        lengths[p.name].append(n)
                        at += 1
                    found[p.name] += words[at : at + n]
                    at += n
        except IndexError:
            at = len(words) + 1
        if at > len(words):
            raise SceneError(f"{self._path} is truncated: it ends within its data; download it again")
        self._at = at
        for p in element.properties:
            values = _numbers(self._path, np.array(found[p.name]), p.dtype)
            if p.counted_by:
                element.lists[p.name] = values, np.array(lengths[p.name], dtype=np.int64)
            else:
                element.columns[p.name] = values

    def finish(self) -> None:
        if self._at < len(self._words):
            raise SceneError(f"{self._path} holds more than its header declares; download or export it again")


def _numbers(path: Path, words: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Text as numbers of a type, which must hold them."""
    if not len(words):
        return np.zeros(0, dtype=dtype)
    try:
        if dtype.kind == "f":
            return words.astype(np.float64).astype(dtype)
        wide = words.astype(np.int64)
    except ValueError as error:
        raise SceneError(f"{path} has what is not a number ({error}); download or export it again") from error
    if wide.min() < np.iinfo(dtype).min or wide.max() > np.iinfo(dtype).max:
        raise SceneError(f"{path} has the number {wide.max()}, too large for its type; export it again")
    return wide.astype(dtype)


class _Binary:
    def __init__(self, path: Path, data: bytes, begin: int) -> None:
        self._path, self._data, self._at = path, data, begin

    def read(self, element: Element) -> None:
        if not element.count:
            for p in element.properties:
                if p.counted_by:
                    element.lists[p.name] = np.zeros(0, p.dtype), np.zeros(0, np.int64)
                else:
                    element.columns[p.name] = np.zeros(0, p.dtype)
            return
        if not self._equal_lists(element):
            self._row_by_row(element)

    def _equal_lists(self, element: Element) -> bool:
        """Read at once, where the lists of all entries are as long as the first one's."""
        fields: list[Any] = []
        at = self._at
        for p in element.properties:
            n = None
            if p.counted_by:
                n = self._length(p, at)
                fields.append((f"#{p.name}", p.counted_by))
                at += p.counted_by.itemsize
            at += p.dtype.itemsize * (1 if n is None else n)
            fields.append((p.name, p.dtype) if n is None else (p.name, p.dtype, (n,)))
        row = np.dtype(fields)
        if self._at + row.itemsize * element.count > len(self._data):
            return False
        rows = np.frombuffer(self._data, row, element.count, self._at)
        for p in element.properties:
            if p.counted_by and (rows[f"#{p.name}"] != rows[f"#{p.name}"][0]).any():
                return False
        for p in element.properties:
            if p.counted_by:
                lengths = rows[f"#{p.name}"].astype(np.int64)
                element.lists[p.name] = rows[p.name].reshape(-1), lengths
            else:
                element.columns[p.name] = rows[p.name]
        self._at += row.itemsize * element.count
        return True

    def _length(self, p: Property, at: int) -> int:
        assert p.counted_by is not None
        if at + p.counted_by.itemsize > len(self._data):
            raise SceneError(f"{self._path} is truncated: it ends within its data; download it again")
        n = int(np.frombuffer(self._data, p.counted_by, 1, at)[0])
        if not 0 <= n <= (len(self._data) - at) // p.dtype.itemsize:
            raise SceneError(f"{self._path} is truncated, or has a list of {n} numbers; download or export it again")
        return n

    def _row_by_row(self, element: Element) -> None:
        """Lists of several lengths."""
        starts: dict[str, list[int]] = {p.name: [] for p in element.properties}
        lengths: dict[str, list[int]] = {p.name: [] for p in element.properties}
        kinds = [(p.name, p.dtype.itemsize, _unpacker(p.counted_by)) for p in element.properties]
        data, at = self._data, self._at
        for _ in range(element.count):
            for name, size, unpack in kinds:
                n = 1
                if unpack is not None:
                    width, signed, little, whole = unpack
                    if not whole:
                        raise SceneError(f"{self._path} counts a list by a number that is not whole; export it again")
                    n = int.from_bytes(data[at : at + width], "little" if little else "big", signed=signed)
                    at += width
                starts[name].append(at)
                lengths[name].append(n)
                at += n * size
                if n < 0 or at > len(data):
                    raise SceneError(f"{self._path} is truncated: it ends within its data; download it again")
        octets = np.frombuffer(data, np.uint8)
        for p in element.properties:
            size, counts = p.dtype.itemsize, np.array(lengths[p.name], dtype=np.int64)
            total = np.repeat(np.array(starts[p.name], dtype=np.int64) - (np.cumsum(counts) - counts) * size, counts)
            total += np.arange(len(total)) * size
            values = octets[total[:, None] + np.arange(size)].reshape(-1).view(p.dtype)
            if p.counted_by:
                element.lists[p.name] = values, counts
            else:
                element.columns[p.name] = values
        self._at = at

    def finish(self) -> None:
        if self._data[self._at :].strip():
            raise SceneError(f"{self._path} holds more than its header declares; download or export it again")


def _unpacker(dtype: np.dtype[Any] | None) -> tuple[int, bool, bool, bool] | None:
    if dtype is None:
        return None
    return dtype.itemsize, dtype.kind == "i", dtype.byteorder != ">", dtype.kind in "iu"
