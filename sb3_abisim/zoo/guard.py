"""rl-zoo3's commands that act with a saved model, with readers of run folders that execute nothing.

``enjoy`` and ``record_video`` read YAML whose tags call anything, evaluate texts in it, import what it names, and
unpickle the model and the means of ``VecNormalize``. :func:`guarded` puts our readers in their place.
"""

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import yaml
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_abisim.zoo.models import load_model, read_model_run
from sb3_abisim.zoo.named import read_text
from sb3_abisim.zoo.preprocessing import items, wrapper_classes
from sb3_abisim.zoo.run_files import RunLoader, read_yaml
from sb3_abisim.zoo.runs import read_run
from sb3_abisim.zoo.saved_spaces import read_vec_normalize

GUARDED = ("enjoy", "record_video")


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Within it, rl-zoo3 executes nothing that a run folder holds."""
    zoo, utils = importlib.import_module("rl_zoo3"), importlib.import_module("rl_zoo3.utils")
    models = {name: _Models() for name in utils.ALGOS}
    with contextlib.ExitStack() as stack:
        for module in (zoo, utils):
            stack.enter_context(mock.patch.object(module, "ALGOS", models))
            stack.enter_context(mock.patch.object(module, "get_saved_hyperparams", saved_hyperparams))
        stack.enter_context(mock.patch.object(utils, "VecNormalize", _Normalizers))
        stack.enter_context(mock.patch.object(yaml, "UnsafeLoader", RunLoader))
        yield


class _Models:
    """In place of an algorithm."""

    def load(self, path: str, **_: Any) -> Any:
        """A saved model; its run says how to build it.

        :param path: the zip
        """
        return load_model(Path(path), read_model_run(Path(path)))


class _Normalizers:
    """In place of ``VecNormalize``."""

    @staticmethod
    def load(path: str, venv: VecEnv) -> VecNormalize:
        """The saved means around an environment.

        :param path: of a run
        :param venv: the environment
        """
        normalize = read_vec_normalize(Path(path))
        normalize.set_venv(venv)
        return normalize


def saved_hyperparams(
    stats_path: str, norm_reward: bool = False, test_mode: bool = False
) -> tuple[dict[str, Any], str | None]:
    """As ``rl_zoo3.utils.get_saved_hyperparams``, of data alone.

    :param stats_path: the folder of ``config.yml``
    :param norm_reward: of the command
    :param test_mode: of the command
    :return: hyperparameters, with classes for the names of wrappers, and the folder
    :raises ValueError: for what only executing it could tell, or wrappers of packages that nobody has named
    """
    if not Path(stats_path).is_dir():
        return {}, None
    path = Path(stats_path) / "config.yml"
    if not path.is_file():
        raise ValueError(f"{stats_path} holds no config.yml, which says how the run was set up")
    if path.with_name("args.yml").is_file():
        # The command reads it next, and could not say which file lacks what, or has what nobody reads.
        read_run(path.parents[1])
    hyperparams = read_yaml(path)
    for key, kind in (("env_wrapper", gym.Wrapper), ("vec_env_wrapper", VecEnvWrapper)):
        if items(hyperparams.get(key)):
            found = wrapper_classes(hyperparams[key], kind, str(path))
            hyperparams[key] = [{wrapper: kwargs} for wrapper, kwargs in found]
    normalize = hyperparams.setdefault("normalize", False)
    if normalize:
        kwargs = read_text(normalize, str(path)) if isinstance(normalize, str) else normalize
        if not isinstance(kwargs, dict):
            kwargs = {"norm_obs": bool(kwargs), "norm_reward": norm_reward}
        elif test_mode and isinstance(normalize, str):
            kwargs["norm_reward"] = norm_reward
        hyperparams["normalize_kwargs"] = kwargs
    return hyperparams, stats_path
