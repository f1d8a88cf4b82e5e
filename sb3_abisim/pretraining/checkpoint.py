"""Checkpoints of a pretraining run: weights, optimizer, random state and position in one safetensors file."""

import contextlib
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch as th
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import nn

from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.vocabulary import current_settings, current_term

# How many of the newest ones stay.
N_KEPT = 2
_HASH_BYTES = 32


class Checkpoints:
    """The checkpoints of a run, in its folder.

    :param folder: of the run
    :param settings: of the run; JSON types, or tuples
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.folder = folder
        self.settings = settings

    def save(
        self, module: nn.Module, optimizer: th.optim.Optimizer, n_updates: int, rows: list[dict[str, float]]
    ) -> None:
        """Write a checkpoint, then remove all but the newest two.

        :param module: its parameters and buffers are saved
        :param optimizer: its state is saved, not its hyperparameters
        :param n_updates: how many updates were made
        :param rows: of the log, so far
        """
        path = self.folder / f"checkpoint-{n_updates:09d}.safetensors"
        metadata = {"n_updates": n_updates, "settings": self.settings, "rows": rows}
        _write(path, module, optimizer, metadata)
        self.remove(keep=N_KEPT)

    def restore(self, module: nn.Module, optimizer: th.optim.Optimizer) -> tuple[int, list[dict[str, float]]]:
        """Put the newest checkpoint, if there is one, back into a module, its optimizer and the random state.

        :param module: gets parameters and buffers
        :param optimizer: gets its state
        :return: ``n_updates`` and ``rows`` of :meth:`save`; 0 and none without a checkpoint
        :raises ValueError: for a damaged file or another run's checkpoint
        """
        paths = self._paths()
        if not paths:
            return 0, []
        metadata = _read(paths[-1], module, optimizer, self.settings)
        rows = [{current_term(name): value for name, value in row.items()} for row in metadata["rows"]]
        return metadata["n_updates"], rows

    def remove(self, keep: int) -> None:
        """Remove them: only an unfinished run needs them, or one that is to get more updates.

        :param keep: how many of the newest ones stay
        """
        for path in self._paths()[::-1][keep:]:
            path.unlink()

    def exist(self) -> bool:
        """Whether there are any."""
        return bool(self._paths())

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob("checkpoint-*.safetensors"))


def asks_for_more_updates(there: dict[str, Any], here: dict[str, Any]) -> bool:
    """Whether a run differs from another one in nothing but a larger ``n_updates``.

    :param there: settings of the other run
    :param here: settings of the present run
    """
    there, here = (current_settings(json.loads(json.dumps(settings))) for settings in (there, here))
    return {**there, "n_updates": None} == {**here, "n_updates": None} and there["n_updates"] < here["n_updates"]


def rate_is_constant(settings: dict[str, Any]) -> bool:
    """Whether the first updates of a longer run are those of a shorter one: its learning rate does not fall.

    :param settings: of a run
    """
    return not isinstance(settings["learning_rate"], str)


def refuse_other_settings(path: Path, there: dict[str, Any], here: dict[str, Any]) -> None:
    """Refuse a file that a run with other settings wrote, whatever its version of this package called them.

    :param path: the file
    :param there: its settings
    :param here: those of the present run
    :raises ValueError: with the settings that differ, and both values of each
    """
    # Through JSON, since that is how the file's settings came back (tuples, for one, became lists).
    there, here = (current_settings(json.loads(json.dumps(settings))) for settings in (there, here))
    names = sorted({*there, *here})
    differences = [f"{n}: {there.get(n)!r} there, {here.get(n)!r} here" for n in names if there.get(n) != here.get(n)]
    if differences:
        raise ValueError(
            f"{path} belongs to a run with other settings ({'; '.join(differences)}); choose another output, or remove "
            "the file"
        )


def _write(path: Path, module: nn.Module, optimizer: th.optim.Optimizer, metadata: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all; a sha256 of the content stands at its end."""
    tensors = {f"module.{name}": tensor for name, tensor in module.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": th.as_tensor(value) for name, value in state.items()}
    tensors["rng"] = th.get_rng_state()
    # safetensors refuses tensors that share memory or are not contiguous.
    copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    content = save_tensors(copies, metadata={"run": json.dumps(metadata)})
    write_atomic(path, lambda file: file.write(content + hashlib.sha256(content).digest()))


def _read(path: Path, module: nn.Module, optimizer: th.optim.Optimizer, settings: dict[str, Any]) -> dict[str, Any]:
    whole = path.read_bytes()
    content, hash = whole[:-_HASH_BYTES], whole[-_HASH_BYTES:]
    if hashlib.sha256(content).digest() != hash:
        raise ValueError(f"{path} is damaged; remove it to go on from the checkpoint before it")
    with _one_sentence(path):
        tensors = load_tensors(content)
        header_size = int.from_bytes(content[:8], "little")
        metadata: dict[str, Any] = json.loads(json.loads(content[8 : 8 + header_size])["__metadata__"]["run"])
        there = dict(metadata["settings"])
        continues = rate_is_constant(settings) and asks_for_more_updates(there, settings)
    if not continues:
        refuse_other_settings(path, there, settings)
    with _one_sentence(path):
        module.load_state_dict({k.removeprefix("module."): v for k, v in tensors.items() if k.startswith("module.")})
        optimizer.load_state_dict(
            {"state": _optimizer_state(tensors, optimizer), "param_groups": optimizer.state_dict()["param_groups"]}
        )
        n_updates, rows = metadata["n_updates"], metadata["rows"]
        if type(n_updates) is not int or n_updates < 0:
            raise ValueError(f"{n_updates!r} updates")
        if not all(type(value) in (int, float) for row in rows for value in row.values()):
            raise ValueError("rows of a log that are no numbers")
        th.set_rng_state(tensors["rng"])
    return metadata


def _optimizer_state(tensors: dict[str, th.Tensor], optimizer: th.optim.Optimizer) -> dict[int, dict[str, th.Tensor]]:
    shapes = [parameter.shape for group in optimizer.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, th.Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".")
            if tensor.dim() and tensor.shape != shapes[int(index)]:
                raise ValueError(f"{name} has the shape {tuple(tensor.shape)}, its weight {tuple(shapes[int(index)])}")
            state.setdefault(int(index), {})[key] = tensor
    return state


@contextlib.contextmanager
def _one_sentence(path: Path) -> Iterator[None]:
    """The hash is that of any content: what is forged can be wrong in any way."""
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(
            f"{path} is no checkpoint of this run ({reason}); remove it to go on from the checkpoint before it"
        ) from error
