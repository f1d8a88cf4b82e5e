"""Where the files that come with the package lie: encoders and hyperparameters."""

from pathlib import Path
from typing import Literal

_PACKAGE = Path(__file__).resolve().parent


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
