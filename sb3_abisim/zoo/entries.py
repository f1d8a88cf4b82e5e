"""Entries of a zoo YAML: where the one of an environment is, and what it says."""

import importlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_abisim.common.paths import resource_path
from sb3_abisim.common.yaml_text import read_yaml_file
from sb3_abisim.zoo.preprocessing import class_name, items

ENCODING_WRAPPER = "sb3_abisim.VecEncodeObservations"
ENCODER_CALLBACK = "sb3_abisim.EncoderCallback"
# Of policy_kwargs: what a YAML names by its dotted path.
_CLASS_KEYS = ("features_extractor_class", "optimizer_class", "activation_fn")


def hyperparameters_file(algo: str, env_id: str) -> Path | None:
    """The YAML file of this package with hyperparameters of an algorithm for an environment.

    :param algo: rl-zoo3's name of the algorithm, e.g. "ppo"
    :param env_id: any id
    :return: None for an environment that is in none of the files
    :raises ValueError: when only other algorithms have some, naming these
    """
    files = [path for path in sorted(resource_path("hyperparams").glob("*.yml")) if env_id in read_entries(path)]
    for path in files:
        if path.stem == algo:
            return path
    if not files:
        return None
    known = ", ".join(path.stem for path in files)
    raise ValueError(
        f"sb3_abisim has no hyperparameters of {algo} for {env_id}, only of: {known}; "
        "choose one of these with --algo, or give a custom YAML file with --conf-file"
    )


def hyperparameters_entry(algo: str, env_id: str) -> dict[str, Any]:
    """The hyperparameters of an algorithm for an environment: this package's, else rl-zoo3's own.

    :param algo: rl-zoo3's name of the algorithm
    :param env_id: a registered id
    :raises ValueError: when there are none
    """
    path = hyperparameters_file(algo, env_id)
    if path is not None:
        return dict(read_entries(path)[env_id])
    exp_manager: Any = importlib.import_module("rl_zoo3.exp_manager")
    path = zoo_hyperparams() / f"{algo}.yml"
    entries = read_entries(path) if path.is_file() else {}
    key = "atari" if exp_manager.ExperimentManager.is_atari(env_id) else "default"
    # As there: no default for Atari.
    for name in (env_id, key):
        if name in entries:
            return dict(entries[name])
    raise ValueError(f"rl-zoo3 has no hyperparameters of {algo} for {env_id}; choose another with --algo")


def policy_of(algo: str, policy: str) -> str:
    """The algorithm's policy of a kind, which rl-zoo3's default entry for RecurrentPPO calls as PPO does.

    :param algo: rl-zoo3's name of the algorithm
    :param policy: such as "MlpPolicy", or the dotted path of a custom one
    :return: such as "MlpLstmPolicy"
    :raises ValueError: when there is none
    """
    from rl_zoo3.utils import ALGOS  # type: ignore[import-untyped, unused-ignore]

    known = ALGOS[algo].policy_aliases
    if "." in policy or policy in known:
        return policy
    kind = re.match("Cnn|Mlp|MultiInput", policy)
    found = [name for name in known if kind is not None and name.startswith(kind[0])]
    if len(found) != 1:
        raise ValueError(f"{algo} has no policy {policy!r}, only {', '.join(known)}; choose another with --algo")
    return str(found[0])


def zoo_hyperparams() -> Path:
    """The folder of rl-zoo3's own hyperparameters."""
    module: Any = importlib.import_module("rl_zoo3")
    return Path(module.__file__).parent / "hyperparams"


def read_entries(path: Path) -> dict[str, Any]:
    """The entries of a zoo YAML by environment id; empty for a file of another form.

    :param path: the file
    """
    content = read_yaml_file(path)
    return content if isinstance(content, dict) else {}


def resolve_classes(policy_kwargs: Any) -> Any:
    """Import what ``policy_kwargs`` name by a dotted path, such as ``activation_fn: torch.nn.ReLU``.

    :param policy_kwargs: of a zoo entry, a mapping; anything else is returned as it is
    :return: a new dictionary
    :raises ValueError: for a path that cannot be imported
    """
    if not isinstance(policy_kwargs, Mapping):
        return policy_kwargs
    kwargs = dict(policy_kwargs)
    for key in _CLASS_KEYS:
        if isinstance(kwargs.get(key), str):
            module, _, name = kwargs[key].rpartition(".")
            try:
                kwargs[key] = getattr(importlib.import_module(module), name)
            except (ImportError, AttributeError, ValueError) as error:
                raise ValueError(
                    f"policy_kwargs: cannot import {key} {kwargs[key]!r} ({error}); give its dotted path"
                ) from error
    return kwargs


def encoding_kwargs(hyperparams: Mapping[str, Any]) -> dict[str, Any] | None:
    """The arguments of ``VecEncodeObservations`` in a zoo entry, None where it is not used.

    :param hyperparams: of a zoo entry, or of a run's ``config.yml``
    """
    for wrapper in items(hyperparams.get("vec_env_wrapper")):
        if isinstance(wrapper, dict) and class_name(wrapper) == ENCODING_WRAPPER.rpartition(".")[2]:
            kwargs: dict[str, Any] = next(iter(wrapper.values()))
            return kwargs
    return None


def unfreezes(hyperparams: Mapping[str, Any]) -> bool:
    """Whether the ``EncoderCallback`` of a zoo entry unfreezes a frozen encoder at some step.

    :param hyperparams: of a zoo entry, or of a run's ``config.yml``
    """
    for item in items(hyperparams.get("callback")):
        if isinstance(item, Mapping) and class_name(item) == ENCODER_CALLBACK.rpartition(".")[2]:
            return (next(iter(item.values())) or {}).get("unfreeze_at") is not None
    return False
