"""Finding custom videos in a folder, and dividing them into a train and an eval side.

A folder may hold video files and folders of frames at any depth, or be a DAVIS root, which defines a split.
"""

import os
import re
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_abisim.common.files import find
from sb3_abisim.envs.backgrounds.clips import SPLITS, split_groups
from sb3_abisim.envs.backgrounds.video_roles import (
    CONTAINER_FOLDERS,
    IMAGE_SUFFIXES,
    SIDECAR_SUFFIXES,
    VIDEO_SUFFIXES,
    is_other_role,
    require_images,
    require_one_series,
)
from sb3_abisim.envs.backgrounds.video_whole import is_animated_webp

# yt-dlp writes "title [id].mp4", Kinetics "id_000010_000020.mp4".
_YOUTUBE_ID = re.compile(r"\[([\w-]{11})\]|^([\w-]{11})_\d{6}_\d{6}$")
# A split that the folder defines, in any case of letters.
TRAIN_FOLDERS = ("train", "training")
EVAL_FOLDERS = ("eval", "evaluation", "val", "valid", "validation", "test", "testing")
# Of each video beside them; more images are frames.
MAX_THUMBNAILS = 4
# Where the images of DAVIS lie, the smaller ones first.
_DAVIS_SIZES = ("480p", "Full-Resolution")
# Names in a warning.
_MAX_NAMED = 12
_DAVIS_LISTS = {"train": "train.txt", "eval": "val.txt"}


@dataclass(frozen=True)
class Source:
    """A clip as found on disk.

    :param name: path relative to the folder searched
    :param group: what must stay on one side of the split: a YouTube id in the file's name, else the uppermost folder
        within the folder searched, else the file
    :param path: the video file or the folder of frames
    :param files: the video, or the frames in natural order
    :param stamps: size and time of change of each file
    :param split: "train" or "eval" where the folder defines it, else None
    """

    name: str
    group: str
    path: Path
    files: tuple[Path, ...]
    stamps: tuple[tuple[int, int], ...]
    split: str | None = None

    @property
    def is_video(self) -> bool:
        """Whether this is a video file, not a folder of frames."""
        return self.files == (self.path,)


def natural_key(name: str) -> list[Any]:
    """Sorts frame2 before frame10, in any case of letters.

    :param name: a file name or path
    """
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(re.split("([0-9]+)", name))]


@dataclass
class Found:
    """What is in a folder of videos.

    :param sources: the clips
    :param left_out: paths that are no clips, with the reason
    """

    sources: list[Source] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)

    def leave_out(self, path: Path, root: Path, why: str) -> None:
        """Note a path that is no clip, by its name within ``root``."""
        self.left_out[path.relative_to(root).as_posix()] = why


def find_sources(root: Path) -> tuple[Source, ...]:
    """All clips in a folder, sorted by name.

    ``root/train`` and ``root/eval`` (:data:`TRAIN_FOLDERS` and :data:`EVAL_FOLDERS`), where both exist, are taken as
    the split. Links to folders are followed. Hidden files are left out, and so are images beside video files (their
    thumbnails). Masks and depth (:data:`OTHER_ROLES`), kinds of files that are not read, and what is no file are left
    out with a warning that names them.

    :param root: the folder
    :raises ValueError: for a folder that is missing, not a folder, without videos, with frames beside video files, or
        with images that may be masks
    """
    found = explore(root)
    if not found.sources:
        lines = "; ".join(f"{name}: {why}" for name, why in list(found.left_out.items())[:5])
        raise ValueError(
            f"no videos in {root}, found {_count_suffixes(root)}{f' ({lines})' if lines else ''}; put video files "
            f"({' '.join(VIDEO_SUFFIXES)}) or folders of frames ({' '.join(IMAGE_SUFFIXES)}) there"
        )
    if found.left_out:
        lines = "; ".join(f"{name} ({why})" for name, why in list(found.left_out.items())[:_MAX_NAMED])
        more = f" and {len(found.left_out) - _MAX_NAMED} more" * (len(found.left_out) > _MAX_NAMED)
        warnings.warn(f"left out of {len(found.sources)} clips in {root}: {lines}{more}", stacklevel=3)
    return tuple(sorted(found.sources, key=lambda source: natural_key(source.name)))


