"""Where files lie: those that come with the package, encoders and hyperparameters, and those that it keeps."""

import os
from pathlib import Path
from typing import Literal

import platformdirs

CACHE_VARIABLE = "SB3_ABISIM_CACHE"
_PACKAGE = Path(__file__).resolve().parents[1]


def resource_path(kind: Literal["encoders", "hyperparams"]) -> Path:
    """Folder of the files that come with the package.

    An installed package holds them beside its modules; a checkout holds them at its top level.

    :param kind: "encoders" or "hyperparams"
    :return: absolute path of the folder; it need not exist in a checkout that ships no such files yet
    """
    if kind not in ("encoders", "hyperparams"):
        raise ValueError(f"kind must be 'encoders' or 'hyperparams', got {kind!r}")
    installed = _PACKAGE / kind
    return installed if installed.is_dir() else _PACKAGE.parent / kind


def cache_folder(kind: str = "") -> Path:
    """Where what takes long to make is kept.

    :param kind: a folder within the user's cache folder
    :return: ``$SB3_ABISIM_CACHE`` if it is set, else ``sb3_abisim/<kind>`` in the user's cache folder; may be absent
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    if chosen:
        return Path(chosen)
    return platformdirs.user_cache_path("sb3_abisim", appauthor=False) / kind
