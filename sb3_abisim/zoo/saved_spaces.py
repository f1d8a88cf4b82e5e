"""Spaces of saved models, and means of VecNormalize: pickles, opened by an unpickler that makes nothing else."""

import base64
import importlib
import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_abisim.common.pickle_size import check_pickle_size

# Whatever else a pickle names is refused. The generators are those of random numbers, whose state a space keeps.
_CLASSES = {
    "gymnasium.spaces.box": {"Box"},
    "gymnasium.spaces.dict": {"Dict"},
    "gymnasium.spaces.discrete": {"Discrete"},
    "gymnasium.spaces.multi_binary": {"MultiBinary"},
    "gymnasium.spaces.multi_discrete": {"MultiDiscrete"},
    "sb3_abisim.rl.vec_encode": {"EncodedBox"},
    "numpy": {"ndarray"},
    "numpy.random._pcg64": {"PCG64"},
    "numpy.random.bit_generator": {"SeedSequence"},
}
# Objects of the classes are filled with what the file holds; these alone are called.
_FUNCTIONS = {
    "collections": {"OrderedDict"},
    "numpy": {"dtype"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
    "numpy.random._pickle": {"__bit_generator_ctor", "__generator_ctor"},
    "numpy.random.bit_generator": {"__pyx_unpickle_SeedSequence"},
}
_NAMES = {module: _CLASSES.get(module, set()) | _FUNCTIONS.get(module, set()) for module in {**_CLASSES, **_FUNCTIONS}}
# As NumPy 1 wrote it, too.
_CALLED = {
    f"{module.replace('numpy._core.', core)}.{name}"
    for module, names in _FUNCTIONS.items()
    for name in names
    for core in ("numpy._core.", "numpy.core.")
}
_NORMALIZE = {
    "stable_baselines3.common.vec_env.vec_normalize": {"VecNormalize"},
    "stable_baselines3.common.running_mean_std": {"RunningMeanStd"},
}


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, names: Mapping[str, set[str]] = MappingProxyType(_NAMES)) -> None:
        check_pickle_size(data, _CALLED)
        super().__init__(io.BytesIO(data))
        self._names = names

    def find_class(self, module: str, name: str) -> Any:
        """Look a name up in the list alone."""
        # As NumPy 1 wrote it.
        module = module.replace("numpy.core.", "numpy._core.")
        if name not in self._names.get(module, ()):
            raise ValueError(f"a pickle names {module}.{name}, which is not among what is read here")
        return getattr(importlib.import_module(module), name)


def read_space(stored: Any) -> spaces.Space[Any]:
    """A space from the data of a zip.

    :param stored: what the JSON holds of it
    :raises Exception: of any kind, for anything else; nothing has been executed then
    """
    if not isinstance(stored, Mapping):
        raise ValueError("it says nothing of its spaces")
    space = _Unpickler(base64.b64decode(stored[":serialized:"])).load()
    _check(space)
    found: spaces.Space[Any] = space
    return found


def read_vec_normalize(path: Path) -> VecNormalize:
    """What ``VecNormalize.save`` wrote, without executing anything else that the file holds.

    :param path: of a run
    :return: without an environment
    :raises ValueError: for anything else
    """
    try:
        found = _Unpickler(path.read_bytes(), _NAMES | _NORMALIZE).load()
    except OSError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path} is damaged or holds more than means ({reason}); copy it again") from error
    if type(found) is not VecNormalize:
        raise ValueError(f"{path} holds no VecNormalize; copy it again")
    return found


def _check(space: Any) -> None:
    """Refuse one whose numbers do not fit together: who samples it would get another amount than the file holds."""
    if isinstance(space, spaces.Dict):
        for part in space.spaces.values():
            _check(part)
    elif isinstance(space, spaces.Box):
        sides = space.low, space.high
        if not all(isinstance(side, np.ndarray) and side.shape == space.shape for side in sides):
            raise ValueError("the bounds of a Box have another shape than it")
    elif not isinstance(space, spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
        raise ValueError(f"a {type(space).__name__} is no space of a model")
