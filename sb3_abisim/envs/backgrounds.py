"""Moving backgrounds: clips of 64x64 frames, how an environment plays them, and the clips that are built in.

The built-in clips are called ``photo_pan``: a camera that pans and zooms over seventeen photographs, and two shots of
a city. They need NumPy alone and integer arithmetic only, so that they have the same bytes on every machine; each clip
is compared with the sha256 of its manifest when it is first shown. A user's own videos are read by
:mod:`sb3_abisim.envs.video`.
"""

import hashlib
import json
import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.looks import Looks

SIZE = 64
FRAME_SHAPE = (3, SIZE, SIZE)
SPLITS = ("train", "eval")
ORDERS = ("video", "shuffled")
MEDIA_FOLDER = Path(__file__).resolve().parent.parent / "media"

# Camera paths are computed in this fraction of a photograph's pixel.
_UNITS = 1024
# Frames between two control points of a camera path.
_SEGMENT = 32
# A clip of a user's own keeps its file open, of which a process may have 256 on macOS.
MAX_OPEN_CLIPS = 200
# Random numbers used per episode, whatever the clips are.
N_DRAWS = 3


@dataclass(frozen=True)
class Clip:
    """A sequence of background frames, loaded when first shown.

    :param name: unique among the clips of a source
    :param group: clips of one film or photograph share their group, and a group lies on one side of the split
    :param length: number of frames, at least 2
    :param digest: sha256 of the frames' bytes, in hexadecimal
    :param load: returns the frames, uint8 (length, 3, 64, 64), RGB
    """

    name: str
    group: str
    length: int
    digest: str
    load: Callable[[], NDArray[np.uint8]]

    @property
    def clip_id(self) -> int:
        """A number that names the content, whatever split or selection the clip is found in; 0 <= id < 2**60."""
        return int(self.digest[:15], 16)


