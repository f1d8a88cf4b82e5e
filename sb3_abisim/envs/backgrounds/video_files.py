"""Finding custom videos in a folder, and dividing them into a train and an eval side.

A folder may hold video files and folders of frames at any depth, or be a DAVIS root, which defines a split.
"""

import os
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_abisim.envs.backgrounds.clips import SPLITS, split_groups

VIDEO_SUFFIXES = (".avi", ".gif", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ogv", ".webm")
IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".webp")
# yt-dlp writes "title [id].mp4", Kinetics "id_000010_000020.mp4".
_YOUTUBE_ID = re.compile(r"\[([\w-]{11})\]|^([\w-]{11})_\d{6}_\d{6}$")
# A split that the folder defines, in any case of letters.
TRAIN_FOLDERS = ("train", "training")
EVAL_FOLDERS = ("eval", "evaluation", "val", "valid", "validation", "test", "testing")
# Of each video beside them; more images are frames.
MAX_THUMBNAILS = 4
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


def find_sources(root: Path) -> tuple[Source, ...]:
    """All clips in a folder, sorted by name.

    ``root/train`` and ``root/eval`` (:data:`TRAIN_FOLDERS` and :data:`EVAL_FOLDERS`), where both exist, are taken as
    the split. Links to folders are followed. Hidden files are left out, and so are images beside video files (their
    thumbnails).

    :param root: the folder
    :raises ValueError: for a folder that is missing, not a folder, without videos, or with frames beside video files
    """
    if not root.exists():
        raise ValueError(f"the folder of videos {root} does not exist (from {Path.cwd()}); correct the path")
    if not root.is_dir():
        raise ValueError(f"{root} is a file; give the folder with your videos, at least two, one for each of {SPLITS}")
    if (root / "JPEGImages" / "480p").is_dir():
        return _find_davis(root)
    sides = {
        side: [folder for folder in sorted(root.iterdir()) if folder.name.lower() in names and folder.is_dir()]
        for side, names in (("train", TRAIN_FOLDERS), ("eval", EVAL_FOLDERS))
    }
    if sides["train"] and sides["eval"]:
        sources = [source for side, folders in sides.items() for folder in folders for source in _find(folder, side)]
    else:
        sources = _find(root, None)
    if not sources:
        suffixes = Counter(file.suffix.lower() or "no suffix" for file in root.rglob("*") if file.is_file())
        found = ", ".join(f"{n} x {suffix}" for suffix, n in suffixes.most_common(5)) or "an empty folder"
        raise ValueError(
            f"no videos in {root}, found {found}; put video files ({' '.join(VIDEO_SUFFIXES)}) "
            f"or folders of frames ({' '.join(IMAGE_SUFFIXES)}) there"
        )
    return tuple(sorted(sources, key=lambda source: natural_key(source.name)))


def _find(root: Path, split: str | None) -> list[Source]:
    prefix = f"{root.name}/" if split else ""
    sources = []
    seen = {root.resolve()}
    for folder, subfolders, names in os.walk(root, followlinks=True):
        subfolders[:] = [name for name in sorted(subfolders) if not name.startswith(".")]
        # Links may lead back.
        places = {name: (Path(folder) / name).resolve() for name in subfolders}
        subfolders[:] = [name for name, place in places.items() if place not in seen]
        seen |= set(places.values())
        visible = sorted((name for name in names if not name.startswith(".")), key=natural_key)
        here = Path(folder)
        videos = [here / name for name in visible if name.lower().endswith(VIDEO_SUFFIXES)]
        images = [here / name for name in visible if name.lower().endswith(IMAGE_SUFFIXES)]
        clips = [(video, [video]) for video in videos]
        if videos and len(images) > MAX_THUMBNAILS * len(videos):
            raise ValueError(
                f"{here} holds {len(images)} images beside {videos[0].name}: frames or thumbnails? "
                "Move the images or the video to another folder"
            )
        if images and not videos:
            clips.append((here, images))
        for path, files in clips:
            relative = path.relative_to(root)
            parts = relative.parts or (root.name,)
            youtube = _YOUTUBE_ID.search(relative.stem)
            group = (youtube[1] or youtube[2]) if youtube else prefix + parts[0]
            sources.append(_source(prefix + "/".join(parts), group, path, tuple(files), split))
    return sources


def _source(name: str, group: str, path: Path, files: tuple[Path, ...], split: str | None) -> Source:
    stats = [file.stat() for file in files]
    return Source(name, group, path, files, tuple((stat.st_size, stat.st_mtime_ns) for stat in stats), split)


def _find_davis(root: Path) -> tuple[Source, ...]:
    frames, sources = root / "JPEGImages" / "480p", []
    for split, list_name in _DAVIS_LISTS.items():
        path = root / "ImageSets" / "2017" / list_name
        if not path.is_file():
            raise ValueError(
                f"{root} looks like DAVIS but has no {path}; restore it, or give {frames} for a split by hash"
            )
        for name in path.read_text(encoding="utf-8").split():
            files = sorted((frames / name).glob("*.jpg"), key=lambda file: natural_key(file.name))
            if not files:
                raise ValueError(f"{path} lists {name!r} but {frames / name} has no *.jpg; unpack it or edit the list")
            sources.append(_source(name, name, frames / name, tuple(files), split))
    return tuple(sources)


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
