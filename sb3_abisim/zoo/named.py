"""Classes that files name: found among what is loaded, and no module is imported because a file alone names it.

The texts in which rl-zoo3 keeps ``policy_kwargs`` and ``normalize`` are Python. They are read here, not evaluated.
"""

import ast
import importlib
import re
import sys
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn, optim

from sb3_abisim.networks.encoder_name import HUB_PREFIX
from sb3_abisim.registry import is_import_path, named_packages, networks

# What this package stands on: their modules are imported, since they only define.
_FOUNDATION = ("gymnasium", "rl_zoo3", "sb3_abisim", "sb3_contrib", "stable_baselines3")
# Of policy_kwargs: what is named by its dotted path, and what it must be.
_KINDS = {
    "features_extractor_class": BaseFeaturesExtractor,
    "optimizer_class": optim.Optimizer,
    "activation_fn": nn.Module,
}
# What rl-zoo3 has in scope where it evaluates.
_SCOPE = {
    "nn": "torch.nn",
    "th": "torch",
    "torch": "torch",
    "sb3": "stable_baselines3",
    "RMSpropTFLike": "stable_baselines3.common.sb2_compat.rmsprop_tf_like.RMSpropTFLike",
}
_MAX_TEXT = 10_000


def named_class(path: Any, kind: type, where: str, word: str) -> Any:
    """The class that a file names.

    :param path: dotted
    :param kind: what it must be a subclass of
    :param where: the file, for messages
    :param word: what the file names it as, for messages
    :raises ValueError: for a class of a package that nobody has imported, one that is not there, or another kind
    """
    *modules, name = str(path).split(".")
    module, package = ".".join(modules), modules[0] if modules else ""
    if any(not part.isidentifier() or part.startswith("_") for part in (*modules, name)):
        raise ValueError(f"{where} names the {word} {path!r}, which is no dotted path")
    if module not in sys.modules and package in (*_FOUNDATION, *named_packages()):
        try:
            importlib.import_module(module)
        except Exception as error:
            raise ValueError(f"{where} names the {word} {path!r}, which is not there ({error})") from error
    if module not in sys.modules:
        raise ValueError(
            f"{where} names the {word} {path!r} of a package that is not imported; if you trust it, add --packages "
            f"{package or path}"
        )
    found = getattr(sys.modules[module], name, None)
    if found is None:
        raise ValueError(f"{where} names the {word} {path!r}, which is not there")
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ValueError(f"{where} names {path!r} as a {word}, which is no {kind.__name__}")
    return found


def named_policy_kwargs(policy_kwargs: Any, where: str) -> dict[str, Any]:
    """``policy_kwargs`` of a file, with its classes.

    :param policy_kwargs: a mapping, the text of one, or None
    :param where: the file, for messages
    :raises ValueError: for what names a class of another package, or a network to be imported
    """
    read = read_text(policy_kwargs, where) if isinstance(policy_kwargs, str) else policy_kwargs or {}
    if not isinstance(read, Mapping):
        raise ValueError(f"{where}: policy_kwargs must be a mapping, got {read!r}")
    kwargs = {str(name): value for name, value in read.items()}
    for key in kwargs.keys() & _KINDS.keys():
        kwargs[key] = named_class(kwargs[key], _KINDS[key], where, key)
    if "features_extractor_kwargs" in kwargs:
        kwargs["features_extractor_kwargs"] = _local(kwargs["features_extractor_kwargs"], where)
    return kwargs


def _local(value: Any, where: str) -> Any:
    """Arguments of an extractor, with nothing to import or to download."""
    if isinstance(value, Mapping):
        network = value.get("network")
        if isinstance(network, str) and is_import_path(network) and network not in networks():
            raise ValueError(f"{where} names the network {network!r}; if you trust it, add --packages {network}")
        augment = value.get("augment")
        if (
            isinstance(augment, str)
            and is_import_path(augment)
            and re.split("[.:]", augment)[0] not in named_packages()
        ):
            package = augment.partition(":")[0]
            raise ValueError(f"{where} names the augmentation {augment!r}; if you trust it, add --packages {package}")
        return {name: _local(part, where) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_local(part, where) for part in value)
    if isinstance(value, str) and value.startswith(HUB_PREFIX):
        # The weights lie in the saved model.
        return f"(the saved model has the weights of {value.removeprefix(HUB_PREFIX)})"
    return value


def read_text(text: str, where: str) -> Any:
    """What a text of Python says, if it is made of ``dict(...)``, literals and names of classes.

    :param text: such as ``dict(net_arch=[64], activation_fn=nn.ReLU)``
    :param where: the file, for messages
    :return: classes by their dotted paths
    :raises ValueError: for anything else
    """
    try:
        if len(text) > _MAX_TEXT:
            raise ValueError(f"{len(text)} letters")
        return _value(ast.parse(text.strip(), mode="eval").body)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(
            f"{where} holds {text[:80]!r}; only dict(...), literals and names of classes are read here ({error})"
        ) from error


def _value(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords) if all(word.arg for word in keywords):
            return {word.arg: _value(word.value) for word in keywords}
        case ast.Call(func=ast.Name(id="get_class_by_name"), args=[ast.Constant(value=str(path))], keywords=[]):
            return path
        case ast.Name(id=name) if name in _SCOPE:
            return _SCOPE[name]
        case ast.Attribute(value=inner, attr=name):
            return f"{_value(inner)}.{name}"
        case ast.Dict(keys=keys, values=values) if None not in keys:
            pairs = zip(keys, values, strict=True)
            return {ast.literal_eval(key): _value(value) for key, value in pairs if key is not None}
        case ast.List(elts=parts):
            return [_value(part) for part in parts]
        case ast.Tuple(elts=parts):
            return tuple(_value(part) for part in parts)
    return ast.literal_eval(node)