class Backgrounds:
    """Clips of one side of the split, with frames fetched by (clip, frame).

    :param source: where the clips come from, for reports: "photo_pan" or a path
    :param split: "train" or "eval"
    :param clips: at least one
    """

    def __init__(self, source: str, split: str, clips: Sequence[Clip]) -> None:
        assert clips, "a side of the split has at least one clip"
        self.source = source
        self.split = split
        self.clips = tuple(clips)
        self.names = tuple(clip.name for clip in clips)
        self.lengths = np.array([clip.length for clip in clips], dtype=np.int64)
        self.clip_ids = np.array([clip.clip_id for clip in clips], dtype=np.int64)
        # Of clips that were shown, the last ones at the end.
        self._arrays: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._selected: dict[tuple[str, ...], Backgrounds] = {}

    @property
    def n_clips(self) -> int:
        """Number of clips."""
        return len(self.clips)

    @property
    def fingerprint(self) -> str:
        """sha256 over the clips in their order and the frame's shape; it changes when one pixel of a clip does."""
        content = [list(FRAME_SHAPE), [[clip.name, clip.length, clip.digest] for clip in self.clips]]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def select(self, names: Iterable[str]) -> "Backgrounds":
        """The clips with these names, in the order given.

        :param names: of clips, distinct, at least one
        :raises ValueError: for a name that is not among this split's clips, a repeated name, or none at all
        """
        chosen = list(names)
        unknown = sorted(set(chosen) - set(self.names))
        if unknown or not chosen or len(set(chosen)) < len(chosen):
            problem = f"unknown: {unknown}" if unknown else f"got {chosen}"
            raise ValueError(
                f"clips must be distinct names of the {self.split} clips of {self.source}, {problem}; "
                f"there are {', '.join(self.names)}"
            )
        # One for all environments, as its clips take memory once.
        if tuple(chosen) not in self._selected:
            clips = [self.clips[self.names.index(name)] for name in chosen]
            self._selected[tuple(chosen)] = Backgrounds(self.source, self.split, clips)
        return self._selected[tuple(chosen)]

    def fold(self, clip: NDArray[np.int64], frame: NDArray[np.int64]) -> NDArray[np.int64]:
        """Frame indices within the clips: a clip plays forwards, then backwards, and so on, without repeating its ends.

        :param clip: indices of clips, shape (m,)
        :param frame: shape (m,), at least 0
        :return: shape (m,), each below the clip's length
        """
        last = self.lengths[clip] - 1
        phase = frame % (2 * last)
        return np.where(phase <= last, phase, 2 * last - phase)

    def frames(self, clip: NDArray[np.int64], frame: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Background pictures in a new array.

        :param clip: indices of clips, shape (m,)
        :param frame: shape (m,), at least 0; folded at the clips' ends
        :return: uint8 (m, 3, 64, 64)
        """
        pictures = np.empty((len(clip), *FRAME_SHAPE), dtype=np.uint8)
        rows = zip(clip.tolist(), self.fold(clip, frame).tolist(), strict=True)
        for i, (c, f) in enumerate(rows):
            if c not in self._arrays:
                self._arrays[c] = self._load(c)
                if len(self._arrays) > MAX_OPEN_CLIPS:
                    self._arrays.popitem(last=False)
            self._arrays.move_to_end(c)
            pictures[i] = self._arrays[c][f]
        return pictures

    def _load(self, index: int) -> NDArray[np.uint8]:
        clip = self.clips[index]
        array = clip.load()
        assert array.shape == (clip.length, *FRAME_SHAPE) and array.dtype == np.uint8
        return array


class BackgroundPlayer:
    """Plays backgrounds behind ``n_envs`` environments: one clip per episode, a random start, one frame per step.

    All randomness comes from the generators given to :meth:`start`, by the same number of draws for any clips: what an
    environment draws afterwards is the same in every split.

    :param backgrounds: the clips
    :param n_envs: number of environments
    :param order: "video", or "shuffled" for each clip's frames in a random order of the episode's own, which takes
        away the correlation between neighbouring frames
    :param recolour: whether each episode shows its clip in a look of its own (:class:`~sb3_abisim.envs.looks.Looks`)
    :raises ValueError: for an unknown order
    """

    def __init__(self, backgrounds: Backgrounds, n_envs: int, order: str = "video", recolour: bool = False) -> None:
        if order not in ORDERS:
            raise ValueError(f"order must be one of {ORDERS}, got {order!r}")
        self.backgrounds = backgrounds
        self.clip = np.zeros(n_envs, dtype=np.int64)
        self._position = np.zeros(n_envs, dtype=np.int64)
        self._shuffles: list[NDArray[np.int64]] | None = None
        if order == "shuffled":
            self._shuffles = [np.zeros(1, dtype=np.int64)] * n_envs
        self._looks = Looks(n_envs) if recolour else None

    @property
    def fingerprint(self) -> str:
        """That of the clips; another one where they are shown in other looks."""
        plain = self.backgrounds.fingerprint
        return plain if self._looks is None else hashlib.sha256(f"{plain} in looks".encode()).hexdigest()

    def start(self, index: int, generator: np.random.Generator) -> None:
        """Begin a new episode of environment ``index``.

        :param index: of the environment
        :param generator: three numbers are drawn from it
        """
        clip_draw, start_draw, own_draw = generator.random(N_DRAWS).tolist()
        clip = int(clip_draw * self.backgrounds.n_clips)
        length = int(self.backgrounds.lengths[clip])
        self.clip[index] = clip
        self._position[index] = int(start_draw * length)
        own = np.random.default_rng(int(own_draw * 2**53))
        if self._shuffles is not None:
            self._shuffles[index] = own.permutation(length)
        if self._looks is not None:
            self._looks.draw(index, own)

    def advance(self) -> None:
        """Go on by one frame in every environment."""
        self._position += 1

    @property
    def frame(self) -> NDArray[np.int64]:
        """Index of the frame now shown, within its clip, shape (n_envs,)."""
        frame = self.backgrounds.fold(self.clip, self._position)
        if self._shuffles is not None:
            rows = zip(self._shuffles, frame.tolist(), strict=True)
            frame = np.array([shuffle[position] for shuffle, position in rows], dtype=np.int64)
        return frame

    def pictures(self, indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        """What is now shown behind the environments ``indices``: a new array, uint8 (len(indices), 3, 64, 64).

        :param indices: of environments, shape (m,)
        """
        # Positions that are not shuffled need no folding here, `frames` does it.
        frame = self._position if self._shuffles is None else self.frame
        pictures = self.backgrounds.frames(self.clip[indices], frame[indices])
        return pictures if self._looks is None else self._looks.apply(pictures, indices)


def composite(
    pictures: NDArray[np.uint8], masks: NDArray[np.bool_], backgrounds: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Lay pictures over backgrounds; foreground pixels keep their bytes.

    :param pictures: uint8 (m, 3, 64, 64)
    :param masks: (m, 64, 64), true where a picture's pixel belongs to the foreground
    :param backgrounds: uint8 (m, 3, 64, 64), overwritten
    :return: ``backgrounds``
    """
    # Bytes of 0 at the foreground and 255 elsewhere, so that bitwise operations choose, faster than a masked copy.
    behind = (masks.view(np.uint8) - np.uint8(1))[:, None]
    np.bitwise_xor(backgrounds, pictures, out=backgrounds)
    np.bitwise_and(backgrounds, behind, out=backgrounds)
    np.bitwise_xor(backgrounds, pictures, out=backgrounds)
    return backgrounds


def load_backgrounds(
    source: str | os.PathLike[str] | None = None,
    split: str = "train",
    *,
    seed: int = 0,
    eval_fraction: float = 0.25,
    min_frames: int = 16,
    max_bytes: int = 2 * 1024**3,
    on_error: str = "raise",
) -> Backgrounds:
    """The clips of one side of the split; loaded once per process and shared.

    The keyword arguments apply to a user's own videos; the built-in clips have a fixed split.

    :param source: folder of videos, of folders of frames, or a DAVIS root; None for the built-in ``photo_pan``
    :param split: "train" or "eval"
    :param seed: of the split, where the folder does not bring its own
    :param eval_fraction: share of the groups that go to "eval", 0..1, at least one group on each side
    :param min_frames: shortest clip accepted, at least 2
    :param max_bytes: most memory the decoded frames of this side may take, 12,288 bytes a frame
    :param on_error: "raise", or "skip" to leave clips out that cannot be used, with a warning that lists them
    :raises ValueError: for what is wrong with the folder or a file in it, and for unknown settings
    :raises ImportError: if a decoder is needed and not installed
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {SPLITS}, got {split!r}")
    if source is None:
        return _photo_pan(split)
    if not 0 < eval_fraction < 1:
        raise ValueError(f"eval_fraction must lie between 0 and 1, got {eval_fraction}")
    if min_frames < 2:
        raise ValueError(f"min_frames must be at least 2, got {min_frames}")
    if on_error not in ("raise", "skip"):
        raise ValueError(f"on_error must be 'raise' or 'skip', got {on_error!r}")
    from sb3_abisim.envs import video, video_files

    sources = video_files.find_sources(Path(source))
    chosen = video_files.split_sources(sources, seed, eval_fraction)
    return video.load_split(str(source), split, chosen["train"], chosen["eval"], min_frames, max_bytes, on_error)


def split_groups(groups: Iterable[str], seed: int, eval_fraction: float) -> tuple[set[str], set[str]]:
    """Divide groups by their rank under a hash of seed and name, so that the machine and the order do not matter.

    :param groups: at least two different names
    :param seed: another seed gives another split
    :param eval_fraction: share of the groups for evaluation, rounded, at least one group on each side
    :return: (train groups, eval groups)
    """
    ranked = sorted(set(groups), key=lambda group: hashlib.sha256(f"{seed}:{group}".encode()).digest())
    n_eval = min(max(1, round(eval_fraction * len(ranked))), len(ranked) - 1)
    return set(ranked[n_eval:]), set(ranked[:n_eval])


def digest_of(frames: NDArray[np.uint8]) -> str:
    """sha256 of an array's bytes, in hexadecimal.

    :param frames: of any shape and dtype
    """
    return hashlib.sha256(np.ascontiguousarray(frames).data).hexdigest()


# The built-in clips.


@cache
def _photo_pan(split: str) -> Backgrounds:
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
    with np.load(pack, allow_pickle=False) as arrays:
        differences = arrays[entry["name"]]
    # Photographs are stored as differences along a row, shots as differences in time: the file is a third smaller.
    axis = 0 if entry["kind"] == "shot" else 2
    pixels = np.cumsum(differences, axis=axis, dtype=np.uint8)
    frames = pixels if entry["kind"] == "shot" else render_pan(pixels, entry["path"], entry["length"])
    if digest_of(frames) != entry["sha256"]:
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
