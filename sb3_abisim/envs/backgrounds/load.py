"""The clips of a source: the built-in ones, or custom videos."""

import os
from pathlib import Path

from sb3_abisim.common.arguments import checked_arguments
from sb3_abisim.common.extras import require_extra
from sb3_abisim.envs.backgrounds.clips import SPLITS, Backgrounds
from sb3_abisim.envs.backgrounds.photo_pan import photo_pan


@checked_arguments
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

    The keyword arguments apply to custom videos; the built-in clips have a fixed split.

    :param source: folder of videos, of folders of frames, or a DAVIS root; None for the built-in ``photo_pan``
    :param split: "train" or "eval"
    :param seed: of the split, where the folder does not define one
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
        return photo_pan(split)
    if not 0 < eval_fraction < 1:
        raise ValueError(f"eval_fraction must lie between 0 and 1, got {eval_fraction}")
    if min_frames < 2:
        raise ValueError(f"min_frames must be at least 2, got {min_frames}")
    if on_error not in ("raise", "skip"):
        raise ValueError(f"on_error must be 'raise' or 'skip', got {on_error!r}")
    require_extra("video", "videos= of your own (the built-in ones need nothing)", "av", "PIL")
    from sb3_abisim.envs.backgrounds import video_cache, video_files

    sources = video_files.find_sources(Path(source))
    chosen = video_files.split_sources(sources, seed, eval_fraction)
    return video_cache.load_split(str(source), split, chosen["train"], chosen["eval"], min_frames, max_bytes, on_error)
