"""Decoded custom videos, kept in a cache that processes share.

Clips lie there as memory-mapped arrays, named by the hash of the original's content. A renamed video is thus found
again, and a changed one is not mistaken for the old one.
"""

import hashlib
import json
import os
import sys
import warnings
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.arrays import ARRAY_ERRORS
from sb3_abisim.common.files import file_hash, write_atomic
from sb3_abisim.common.paths import CACHE_VARIABLE, cache_folder
from sb3_abisim.envs.backgrounds.clips import FRAME_SHAPE, SIZE, Backgrounds, Clip, array_hash
from sb3_abisim.envs.backgrounds.video_files import Source, describe_split
from sb3_abisim.envs.backgrounds.video_frames import decode_clip, expected_frames
from sb3_abisim.envs.backgrounds.video_whole import ClipError

_BYTES_PER_FRAME = 3 * SIZE * SIZE
# Raise it when the decoding changes, so that older cache entries are not used.
_CACHE_VERSION = 3


def _make_cache(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError("it cannot be written")
    except (PermissionError, FileExistsError, NotADirectoryError) as error:
        remedy = f"set {CACHE_VARIABLE} to a folder that can be written"
        raise type(error)(f"cannot keep decoded clips in {folder} ({error}); {remedy}") from error


def _content_hash(source: Source) -> str:
    sha256 = hashlib.sha256(f"{_CACHE_VERSION}:{FRAME_SHAPE}:{source.is_video}".encode())
    for file in source.files:
        sha256.update(file_hash(file).encode())
    return sha256.hexdigest()


@dataclass(frozen=True)
class _Entry:
    """A clip's place in the cache: the frames, and a note of their number and sha256 that is written last."""

    source: Source
    hash: str

    @property
    def frames_path(self) -> Path:
        return cache_folder() / f"{self.hash}.npy"

    @property
    def note_path(self) -> Path:
        return cache_folder() / f"{self.hash}.json"

    def read(self) -> Clip | None:
        """The clip, or None where there is no whole, undamaged entry."""
        try:
            note = json.loads(self.note_path.read_bytes())
            frames = _map(self.frames_path)
            if len(frames) != note["n_frames"] or array_hash(frames) != note["sha256"]:
                return None
        except (OSError, *ARRAY_ERRORS):
            return None
        load = partial(_map, self.frames_path)
        return Clip(self.source.name, self.source.group, len(frames), note["sha256"], load)

    def decode(self, max_frames: int, total: int) -> None:
        """Decode the clip into the cache, up to ``max_frames`` of ``total`` for all clips."""
        source, sha256, count = self.source, hashlib.sha256(), 0

        def write(file: BinaryIO) -> None:
            nonlocal count
            _write_header(file, 0)
            for frame in decode_clip(source):
                if count == max_frames:
                    raise _too_large(f"{source.path} and the clips before it", f"more than {total}", total)
                block = frame.tobytes()
                sha256.update(block)
                file.write(block)
                count += 1
            file.seek(0)
            _write_header(file, count)

        _make_cache(cache_folder())
        write_atomic(self.frames_path, write)
        note = {"n_frames": count, "sha256": sha256.hexdigest(), "source": str(source.path)}
        write_atomic(self.note_path, lambda file: file.write(json.dumps(note).encode()))


def _write_header(file: BinaryIO, n_frames: int) -> None:
    # NumPy pads headers so that the first axis can grow without moving the data.
    header = {"descr": "|u1", "fortran_order": False, "shape": (n_frames, *FRAME_SHAPE)}
    np.lib.format.write_array_header_1_0(file, header)


def _map(path: Path) -> NDArray[np.uint8]:
    return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def _too_large(what: str, n_frames: object, max_frames: int) -> ValueError:
    return ValueError(
        f"{what} have {n_frames} frames, but max_bytes allows {max_frames} ({_BYTES_PER_FRAME} bytes each); "
        "give fewer or shorter videos, or a larger max_bytes"
    )


@lru_cache(maxsize=16)
def load_split(
    origin: str,
    split: str,
    train_sources: tuple[Source, ...],
    eval_sources: tuple[Source, ...],
    min_frames: int,
    max_bytes: int,
    on_error: str,
) -> Backgrounds:
    """Decode one side of the split, or map it from the cache.

    :param origin: the folder, for messages
    :param split: which side to load
    :param train_sources: the train side
    :param eval_sources: the eval side
    :param min_frames: shortest clip accepted
    :param max_bytes: most memory the decoded frames may take
    :param on_error: "raise", or "skip" for a warning that lists what was left out
    :raises ClipError: for a clip that cannot be decoded, lacks frames or is shorter than ``min_frames``
    :raises ValueError: for a file on both sides, more than ``max_bytes`` of frames, or if every clip was skipped
    """
    hashes = {source: _content_hash(source) for source in (*train_sources, *eval_sources)}
    by_hash = {hashes[source]: source for source in train_sources}
    for source in eval_sources:
        twin = by_hash.get(hashes[source])
        if twin:
            raise ValueError(f"{twin.path} (train) and {source.path} (eval) have the same content; remove one of them")
    entries = [_Entry(source, hashes[source]) for source in (train_sources if split == "train" else eval_sources)]
    found = {entry: entry.read() for entry in entries}
    if not all(found.values()):
        # Once, before they are decoded.
        print(describe_split(origin, {"train": train_sources, "eval": eval_sources}), file=sys.stderr)
    max_frames = max_bytes // _BYTES_PER_FRAME
    expected = sum(clip.length if clip else expected_frames(entry.source) for entry, clip in found.items())
    if expected > max_frames:
        raise _too_large(f"the {split} clips of {origin}", expected, max_frames)
    clips: list[Clip] = []
    skipped: list[str] = []
    for entry, cached in _progress(found):
        try:
            clips.append(_usable(entry, cached, min_frames, max_frames - sum(c.length for c in clips), max_frames))
        except ClipError as error:
            if on_error == "raise":
                raise
            skipped.append(str(error))
    if skipped:
        report = "\n".join(skipped)
        if not clips:
            raise ValueError(f"all {len(skipped)} {split} clips of {origin} were skipped:\n{report}")
        warnings.warn(f"skipped {len(skipped)} of {len(entries)} {split} clips:\n{report}", stacklevel=3)
    return Backgrounds(origin, split, clips)


def _usable(entry: _Entry, clip: Clip | None, min_frames: int, max_frames: int, total: int) -> Clip:
    if clip is not None and clip.length > max_frames:
        raise _too_large(f"{entry.source.path} and the clips before it", f"more than {total}", total)
    if clip is None:
        entry.decode(max_frames, total)
        clip = entry.read()
        if clip is None:
            raise OSError(f"{entry.frames_path} does not read back as it was written; check the disk")
    if clip.length < min_frames:
        raise ClipError(
            f"{entry.source.path} has {clip.length} frames, fewer than min_frames={min_frames}; "
            "give a longer clip or a smaller min_frames"
        )
    return clip


def _progress(found: dict[_Entry, Clip | None]) -> Any:
    """The entries, with a progress bar while there is something to decode and a terminal to show it on."""
    items = found.items()
    if all(found.values()):
        return items
    from tqdm import tqdm

    return tqdm(items, desc="decoding backgrounds", unit="clip", disable=None)
