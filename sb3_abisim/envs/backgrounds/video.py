"""A user's own videos as backgrounds: decoding once, and a cache shared by processes.

Frames are cropped to the central square and averaged to 64x64. Decoded clips lie in a cache as memory-mapped arrays,
named by the hash of the original's content, so that a renamed video is found again and a changed one is not mistaken
for the old.

Decoders go on silently after damage: half a file decodes to half of the frames without an error. What was decoded is
therefore compared with what the file's header or the numbers of the frames promise. An MP4 file that an editor has
trimmed counts frames that are not shown; it is complete if its last frame ends when the header says.
"""

import hashlib
import itertools
import json
import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.files import file_hash, write_atomic
from sb3_abisim.common.paths import CACHE_VARIABLE, cache_folder
from sb3_abisim.envs.backgrounds.clips import FRAME_SHAPE, SIZE, Backgrounds, Clip, array_hash
from sb3_abisim.envs.backgrounds.video_files import Source

if TYPE_CHECKING:
    from PIL import Image


_BYTES_PER_FRAME = 3 * SIZE * SIZE
# Raise it when the decoding changes, so that older cache entries are not used.
_CACHE_VERSION = 1


class ClipError(ValueError):
    """One clip cannot be used; ``on_error="skip"`` leaves it out."""


def decode_video(path: Path) -> Iterator["Image.Image"]:
    """The frames of a video file.

    :param path: the file
    :raises ClipError: if it cannot be decoded or has fewer frames than its header promises (so does a complete Matroska
        file whose frame rate varies)
    :raises ImportError: if the decoder is not installed
    """
    av = _import_decoder("av")
    count, end, length = 0, 0.0, None
    try:
        # Titles and the like may be in any encoding.
        with av.open(str(path), metadata_errors="ignore") as container:
            promised, share = _promise(container, path)
            length = _mp4_length(container)
            container.streams.video[0].thread_type = "AUTO"
            for frame in container.decode(video=0):
                if frame.is_corrupt:
                    raise ClipError(f"frame {count} of {path} is damaged; replace the file or remove it")
                yield frame.to_image()
                count += 1
                if length is not None and frame.pts is not None:
                    end = float((frame.pts + frame.duration) * frame.time_base)
    except av.FFmpegError as error:
        raise ClipError(
            f"{path} cannot be decoded after {count} frames ({error}); replace the file or remove it"
        ) from error
    complete = length is not None and end >= share * length
    if promised is not None and count < share * promised and not complete:
        raise ClipError(
            f"decoded {count} of {promised} frames of {path}: the file is cut off, or its frames are not evenly timed; "
            f"get a complete copy or, if it plays to its end, even it out: ffmpeg -i {path.name} -fps_mode cfr even.mp4"
        )


def _promise(container: Any, path: Path) -> tuple[int | None, float]:
    """How many frames the header promises, and the share of them that must come."""
    if not container.streams.video:
        raise ClipError(f"{path} holds no video; remove it")
    stream = container.streams.video[0]
    if stream.frames:
        return int(stream.frames), 0.98
    rate = stream.average_rate
    if not rate:
        return None, 0.0
    if stream.duration is not None:
        return round(stream.duration * stream.time_base * rate), 0.98
    if container.duration is not None:
        # In microseconds, and of the longest stream, which may be the sound.
        return round(container.duration * rate / 1_000_000), 0.9
    return None, 0.0


def _mp4_length(container: Any) -> float | None:
    """When an MP4 or MOV file's last frame ends, in seconds.

    None for other formats: what is left of an AVI file tells its own length, and Matroska steps over damage, so that a
    piece lost from the middle cannot be told from a still picture.
    """
    stream = container.streams.video[0]
    if "mp4" not in container.format.name or stream.duration is None:
        return None
    return float(((stream.start_time or 0) + stream.duration) * stream.time_base)


def _decode_images(source: Source) -> Iterator["Image.Image"]:
    image_module = _import_decoder("PIL.Image")
    _check_numbers(source)
    for file in source.files:
        try:
            with image_module.open(file) as image:
                if image.mode.startswith(("I", "F")):
                    raise ClipError(
                        f"{file} has more than 8 bits per value ({image.mode}); convert {source.path} to 8 bits"
                    )
                yield image.convert("RGB")
        except (OSError, SyntaxError, image_module.DecompressionBombError) as error:
            raise ClipError(f"{file} cannot be decoded ({error}); replace the file or remove {source.path}") from error


