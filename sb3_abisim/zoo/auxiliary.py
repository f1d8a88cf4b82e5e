"""The auxiliary objective of a run: as a word of the command, as a callback of a zoo entry, and back."""

import inspect
import json
import re
from collections.abc import Mapping
from typing import Any

from sb3_abisim.common.cli import parse_pairs
from sb3_abisim.rl.auxiliary import AuxiliaryObjective
from sb3_abisim.zoo.preprocessing import class_name, items

AUXILIARY_CALLBACK = "sb3_abisim.AuxiliaryObjective"
GRAMMAR = "OBJECTIVE[:NAME=VALUE...]"
# Arguments whose entries are set one by one.
_NESTED = ("objective_kwargs", "base_kwargs")


def parse_auxiliary(text: str) -> dict[str, Any]:
    """Read ``OBJECTIVE[:NAME=VALUE...]``.

    :param text: e.g. "ssi", "abisim:weight=0.5" or "abisim:weight=0.5:objective_kwargs.c=0.9"
    :return: arguments of :class:`~sb3_abisim.rl.auxiliary.AuxiliaryObjective`
    :raises ValueError: for anything else
    """
    objective, *settings = re.split(r":(?=[^:=]*=)", text)
    words = [setting.replace("=", ":", 1) for setting in settings]
    kwargs: dict[str, Any] = {"objective": objective}
    known = [name for name in inspect.signature(AuxiliaryObjective).parameters if name != "objective"]
    for name, value in parse_pairs(words, f"--auxiliary {text}: {GRAMMAR}").items():
        outer, dot, inner = name.partition(".")
        if outer not in known or (outer in _NESTED) != bool(dot):
            shown = ", ".join(f"{each}.NAME" if each in _NESTED else each for each in known)
            raise ValueError(f"--auxiliary {text}: unknown setting {name}; known are {shown}")
        if dot:
            kwargs.setdefault(outer, {})[inner] = value
        else:
            kwargs[name] = value
    # Its arguments are checked now, not when training starts.
    AuxiliaryObjective(**kwargs)
    return kwargs


def auxiliary_text(kwargs: Mapping[str, Any]) -> str:
    """The inverse of :func:`parse_auxiliary`.

    :param kwargs: arguments of :class:`~sb3_abisim.rl.auxiliary.AuxiliaryObjective`
    """
    settings = {name: value for name, value in kwargs.items() if name != "objective" and name not in _NESTED}
    for outer in _NESTED:
        settings |= {f"{outer}.{name}": value for name, value in (kwargs.get(outer) or {}).items()}
    words = [f":{name}={_text(value)}" for name, value in sorted(settings.items())]
    return str(kwargs.get("objective", "ssi")) + "".join(words)


def _text(value: Any) -> str:
    return value if isinstance(value, str) and value.isidentifier() else json.dumps(value, separators=(",", ":"))


def auxiliary_of(hyperparams: Mapping[str, Any]) -> str | None:
    """The auxiliary objective among an entry's callbacks, as a word; None where there is none.

    :param hyperparams: of a zoo entry
    """
    for item in items(hyperparams.get("callback")):
        if class_name(item) == AUXILIARY_CALLBACK.rpartition(".")[2]:
            return auxiliary_text(next(iter(item.values())) or {} if isinstance(item, Mapping) else {})
    return None


def with_auxiliary(callback: Any, text: str) -> list[Any]:
    """An entry's callbacks with this auxiliary objective in place of another one.

    :param callback: of a zoo entry
    :param text: see :func:`parse_auxiliary`
    """
    name = AUXILIARY_CALLBACK.rpartition(".")[2]
    others = [item for item in items(callback) if class_name(item) != name]
    return [*others, {AUXILIARY_CALLBACK: parse_auxiliary(text)}]
