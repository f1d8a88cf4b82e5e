"""What Stable-Baselines3 saves during training, whole or not at all.

Its writers open the file that is there, which is empty from then on: where the disk is full, or the process killed,
the last good model and all evaluations before are gone. :func:`saves_whole` lets them write beside it and rename.
"""

import contextlib
import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from sb3_abisim.common.files import write_atomic


@contextlib.contextmanager
def saves_whole() -> Iterator[None]:
    """Within it, models, replay buffers, evaluations and the means of ``VecNormalize`` replace a file as a whole."""
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
