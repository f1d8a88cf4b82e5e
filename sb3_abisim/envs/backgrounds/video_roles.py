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
        "semseg",
        "insseg",
        "trimap",
        "trimaps",
        "silhouette",
        "silhouettes",
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
# Of these, what may be a clip's name as well, such as alpha_2.
_DOUBTFUL = frozenset(
    ("alpha", "flow", "flows", "normal", "normals", "gt", "instance", "instances", "label", "labels", "matte", "disp")
)
# Words beside a role's: how it is stored, shown or made.
_FORMS = frozenset(
    (
        "png", "jpg", "jpeg", "exr", "npy", "raw", "bit", "bits", "vis", "viz", "color", "colored", "map",
        "maps", "image", "images", "img", "imgs", "frames", "v", "pred", "preds", "predicted", "class", "object",
        "id", "ids", "fine", "coarse", "left", "right", "hd", "full", "trainids", "sem",
    )
)  # fmt: skip
# Folders of which the name says that images lie there, not of which clip.
CONTAINER_FOLDERS = frozenset(("jpegimages", "480p", "1080p", "full-resolution", "rgb", "images", "frames", "color"))
# A mask or a code has no more colors than this.
_MAX_COLORS = 16
NUMBERED = re.compile(r"(.*?)([0-9]+)([^0-9]*)")


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
    :param siblings: the names beside it; ``bear_mask`` is taken for the masks of ``bear`` where that is there, and
        ``alpha_png`` for a role beside ``rgb``
    :param alone: whether a word such as ``masks`` alone says so; else it does beside ``rgb``
    """
    words, others = _words(name), [sibling for sibling in siblings if sibling != name]
    if role := _role(words):
        if any(map(_is_color, others)):
            return True
        if alone and ("".join(words) in OTHER_ROLES or role not in _DOUBTFUL):
            return True
    beside = {"".join(_words(sibling)) for sibling in others}
    halves = [half for k in range(1, len(words)) for half in ((words[k:], words[:k]), (words[:k], words[k:]))]
    return any(_role(one) and "".join(other) in beside for one, other in halves)


def _words(name: str) -> list[str]:
    """Of a name such as ``DepthMaps_16bit``, in small letters, and its numbers."""
    return [part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+|[^\W\d_A-Za-z]+", name)]


def _role(words: list[str]) -> str:
    """The role that all words speak of, but for those of its form; empty for none."""
    if words[:1] == ["annotations"]:
        return words[0]
    bare = [word for word in words if word not in _FORMS and not word.isdigit()]
    is_role = "".join(bare) in OTHER_ROLES or (bare and all(word in OTHER_ROLES for word in bare))
    return "".join(bare) if is_role else ""


def _is_color(name: str) -> bool:
    return name.lower() in CONTAINER_FOLDERS or "".join(_words(name)) in ("image", "video")


def require_one_series(folder: Path, images: Collection[Path]) -> None:
    """Refuse a folder whose images are the frames of several clips, frames and their masks, or photographs.

    :param folder: of the images
    :param images: in it
    :raises ValueError: if frames of one number have several names, or if names differ by more than numbers
    """
    series: dict[tuple[str, str], list[int]] = defaultdict(list)
    for image in images:
        if match := NUMBERED.fullmatch(image.stem):
            series[match[1], match[3] + image.suffix.lower()].append(int(match[2]))
    kinds = sorted(series, key=lambda kind: -len(series[kind]))
    pairs = [(one, other) for i, one in enumerate(kinds) for other in kinds[i + 1 :]]
    twice = [(kind, kind) for kind in kinds if len(set(series[kind])) < len(series[kind])]
    for one, other in twice + [pair for pair in pairs if len(set(series[pair[0]]) & set(series[pair[1]])) > 1]:
        names = " and ".join(f"{before}N{behind}" for before, behind in (one, other))
        raise ValueError(
            f"{folder} holds several images of one number, {names}: frames of two clips, or their masks? Put "
            "the frames of each clip into a folder of their own"
        )
    patterns = sorted({re.sub("[0-9]+", "N", image.stem) for image in images})
    if len(images) > 1 and (len(patterns) > 1 or "N" not in patterns[0]):
        raise ValueError(
            f"{folder} holds images whose names are no numbers of one series ({', '.join(patterns[:3])}): photographs, "
            "or frames of several clips? Number the frames of each clip in a folder of their own"
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
        with Image.open(file, formats=("BMP", "JPEG", "PNG", "WEBP")) as image:
            if image.mode.startswith(("I", "F")):
                return None  # decoding refuses these
            image.draft("RGB", (256, 256))
            few = _has_few_colors(image.convert("RGB"))
            if image.mode in ("1", "P", "L", "LA", "PA"):
                is_gray = image.mode in ("1", "L", "LA")
                return "codes" if few else "gray" if is_gray else "color"
            return "few colors" if few else "color"
    except Exception:  # what Pillow raises depends on where the damage is
        return None  # decoding will say so


def _has_few_colors(image: Any) -> bool:
    colors = image.getcolors(_MAX_COLORS)
    return colors is not None
