"""Decoding custom videos and folders of frames, cropped to the central square and averaged to 64x64.

Decoders go on silently after damage: half a file decodes to half of the frames without an error. What was decoded is
therefore compared with what the file's header or the numbers of the frames promise. An MP4 file that an editor has
trimmed counts frames that are not shown; it is complete if its last frame ends when the header promises.
"""

import importlib
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.backgrounds.clips import SIZE
from sb3_abisim.envs.backgrounds.video_files import Source

if TYPE_CHECKING:
    from PIL import Image


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

    None for other formats: what is left of an AVI file gives its remaining length, and Matroska steps over damage, so
    that a lost piece looks like a still image.
    """
    stream = container.streams.video[0]
    if "mp4" not in container.format.name or stream.duration is None:
        return None
    return float(((stream.start_time or 0) + stream.duration) * stream.time_base)


def decode_clip(source: Source) -> Iterator[NDArray[np.uint8]]:
    """The frames of a clip, each uint8 (3, 64, 64).

    :param source: a video file or a folder of frames
    :raises ClipError: if it cannot be decoded or lacks frames
    :raises ImportError: if the decoder is not installed
    """
    return map(shrink, decode_video(source.path) if source.is_video else _decode_images(source))


def expected_frames(source: Source) -> int:
    """Number of frames as far as it is known before decoding, else 0.

    :param source: a video file or a folder of frames
    """
    if not source.is_video:
        return len(source.files)
    av = _import_decoder("av")
    try:
        with av.open(str(source.path), metadata_errors="ignore") as container:
            return _promise(container, source.path)[0] or 0
    except (ClipError, av.FFmpegError):
        return 0  # decoding will report what is wrong


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
    """The central square of a frame, averaged to uint8 (3, 64, 64).

    :param image: of any size and mode
    """
    box = _import_decoder("PIL.Image").Resampling.BOX
    side = min(image.size)
    left, top = (image.width - side) // 2, (image.height - side) // 2
    small = image.convert("RGB").resize((SIZE, SIZE), box, box=(left, top, left + side, top + side))
    return np.ascontiguousarray(np.asarray(small).transpose(2, 0, 1))


def _import_decoder(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"custom videos need PyAV and Pillow ({error}): pip install 'sb3_abisim[video]', "
            "or leave out videos= to use the built-in backgrounds"
        ) from error
