"""What Stable-Baselines3 saves, whole or not at all.

Its writers open the file that is there, which is empty from then on: where the disk is full, or the process killed,
the last good model and all evaluations before are gone. :func:`saves_whole` lets them write beside it and rename.
"""

import contextlib
import errno
import importlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize, VecVideoRecorder

from sb3_abisim.common.files import check_output, write_atomic


@contextlib.contextmanager
def saves_whole() -> Iterator[None]:
    """Within it, models, buffers, evaluations, videos and means of ``VecNormalize`` replace a file as a whole."""
    models = importlib.import_module("stable_baselines3.common.base_class")
    buffers = importlib.import_module("stable_baselines3.common.off_policy_algorithm")
    with contextlib.ExitStack() as stack:
        for owner, name, suffix in (
            (models, "save_to_zip_file", ".zip"),
            (buffers, "save_to_pkl", ".pkl"),
            (np, "savez", ".npz"),
        ):
            stack.enter_context(mock.patch.object(owner, name, _whole(getattr(owner, name), suffix)))
        stack.enter_context(mock.patch.object(VecNormalize, "save", _whole_means(VecNormalize.save)))
        stop = VecVideoRecorder._stop_recording
        stack.enter_context(mock.patch.object(VecVideoRecorder, "_stop_recording", _whole_video(stop)))
        stack.enter_context(mock.patch.object(VecVideoRecorder, "__init__", _with_frames(VecVideoRecorder.__init__)))
        yield


def _whole(write: Callable[..., object], suffix: str) -> Callable[..., None]:
    def written(path: Any, *args: Any, **kwargs: Any) -> None:
        if not isinstance(path, str | os.PathLike):
            write(path, *args, **kwargs)
            return
        name = Path(path)
        # As they name it: NumPy adds its own suffix to any other, Stable-Baselines3 where there is none.
        if not name.suffix or (suffix == ".npz" and name.suffix != suffix):
            name = Path(f"{name}{suffix}")
        name.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(name, lambda file: write(file, *args, **kwargs))

    return written


def _whole_means(save: Callable[..., None]) -> Callable[..., None]:
    def written(normalize: VecNormalize, path: str) -> None:
        # It opens a name, or a descriptor, which it closes.
        write_atomic(path, lambda file: save(normalize, os.dup(file.fileno())))

    return written


def _is_whole(video: bytes) -> bool:
    """Whether the boxes of an MP4 file end where it does, and one of them says what is in the others."""
    at, names = 0, set()
    while at < len(video):
        size, name = int.from_bytes(video[at : at + 4]), video[at + 4 : at + 8]
        # One without a size goes on to the end; none is shorter than its own size and name.
        at += max(int.from_bytes(video[at + 8 : at + 16]) if size == 1 else size or len(video), 8)
        names.add(name)
    return at == len(video) and b"moov" in names


def _with_frames(init: Callable[..., None]) -> Callable[..., None]:
    def started(recorder: VecVideoRecorder, *args: Any, **kwargs: Any) -> None:
        # One that cannot make its folder looks for them when it is deleted.
        recorder.recorded_frames = []
        init(recorder, *args, **kwargs)

    return started


def _whole_video(stop: Callable[[VecVideoRecorder], None]) -> Callable[[VecVideoRecorder], None]:
    def stopped(recorder: VecVideoRecorder) -> None:
        place = recorder.video_path
        try:
            check_output(place)
            with tempfile.TemporaryDirectory() as folder:
                # ffmpeg knows the format by the name's ending.
                recorder.video_path = os.path.join(folder, os.path.basename(place))
                stop(recorder)
                content = Path(recorder.video_path).read_bytes()
        finally:
            # What is not saved now will not be, of which Stable-Baselines3 would warn.
            recorder.recorded_frames = []
        # ffmpeg may have stopped without a word.
        if not _is_whole(content):
            reason = "the video was not written to its end; free some space and run the same command again"
            raise OSError(errno.EIO, reason, place)
        write_atomic(place, lambda file: file.write(content))

    return stopped