def explore(root: Path) -> Found:
    """The clips in a folder, and what was left out.

    :param root: the folder
    :raises ValueError: see :func:`find_sources`
    """
    if not root.exists():
        raise ValueError(f"the folder of videos {root} does not exist (from {Path.cwd()}); correct the path")
    if not root.is_dir():
        raise ValueError(f"{root} is a file; give the folder with your videos, at least two, one for each of {SPLITS}")
    davis = [folder for name in _DAVIS_SIZES if (folder := root / "JPEGImages" / name).is_dir()]
    if davis and (len(davis) > 1 or (root / "ImageSets").is_dir() or davis[0].name == _DAVIS_SIZES[0]):
        return _find_davis(root, davis[0])
    found = Found()
    children = sorted(root.iterdir())
    sides = {
        side: [folder for folder in children if folder.name.lower() in names and folder.is_dir()]
        for side, names in (("train", TRAIN_FOLDERS), ("eval", EVAL_FOLDERS))
    }
    if sides["train"] and sides["eval"]:
        for side, folders in sides.items():
            for folder in folders:
                _find(folder, side, root, found)
        for child in children:
            is_clip = not child.name.startswith(".") and (child.is_dir() or _is_medium(child.name))
            if is_clip and child not in sides["train"] + sides["eval"]:
                found.leave_out(child, root, "beside the folders of the two sides")
    else:
        _find(root, None, root, found)
    require_images(found.sources)
    return found


def _is_medium(name: str) -> bool:
    return not name.lower().endswith(SIDECAR_SUFFIXES) and "." in name


def _refuse(error: OSError) -> None:
    """Of a folder that may not be read: without it, the split would be another."""
    raise error


def _count_suffixes(root: Path) -> str:
    suffixes: Counter[str] = Counter()
    for _, _, names in os.walk(root, onerror=_refuse):
        suffixes.update(Path(name).suffix.lower() or "no suffix" for name in names)
    return ", ".join(f"{n} x {suffix}" for suffix, n in suffixes.most_common(5)) or "an empty folder"


def _find(root: Path, split: str | None, top: Path, found: Found) -> None:
    prefix = f"{root.name}/" if split else ""
    seen = {root.resolve()}
    for folder, subfolders, names in os.walk(root, onerror=_refuse, followlinks=True):
        here = Path(folder)
        subfolders[:] = [name for name in sorted(subfolders) if not name.startswith(".")]
        for name in subfolders:
            if is_other_role(name, subfolders):
                found.leave_out(here / name, top, "masks, depth or the like by its name")
        subfolders[:] = [name for name in subfolders if not is_other_role(name, subfolders)]
        # Links may lead back.
        places = {name: (here / name).resolve() for name in subfolders}
        subfolders[:] = [name for name, place in places.items() if place not in seen]
        seen |= set(places.values())
        visible = sorted((name for name in names if not name.startswith(".")), key=natural_key)
        for path, files in _clips_in(here, visible, top, found):
            relative = path.relative_to(root)
            parts = relative.parts or (root.name,)
            youtube = _YOUTUBE_ID.search(relative.stem)
            # The first that says which clip it is, not that images lie there.
            own = [part for part in parts if part.lower() not in CONTAINER_FOLDERS] or [parts[-1]]
            group = (youtube[1] or youtube[2]) if youtube else prefix + own[0]
            found.sources.append(_source(prefix + "/".join(parts), group, path, tuple(files), split))


