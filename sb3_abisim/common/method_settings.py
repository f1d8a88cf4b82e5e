"""The settings that a method's YAML file has for an environment."""

from pathlib import Path
from typing import Any

from sb3_abisim.common.paths import resource_path
from sb3_abisim.common.yaml_text import read_yaml_file
from sb3_abisim.registry import get_method


def settings_entry(method: str, env_id: str | None) -> tuple[str | None, dict[str, Any]]:
    """What a method's file says of an environment; without a file, nothing.

    :param method: a registered name
    :param env_id: key in the file; an id that is not there, or None, gets the entry ``default``
    :return: the key of the entry, None where there is none, and a copy of the entry
    :raises ValueError: for an unknown method
    """
    custom = get_method(method).hyperparams
    path = resource_path("hyperparams") / "pretrain" / f"{method}.yml" if custom is None else Path(custom)
    entries = read_yaml_file(path) if custom is not None or path.is_file() else {}
    for key in (env_id, "default"):
        if key in entries:
            return key, dict(entries[key])
    return None, {}
