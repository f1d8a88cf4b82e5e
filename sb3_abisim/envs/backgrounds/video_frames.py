"""Decoding custom videos and folders of frames, cropped to the central square and averaged to 64x64.

Decoders go on silently after damage: half a file decodes to half of the frames without an error. What was decoded is
therefore compared with what the file's header or the numbers of the frames promise. An MP4 file that an editor has
trimmed counts frames that are not shown; it is complete if its last frame ends when the header promises.
"""

import contextlib
import gc
import importlib
import itertools
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.images import too_many_passes
from sb3_abisim.envs.backgrounds.clips import SIZE
from sb3_abisim.envs.backgrounds.video_files import Source
from sb3_abisim.envs.backgrounds.video_roles import NUMBERED
from sb3_abisim.envs.backgrounds.video_whole import ClipError, require_whole

if TYPE_CHECKING:
    from PIL import Image


# Of an image.
MAX_FRAME_PIXELS = 34_000_000
# Of a frame of a video, whose decoder may keep sixteen others; 4K has 9 million.
MAX_VIDEO_PIXELS = 17_000_000
# Of all frames of a file together: that many and more by its size, which no encoder comes near.
_MAX_PIXELS, _MAX_PIXELS_PER_BYTE = 2_000_000_000, 10_000
# A frame of PyAV and its side data refer to each other: it stays in memory until Python looks for such circles.
_PIXELS_BEFORE_COLLECTION, _LEAST_ROW = 32_000_000, 128
# What is opened is a file of these formats: no playlist and no list of files, which may name others or the network.
_OPTIONS = {
    "protocol_whitelist": "none",
    "format_whitelist": "mov,matroska,avi,gif,ogg,mpeg,mpegvideo",
    # Larger ones are left without a size, before memory is taken for them.
    "max_pixels": str(MAX_VIDEO_PIXELS),
}
# What is behind a transparent part is not known, and its own color is not meant to be seen.
_TRANSPARENT = "{path} is transparent in parts; lay it over a color, or remove it"
OPAQUE = 255
# Transfer functions of HDR: SMPTE 2084 (PQ) and ARIB STD-B67 (HLG).
_HDR = (16, 18)
# Pillow's formats of frames, whatever their suffix says, and its modes of 8 bits per channel whose colors are read.
_FORMATS = ("BMP", "JPEG", "PNG", "WEBP")
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "YCbCr")
# From the display matrix, of which a row says where an axis goes, to Pillow's transposition.
_TRANSPOSITIONS = {
    (1, 0, 0, 1): None,
    (-1, 0, 0, 1): "FLIP_LEFT_RIGHT",
    (1, 0, 0, -1): "FLIP_TOP_BOTTOM",
    (-1, 0, 0, -1): "ROTATE_180",
    (0, 1, -1, 0): "ROTATE_270",
    (0, -1, 1, 0): "ROTATE_90",
    (0, 1, 1, 0): "TRANSPOSE",
    (0, -1, -1, 0): "TRANSVERSE",
}


@contextlib.contextmanager
def open_container(path: Path) -> Iterator[Any]:
    """A video file as a container of PyAV, which reads this file and nothing else.

    It is given an open file: a name such as ``http:a.mp4`` would be taken for an address.

    :param path: the file
    :raises av.FFmpegError: if it is none of the formats that are read
    """
    # Titles and the like may be in any encoding.
    av = importlib.import_module("av")
    with path.open("rb") as file, av.open(file, options=dict(_OPTIONS), metadata_errors="ignore") as container:
        yield container


def decode_video(path: Path) -> Iterator[tuple["Image.Image", float]]:
    """The frames of a video file as its header says that they are shown, each with the aspect of its pixels.

    :param path: the file
    :return: the frames, turned and mirrored, and the width of a pixel over its height
    :raises ClipError: if it cannot be decoded or has fewer frames than its header promises (so does a complete Matroska
        file whose frame rate varies)
    :raises ImportError: if the decoder is not installed
    """
    av = importlib.import_module("av")
    count, end, length, n_pixels = 0, 0.0, None, 0
    most = _MAX_PIXELS + _MAX_PIXELS_PER_BYTE * path.stat().st_size
    try:
        is_whole = require_whole(path)
        with open_container(path) as container:
            stream = _video_stream(container, path)
            promised, share = _promise(container, path)
            if promised is None and not is_whole:
                raise ClipError(
                    f"{path} does not say how long it is, so that a cut-off copy would look the same; write it anew: "
                    f"ffmpeg -i {path.name} -c copy whole{path.suffix}"
                )
            length = _mp4_length(container, stream)
            aspect = float(stream.sample_aspect_ratio or 1)
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                if frame.is_corrupt:
                    raise ClipError(f"frame {count} of {path} is damaged; replace the file or remove it")
                yield _upright(frame, aspect, path)
                count += 1
                # Rows are padded in memory.
                before, n_pixels = n_pixels, n_pixels + max(frame.width, _LEAST_ROW) * frame.height
                if n_pixels > most:
                    raise ClipError(
                        f"{path} holds more than {most} pixels in so small a file; scale it down or remove it"
                    )
                if n_pixels // _PIXELS_BEFORE_COLLECTION > before // _PIXELS_BEFORE_COLLECTION:
                    gc.collect()
                if length is not None and frame.pts is not None:
                    end = float((frame.pts + frame.duration) * frame.time_base)
    except av.FFmpegError as error:
        raise ClipError(
            f"{path} cannot be decoded after {count} frames ({error}); replace the file or remove it"
        ) from error
    complete = is_whole or (length is not None and end >= share * length)
    if promised is not None and count < share * promised and not complete:
        raise ClipError(
            f"decoded {count} of {promised} frames of {path}: the file is cut off, or its frames are not evenly timed; "
            f"get a complete copy or, if it plays to its end, even it out: ffmpeg -i {path.name} -fps_mode cfr even.mp4"
        )


