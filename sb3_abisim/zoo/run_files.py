"""The files of a run folder: YAML without executing its tags, curves, and the episodes of training."""

import csv
import dataclasses
import glob
import json
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sb3_abisim.common.arrays import read_npz
from sb3_abisim.common.files import find
from sb3_abisim.common.hashes import HASHES_NAME, write_hashes
from sb3_abisim.common.yaml_text import read_yaml_file

# The training episodes of an exported run, averaged: see Run.training.
TRAINING_CURVE = "training.npz"
# The means of VecNormalize, in <Env>/ of a run's folder.
MEANS_NAME = "vecnormalize.pkl"
# Whatever a report or a rebuilt model depends on; beside them, a run's folder has models and logs.
_RESULTS = (
    "*.monitor.csv", "evaluations.npz", "final_evaluations.npz", TRAINING_CURVE, "*/args.yml", "*/config.yml",
    "*/method.json", "*/command.txt",
)  # fmt: skip


class RunLoader(yaml.SafeLoader):
    """The zoo writes ``!!python`` tags; the three below are data, all others are refused."""


RunLoader.add_constructor(
    "tag:yaml.org,2002:python/object/apply:collections.OrderedDict",
    lambda loader, node: OrderedDict(*loader.construct_sequence(node, deep=True)),  # type: ignore[arg-type]
)
# Of a class or function, its name.
RunLoader.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda loader, suffix, node: suffix)
RunLoader.add_constructor(
    "tag:yaml.org,2002:python/tuple",
    lambda loader, node: tuple(loader.construct_sequence(node, deep=True)),  # type: ignore[arg-type]
)


class NoEpisodesError(ValueError):
    """No episode of training has ended."""


@dataclasses.dataclass(frozen=True)
class Curve:
    """Returns over the course of a run.

    :param steps: environment steps, rising, shape (n,)
    :param returns: mean return at each, shape (n,)
    :param successes: share of successful episodes at each, shape (n,); None where the run does not say
    """

    steps: NDArray[np.int64]
    returns: NDArray[np.float64]
    successes: NDArray[np.float64] | None


def result_names(folder: Path) -> list[str]:
    """The files of a run folder that have hashes, relative to it.

    :param folder: of a run
    """
    found = {path for pattern in _RESULTS for path in find(folder, pattern)}
    return sorted(path.relative_to(folder).as_posix() for path in found)


def hash_run(folder: Path) -> None:
    """Write the hashes of a run that has ended; a changed bit in its results is found from then on.

    :param folder: of a run
    """
    # A report needs no means, so that a folder without their hash is read, too.
    means = [path.relative_to(folder).as_posix() for path in find(folder, f"*/{MEANS_NAME}")]
    write_hashes(folder, [*result_names(folder), *means])


