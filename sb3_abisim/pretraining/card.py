"""The model card beside an encoder file (``.json``): what a reader wants to know of an encoder."""

import json
import math
import platform
import shlex
import warnings
from pathlib import Path
from typing import Any

import torch as th

from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.vocabulary import current_dataset, current_settings, current_term
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CONTENT_HASH_KEY
from sb3_abisim.objectives.base import Objective
from sb3_abisim.pretraining.config import N_EVAL_BATCHES, PretrainConfig


def make_card(
    settings: dict[str, Any],
    config: PretrainConfig,
    dataset: TransitionDataset,
    module: Objective,
    rows: list[dict[str, float]],
    device: str,
    n_processes: int = 1,
) -> dict[str, Any]:
    """A model card; free of times and paths, so that equal runs write equal cards.

    :param settings: of the run, with objective, seed and hashes
    :param config: its settings by name
    :param dataset: that it was trained on
    :param module: the trained objective
    :param rows: of the log
    :param device: type of the device that it was trained on
    :param n_processes: that trained it together
    """
    # A callback may have been there for some of the rows only.
    names = dict.fromkeys(name for row in rows for name in row)
    return {
        "settings": settings,
        "commands": reproducing_commands(settings, config, dataset, n_processes),
        "dataset": {
            "hash": dataset.hash,
            "env_id": dataset.env_id,
            "env_kwargs": dataset.env_kwargs,
            "content_hash": dataset.meta[CONTENT_HASH_KEY],
            "n_transitions": dataset.n_transitions,
        },
        "features_dim": module.encoder.features_dim,
        "n_parameters": sum(parameter.numel() for parameter in module.encoder.parameters()),
        "metrics": rows[-1] if rows else {},
        "curves": {name: [row.get(name) for row in rows] for name in names},
        "versions": {"python": platform.python_version(), "torch": th.__version__.split("+")[0]},
        "device": device,
        # As in cards from before there could be several.
        **({"n_processes": n_processes} if n_processes > 1 else {}),
    }


def write_card(path: Path, card: dict[str, Any]) -> None:
    """Write a model card.

    :param path: the encoder file's, ending in ``.json``
    :param card: of :func:`make_card`
    """
    text = json.dumps(card, indent=1, sort_keys=True) + "\n"
    write_atomic(path, lambda file: file.write(text.encode()))


def read_card(path: Path) -> dict[str, Any]:
    """A model card under today's names, whichever version of this package wrote it.

    :param path: the card
    :raises FileNotFoundError: if it is not there
    :raises ValueError: if it is damaged, or something else
    """
    try:
        card = json.loads(path.read_bytes())
        return {
            **card,
            "settings": current_settings(card["settings"]),
            "dataset": current_dataset(card["dataset"]),
            "metrics": {current_term(name): value for name, value in card["metrics"].items()},
            "curves": {current_term(name): values for name, values in card["curves"].items()},
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"the model card {path} is damaged ({error!r}); copy or pretrain it again") from error


def refuse_to_replace(path: Path) -> None:
    """Refuse to write a model card over something else: its name follows from that of the encoder file.

    :param path: of the card
    :raises ValueError: if the file there is not a model card
    """
    if not path.exists():
        return
    try:
        read_card(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"the model card would replace {path}, which is not one; name another output") from error


def reproducing_commands(
    settings: dict[str, Any], config: PretrainConfig, dataset: TransitionDataset, n_processes: int = 1
) -> list[str]:
    """The commands that make an encoder again, with DATA, BASE and FILE for the paths.

    :param settings: of the run, with objective and seed
    :param config: its settings by name
    :param dataset: that it was trained on
    :param n_processes: that trained it together
    """
    commands, meta = [], dataset.meta
    # Data that was imported has no command that would collect it again.
    if meta["n_envs"] is not None:
        collect = ["--env", dataset.env_id, "-n", str(dataset.n_transitions), "--seed", str(meta["seed"])]
        collect += ["--n-envs", str(meta["n_envs"]), "-o", "DATA"]
        if dataset.env_kwargs:
            collect += ["--env-kwargs", *(f"{name}:{value!r}" for name, value in dataset.env_kwargs.items())]
        commands.append(f"sb3-abisim collect {shlex.join(collect)}")
    words = ["--objective", settings["objective"], "--env", dataset.env_id, "--seed", str(settings["seed"])]
    words += ["--data", "DATA", "-o", "FILE"] + (["--base", "BASE"] if "base_hash" in settings else [])
    words += ["-params", *(f"{name}:{json.dumps(value)}" for name, value in config.as_settings().items())]
    program = f"torchrun --nproc-per-node {n_processes} -m sb3_abisim" if n_processes > 1 else "sb3-abisim"
    commands.append(f"{program} pretrain {shlex.join(words)}")
    return commands


def warn_at_chance(
    output: Path,
    module: Objective,
    config: PretrainConfig,
    rows: list[dict[str, float]],
    n_eval: int,
    preprocessing: dict[str, Any],
) -> None:
    """Warn of an encoder that has learned nothing: it looks like any other file.

    :param output: the encoder file
    :param module: the trained objective
    :param config: the settings
    :param rows: of the log
    :param n_eval: transitions of the eval split
    :param preprocessing: of the dataset
    """
    name = "eval/accuracy" if config.eval_fraction else "train/accuracy"
    accuracy = rows[-1].get(name) if rows else None
    batch_size, n = config.batch_size, config.batch_size * N_EVAL_BATCHES
    if config.eval_fraction:
        batch_size, n = min(batch_size, n_eval), min(n, n_eval)
    chance = module.chance_accuracy(batch_size)
    if accuracy is None or chance is None:
        return
    # Three standard errors of the share of right guesses.
    if accuracy <= chance + max(0.005, 3 * math.sqrt(chance * (1 - chance) / n)):
        warnings.warn(
            f"{output}: {name} ended at {accuracy:.3g}, no better than guessing ({chance:.3g}), so the encoder has "
            f"learned nothing of its objective; {advice(module, preprocessing)}",
            stacklevel=2,
        )


def advice(module: Objective, preprocessing: dict[str, Any]) -> str:
    """What to try where nothing was learned, as part of a message.

    That one frame cannot tell the action is not seen in the data by cheaper means than by learning to tell it.

    :param module: the trained objective
    :param preprocessing: of the dataset
    """
    settings, words = module.remedies(), "try more updates or another seed"
    if settings:
        words += f", or -params {' '.join(settings)} (each with base. in front, for the base of another encoder)"
    if preprocessing.get("frame_stack", 1) == 1:
        words += (
            ". One frame may not tell the action, as where actions change velocities: then collect again with "
            "--frame-stack 4"
        )
    return words
