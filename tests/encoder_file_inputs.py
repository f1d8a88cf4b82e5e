"""Encoder files for tests: whole ones, and forged ones whose hash is right."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch as th
from gymnasium import spaces

from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.networks.encoder_file import (
    save_encoder,
)

SPACE = spaces.Box(0, 255, (3, 15, 15), np.uint8)
ACTIONS = spaces.Box(np.array([-1, -2], np.float32), np.array([3, 4], np.float32))
FRAMES = np.random.default_rng(0).integers(0, 256, (5, 3, 15, 15), np.uint8)
DATASET_HASH = "0" * 64


def seeded_encoder(seed: int = 0) -> Encoder:
    th.manual_seed(seed)
    return make_encoder(SPACE)


def save(path: Path, encoder: Encoder | None = None, **changes: Any) -> str:
    arguments: dict[str, Any] = {
        "observation_space": SPACE,
        "action_space": ACTIONS,
        "env_id": "Nav2D-v0",
        "env_kwargs": {"n_obstacles": 3},
        "objective": "ssi",
        "settings": {"beta": 0.5, "digest": "0" * 64},
        "dataset_hash": DATASET_HASH,
        "reference_observations": FRAMES,
    }
    return save_encoder(path, encoder or seeded_encoder(), **(arguments | changes))


def write_with_hash(path: Path, tensors: dict[str, th.Tensor], document: Any) -> None:
    """An encoder file with a right hash, made without the code under test: search for a placeholder and replace it."""
    placeholder = bytes(range(200, 232))
    tensors["digest"] = th.tensor(list(placeholder), dtype=th.uint8)
    data = safetensors.torch.save(
        tensors, {"sb3_abisim": document if isinstance(document, str) else json.dumps(document)}
    )
    assert data.count(placeholder) == 1
    hash = hashlib.sha256(data.replace(placeholder, bytes(32))).digest()
    path.write_bytes(data.replace(placeholder, hash))


def forge(path: Path, edit: Callable[[dict[str, th.Tensor], dict[str, Any]], object]) -> None:
    """Change tensors and metadata of an encoder file, and set the hash right."""
    data = path.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    tensors, document = safetensors.torch.load(data), json.loads(header["__metadata__"]["sb3_abisim"])
    edit(tensors, document)
    write_with_hash(path, tensors, document)
