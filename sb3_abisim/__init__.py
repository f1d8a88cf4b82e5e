"""Action-bisimulation and baseline encoders for Stable-Baselines3, pretrained without rewards.

Importing the package registers its environments. The names that need torch are imported when they are first used, so
that environments and data collection start quickly.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sb3_abisim import envs as _envs  # noqa: F401  (registers the environments)
from sb3_abisim._version import __version__

if TYPE_CHECKING:
    from sb3_abisim.checkpoint import load_encoder, save_encoder
    from sb3_abisim.dataset import TransitionDataset
    from sb3_abisim.extractors import (
        ACROExtractor,
        ActionBisimExtractor,
        BetaVAEExtractor,
        CURLExtractor,
        InfoNCEExtractor,
        SSIExtractor,
        VanillaExtractor,
    )
    from sb3_abisim.optimizers import EncoderLRAdam

_LAZY = {
    "load_encoder": "checkpoint",
    "save_encoder": "checkpoint",
    "TransitionDataset": "dataset",
    "ACROExtractor": "extractors",
    "ActionBisimExtractor": "extractors",
    "BetaVAEExtractor": "extractors",
    "CURLExtractor": "extractors",
    "InfoNCEExtractor": "extractors",
    "SSIExtractor": "extractors",
    "VanillaExtractor": "extractors",
    "EncoderLRAdam": "optimizers",
}

__all__ = [
    "ACROExtractor",
    "ActionBisimExtractor",
    "BetaVAEExtractor",
    "CURLExtractor",
    "EncoderLRAdam",
    "InfoNCEExtractor",
    "SSIExtractor",
    "TransitionDataset",
    "VanillaExtractor",
    "__version__",
    "load_encoder",
    "save_encoder",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
