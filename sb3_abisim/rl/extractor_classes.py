"""The features extractor classes of the registered methods.

They are made when they are asked for, and importable by their names from :mod:`sb3_abisim.rl.extractors`, where pickles
find them.
"""

import copyreg
import functools
import inspect
from typing import Any

from sb3_abisim.registry import Method, get_method, methods
from sb3_abisim.rl import extractors
from sb3_abisim.rl.extractors import BaseEncoderExtractor, PretrainedExtractor, VanillaExtractor


def extractor_class(method: str) -> type[BaseEncoderExtractor]:
    """The features extractor of a method, the same object at every call.

    :param method: a registered name, e.g. "ssi"
    :raises ValueError: for an unknown one
    """
    return _class_of(get_method(method))


def method_of(extractor: type[BaseEncoderExtractor]) -> str | None:
    """The name of the method whose features extractor a class is; None for one that belongs to none.

    :param extractor: the class
    """
    return next((name for name, method in methods().items() if _is_class_of(method, extractor)), None)


def find_extractor_class(name: str, registered_by: str | None = None) -> type[BaseEncoderExtractor]:
    """The features extractor of this name.

    :param name: of the class
    :param registered_by: the module that its method is expected to be registered by, None if that is not known
    :raises ImportError: when no method has one. Not an ``AttributeError``, which ``load`` of SB3 turns into a warning
    """
    for method in methods().values():
        if method.extractor == name:
            return _class_of(method)
    known = ", ".join(method.extractor for method in methods().values())
    remedy = f"import {registered_by}" if registered_by else "import the package that registers its method"
    flag = f"--packages {registered_by}" if registered_by else "--packages"
    raise ImportError(
        f"no method has a features extractor {name!r}, only {known}; {remedy} first ({flag} in a command)"
    )


def _is_class_of(method: Method, extractor: type) -> bool:
    return method.extractor == extractor.__name__ and _class_of(method) is extractor


@functools.cache
def _class_of(method: Method) -> type[BaseEncoderExtractor]:
    parent: type[BaseEncoderExtractor] = PretrainedExtractor if method.has_encoder_file else VanillaExtractor
    if method.extractor == parent.__name__:
        return parent
    attributes: dict[str, Any] = {"__module__": extractors.__name__, "default_augment": method.augment}
    summary = f"The network without pretraining, for the method ``{method.name}``"
    if method.has_encoder_file:
        attributes["objective"] = method.name
        summary = f"An encoder pretrained by {method.label} (``--objective {method.name}``)"
        if method.trained_elsewhere:
            summary = "An encoder trained elsewhere (:func:`~sb3_abisim.networks.from_module.from_module`)"
    _, param, parameters = inspect.cleandoc(parent.__doc__ or "").partition(":param")
    attributes["__doc__"] = f"{summary}.\n\n{param}{parameters}\n"
    metaclass = type if _registered_by(method) is None else _ForeignType
    return metaclass(method.extractor, (parent,), attributes)


def _registered_by(method: Method) -> str | None:
    """The module of another package that brings a method; None for a method of ours, or where it cannot be imported."""
    module: str | None = getattr(method.objective, "__module__", None)
    is_ours = module is not None and module.partition(".")[0] == __name__.partition(".")[0]
    return None if is_ours or module == "__main__" else module


class _ForeignType(type):
    """The type of extractors of other packages' methods: a pickle of one says which module to import."""


def _reduce_foreign(extractor: _ForeignType) -> Any:
    for method in methods().values():
        if _is_class_of(method, extractor):
            return find_extractor_class, (extractor.__name__, _registered_by(method))
    # A subclass that somebody has written: by its module and name, as any class.
    return extractor.__qualname__


copyreg.pickle(_ForeignType, _reduce_foreign)
