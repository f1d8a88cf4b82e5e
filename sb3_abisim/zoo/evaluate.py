"""Evaluate the final model of a zoo run: ``sb3-abisim benchmark evaluate RUN_FOLDER``.

The zoo evaluates during training, deterministically, on one split of the clips. This evaluates the model that training
ended with, deterministically and stochastically, and on every split: in the Distractor environments on clips that
training never showed ("eval"), on those that it showed ("train") and without any ("clean"). Every model is evaluated in
the same mazes. Wrappers, stacks and the frozen encoder are those of the run.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.files import check_output, write_atomic
from sb3_abisim.registry import get_traits
from sb3_abisim.zoo.run_envs import final_model, make_run_env, split_kwargs
from sb3_abisim.zoo.run_files import hash_again
from sb3_abisim.zoo.runs import Run, read_run

FILE_NAME = "final_evaluations.npz"
MODES = ("deterministic", "stochastic")
N_ENVS = 16
# Far from the small seeds of training.
SEED = 1_000_000


def evaluate_final(folder: str | Path, n_episodes: int = 100, trust: bool = False) -> Path:
    """Evaluate the last model of a run and write ``final_evaluations.npz`` into its folder.

    The file holds, for each mode and split (``standard`` where there are no splits), ``<mode>/<split>/results``,
    ``/ep_lengths`` and ``/successes``, each of shape (n_episodes,).

    :param folder: of a zoo run that has ended
    :param n_episodes: of each mode on each split
    :param trust: see :func:`~sb3_abisim.zoo.models.load_model`
    :return: the file
    :raises ValueError: if the folder holds no finished run, or ``n_episodes`` is below 1
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be at least 1, got {n_episodes}")
    # An evaluation that was killed may have left half of what belongs together.
    run = read_run(folder, remade=[FILE_NAME])
    path = run.folder / FILE_NAME
    check_output(path)
    model = final_model(run, trust)
    arrays: dict[str, NDArray[Any]] = {}
    for split in get_traits(run.env_id).splits or (None,):
        env_kwargs = split_kwargs(run.env_id, run.env_kwargs, split)
        for mode in MODES:
            values = _episodes(model, run, env_kwargs, n_episodes, mode == MODES[0])
            arrays |= {f"{mode}/{split or 'standard'}/{name}": array for name, array in values.items()}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    write_atomic(path, lambda file: file.write(buffer.getvalue()))
    hash_again(run.folder)
    return path


def _episodes(
    model: Any, run: Run, env_kwargs: dict[str, Any], n_episodes: int, deterministic: bool
) -> dict[str, NDArray[Any]]:
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.utils import set_random_seed

    successes: list[bool] = []

    def note(scope: dict[str, Any], _: dict[str, Any]) -> None:
        if scope["done"]:
            successes.append(bool(scope["info"].get("is_success", False)))

    env = make_run_env(run, model, min(N_ENVS, n_episodes), env_kwargs, SEED)
    set_random_seed(SEED)
    try:
        returns, lengths = evaluate_policy(
            model, env, n_episodes, deterministic=deterministic, callback=note, return_episode_rewards=True
        )
    finally:
        env.close()
    if not np.isfinite(returns).all():
        raise FloatingPointError(
            f"an episode of {run.folder} has a return of NaN or infinity; mend the rewards of {run.env_id}"
        )
    return {"results": np.array(returns), "ep_lengths": np.array(lengths), "successes": np.array(successes)}