def _upright(frame: Any, aspect: float, path: Path) -> tuple["Image.Image", float]:
    """A frame as it is shown, and the aspect of its pixels then."""
    side_data = {data.type.name: data for data in frame.side_data}
    if int(frame.color_trc) in _HDR:
        raise ClipError(
            f"{path} is in HDR, whose colors are not read; convert it: ffmpeg -i {path.name} -vf "
            "zscale=t=linear:npl=100,tonemap=hable,zscale=t=bt709:m=bt709:r=tv,format=yuv420p sdr.mp4"
        )
    if "SPHERICAL" in side_data or ("STEREO3D" in side_data and any(bytes(side_data["STEREO3D"])[:4])):
        raise ClipError(f"{path} holds two images or a sphere in each frame; take one view out of it, or remove it")
    # Its own to_image keeps more of them in memory.
    image = importlib.import_module("PIL.Image").fromarray(_opaque(frame, path))
    matrix = side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return image, aspect
    # Fixed-point numbers: x to (a, b), y to (c, d).
    a, b, _, c, d, *_ = struct.unpack("9i", bytes(matrix))
    largest = max(map(abs, (a, b, c, d))) or 1
    rows = tuple(round(value / largest, 2) for value in (a, b, c, d))
    if rows not in _TRANSPOSITIONS:
        raise ClipError(f"{path} is to be shown turned by no right angle, or skewed; turn it before, or remove it")
    name = _TRANSPOSITIONS[rows]
    if name is None:
        return image, aspect
    turned = image.transpose(importlib.import_module("PIL.Image").Transpose[name])
    return turned, aspect if rows[0] else 1 / aspect


def _opaque(frame: Any, path: Path) -> NDArray[np.uint8]:
    """The colors of a frame, which hides nothing."""
    if not (frame.format.has_palette or any(component.is_alpha for component in frame.format.components)):
        return np.asarray(frame.to_ndarray(format="rgb24"))
    pixels = frame.to_ndarray(format="rgba")
    if pixels[..., 3].min() < OPAQUE:
        raise ClipError(_TRANSPARENT.format(path=path))
    return np.ascontiguousarray(pixels[..., :3])


def _video_stream(container: Any, path: Path) -> Any:
    """The video, which is no cover image."""
    cover = importlib.import_module("av.stream").Disposition.attached_pic
    streams = [stream for stream in container.streams.video if not stream.disposition & cover]
    if not streams:
        raise ClipError(f"{path} holds no video{' but a cover' * bool(container.streams.video)}; remove it")
    if len(streams) > 1:
        raise ClipError(
            f"{path} holds {len(streams)} videos, and which is meant is not known; take one: "
            f"ffmpeg -i {path.name} -map 0:v:0 -c copy one{path.suffix}"
        )
    if streams[0].metadata.get("alpha_mode") == "1":
        raise ClipError(_TRANSPARENT.format(path=path))
    # A stream that no decoder is known for has no size at all.
    if not (getattr(streams[0], "width", 0) and getattr(streams[0], "height", 0)):
        raise ClipError(
            f"{path} has frames of over {MAX_VIDEO_PIXELS} pixels, or of a kind that is not known; scale it down: "
            f"ffmpeg -i {path.name} -vf scale=640:-2 small.mp4"
        )
    return streams[0]


def _promise(container: Any, path: Path) -> tuple[int | None, float]:
    """How many frames the header promises, and the share of them that must come."""
    stream = _video_stream(container, path)
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


def _mp4_length(container: Any, stream: Any) -> float | None:
    """When an MP4 or MOV file's last frame ends, in seconds.

    None for other formats: what is left of an AVI file gives its remaining length, and Matroska steps over damage, so
    that a lost piece looks like a still image.
    """
    if "mp4" not in container.format.name or stream.duration is None:
        return None
    return float(((stream.start_time or 0) + stream.duration) * stream.time_base)


