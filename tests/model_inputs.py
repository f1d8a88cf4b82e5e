"""What the tests of saved models share: small runs, what is in a model, and zips that are forged."""

import json
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch as th
from zoo_inputs import SMALL, run, write_encoder

from sb3_abisim.zoo.runs import Run, read_run

ENV_ID = "Nav2D-v0"
CONTINUOUS = "ContinuousPointMaze-v0"
NORMALIZED = [*SMALL["ppo"], "normalize:{'norm_obs': False, 'norm_reward': True}"]
CASES = {
    "ppo": ("ppo", ENV_ID, "", SMALL["ppo"]),
    "ppo-frozen": ("ppo", ENV_ID, ",frozen", [*SMALL["ppo"], "learning_rate:lin_0.001"]),
    "ppo-normalized": ("ppo", ENV_ID, "", NORMALIZED),
    "dqn": ("dqn", ENV_ID, "", SMALL["dqn"]),
    "dqn-frozen": ("dqn", ENV_ID, ",frozen", SMALL["dqn"]),
    "sac": ("sac", CONTINUOUS, ",frozen", SMALL["sac"]),
}


def train(patch: pytest.MonkeyPatch, folder: Path, algo: str, env_id: str, method: str, *words: str) -> Run:
    encoder = write_encoder_once(folder, env_id)
    flags = ["--algo", algo, "--env", env_id, "-f", str(folder), "--conf-file", f"abisim={encoder}{method}"]
    run(patch, "train", *flags, "-n", "300", "--eval-freq", "-1", "--num-threads", "1", "-params", *words)
    return read_run(folder / algo / f"{env_id}_1")


def write_encoder_once(folder: Path, env_id: str) -> Path:
    folder.mkdir(exist_ok=True)
    write_encoder(folder / "e.safetensors", env_id)
    return folder / "e.safetensors"


def flat(value: Any) -> list[Any]:
    if isinstance(value, th.Tensor):
        return value.flatten().tolist()
    if isinstance(value, dict | list | tuple):
        return [x for part in (value.values() if isinstance(value, dict) else value) for x in flat(part)]
    return [value]


class Execute:
    """A pickle of it makes a file when it is opened."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def rewrite(path: Path, change: Any = None, compression: int = zipfile.ZIP_STORED, **files: bytes) -> None:
    """Change the JSON of a zip, and other files in it."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()} | files
    data = json.loads(content["data"])
    if change is not None:
        change(data)
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, value in (content | {"data": json.dumps(data).encode()}).items():
            archive.writestr(name, value)