def _clips_in(here: Path, names: list[str], top: Path, found: Found) -> list[tuple[Path, list[Path]]]:
    """The clips that lie in a folder itself: its videos, or all its images as one."""
    videos, images = [], []
    stems = [Path(name).stem for name in names]
    for name in names:
        path, is_animated = here / name, name.lower().endswith(".webp")
        known = name.lower().endswith(VIDEO_SUFFIXES + IMAGE_SUFFIXES)
        # A pipe would be waited for without end.
        if known and not path.is_file():
            found.leave_out(path, top, "no regular file, or a link to nothing")
        elif name.lower().endswith(VIDEO_SUFFIXES) or (is_animated and is_animated_webp(path)):
            if is_other_role(Path(name).stem, stems, alone=False):
                found.leave_out(path, top, "masks, depth or the like by its name")
            else:
                videos.append(path)
        elif known:
            images.append(path)
        elif _is_medium(name):
            found.leave_out(path, top, "of a kind that is not read")
    if videos and len(images) > MAX_THUMBNAILS * len(videos):
        raise ValueError(
            f"{here} holds {len(images)} images beside {videos[0].name}: frames or thumbnails? "
            "Move the images or the video to another folder"
        )
    if images and not videos:
        require_one_series(here, images)
        return [(here, images)]
    return [(video, [video]) for video in videos]


def _source(name: str, group: str, path: Path, files: tuple[Path, ...], split: str | None) -> Source:
    stats = [file.stat() for file in files]
    return Source(name, group, path, files, tuple((stat.st_size, stat.st_mtime_ns) for stat in stats), split)


def _find_davis(root: Path, frames: Path) -> Found:
    found = Found()
    for split, list_name in _DAVIS_LISTS.items():
        path = root / "ImageSets" / "2017" / list_name
        if not path.is_file():
            raise ValueError(
                f"{root} looks like DAVIS but has no {path}; restore it, or give {frames} for a split by hash"
            )
        for name in path.read_text(encoding="utf-8").split():
            files = sorted(find(frames / name, "*.jpg"), key=lambda file: natural_key(file.name))
            if not files:
                raise ValueError(f"{path} lists {name!r} but {frames / name} has no *.jpg; unpack it or edit the list")
            found.sources.append(_source(name, name, frames / name, tuple(files), split))
    return found


def describe_split(origin: str, chosen: dict[str, tuple[Source, ...]]) -> str:
    """Which clips are on which side, a line each.

    :param origin: the folder
    :param chosen: of :func:`split_sources`
    """
    lines = [
        f"  {side:5}  {source.name} ({'video' if source.is_video else f'{len(source.files)} frames'})"
        for side, sources in chosen.items()
        for source in sources
    ]
    return "\n".join([f"clips in {origin}:", *lines])


def split_sources(sources: tuple[Source, ...], seed: int, eval_fraction: float) -> dict[str, tuple[Source, ...]]:
    """The sources of each side: as the folder defines it, else by groups ranked by a hash of ``seed`` and name.

    :param sources: at least one, from :func:`find_sources`
    :param seed: of the split by hash
    :param eval_fraction: share of the groups that go to "eval", 0..1
    :raises ValueError: if a side is empty
    """
    if sources[0].split is not None:
        sides = {side: {s.group for s in sources if s.split == side} for side in SPLITS}
        shared = sides["train"] & sides["eval"]
        if shared:
            raise ValueError(f"{sorted(shared)} are in the lists of both sides; remove them from one")
    else:
        groups = {source.group for source in sources}
        if len(groups) < 2:
            raise ValueError(
                f"the {len(sources)} clips found belong to one group, {groups.pop()!r}, which would leave a side of "
                "the split empty; add another video, or divide them into two folders, train and eval"
            )
        sides = dict(zip(SPLITS, split_groups(groups, seed, eval_fraction), strict=True))
    chosen = {side: tuple(source for source in sources if source.group in sides[side]) for side in SPLITS}
    for side, members in chosen.items():
        if not members:
            raise ValueError(f"the {side} side of the split has no clips; add some to it")
    return chosen
