"""For ``sb3-abisim collect``: what the zoo puts between an environment and the algorithm.

The zoo's YAML entry of an id (this package's, else rl-zoo3's own, or that of ``--conf-file``) gives ``env_wrapper``,
``frame_stack`` and ``env_kwargs``, so that an encoder is pretrained on what ``sb3-abisim train`` shows it. With
``--policy`` the model of a run acts.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.files import file_hash
from sb3_abisim.data.rollout import Policy
from sb3_abisim.networks.encoder_file import RUN_COPY
from sb3_abisim.registry import get_traits
from sb3_abisim.rl.merge import merge_encoder
from sb3_abisim.rl.vec_encode import EncodedBox
from sb3_abisim.zoo.entries import hyperparameters_entry, read_entries
from sb3_abisim.zoo.models import load_model
from sb3_abisim.zoo.preprocessing import PREPROCESSING_KEYS, normalizes_observations, other_vec_wrappers
from sb3_abisim.zoo.run_envs import saved_means
from sb3_abisim.zoo.runs import read_run


def preprocessing_entry(env_id: str, conf_file: str | None = None) -> dict[str, Any]:
    """What stands between an environment and the algorithm in the zoo's entry of its id.

    :param env_id: any id
    :param conf_file: a YAML file of the zoo's form; None for this package's and rl-zoo3's own
    :return: ``env_wrapper``, ``frame_stack`` and ``env_kwargs``, those that are given
    :raises ValueError: if the file has no entry of this id, or normalizes observations, or the entry has a
        ``vec_env_wrapper``
    """
    if conf_file is not None:
        entries = read_entries(Path(conf_file))
        if env_id not in entries:
            raise ValueError(f"--conf-file {conf_file} has no entry {env_id}, only {', '.join(entries) or 'none'}")
        entry = entries[env_id]
    else:
        entry = hyperparameters_entry(get_traits(env_id).algo, env_id)
    # rl-zoo3's default entries normalize vectors; what shows images has no use for it, and says so at training.
    if conf_file is not None and normalizes_observations(entry.get("normalize")):
        raise ValueError(
            f"--conf-file {conf_file} normalizes the observations of {env_id}, which would no longer be uint8 images; "
            'give normalize: "dict(norm_obs=False, norm_reward=True)"'
        )
    others = other_vec_wrappers(entry)
    if others:
        raise ValueError(
            f"the entry of {env_id} has the vec_env_wrapper {', '.join(others)}, and data is collected without such; "
            "give what it does as env_wrapper, or leave it out of a --conf-file of yours"
        )
    keys = {*PREPROCESSING_KEYS, "env_kwargs"} - {"normalize"}
    return {key: entry[key] for key in sorted(keys) if entry.get(key)}


def model_policy(name: str, epsilon: float, trust: bool = False) -> Policy:
    """A trained model's deterministic actions.

    :param name: folder of a zoo run, whose final model acts, or a model's ``.zip`` in it
    :param epsilon: see :class:`~sb3_abisim.data.rollout.Policy`
    :param trust: see :func:`~sb3_abisim.zoo.models.load_model`
    :raises ValueError: if it is none, or was trained on something else than observations
    """
    path = Path(name)
    if not path.exists():
        raise ValueError(f"--policy: there is no {path}; give a run's folder, or a .zip in it")
    run = read_run(path if path.is_dir() else path.parent)
    means = saved_means(run)
    if means is not None and run.settings.get("frame_stack"):
        raise ValueError(
            f"{run.folder} was trained on stacks of normalized observations, which are not made here; give a run "
            "without one of the two"
        )
    path = run.folder / f"{run.env_name}.zip" if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"--policy: there is no model {path}; give a run's folder, or a .zip in it")
    model: Any = load_model(path, run, trust)
    if isinstance(model.observation_space, EncodedBox):
        # Trained on embeddings.
        model = merge_encoder(model, str(run.folder / run.env_name / RUN_COPY))
    space = model.observation_space
    if means is not None and means.observation_space.shape != space.shape:
        raise ValueError(
            f"{run.folder} has means of observations {means.observation_space.shape}, and its model takes "
            f"{space.shape}; copy the run again, or give one whose observations have their channels first"
        )

    def act(observations: NDArray[np.uint8]) -> NDArray[Any]:
        if observations.shape[1:] != space.shape:
            raise ValueError(
                f"{path} takes observations {space.shape}, and the dataset's are {observations.shape[1:]}; give its "
                "environment, --env-wrapper and --frame-stack"
            )
        seen: Any = observations if means is None else means.normalize_obs(observations)
        actions: NDArray[Any] = model.predict(seen, deterministic=True)[0]
        return actions

    return Policy(act, f"{run.algo} {file_hash(path)[:16]}", epsilon, model.action_space)
