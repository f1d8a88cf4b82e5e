"""The model card: what a reader wants to know of an encoder."""

import json
import shlex
from typing import Any

from sb3_abisim.pretraining.config import PretrainConfig


def reproducing_commands(settings: dict[str, Any], config: PretrainConfig, meta: dict[str, Any]) -> list[str]:
    """The commands that make an encoder again, with DATA, BASE and FILE for the paths.

    :param settings: of the run, with objective and seed
    :param config: its settings by name
    :param meta: of its dataset
    """
    commands = []
    # Data that was imported has no command that would collect it again.
    if meta["n_envs"] is not None:
        collect = ["--env", meta["env_id"], "-n", str(meta["n_transitions"]), "--seed", str(meta["seed"])]
        collect += ["--n-envs", str(meta["n_envs"]), "-o", "DATA"]
        if meta["env_kwargs"]:
            collect += ["--env-kwargs", *(f"{name}:{value!r}" for name, value in meta["env_kwargs"].items())]
        commands.append(f"sb3-abisim collect {shlex.join(collect)}")
    words = ["--objective", settings["objective"], "--env", meta["env_id"], "--seed", str(settings["seed"])]
    words += ["--data", "DATA", "-o", "FILE"] + (["--base", "BASE"] if "base_hash" in settings else [])
    words += ["-params", *(f"{name}:{json.dumps(value)}" for name, value in config.as_settings().items())]
    commands.append(f"sb3-abisim pretrain {shlex.join(words)}")
    return commands
