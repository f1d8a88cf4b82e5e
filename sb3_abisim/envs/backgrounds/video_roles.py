"""Which folders and files of a data set are images, and which are masks, depth and the like beside them."""

import re
from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, Protocol

VIDEO_SUFFIXES = (".avi", ".gif", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ogv", ".webm")
IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".webp")
# Beside clips, and no clips by themselves. Other files are named.
SIDECAR_SUFFIXES = (
    ".txt", ".json", ".xml", ".csv", ".tsv", ".srt", ".vtt", ".ass", ".md", ".yml", ".yaml", ".nfo", ".html", ".url",
    ".pdf", ".log", ".sha256", ".md5", ".ini", ".db",
)  # fmt: skip
# Words for what is not a image of a scene, as names of folders and at the ends of names.
OTHER_ROLES = frozenset(
    (
        "annotation",
        "annotations",
        "mask",
        "masks",
        "matte",
        "mattes",
        "alpha",
        "seg",
        "segmentation",
        "segmentations",
        "segmask",
        "segmasks",
        "label",
        "labels",
        "gt",
        "groundtruth",
        "depth",
        "depths",
        "depthmap",
        "depthmaps",
        "disparity",
        "disparities",
        "disp",
        "flow",
        "flows",
        "opticalflow",
        "normal",
        "normals",
        "semantic",
        "semantics",
        "instance",
        "instances",
        "panoptic",
        "scribbles",
        "saliency",
        "albedo",
    )
)
# Folders of which the name says that images lie there, not of which clip.
CONTAINER_FOLDERS = frozenset(("jpegimages", "480p", "1080p", "full-resolution", "rgb", "images", "frames", "color"))
# A mask or a code has no more colors than this.
_MAX_COLORS = 16
_NUMBERED = re.compile(r"(.*?)([0-9]+)([^0-9]*)")


class _Clip(Protocol):
    @property
    def path(self) -> Path: ...
    @property
    def files(self) -> tuple[Path, ...]: ...
    @property
    def is_video(self) -> bool: ...


def is_other_role(name: str, siblings: Collection[str], alone: bool = True) -> bool:
    """Whether a name says that something is masks, depth or the like.

    :param name: of a folder, or of a file without its suffix
    :param siblings: the names beside it; ``bear_mask`` is taken for the masks of ``bear`` where that is there
    :param alone: whether a word such as ``masks`` alone says so
    """
    words = [word for word in re.split(r"[\s_.-]+", name.lower()) if word]
    if alone and words and ("".join(words) in OTHER_ROLES or words[0] == "annotations"):
        return True
    others = {sibling.lower() for sibling in siblings}
    match = re.fullmatch(r"(.+)[\s_.-]+([a-z]+)", name.lower())
    return match is not None and match[2] in OTHER_ROLES and match[1] in others


def require_one_series(folder: Path, images: Iterable[Path]) -> None:
    """Refuse a folder whose images are the frames of several clips, or frames and their masks.

    :param folder: of the images
    :param images: in it
    :raises ValueError: if frames of one number have several names
    """
    series: dict[tuple[str, str], set[int]] = defaultdict(set)
    for image in images:
        if match := _NUMBERED.fullmatch(image.stem):
            series[match[1], match[3] + image.suffix.lower()].add(int(match[2]))
    kinds = sorted(series, key=lambda kind: -len(series[kind]))
    for i, one in enumerate(kinds):
        for other in kinds[i + 1 :]:
            if len(series[one] & series[other]) > 1:
                names = " and ".join(f"{before}N{behind}" for before, behind in (one, other))
                raise ValueError(
                    f"{folder} holds several images of one number, {names}: frames of two clips, or their masks? Put "
                    "the frames of each clip into a folder of their own"
                )


def require_images(sources: Iterable[_Clip]) -> None:
    """Refuse folders of frames that look like masks or depth, by their middle frames.

    Palettes and gray images of few values are masks. Beside folders of color, folders of gray or of few colors are
    suspected, too.

    :param sources: clips of one folder of videos
    :raises ValueError: naming a folder of each kind
    """
    kinds: dict[str, _Clip] = {}
    folders = [source for source in sources if not source.is_video]
    for source in folders:
        kind = _kind(source.files[len(source.files) // 2])
        if kind is not None:
            kinds.setdefault(kind, source)
    if "codes" in kinds:
        raise ValueError(
            f"{kinds['codes'].path} holds masks (palettes or gray images of {_MAX_COLORS} values at most); "
            "move it out of the folder of videos, or convert it to RGB if it is meant"
        )
    for kind in ("gray", "few colors"):
        if kind in kinds and "color" in kinds:
            raise ValueError(
                f"{kinds[kind].path} holds images of {kind} beside the color images in {kinds['color'].path}: depth or "
                "masks? Move it out of the folder of videos"
            )


def _kind(file: Path) -> str | None:
    from PIL import Image

    try:
        with Image.open(file) as image:
            if image.mode.startswith(("I", "F")):
                return None  # decoding refuses these
            image.draft("RGB", (256, 256))
            few = _has_few_colors(image.convert("RGB"))
            if image.mode in ("1", "P", "L", "LA", "PA"):
                is_gray = image.mode in ("1", "L", "LA")
                return "codes" if few else "gray" if is_gray else "color"
            return "few colors" if few else "color"
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None  # decoding will say so


def _has_few_colors(image: Any) -> bool:
    colors = image.getcolors(_MAX_COLORS)
    return colors is not None
