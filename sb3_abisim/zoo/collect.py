"""``sb3-abisim collect`` with what the zoo puts between an environment and the algorithm.

The zoo's YAML entry of an id (this package's, else rl-zoo3's own, or that of ``--conf-file``) gives ``env_wrapper``,
``frame_stack`` and ``env_kwargs``, so that an encoder is pretrained on what ``sb3-abisim train`` shows it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_abisim.data import collect
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.registry import get_traits
from sb3_abisim.zoo.methods import PREPROCESSING_KEYS, hyperparameters_entry, normalizes_observations, read_entries


def preprocessing_entry(env_id: str, conf_file: str | None = None) -> dict[str, Any]:
    """What stands between an environment and the algorithm in the zoo's entry of its id.

    :param env_id: any id
    :param conf_file: a YAML file of the zoo's form; None for this package's and rl-zoo3's own
    :return: ``env_wrapper``, ``frame_stack`` and ``env_kwargs``, those that are given
    :raises ValueError: if the file has no entry of this id, or normalizes observations
    """
    if conf_file is not None:
        entries = read_entries(Path(conf_file))
        if env_id not in entries:
            raise ValueError(f"--conf-file {conf_file} has no entry {env_id}, only {', '.join(entries) or 'none'}")
        entry = entries[env_id]
    elif env_id in ENV_IDS:
        # Their arguments of collection are those of the command line.
        return {}
    else:
        entry = hyperparameters_entry(get_traits(env_id).algo, env_id)
    # rl-zoo3's default entries normalize vectors; what shows images has no use for it, and says so at training.
    if conf_file is not None and normalizes_observations(entry.get("normalize")):
        raise ValueError(
            f"--conf-file {conf_file} normalizes the observations of {env_id}, which would no longer be uint8 images; "
            'give normalize: "dict(norm_obs=False, norm_reward=True)"'
        )
    keys = {*PREPROCESSING_KEYS, "env_kwargs"} - {"normalize"}
    return {key: entry[key] for key in sorted(keys) if entry.get(key)}


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its arguments; None for those of the process
    """
    collect.main(argv, preprocessing_entry)
