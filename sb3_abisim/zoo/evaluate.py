"""Evaluate the final model of a zoo run: ``sb3-abisim benchmark evaluate RUN_FOLDER``.

The zoo evaluates during training, deterministically, on one split of the clips. This evaluates the model that training
ended with, deterministically and stochastically, and on every split: in the Distractor environments on clips that
training never showed ("eval"), on those that it showed ("train") and without any ("clean"). Every model is evaluated in
the same mazes.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_abisim.common.files import write_atomic
from sb3_abisim.networks.encoder_file import RUN_COPY, load_encoder
from sb3_abisim.registry import get_traits
from sb3_abisim.rl.merge import merge_encoder
from sb3_abisim.rl.vec_encode import EncodedBox, VecEncodeObservations
from sb3_abisim.zoo.methods import normalizes_observations
from sb3_abisim.zoo.runs import Run, read_run

FILE_NAME = "final_evaluations.npz"
MODES = ("deterministic", "stochastic")
N_ENVS = 16
# Far from the small seeds of training.
SEED = 1_000_000


def evaluate_final(folder: str | Path, n_episodes: int = 100) -> Path:
    """Evaluate the last model of a run and write ``final_evaluations.npz`` into its folder.

    The file holds, for each mode and split (``standard`` where there are no splits), ``<mode>/<split>/results``,
    ``/ep_lengths`` and ``/successes``, each of shape (n_episodes,).

    :param folder: of a zoo run that has ended
    :param n_episodes: of each mode on each split
    :return: the file
    :raises ValueError: if the folder holds no finished run, or ``n_episodes`` is below 1
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be at least 1, got {n_episodes}")
    run = read_run(folder)
    model = final_model(run)
    arrays: dict[str, NDArray[Any]] = {}
    for split in get_traits(run.env_id).splits or (None,):
        for mode in MODES:
            values = _episodes(
                model, run.env_id, split_kwargs(run.env_id, run.env_kwargs, split), n_episodes, mode == MODES[0]
            )
            arrays |= {f"{mode}/{split or 'standard'}/{name}": array for name, array in values.items()}
    path = run.folder / FILE_NAME
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    write_atomic(path, lambda file: file.write(buffer.getvalue()))
    return path


def final_model(run: Run) -> BaseAlgorithm:
    """The model that a run ended with, on the CPU; it acts on observations, whatever it was trained on.

    :param run: a zoo run
    :raises ValueError: if the run has not ended, if its environment is not registered, or if it had wrappers around it
        that are not there here
    """
    import gymnasium as gym
    from rl_zoo3.utils import ALGOS

    try:
        gym.spec(run.env_id)
    except gym.error.Error as error:
        raise ValueError(
            f"{run.folder} was trained in {run.env_id}, which is not registered here; give the module that "
            "registers it with --packages"
        ) from error
    missing = not_rebuilt(run.settings)
    if missing:
        raise ValueError(
            f"{run.folder} was trained with {', '.join(missing)}, which is not rebuilt here; look at it with "
            "sb3-abisim enjoy"
        )
    path = run.folder / f"{run.env_name}.zip"
    if not path.is_file():
        raise ValueError(f"{run.folder} holds no final model ({path.name}); let the run end first")
    model: BaseAlgorithm = ALGOS[run.algo].load(path, device="cpu")
    if isinstance(model.observation_space, EncodedBox):
        # Trained on embeddings, and the environments here give observations.
        copy = run.folder / run.env_name / RUN_COPY
        if copy.is_file() and load_encoder(copy).metadata["preprocessing"].get("frame_stack", 1) > 1:
            raise ValueError(
                f"{run.folder} was trained on a frozen encoder of stacked observations, which are not stacked here; "
                "look at it with sb3-abisim enjoy"
            )
        model = merge_encoder(model, str(copy))
    return model


def not_rebuilt(settings: Mapping[str, Any]) -> list[str]:
    """The wrappers that a model was trained with, and that the environments here are made without.

    :param settings: of the zoo
    :return: names of wrappers; empty where the final evaluation is as training was
    """
    found = [name for name in ("env_wrapper", "frame_stack") if settings.get(name)]
    # Normalized rewards change nothing of what a model sees.
    found += ["normalize"] if normalizes_observations(settings.get("normalize")) else []
    wrappers = settings.get("vec_env_wrapper") or []
    for wrapper in wrappers if isinstance(wrappers, list) else [wrappers]:
        name = next(iter(wrapper)) if isinstance(wrapper, dict) else str(wrapper)
        found += [name] if name.rpartition(".")[2] != VecEncodeObservations.__name__ else []
    return found


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


def _episodes(
    model: Any, env_id: str, env_kwargs: dict[str, Any], n_episodes: int, deterministic: bool
) -> dict[str, NDArray[Any]]:
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.utils import set_random_seed

    successes: list[bool] = []

    def note(scope: dict[str, Any], _: dict[str, Any]) -> None:
        if scope["done"]:
            successes.append(bool(scope["info"].get("is_success", False)))

    env = make_vec_env(env_id, min(N_ENVS, n_episodes), seed=SEED, env_kwargs=env_kwargs)
    set_random_seed(SEED)
    try:
        returns, lengths = evaluate_policy(
            model, env, n_episodes, deterministic=deterministic, callback=note, return_episode_rewards=True
        )
    finally:
        env.close()
    return {"results": np.array(returns), "ep_lengths": np.array(lengths), "successes": np.array(successes)}
