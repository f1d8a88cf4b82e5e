"""Checkpoints of a pretraining run: weights, optimizer, random state and position in one safetensors file."""

import hashlib
import json
from pathlib import Path
from typing import Any

import torch as th
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import nn

from sb3_abisim.common.files import write_atomic

_HASH_BYTES = 32


def save_training_state(path: Path, module: nn.Module, optimizer: th.optim.Optimizer, metadata: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all; a sha256 of the content stands at its end.

    :param path: the file
    :param module: its parameters and buffers are saved
    :param optimizer: its state is saved, not its hyperparameters
    :param metadata: JSON types; must hold "settings"
    """
    tensors = {f"module.{name}": tensor for name, tensor in module.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": th.as_tensor(value) for name, value in state.items()}
    tensors["rng"] = th.get_rng_state()
    # safetensors refuses tensors that share memory or are not contiguous.
    copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    content = save_tensors(copies, metadata={"run": json.dumps(metadata)})
    write_atomic(path, lambda file: file.write(content + hashlib.sha256(content).digest()))


def load_training_state(
    path: Path, module: nn.Module, optimizer: th.optim.Optimizer, settings: dict[str, Any]
) -> dict[str, Any]:
    """Put a checkpoint back into a module, its optimizer and the random state.

    :param path: the file
    :param module: gets parameters and buffers
    :param optimizer: gets its state
    :param settings: of the present run; must equal those of the checkpoint
    :return: the metadata
    :raises ValueError: for a damaged file or another run's checkpoint
    """
    whole = path.read_bytes()
    content, hash = whole[:-_HASH_BYTES], whole[-_HASH_BYTES:]
    if hashlib.sha256(content).digest() != hash:
        raise ValueError(f"{path} is damaged; remove it to go on from the checkpoint before it")
    tensors = load_tensors(content)
    header_size = int.from_bytes(content[:8], "little")
    metadata: dict[str, Any] = json.loads(json.loads(content[8 : 8 + header_size])["__metadata__"]["run"])
    here = json.loads(json.dumps(settings))
    if metadata["settings"] != here:
        raise ValueError(
            f"{path} belongs to a run with other settings ({metadata['settings']} there, {here} here); "
            "choose another output or remove the folder"
        )
    module.load_state_dict({k.removeprefix("module."): v for k, v in tensors.items() if k.startswith("module.")})
    state: dict[int, dict[str, th.Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".", 2)
            state.setdefault(int(index), {})[key] = tensor
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    th.set_rng_state(tensors["rng"])
    return metadata