def _check_numbers(source: Source) -> None:
    """Frames numbered 0, 5, 10 are complete, frames 0, 1, 3 are not."""
    matches = [re.fullmatch("(.*?)([0-9]+)", file.stem) for file in source.files]
    if len(matches) < 3 or len({match and match[1] for match in matches}) > 1 or matches[0] is None:
        return
    numbers = [int(match[2]) for match in matches if match]
    steps = [b - a for a, b in itertools.pairwise(numbers)]
    if max(steps) > min(steps) > 0:
        gap = next(i for i, step in enumerate(steps) if step > min(steps))
        expected = (numbers[-1] - numbers[0]) // min(steps) + 1
        raise ClipError(
            f"{source.path} has {len(numbers)} of {expected} frames: there is none between "
            f"{source.files[gap].name} and {source.files[gap + 1].name}; restore the missing frames or renumber"
        )


def shrink(image: "Image.Image") -> NDArray[np.uint8]:
    """The central square of a picture, averaged to uint8 (3, 64, 64).

    :param image: of any size and mode
    """
    box = _import_decoder("PIL.Image").Resampling.BOX
    side = min(image.size)
    left, top = (image.width - side) // 2, (image.height - side) // 2
    small = image.convert("RGB").resize((SIZE, SIZE), box, box=(left, top, left + side, top + side))
    return np.ascontiguousarray(np.asarray(small).transpose(2, 0, 1))


def _import_decoder(module: str) -> Any:
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"your own videos need PyAV and Pillow ({error}): pip install 'sb3_abisim[video]', "
            "or leave out videos= to use the built-in backgrounds"
        ) from error


# The cache.


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
    key: str

    @property
    def frames_path(self) -> Path:
        return cache_folder() / f"{self.key}.npy"

    @property
    def note_path(self) -> Path:
        return cache_folder() / f"{self.key}.json"

    def read(self) -> Clip | None:
        """The clip, or None where there is no whole, undamaged entry."""
        try:
            note = json.loads(self.note_path.read_bytes())
            frames = _map(self.frames_path)
            if len(frames) != note["n_frames"] or array_hash(frames) != note["sha256"]:
                return None
        except (OSError, ValueError, KeyError, TypeError):
            return None
        load = partial(_map, self.frames_path)
        return Clip(self.source.name, self.source.group, len(frames), note["sha256"], load)

    def decode(self, max_frames: int, total: int) -> None:
        """Decode the clip into the cache, up to ``max_frames`` of ``total`` for all clips."""
        source, sha256, count = self.source, hashlib.sha256(), 0

        def write(file: BinaryIO) -> None:
            nonlocal count
            _write_header(file, 0)
            for image in decode_video(source.path) if source.is_video else _decode_images(source):
                if count == max_frames:
                    raise _too_large(f"{source.path} and the clips before it", f"more than {total}", total)
                block = shrink(image).tobytes()
                sha256.update(block)
                file.write(block)
                count += 1
            file.seek(0)
            _write_header(file, count)

        _make_cache(cache_folder())
        write_atomic(self.frames_path, write)
        note = {"n_frames": count, "sha256": sha256.hexdigest(), "source": str(source.path)}
        write_atomic(self.note_path, lambda file: file.write(json.dumps(note).encode()))

    def expected_frames(self) -> int:
        """Number of frames as far as it is known before decoding, else 0."""
        if not self.source.is_video:
            return len(self.source.files)
        av = _import_decoder("av")
        try:
            with av.open(str(self.source.path), metadata_errors="ignore") as container:
                return _promise(container, self.source.path)[0] or 0
        except (ClipError, av.FFmpegError):
            return 0  # decoding will say what is wrong


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
    train: tuple[Source, ...],
    unseen: tuple[Source, ...],
    min_frames: int,
    max_bytes: int,
    on_error: str,
) -> Backgrounds:
    """Decode one side of the split, or map it from the cache.

    :param origin: the folder, for reports
    :param split: which side to load
    :param train: sources of the train side
    :param unseen: sources of the eval side
    :param min_frames: shortest clip accepted
    :param max_bytes: most memory the decoded frames may take
    :param on_error: "raise", or "skip" for a warning that lists what was left out
    :raises ClipError: for a clip that cannot be decoded, lacks frames or is shorter than ``min_frames``
    :raises ValueError: for a file on both sides, more than ``max_bytes`` of frames, or if every clip was skipped
    """
    keys = {source: _content_hash(source) for source in (*train, *unseen)}
    by_key = {keys[source]: source for source in train}
    for source in unseen:
        twin = by_key.get(keys[source])
        if twin:
            raise ValueError(f"{twin.path} (train) and {source.path} (eval) have the same content; remove one of them")
    entries = [_Entry(source, keys[source]) for source in (train if split == "train" else unseen)]
    found = {entry: entry.read() for entry in entries}
    max_frames = max_bytes // _BYTES_PER_FRAME
    expected = sum(clip.length if clip else entry.expected_frames() for entry, clip in found.items())
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