def decode_clip(source: Source) -> Iterator[NDArray[np.uint8]]:
    """The frames of a clip, each uint8 (3, 64, 64).

    :param source: a video file or a folder of frames
    :raises ClipError: if it cannot be decoded or lacks frames
    :raises ImportError: if the decoder is not installed
    """
    if not source.is_video:
        return map(shrink, _decode_images(source))
    if source.path.suffix.lower() == ".webp":
        return map(shrink, _decode_webp(source.path))
    return itertools.starmap(shrink, decode_video(source.path))


def expected_frames(source: Source) -> int:
    """Number of frames as far as it is known before decoding, else 0.

    :param source: a video file or a folder of frames
    """
    if not source.is_video:
        return len(source.files)
    if source.path.suffix.lower() == ".webp":
        return 0
    av = importlib.import_module("av")
    try:
        with open_container(source.path) as container:
            return _promise(container, source.path)[0] or 0
    except (ClipError, av.FFmpegError):
        return 0  # decoding will report what is wrong


def _decode_images(source: Source) -> Iterator["Image.Image"]:
    image_module = importlib.import_module("PIL.Image")
    ops = importlib.import_module("PIL.ImageOps")
    _check_numbers(source)
    size = None
    for file in source.files:
        with _decoding(file, source.path), image_module.open(file, formats=_FORMATS) as image:
            _require_size(image, file)
            if too_many_passes(file.read_bytes(), *image.size):
                raise ClipError(f"{file} has more scans than programs write; save it again, or remove {source.path}")
            if image.mode.startswith(("I", "F")):
                raise ClipError(
                    f"{file} has more than 8 bits per value ({image.mode}); convert {source.path} to 8 bits"
                )
            if image.mode not in _MODES:
                raise ClipError(
                    f"{file} has colors of the kind {image.mode}, which are not read; convert {source.path} to RGB"
                )
            if getattr(image, "n_frames", 1) > 1:
                raise ClipError(f"{file} holds several frames; make it a video, or remove {source.path}")
            shown = _flat(ops.exif_transpose(image), file)
        if size not in (None, shown.size):
            raise ClipError(
                f"{file} has {shown.width} x {shown.height} pixels, and frames before it have others; are these "
                f"photographs? Give {source.path} frames of one size, or remove it"
            )
        size = shown.size
        yield shown


def _decode_webp(path: Path) -> Iterator["Image.Image"]:
    """The images of an animated WebP."""
    image_module = importlib.import_module("PIL.Image")
    require_whole(path)
    with _decoding(path, path), image_module.open(path, formats=("WEBP",)) as image:
        _require_size(image, path)
        for index in range(image.n_frames):
            image.seek(index)
            yield _flat(image, path)


@contextlib.contextmanager
def _decoding(file: Path, clip: Path) -> Iterator[None]:
    """Whatever Pillow raises, which depends on where the damage is, as one sentence."""
    try:
        yield
    except ClipError:
        raise
    except Exception as error:
        raise ClipError(f"{file} cannot be decoded ({error}); replace the file or remove {clip}") from error


def _flat(image: "Image.Image", path: Path) -> "Image.Image":
    """An image in RGB, which hides nothing."""
    if "A" in image.getbands() or "transparency" in image.info:
        clearest: Any = image.convert("RGBA").getchannel("A").getextrema()[0]
        if clearest < OPAQUE:
            raise ClipError(_TRANSPARENT.format(path=path))
    return image.convert("RGB")


def _require_size(image: "Image.Image", file: Path) -> None:
    if image.width * image.height > MAX_FRAME_PIXELS:
        raise ClipError(
            f"{file} has {image.width} x {image.height} pixels, more than {MAX_FRAME_PIXELS}; scale it down"
        )


def _check_numbers(source: Source) -> None:
    """Frames numbered 0, 5, 10 are complete, frames 0, 1, 3 are not."""
    matches = [NUMBERED.fullmatch(file.stem) for file in source.files]
    if len(matches) < 3 or len({match and (match[1], match[3]) for match in matches}) > 1 or matches[0] is None:
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


def shrink(image: "Image.Image", aspect: float = 1.0) -> NDArray[np.uint8]:
    """The central square of a frame, averaged to uint8 (3, 64, 64).

    :param image: of any size and mode
    :param aspect: width of a pixel over its height
    """
    box = importlib.import_module("PIL.Image").Resampling.BOX
    # Of the square as it is shown, in units of the height of a pixel.
    side = min(image.width * aspect, image.height)
    left, top = (image.width - side / aspect) / 2, (image.height - side) / 2
    if aspect == 1:
        left, top = int(left), int(top)  # whole pixels
    region = (left, top, left + side / aspect, top + side)
    small = image.convert("RGB").resize((SIZE, SIZE), box, box=region)
    return np.ascontiguousarray(np.asarray(small).transpose(2, 0, 1))
