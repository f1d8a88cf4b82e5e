"""A scan's file, the files beside it, and what all of them together may ask of memory."""

import os
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import unquote

from sb3_abisim.common.files import file_hash

SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
# What a scan may declare; it is counted before anything of that size is allocated.
MAX_FILE_BYTES = 2 * 2**30
MAX_FACES = 8_000_000
MAX_VERTICES = 24_000_000
MAX_INSTANCES = 100_000
MAX_IMAGE_SIDE = 8192
MAX_IMAGE_FILE_BYTES = 300_000_000  # four for each pixel of the largest, and what is written about it
MAX_WEBP_PIXELS = 34_000_000  # its decoder takes 16 bytes for each
MAX_IMAGE_PIXELS = 512_000_000  # of all textures together
# A few bytes can declare an image of any size; these many pixels are granted in any case, and then so many per byte.
FREE_IMAGE_PIXELS = 68_000_000
IMAGE_PIXELS_PER_BYTE = 20
_MAX_STEPS = 16  # folders of a path that are looked for
_MAX_MISSING = 2000  # files that are looked for everywhere


class SceneError(ValueError):
    """A scan that cannot be used; the message names the file and the remedy."""


class Budget:
    """What a scan has declared so far.

    :param path: of the scan, for messages
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._counts = {"faces": 0, "vertices": 0, "instances": 0, "morph targets": 0}
        self._pixels = self._image_bytes = 0

    def add(self, what: str, number: int) -> None:
        """Count what is about to be read.

        :param what: "faces", "vertices", "instances" or "morph targets", each as often as it is shown
        :param number: of them
        :raises SceneError: for more than the limit
        """
        self._counts[what] += number
        limit = {"faces": MAX_FACES, "vertices": MAX_VERTICES}.get(what, MAX_INSTANCES)
        if self._counts[what] > limit:
            raise SceneError(
                f"{self._path} declares {self._counts[what]} {what}, more than {limit}; decimate the scan, or cut it "
                "into several"
            )

    def check_image_file(self, name: str, n_bytes: int) -> None:
        """Refuse a texture before its file is read.

        :param name: of the texture
        :param n_bytes: of its file
        :raises SceneError: for more than any texture takes
        """
        if n_bytes > MAX_IMAGE_FILE_BYTES:
            raise SceneError(
                f"{self._path}: the texture {name} has {n_bytes} bytes, more than {MAX_IMAGE_FILE_BYTES}; {REEXPORT}"
            )

    def add_image(self, name: str, width: int, height: int, n_bytes: int) -> None:
        """Count a texture before it is decoded.

        :param name: of the texture
        :param width: in pixels, as its header says
        :param height: in pixels, as its header says
        :param n_bytes: of its file
        :raises SceneError: for one that is too large, or too many
        """
        if max(width, height) > MAX_IMAGE_SIDE:
            raise SceneError(f"{self._path}: the texture {name} has {width} x {height} pixels; {REEXPORT}")
        self._pixels += width * height
        self._image_bytes += n_bytes
        granted = min(MAX_IMAGE_PIXELS, FREE_IMAGE_PIXELS + IMAGE_PIXELS_PER_BYTE * self._image_bytes)
        if self._pixels > granted:
            raise SceneError(
                f"{self._path}: its textures declare {self._pixels} pixels in {self._image_bytes} bytes, more than "
                f"{granted}; export it again with smaller textures"
            )


# Pillow refuses far larger ones.
REEXPORT = f"export it again with PNG or JPEG textures of at most {MAX_IMAGE_SIDE} x {MAX_IMAGE_SIDE} pixels"


def check_file(path: Path) -> None:
    """Refuse what is visibly wrong without reading all of it.

    :param path: of the scan
    :raises SceneError: for what is wrong
    """
    if path.suffix.lower() not in SUFFIXES:
        raise SceneError(f"{path} is no scan file: its suffix must be one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise SceneError(f"there is no scan file {path}; check the path")
    with open(path, "rb") as file:
        head = file.read(64)
    if not head:
        raise SceneError(f"{path} is empty; download or copy it again")
    if head.startswith(b"version https://git-lfs"):
        raise SceneError(f"{path} is a Git LFS pointer, not the scan itself; run `git lfs pull` in its repository")
    if (size := path.stat().st_size) > MAX_FILE_BYTES:
        raise SceneError(
            f"{path} has {size} bytes, more than {MAX_FILE_BYTES}; decimate the scan, or cut it into several"
        )


class FileSpan:
    """A part of a file, sliced as bytes are; what nobody asks for is not read.

    :param path: of the file
    :param begin: of the part
    :param length: of the part, within the file
    """

    def __init__(self, path: Path, begin: int, length: int) -> None:
        self._path, self._begin, self._length = path, begin, length

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, part: slice) -> bytes:
        begin, end, _ = part.indices(self._length)
        with open(self._path, "rb") as file:
            file.seek(self._begin + begin)
            return file.read(max(end - begin, 0))

    def span(self, begin: int, length: int) -> "FileSpan":
        """A part of this one.

        :param begin: of the part
        :param length: of the part, within this one
        """
        return FileSpan(self._path, self._begin + begin, length)


class ScanFiles:
    """The files in a scan's folder that it refers to. Nothing outside of the folder is read.

    :param path: of the scan
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.folder = path.parent
        # What was read: path relative to the folder, to its sha256, or to "" for a place where nothing was found.
        self.hashes = {path.name: file_hash(path)}
        self.missing: list[str] = []

    def find(self, name: str, beside: str = "") -> str | None:
        """Where a file lies, whatever program and machine has written its name.

        Exporters write a space as %20, backslashes, other letters' case, and folders of another machine: of those, the
        longest end of the path that is there counts.

        :param name: as the scan gives it
        :param beside: folder of the file that gives it, relative to the scan's
        :return: relative to the scan's folder, or None; what was looked for is noted, and that it was not there
        :raises SceneError: where several files differ by the case of their letters alone
        """
        looked_for = []
        for text in dict.fromkeys((name.strip(), unquote(name.strip()))):
            steps = _without_dots([step for step in re.split(r"[/\\]", text) if step])[-_MAX_STEPS:]
            for end in ("/".join(steps[k:]) for k in range(len(steps))):
                looked_for += [f"{beside}/{end}", end] if beside else [end]
        for candidate in dict.fromkeys(looked_for):
            if (found := self._there(candidate)) is not None:
                return found
        if len(self.missing) >= _MAX_MISSING:
            raise SceneError(f"{self.path} refers to over {_MAX_MISSING} files that are not there; export it again")
        # Wherever it appears, it is noticed.
        self.hashes.update(dict.fromkeys((each for each in looked_for if len(each) < 1000), ""))
        self.missing.append(name)
        return None

    def size(self, found: str) -> int:
        """How many bytes a file has.

        :param found: by :meth:`find`
        """
        return (self.folder / found).stat().st_size

    def read(self, found: str) -> bytes:
        """The content of a file.

        :param found: by :meth:`find`
        """
        file = self.folder / found
        if self.size(found) > MAX_FILE_BYTES:
            raise SceneError(f"{self.path}: {found} has more than {MAX_FILE_BYTES} bytes; decimate the scan")
        self.hashes[found] = file_hash(file)
        return file.read_bytes()

    def _there(self, candidate: str) -> str | None:
        root = self.folder.resolve()
        try:
            if not (root / candidate).resolve().is_relative_to(root):
                return None
            if (self.folder / candidate).is_file():
                return candidate
            place, found = self.folder, []
            for step in candidate.split("/"):
                same = [e for e in os.listdir(place) if e.lower() == step.lower()] if place.is_dir() else []
                if len(same) > 1 and step not in same:
                    raise SceneError(
                        f"{self.path} refers to {candidate}, and {', '.join(sorted(same))} differ by the case of "
                        "letters alone; rename one"
                    )
                if not same:
                    return None
                found.append(step if step in same else same[0])
                place = place / found[-1]
            inside = place.resolve().is_relative_to(root)
        except SceneError:
            raise
        except (OSError, ValueError):  # a name that is none, such as one with a null character or a too long one
            return None
        return "/".join(found) if inside and place.is_file() else None

    def warn_missing(self) -> None:
        """Warn which files are not there, if any."""
        warn_missing(self.path, self.missing, stacklevel=6)


def _without_dots(steps: list[str]) -> list[str]:
    """A path without "." and "..": what leads out of the folder is dropped."""
    kept: list[str] = []
    for step in steps:
        if step == "..":
            kept = kept[:-1]
        elif step != ".":
            kept.append(step)
    return kept


def warn_missing(source: str | os.PathLike[str], names: Iterable[str], stacklevel: int = 4) -> None:
    """Warn which files of a scan are not there, if any.

    :param source: the scan
    :param names: of the files that it refers to
    :param stacklevel: of the warning
    """
    # One file may have been looked for in several places.
    if missing := sorted(set(map(bare_name, names))):
        warnings.warn(
            f"{source} refers to {', '.join(missing)}, which is not there (in the scan's folder); what it covers gets "
            "a plain color",
            stacklevel=stacklevel,
        )


def bare_name(name: str) -> str:
    """A file's name without folders, of this or another machine.

    :param name: as a scan gives it
    """
    return re.split(r"[/\\]", unquote(name.strip()))[-1]