def hash_again(folder: Path) -> None:
    """The same after a result was added to a run that has hashes; one without stays so.

    :param folder: of a run, which was read before the result was added
    """
    if (folder / HASHES_NAME).is_file():
        hash_run(folder)


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file of rl-zoo3 as data; its Python objects become names.

    :param path: ``args.yml`` or ``config.yml``
    :raises ValueError: if it cannot be read
    """
    content = read_yaml_file(path, RunLoader) if path.is_file() else None
    if not isinstance(content, dict):
        what = f"it holds a {type(content).__name__}" if path.is_file() else "it is not there"
        raise ValueError(f"cannot read {path} ({what}); was it written by rl_zoo3.train?")
    return dict(content)


def read_curve(path: Path) -> Curve:
    """A curve from arrays as the zoo's EvalCallback writes them.

    :param path: an npz file with ``timesteps`` (n,), ``results`` (n, n_episodes) and, if known, ``successes`` alike
    :raises ValueError: if it cannot be read, or returns are not finite
    """
    arrays = read_npz(path)
    try:
        steps, returns, successes = arrays["timesteps"], arrays["results"], arrays.get("successes")
        tables = [returns] if successes is None else [returns, successes]
        if steps.ndim != 1 or not len(steps) or any(a.ndim != 2 or len(a) != len(steps) or not a.size for a in tables):
            raise ValueError(f"its arrays do not fit together: {[a.shape for a in (steps, *tables)]}")
        if any(array.dtype.kind not in "iufb" for array in (steps, *tables)):
            raise ValueError("its arrays are no numbers")
        if steps[0] < 0 or not (np.diff(steps.astype(np.float64)) > 0).all() or not steps[-1] < 2**53:
            raise ValueError("its steps do not rise")
        if successes is not None and not ((successes >= 0) & (successes <= 1)).all():
            raise ValueError("its successes are not between 0 and 1")
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is damaged or being written ({error}); try again, or leave the run out") from error
    require_finite(path, returns)
    return Curve(steps.astype(np.int64), returns.mean(axis=1), None if successes is None else successes.mean(axis=1))


def require_finite(path: Path, returns: NDArray[Any]) -> None:
    """Refuse returns that no mean can be taken of.

    :param path: where they are from, for the message
    :param returns: of any shape
    :raises ValueError: if one is NaN or infinite
    """
    n = int((~np.isfinite(returns)).sum())
    if n:
        raise ValueError(
            f"{path} holds {n} returns of {returns.size} that are NaN or infinite; mend the rewards and train again or "
            "leave the run out"
        )


def read_final(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays as ``final_evaluations.npz`` holds them.

    :param path: the file
    :return: ``<mode>/<split>/results`` and so on, each of shape (n_episodes,)
    :raises ValueError: if it cannot be read, or returns are not finite
    """
    arrays = read_npz(path)
    for name, array in arrays.items():
        if array.ndim != 1 or not len(array) or array.dtype.kind not in "iufb" or name.count("/") != 2:
            raise ValueError(f"{path} is damaged: {name!r} is {array.dtype} {array.shape}; evaluate the run again")
        if name.endswith("/results"):
            require_finite(path, array)
    return arrays


def read_episodes(folder: Path) -> Any:
    """The episodes of training in the order of their ends, as Stable-Baselines3 reads them.

    :param folder: of a run, with ``*.monitor.csv``
    :return: a table with the columns of the files
    :raises ValueError: for a damaged file, or rewards that are not finite
    :raises NoEpisodesError: if none has ended
    """
    from stable_baselines3.common.monitor import load_results

    for path in find(folder, "*.monitor.csv"):
        _check_monitor(path)
    episodes = load_results(glob.escape(str(folder)))
    if not len(episodes):
        raise NoEpisodesError(f"no episode of {folder} has ended yet; try again later, or leave the run out")
    return episodes


def _check_monitor(path: Path) -> None:
    """Refuse what pandas would guess at."""
    line = 1
    try:
        with open(path, encoding="utf-8", newline="") as file:
            first = file.readline()
            if not first.startswith("#") or not isinstance(json.loads(first[1:])["t_start"], int | float):
                raise ValueError("no start time")
            rows = csv.DictReader(file, strict=True)
            if not {"r", "l", "t"} <= set(rows.fieldnames or ()):
                raise ValueError("no columns r, l and t")
            for row in rows:
                line = rows.line_num + 1
                if None in row or None in row.values():
                    raise ValueError("a row has another number of fields than the header")
                if int(row["l"]) < 1 or not np.isfinite([float(row["r"]), float(row["t"])]).all():
                    raise ValueError(f"an episode of length {row['l']} with return {row['r']}")
                if row.get("is_success", "True") not in _BOOLEANS:
                    raise ValueError(f"is_success {row['is_success']!r}")
    except (ValueError, KeyError, TypeError, csv.Error, RecursionError) as error:
        raise ValueError(
            f"{path} is damaged, being written or has NaN rewards (line {line}: {error}); try again, or leave it out"
        ) from error


_BOOLEANS = {"True", "False", "0", "1", "0.0", "1.0", ""}
