"""Action-bisimulation and baseline encoders for Stable-Baselines3, pretrained without rewards.

Importing the package registers its environments. The other public names are imported when they are first used, so that
environments and ``--help`` are there at once. The features extractors are those of the registered methods:
``ActionBisimExtractor``, ``SSIExtractor`` and so on.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sb3_abisim import envs as _envs  # noqa: F401  (registers the environments)
from sb3_abisim._version import __version__
from sb3_abisim.registry import (
    EnvTraits,
    register_augmentation,
    register_method,
    register_network,
    register_reader,
    register_traits,
)

if TYPE_CHECKING:
    from sb3_abisim.data.collect import collect
    from sb3_abisim.data.dataset import TransitionDataset
    from sb3_abisim.data.format import CUT, TERMINATED, TRUNCATED
    from sb3_abisim.data.importing import import_dataset
    from sb3_abisim.data.writer import Segment, write_dataset
    from sb3_abisim.envs.base import BatchEnv, SingleEnv
    from sb3_abisim.envs.plain_actions import PlainActions
    from sb3_abisim.envs.point_maze.pixel_wrapper import PointMazePixels
    from sb3_abisim.envs.sb3_vec_env import BatchedVecEnv
    from sb3_abisim.envs.shortest_paths import ShortestPaths
    from sb3_abisim.networks.base import Encoder
    from sb3_abisim.networks.encoder_file import load_encoder, save_encoder
    from sb3_abisim.networks.from_module import from_module
    from sb3_abisim.objectives.base import Objective, TensorBatch
    from sb3_abisim.pretraining.pretrain import pretrain
    from sb3_abisim.rl.auxiliary import AuxiliaryObjective
    from sb3_abisim.rl.callbacks import EncoderCallback
    from sb3_abisim.rl.combined import CombinedEncoderExtractor
    from sb3_abisim.rl.extractors import EncoderExtractor
    from sb3_abisim.rl.merge import merge_encoder
    from sb3_abisim.rl.policy_kwargs import policy_kwargs
    from sb3_abisim.rl.unfreeze import unfreeze_encoder
    from sb3_abisim.rl.vec_encode import VecEncodeObservations

# Public name: the module that defines it.
_PUBLIC = {
    "CUT": "data.format",
    "TERMINATED": "data.format",
    "TRUNCATED": "data.format",
    "AuxiliaryObjective": "rl.auxiliary",
    "BatchEnv": "envs.base",
    "BatchedVecEnv": "envs.sb3_vec_env",
    "CombinedEncoderExtractor": "rl.combined",
    "Encoder": "networks.base",
    "EncoderCallback": "rl.callbacks",
    "EncoderExtractor": "rl.extractors",
    "Objective": "objectives.base",
    "PlainActions": "envs.plain_actions",
    "PointMazePixels": "envs.point_maze.pixel_wrapper",
    "Segment": "data.writer",
    "ShortestPaths": "envs.shortest_paths",
    "SingleEnv": "envs.base",
    "TensorBatch": "objectives.base",
    "TransitionDataset": "data.dataset",
    "VecEncodeObservations": "rl.vec_encode",
    "collect": "data.collect",
    "from_module": "networks.from_module",
    "import_dataset": "data.importing",
    "load_encoder": "networks.encoder_file",
    "merge_encoder": "rl.merge",
    "policy_kwargs": "rl.policy_kwargs",
    "pretrain": "pretraining.pretrain",
    "save_encoder": "networks.encoder_file",
    "unfreeze_encoder": "rl.unfreeze",
    "write_dataset": "data.writer",
}
_EXTRACTORS = "sb3_abisim.rl.extractors"

__all__ = [
    "CUT",
    "TERMINATED",
    "TRUNCATED",
    "AuxiliaryObjective",
    "BatchEnv",
    "BatchedVecEnv",
    "CombinedEncoderExtractor",
    "Encoder",
    "EncoderCallback",
    "EncoderExtractor",
    "EnvTraits",
    "Objective",
    "PlainActions",
    "PointMazePixels",
    "Segment",
    "ShortestPaths",
    "SingleEnv",
    "TensorBatch",
    "TransitionDataset",
    "VecEncodeObservations",
    "__version__",
    "collect",
    "from_module",
    "import_dataset",
    "load_encoder",
    "merge_encoder",
    "policy_kwargs",
    "pretrain",
    "register_augmentation",
    "register_method",
    "register_network",
    "register_reader",
    "register_traits",
    "save_encoder",
    "unfreeze_encoder",
    "write_dataset",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    # That of a method, which may be somebody else's.
    if name.endswith("Extractor"):
        return getattr(importlib.import_module(_EXTRACTORS), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    from sb3_abisim.registry import methods

    return sorted({*globals(), *__all__, *(method.extractor for method in methods().values())})
