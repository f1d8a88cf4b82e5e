"""Arguments of a wrong type, refused by name where they are given; the annotations say what is right."""

import collections.abc
import functools
import inspect
import os
import types
import typing
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np

_P = ParamSpec("_P")
_R = TypeVar("_R")
_LONGEST = 200  # characters of a value in a message
# How each plain type is called, and what counts as one. True is no number here, though Python's bool is an int.
_PLAIN: dict[Any, tuple[str, tuple[type, ...]]] = {
    bool: ("True or False", (bool, np.bool_)),
    int: ("a whole number", (int, np.integer)),
    float: ("a number", (int, float, np.integer, np.floating)),
    str: ("a text", (str,)),
    type(None): ("None", (type(None),)),
    os.PathLike: ("a path", (os.PathLike,)),
}


def checked_arguments(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Make a function or a constructor check its arguments against its annotations.

    What an annotation says beyond plain types, unions, sequences, mappings and classes is not checked.

    :param function: annotated; a ValueError of it then names an argument that is unknown, missing or of a wrong type
    """
    signature = inspect.signature(function)
    named = [p.name for p in signature.parameters.values() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    open_ended = any(p.kind is p.VAR_KEYWORD for p in signature.parameters.values())
    is_method = named[:1] == ["self"]

    @functools.wraps(function)
    def checked(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        called = type(args[0]).__name__ if is_method else function.__name__
        if not open_ended and (unknown := [name for name in kwargs if name not in named]):
            known = ", ".join(name for name in named if name != "self")
            raise ValueError(f"{called} takes no argument {unknown[0]!r}; it takes {known}")
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise ValueError(f"{called}: {error}") from error
        hints = _hints(function)
        for name in named:
            if name in given and not fits(given[name], hints.get(name, Any)):
                shown = repr(given[name])
                shown = shown if len(shown) <= _LONGEST else shown[:_LONGEST] + "..."
                raise ValueError(f"{name} must be {described(hints[name])}, got {shown}")
        return function(*args, **kwargs)

    return checked


@functools.cache
def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    try:
        return typing.get_type_hints(function)
    except (NameError, TypeError):  # annotations for type checkers alone
        return {}


def fits(value: Any, hint: Any) -> bool:
    """Whether a value is of an annotated type.

    :param value: anything
    :param hint: an annotation; of another kind than those of :func:`checked_arguments`, everything fits
    """
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, each) for each in inner)
    if hint is None or origin in _PLAIN:
        kinds = _PLAIN[type(None) if hint is None else origin][1]
        return isinstance(value, kinds) and (bool in kinds or not isinstance(value, bool))
    if origin is typing.Literal:
        return any(value is each or (type(value) is type(each) and value == each) for each in inner)
    if hint is Any or not isinstance(origin, type):
        return True
    if issubclass(origin, collections.abc.Mapping):
        keys, values = inner or (Any, Any)
        return isinstance(value, origin) and all(fits(k, keys) and fits(v, values) for k, v in value.items())
    if issubclass(origin, collections.abc.Sequence):
        alike = isinstance(value, origin) and not isinstance(value, str | bytes)
        return alike and (len(inner) != 1 or all(fits(each, inner[0]) for each in value))
    return isinstance(value, origin)


def described(hint: Any) -> str:
    """An annotation in words.

    :param hint: see :func:`fits`
    """
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        words = list(dict.fromkeys(map(described, inner)))
        return f"{', '.join(words[:-1])} or {words[-1]}"
    if hint is None or origin in _PLAIN:
        return _PLAIN[type(None) if hint is None else origin][0]
    if origin is typing.Literal:
        return " or ".join(map(repr, inner))
    if isinstance(origin, type) and issubclass(origin, collections.abc.Mapping):
        return "a mapping"
    if isinstance(origin, type) and issubclass(origin, collections.abc.Sequence):
        return f"a list ({described(inner[0])} each)" if len(inner) == 1 else "a list"
    return f"a {getattr(origin, '__name__', origin)}"
