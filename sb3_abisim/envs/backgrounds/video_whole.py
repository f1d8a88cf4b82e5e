"""Whether a video file is whole, by the structure of its container.

Decoders stop in silence where a file is cut off. Containers whose header promises a length are compared with that in
:mod:`~sb3_abisim.envs.backgrounds.video_frames`. Those here promise none, but say where they end.
"""

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

_CUT = "{path} is cut off or damaged ({why}); get a complete copy, or remove it"
_MPEG_END = (b"\x00\x00\x01\xb7", b"\x00\x00\x01\xb9")
# A program stream may be padded behind its last image.
_MPEG_TAIL = 2**16


class ClipError(ValueError):
    """One clip cannot be used; ``on_error="skip"`` leaves it out."""


def require_whole(path: Path) -> bool:
    """Refuse a file whose container is not whole.

    :param path: of a regular file
    :return: whether that is known now; False for a container whose header promises a length
    :raises ClipError: for one that is cut off or damaged
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(16)
        file.seek(0)
        for is_one, check in _CHECKS:
            if is_one(head):
                try:
                    return check(file, size)
                except (_Damage, struct.error, IndexError) as error:
                    raise ClipError(_CUT.format(path=path, why=str(error) or "it ends too early")) from None
    return False


class _Damage(Exception):
    pass


def _take(file: BinaryIO, n: int) -> bytes:
    data = file.read(n)
    if len(data) < n:
        raise _Damage("it ends too early")
    return data


def _check_gif(file: BinaryIO, size: int) -> bool:
    """Blocks up to the trailer."""
    flags = _take(file, 13)[10]
    if flags & 0x80:
        _take(file, 3 * 2 ** ((flags & 7) + 1))
    while (kind := _take(file, 1)) != b";":
        if kind == b"!":
            _take(file, 1)
        elif kind == b",":
            flags = _take(file, 9)[8]
            _take(file, (3 * 2 ** ((flags & 7) + 1) if flags & 0x80 else 0) + 1)
        else:
            raise _Damage(f"no block of a GIF at byte {file.tell() - 1}")
        while n := _take(file, 1)[0]:
            _take(file, n)
    return True


def _check_ogg(file: BinaryIO, size: int) -> bool:
    """Pages in their numbers, up to the last of every stream."""
    pages: dict[bytes, int] = {}
    ended = set()
    while file.tell() < size:
        head = _take(file, 27)
        serial, (number,) = head[14:18], struct.unpack("<I", head[18:22])
        if not head.startswith(b"OggS") or number != pages.get(serial, -1) + 1:
            raise _Damage(f"a page is missing before byte {file.tell() - 27}")
        pages[serial] = number
        if head[5] & 4:
            ended.add(serial)
        _take(file, sum(_take(file, head[26])))
    if set(pages) != ended:
        raise _Damage("the last page is missing")
    return True


def _check_riff(file: BinaryIO, size: int) -> bool:
    """WebP and AVI say how long they are; an AVI may go on behind that, and says how many frames there are."""
    head = _take(file, 12)
    (length,) = struct.unpack("<I", head[4:8])
    if size < length + 8:
        raise _Damage(f"{size} of {length + 8} bytes")
    return head[8:] == b"WEBP"


def _check_matroska(file: BinaryIO, size: int) -> bool:
    """The header, then one segment that says how long it is, unless it was written as a live stream."""
    for name in (b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"):
        if _take(file, 4) != name:
            raise _Damage("its segment is missing")
        first = _take(file, 1)[0]
        n = 9 - first.bit_length()
        value = int.from_bytes(bytes([first & (0xFF >> n)]) + _take(file, n - 1), "big")
        if value != 2 ** (7 * n) - 1 and file.tell() + value > size:
            raise _Damage(f"{size} of {file.tell() + value} bytes")
        if name.startswith(b"\x1a"):
            file.seek(value, os.SEEK_CUR)
    return False


def _check_mp4(file: BinaryIO, size: int) -> bool:
    """Boxes up to the end of the file; fragments end in a list of them."""
    kinds = []
    while (begin := file.tell()) < size:
        length, kind = struct.unpack(">I4s", _take(file, 8))
        if length == 1:
            (length,) = struct.unpack(">Q", _take(file, 8))
        length = size - begin if length == 0 else length
        if b"moov" in kinds and b"moof" not in kinds and kind != b"moof" and begin + length > size:
            return False  # the number of frames says how many are lost
        if length < 8 or begin + length > size:
            raise _Damage(f"the box at byte {begin} goes beyond the end")
        kinds.append(kind)
        file.seek(begin + length)
    if b"moov" not in kinds:
        raise _Damage("it has no index")
    if b"moof" not in kinds:
        return False
    if b"mfra" not in kinds[-2:]:
        raise _Damage(
            "its fragments are not listed at the end: ffmpeg -i IN -c copy OUT.mp4 makes a file that is known whole"
        )
    return True


def _check_mpeg(file: BinaryIO, size: int) -> bool:
    file.seek(max(0, size - _MPEG_TAIL))
    tail = file.read().rstrip(b"\x00\xff")
    if not any(end in tail for end in _MPEG_END):
        raise _Damage("it has no end code, so that nothing says whether it is whole: ffmpeg -i IN OUT.mp4")
    return True


_CHECKS: tuple[tuple[Callable[[bytes], bool], Callable[[BinaryIO, int], bool]], ...] = (
    (lambda head: head.startswith(b"GIF8"), _check_gif),
    (lambda head: head.startswith(b"OggS"), _check_ogg),
    (lambda head: head[:4] == b"RIFF" and head[8:12] in (b"WEBP", b"AVI "), _check_riff),
    (lambda head: head.startswith(b"\x1a\x45\xdf\xa3"), _check_matroska),
    (lambda head: head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"), _check_mp4),
    (lambda head: head[:4] in (b"\x00\x00\x01\xba", b"\x00\x00\x01\xb3"), _check_mpeg),
)


def is_animated_webp(path: os.PathLike[str]) -> bool:
    """Whether a file is a WebP of several frames.

    :param path: of a regular file
    """
    with open(path, "rb") as file:
        head = file.read(21)
    return head[:4] == b"RIFF" and head[8:16] == b"WEBPVP8X" and len(head) == 21 and bool(head[20] & 2)
