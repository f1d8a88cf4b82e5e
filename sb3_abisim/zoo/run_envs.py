"""The final model of a zoo run, and environments as the run had them: wrappers, stacks and the frozen encoder."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecNormalize

from sb3_abisim.networks.encoder_file import RUN_COPY
from sb3_abisim.registry import get_traits
from sb3_abisim.rl.vec_encode import VecEncodeObservations
from sb3_abisim.zoo.models import load_model
from sb3_abisim.zoo.preprocessing import class_name, items, normalizes_observations, recorded_wrapper
from sb3_abisim.zoo.run_files import MEANS_NAME
from sb3_abisim.zoo.runs import Run
from sb3_abisim.zoo.saved_spaces import read_vec_normalize

Wrapper = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]


def final_model(run: Run, trust: bool = False) -> BaseAlgorithm:
    """The model that a run ended with, on the CPU; it acts in the environments of :func:`make_run_env`.

    :param run: a zoo run
    :param trust: see :func:`~sb3_abisim.zoo.models.load_model`
    :raises ValueError: if the run has not ended, if its environment is not registered, or as
        :func:`~sb3_abisim.zoo.models.load_model`
    """
    try:
        gym.spec(run.env_id)
    except gym.error.Error as error:
        raise ValueError(
            f"{run.folder} was trained in {run.env_id}, which is not registered here; give the module that "
            "registers it with --packages"
        ) from error
    path = run.folder / f"{run.env_name}.zip"
    if not path.is_file():
        raise ValueError(f"{run.folder} holds no final model ({path.name}); let the run end first")
    return load_model(path, run, trust)


def make_run_env(
    run: Run,
    model: BaseAlgorithm,
    n_envs: int,
    env_kwargs: dict[str, Any],
    seed: int,
    inner: Wrapper | None = None,
) -> VecEnv:
    """Environments as the zoo made them for a run, in this process.

    :param run: a zoo run
    :param model: of the run, which must have been trained on what these show
    :param n_envs: number of copies
    :param env_kwargs: arguments of each
    :param seed: of the first copy
    :param inner: goes around each environment, under the run's own wrappers
    :raises ValueError: for wrappers of packages that are not imported, means of observations that are not there or
        damaged, or observations that are not those of the model
    """
    where = str(run.folder / run.env_name / "config.yml")
    outer = recorded_wrapper(run.settings.get("env_wrapper"), where=where)

    def wrap(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        for wrapper in (inner, outer):
            env = env if wrapper is None else wrapper(env)
        return env

    env: VecEnv = make_vec_env(run.env_id, n_envs, seed=seed, env_kwargs=env_kwargs, wrapper_class=wrap)
    try:
        for item in items(run.settings.get("vec_env_wrapper")):
            env = _wrap_all(env, item, run, where)
        if (normalize := saved_means(run)) is not None:
            env = _normalized(env, normalize, run)
        if run.settings.get("frame_stack"):
            env = VecFrameStack(env, run.settings["frame_stack"])
        # As at training: images with channels last are put first.
        env = type(model)._wrap_env(env, verbose=0)
        if env.observation_space != model.observation_space:
            raise ValueError(
                f"the model of {run.folder} was trained on {model.observation_space}, but its environment shows "
                f"{env.observation_space} here; install the versions of then, or train again"
            )
    except BaseException:
        env.close()
        raise
    return env


def _wrap_all(env: VecEnv, item: Any, run: Run, where: str) -> VecEnv:
    if class_name(item) == VecEncodeObservations.__name__:
        copy = run.folder / run.env_name / RUN_COPY
        return VecEncodeObservations(env, str(copy), device="cpu")
    wrap = recorded_wrapper(item, VecEnvWrapper, where)
    assert wrap is not None
    wrapped: VecEnv = wrap(env)
    return wrapped


def saved_means(run: Run) -> VecNormalize | None:
    """What normalizes the observations of a run as at the end of its training; rewards stay as they are.

    :param run: a zoo run
    :return: without an environment; None for a run on observations as they are
    :raises ValueError: if the file is not there, or is damaged
    """
    if not normalizes_observations(run.settings.get("normalize")):
        return None
    path = run.folder / run.env_name / MEANS_NAME
    if not path.is_file():
        raise ValueError(f"{run.folder} was trained on normalized observations, and {path} is not there; copy it again")
    means = read_vec_normalize(path)
    if not means.norm_obs:
        raise ValueError(
            f"{run.folder} was trained on normalized observations, and {path} has none; copy the run again"
        )
    means.training, means.norm_reward = False, False
    return means


def _normalized(env: VecEnv, means: VecNormalize, run: Run) -> VecEnv:
    if means.observation_space.shape != env.observation_space.shape:
        raise ValueError(
            f"{run.folder} has means of observations {means.observation_space}, but its environment shows "
            f"{env.observation_space} here; install the versions of then, or train again"
        )
    means.set_venv(env)
    return means


def split_kwargs(env_id: str, env_kwargs: dict[str, Any], split: str | None) -> dict[str, Any]:
    """Arguments of the environment of training, on another split.

    :param env_id: trained in
    :param env_kwargs: of training
    :param split: None for an environment without splits
    """
    if split is None:
        return env_kwargs
    chosen = get_traits(env_id).split_kwargs
    return {**{name: value for name, value in env_kwargs.items() if name not in chosen}, "split": split}
