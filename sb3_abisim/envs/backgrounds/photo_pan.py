"""The built-in clips, ``photo_pan``: a camera that pans and zooms over photographs, and two shots of a city.

They need NumPy alone and integer arithmetic only, so that they have the same bytes on every machine. Each clip is
compared with the hash in the manifest when it is first shown.
"""

import json
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.arrays import read_npz
from sb3_abisim.envs.backgrounds.clips import FRAME_SHAPE, SIZE, Backgrounds, Clip, array_hash

MEDIA_FOLDER = Path(__file__).resolve().parents[2] / "media"
# Camera paths are computed in this fraction of a photograph's pixel.
_UNITS = 1024
# Frames between two control points of a camera path.
_SEGMENT = 32


@cache
def photo_pan(split: str) -> Backgrounds:
    """The clips of one side of the fixed split.

    :param split: "train" or "eval"
    """
    manifest = json.loads((MEDIA_FOLDER / "photo_pan.json").read_text(encoding="utf-8"))
    clips = [
        Clip(entry["name"], entry["group"], entry["length"], entry["sha256"], partial(_load_entry, entry))
        for entry in manifest["clips"]
        if entry["split"] == split
    ]
    return Backgrounds(manifest["name"], split, clips)


def _load_entry(entry: dict[str, Any]) -> NDArray[np.uint8]:
    """The frames of a clip of the manifest, checked against its sha256."""
    pack = MEDIA_FOLDER / "photo_pan.npz"
    differences = read_npz(pack, names=[entry["name"]])[entry["name"]]
    # Photographs are stored as differences along a row, shots as differences in time: the file is a third smaller.
    axis = 0 if entry["kind"] == "shot" else 2
    pixels = np.cumsum(differences, axis=axis, dtype=np.uint8)
    frames = pixels if entry["kind"] == "shot" else render_pan(pixels, entry["path"], entry["length"])
    if array_hash(frames) != entry["sha256"]:
        raise ValueError(f"clip {entry['name']!r} of {pack} is damaged (its sha256 differs); reinstall sb3_abisim")
    return frames


def render_pan(photo: NDArray[np.uint8], path: Sequence[Sequence[int]], length: int) -> NDArray[np.uint8]:
    """What a camera sees that moves over a photograph: square windows along a smooth path, averaged to 64x64.

    :param photo: uint8 (3, height, width)
    :param path: control points (top, left, side) of the window in pixels, each inside the photograph; a uniform
        cubic B-spline never leaves their convex hull
    :param length: number of frames, 32 for each segment between control points; three segments fewer than points
    :return: uint8 (length, 3, 64, 64)
    """
    integral = np.zeros((3, photo.shape[1] + 1, photo.shape[2] + 1), dtype=np.int64)
    integral[:, 1:, 1:] = photo.cumsum(axis=1, dtype=np.int64).cumsum(axis=2)
    frames = np.empty((length, *FRAME_SHAPE), dtype=np.uint8)
    for frame, (top, left, side) in zip(frames, _camera(path, length).tolist(), strict=True):
        step = side // SIZE
        edges = np.arange(SIZE + 1) * step
        rows = np.diff(_interpolate(integral, top + edges, axis=1), axis=1)
        sums = np.diff(_interpolate(rows, left + edges, axis=2), axis=2)
        frame[:] = (sums + step**2 // 2) // step**2
    return frames


def _camera(path: Sequence[Sequence[int]], length: int) -> NDArray[np.int64]:
    """(top, left, side) at each frame, in 1/1024 pixels, shape (length, 3)."""
    points = np.array(path, dtype=np.int64) * _UNITS
    assert length == _SEGMENT * (len(points) - 3)
    segment, t = np.divmod(np.arange(length), _SEGMENT)
    s = _SEGMENT
    basis = ((s - t) ** 3, 3 * t**3 - 6 * s * t**2 + 4 * s**3, -3 * t**3 + 3 * s * t**2 + 3 * s**2 * t + s**3, t**3)
    total = sum(weight[:, None] * points[segment + k] for k, weight in enumerate(basis))
    return np.asarray(total // (6 * s**3))


def _interpolate(integral: NDArray[np.int64], edges: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    """1024 times the linear interpolation of ``integral`` along ``axis`` at ``edges``, which are in 1/1024 pixels."""
    whole, part = np.divmod(edges, _UNITS)
    part = part.reshape(-1, *[1] * (2 - axis))
    after = np.minimum(whole + 1, integral.shape[axis] - 1)
    return np.asarray(integral.take(whole, axis=axis) * (_UNITS - part) + integral.take(after, axis=axis) * part)
