"""What an auxiliary objective keeps with the model: one tensor of bytes in the state dict of the features extractor.

``save`` of Stable-Baselines3 then stores it, ``load`` brings it back, and no pickle is involved. The bytes are a
safetensors file. No parameters are registered: Stable-Baselines3 averages target networks and clips gradients over all
parameters of a policy, and heads belong to neither.
"""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

KEY = "auxiliary_state"
_METADATA = "auxiliary"


class AuxiliarySlot:
    """The place of that state in an extractor.

    ``saved`` holds what a loaded model brought, until a callback takes it; ``saver``, while there is one, packs the
    present state.
    """

    def __init__(self) -> None:
        self.saved: th.Tensor | None = None
        self.saver: Callable[[], th.Tensor] | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Copies and pickles of a policy keep the state, not whoever is training.
        return {"saved": self.packed(), "saver": None}

    def packed(self) -> th.Tensor | None:
        """The state as bytes, uint8 (n,); None where there is none."""
        return self.saved if self.saver is None else self.saver()

    def save(self, destination: dict[str, Any], prefix: str) -> None:
        """Add the state to a state dict.

        :param destination: the state dict
        :param prefix: of the extractor's keys
        """
        packed = self.packed()
        if packed is not None:
            destination[prefix + KEY] = packed

    def load(self, state_dict: dict[str, Any], prefix: str) -> None:
        """Take the state out of a state dict; one without it, as of models of before, changes nothing.

        :param state_dict: as torch hands it to ``_load_from_state_dict``
        :param prefix: of the extractor's keys
        """
        packed = state_dict.pop(prefix + KEY, None)
        if packed is not None:
            self.saved, self.saver = packed.detach().cpu().clone(), None


def pack(tensors: dict[str, th.Tensor], metadata: dict[str, Any]) -> th.Tensor:
    """Tensors and JSON as one tensor of bytes.

    :param tensors: by name
    :param metadata: JSON types
    :return: uint8 (n,), on the CPU
    """
    # safetensors refuses tensors that share memory or are not contiguous.
    copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    content = save_tensors(copies, metadata={_METADATA: json.dumps(metadata)})
    return th.from_numpy(np.frombuffer(content, np.uint8).copy())


def unpack(packed: th.Tensor) -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    """The inverse of :func:`pack`.

    :param packed: uint8 (n,)
    :raises ValueError: for other bytes
    """
    content = packed.cpu().numpy().tobytes()
    try:
        tensors = load_tensors(content)
        header_size = int.from_bytes(content[:8], "little")
        metadata: dict[str, Any] = json.loads(json.loads(content[8 : 8 + header_size])["__metadata__"][_METADATA])
    except Exception as error:
        raise ValueError(
            f"the state of the auxiliary objective in the saved model is damaged ({error}); copy the model again"
        ) from error
    return tensors, metadata
