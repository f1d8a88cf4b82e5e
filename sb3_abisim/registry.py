"""What can be added by name: methods, networks, augmentations, dataset readers, and what is known of an environment.

The ground floor: nothing of this package is imported here. What the package itself brings registers itself when the
folder that holds it is imported, which happens at the first look-up. Other packages register in the same way: by
being imported (``--packages`` of every command), or by an entry point in the group ``sb3_abisim.plugins`` that names a
module.
"""

import functools
import importlib
import os
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from types import MappingProxyType
from typing import Any, Generic, TypeVar

PLUGIN_GROUP = "sb3_abisim.plugins"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")

RecordT = TypeVar("RecordT")


@dataclass(frozen=True)
class Method:
    """A way to make the encoder that RL runs on.

    :param name: the word of ``--objective`` and ``--conf-file``
    :param objective: subclass of :class:`~sb3_abisim.objectives.base.Objective`; None for a method without pretraining
    :param label: what reports call it
    :param extractor: name of its features extractor class, importable from ``sb3_abisim``
    :param base: the method whose encoder its objective takes as ``base_encoder``; None for none
    :param color: in reports, as matplotlib takes it; None for one that is free
    :param curve: the term of its log that shows how pretraining went, without ``train/`` or ``eval/``
    :param results: the terms that its row in the table of encoders shows
    :param hyperparams: YAML file of its pretraining settings by environment id; None for this package's
        ``hyperparams/pretrain/<name>.yml``, or where there is none for the defaults
    :param trained_elsewhere: whether its encoders come from files that nothing here pretrains
    :param augment: what its features extractor augments observations by, unless it is told otherwise
    """

    name: str
    objective: Any
    label: str
    extractor: str
    base: str | None
    color: str | None
    curve: str
    results: tuple[str, ...]
    hyperparams: str | os.PathLike[str] | None
    trained_elsewhere: bool = False
    augment: str | None = None

    @property
    def is_pretrained(self) -> bool:
        """Whether there is anything to pretrain."""
        return self.objective is not None

    @property
    def has_encoder_file(self) -> bool:
        """Whether its encoder comes from a file; if not, the network starts from random weights."""
        return self.is_pretrained or self.trained_elsewhere


@dataclass(frozen=True)
class Network:
    """An encoder's network.

    :param name: as in ``network=`` and in encoder files
    :param factory: takes an observation space and keyword arguments (JSON types); gives any ``torch.nn.Module`` from
        float images (batch, channels, height, width) in 0..1 to (batch, features_dim)
    :param observation_shape: (channels, height, width) that it is the default for; None for none
    """

    name: str
    factory: Callable[..., Any]
    observation_shape: tuple[int, int, int] | None


@dataclass(frozen=True)
class Reader:
    """Makes a dataset folder of data that something else has written.

    :param name: the word of ``sb3-abisim data import``
    :param read_fn: called with the source (a text, or in Python any object) and the folder to write; returns the
        dataset's hash. Its keyword-only parameters are options: ``--env`` becomes ``env_id``, ``--image-key``
        ``image_key``
    :param help: what a source is, in a line
    """

    name: str
    read_fn: Callable[..., str]
    help: str


@dataclass(frozen=True)
class EnvTraits:
    """What the commands need to know of an environment beside its spaces.

    :param algo: rl-zoo3's name of the algorithm that a benchmark trains by default
    :param n_transitions: random-action transitions that a benchmark pretrains on by default
    :param collect_kwargs: keyword arguments of the environment in data collection alone
    :param splits: values of its argument ``split``: the one for evaluation, the one for training, then others; empty
        without such an argument
    :param split_kwargs: names of the arguments that choose what training sees of a split; evaluation goes without them
    :param free_kwargs: names of the arguments that leave the range of returns as it is
    :param return_range: the worst and the best return of an episode; None where it is not known
    :param length_unit: of distances in its ``factors()``, for figures
    :param same_observations_as: an id with the same observation and action spaces and the same look, whose shipped
        encoders fit; None for none
    """

    algo: str = "ppo"
    n_transitions: int = 100_000
    collect_kwargs: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    splits: tuple[str, ...] = ()
    split_kwargs: tuple[str, ...] = ()
    free_kwargs: tuple[str, ...] = ()
    return_range: tuple[float, float] | None = None
    length_unit: str = "m"
    same_observations_as: str | None = None

    @property
    def eval_split(self) -> str | None:
        """The value of ``split`` for evaluation, None without splits."""
        return self.splits[0] if self.splits else None


class _Records(Generic[RecordT]):
    """Records of one kind by name, in the order of registration."""

    def __init__(self, kind: str, built_in: str) -> None:
        self.kind = kind
        self.built_in = built_in
        self.by_name: dict[str, RecordT] = {}

    def add(self, name: str, record: RecordT) -> None:
        if not _NAME.fullmatch(name):
            raise ValueError(f"the {self.kind}'s name must be made of letters, digits, '_', '-' and '.', got {name!r}")
        if name in self.by_name:
            raise ValueError(f"the {self.kind} {name!r} is registered already; give yours another name")
        self.by_name[name] = record

    def all(self) -> dict[str, RecordT]:
        importlib.import_module(self.built_in)
        load_plugins()
        return dict(self.by_name)

    def get(self, name: str) -> RecordT:
        known = self.all()
        if name not in known:
            raise ValueError(
                f"unknown {self.kind} {name!r}; known are {', '.join(known)} (--packages imports what registers others)"
            )
        return known[name]


_METHODS: _Records[Method] = _Records("method", "sb3_abisim.objectives")
_NETWORKS: _Records[Network] = _Records("network", "sb3_abisim.networks")
_IMPORTED_NETWORKS: dict[str, Network] = {}
# Networks that another library knows by name: FAMILY/MEMBER.
_NETWORK_FAMILIES: _Records[Callable[..., Any]] = _Records("family of networks", "sb3_abisim.networks")
# From float observations (batch, channels, height, width) in 0..1, and keyword arguments, to augmented ones.
_AUGMENTATIONS: _Records[Callable[..., Any]] = _Records("augmentation", "sb3_abisim.networks")
_READERS: _Records[Reader] = _Records("reader", "sb3_abisim.data.readers")
_TRAITS: dict[str, EnvTraits] = {}
_NAMED_PACKAGES: set[str] = set()
_DEFAULT_TRAITS = EnvTraits()


def register_method(
    name: str,
    objective: Any = None,
    *,
    label: str | None = None,
    extractor: str | None = None,
    base: str | None = None,
    color: str | None = None,
    curve: str = "accuracy",
    results: tuple[str, ...] = ("accuracy",),
    hyperparams: str | os.PathLike[str] | None = None,
    trained_elsewhere: bool = False,
    augment: str | None = None,
) -> None:
    """Add a method; its features extractor is then importable from ``sb3_abisim``.

    :param name: the word of ``--objective`` and ``--conf-file``
    :param objective: subclass of :class:`~sb3_abisim.objectives.base.Objective`; None for one that pretrains nothing
    :param label: what reports call it; None for ``name``
    :param extractor: name of its features extractor class; None for ``name`` in capitals, as ``MyMethodExtractor``
    :param base: the method whose encoder its objective takes as ``base_encoder``
    :param color: in reports, as matplotlib takes it
    :param curve: see :class:`Method`
    :param results: see :class:`Method`
    :param hyperparams: see :class:`Method`
    :param trained_elsewhere: see :class:`Method`
    :param augment: see :class:`Method`
    :raises ValueError: for a name that is taken or cannot be one
    """
    class_name = extractor or "".join(part.capitalize() for part in re.split(r"[_.-]", name)) + "Extractor"
    for other in _METHODS.by_name.values():
        if other.extractor == class_name:
            raise ValueError(f"{class_name} is the extractor of method {other.name!r}; give another with extractor=")
    record = Method(
        name, objective, label or name, class_name, base, color, curve, results, hyperparams, trained_elsewhere, augment
    )
    _METHODS.add(name, record)


def register_network(
    name: str, factory: Callable[..., Any], *, observation_shape: tuple[int, int, int] | None = None
) -> None:
    """Add a network; an encoder file names it, and extractors take ``network=name``.

    :param name: its name
    :param factory: see :class:`Network`
    :param observation_shape: see :class:`Network`
    :raises ValueError: for a name that is taken or cannot be one
    """
    _NETWORKS.add(name, Network(name, factory, observation_shape))


def register_network_family(name: str, factory: Callable[..., Any]) -> None:
    """Add the networks that another library knows by name, as ``name/MEMBER``.

    An encoder file may name any member, so that the factory must not load or run what a name says.

    :param name: before the slash
    :param factory: as for :func:`register_network`, with the member's name as first argument
    :raises ValueError: for a name that is taken or cannot be one
    """
    _NETWORK_FAMILIES.add(name, factory)


def register_augmentation(name: str, augment_fn: Callable[..., Any]) -> None:
    """Add an augmentation; features extractors take ``augment=name`` and ``augment_kwargs``.

    :param name: its name
    :param augment_fn: called with float observations (batch, channels, height, width) in 0..1 and the keyword
        arguments; returns new ones of the same shape. It samples from torch's global generator
    :raises ValueError: for a name that is taken or cannot be one
    """
    _AUGMENTATIONS.add(name, augment_fn)


def register_reader(name: str, read_fn: Callable[..., str], *, help: str = "") -> None:
    """Add a reader of datasets; ``sb3-abisim data import NAME SOURCE -o DIR`` calls it.

    :param name: its name
    :param read_fn: see :class:`Reader`
    :param help: what a source is, in a line
    :raises ValueError: for a name that is taken or cannot be one
    """
    _READERS.add(name, Reader(name, read_fn, help))


def register_traits(env_id: str, traits: EnvTraits) -> None:
    """Say what the commands need to know of an environment; without it, the defaults of :class:`EnvTraits` hold.

    :param env_id: an id of Gymnasium's registry
    :param traits: of this id
    :raises ValueError: for an id that has some
    """
    if env_id in _TRAITS:
        raise ValueError(f"{env_id} has traits already")
    _TRAITS[env_id] = traits


def methods() -> dict[str, Method]:
    """All methods by name, in the order of registration."""
    return _METHODS.all()


def get_method(name: str) -> Method:
    """The method of a name.

    :param name: e.g. "ssi"
    :raises ValueError: for an unknown one, naming those that are known
    """
    return _METHODS.get(name)


def get_objective(name: str) -> Any:
    """The objective class of a method.

    :param name: e.g. "ssi"
    :raises ValueError: for an unknown method, or one without pretraining
    """
    objective = get_method(name).objective
    if objective is None:
        known = ", ".join(key for key, method in methods().items() if method.is_pretrained)
        raise ValueError(f"no objective pretrains {name!r}, only {known}; give a file: {name}=FILE")
    return objective


def networks() -> dict[str, Network]:
    """All networks by name, in the order of registration; then those that the user has named by their import path."""
    return {**_NETWORKS.all(), **_IMPORTED_NETWORKS}


def get_network(name: str) -> Network:
    """The network of a name.

    :param name: e.g. "nature"
    :raises ValueError: for an unknown one, naming those that are known
    """
    family, slash, member = name.partition("/")
    if slash and not is_import_path(name):
        return Network(name, functools.partial(_NETWORK_FAMILIES.get(family), member), None)
    return _IMPORTED_NETWORKS.get(name) or _NETWORKS.get(name)


def is_known_network(name: str) -> bool:
    """Whether a network's name is registered, or that of a member of a registered family.

    :param name: of a network
    """
    family, slash, _ = name.partition("/")
    return name in networks() or (bool(slash) and family in _NETWORK_FAMILIES.all())


def is_import_path(name: str | None) -> bool:
    """Whether a name is an import path, ``pkg.module:Factory``.

    :param name: of a network or an augmentation, None for the default one
    """
    return name is not None and ":" in name


def import_network(name: str) -> None:
    """Import a network that the user names by its path; encoder files may name it from then on.

    Never call this with a name from a file: importing a module runs it.

    :param name: ``pkg.module:Factory``, a factory as for :func:`register_network`, such as a module's class
    :raises ValueError: for something that cannot be imported or called
    """
    if name not in _IMPORTED_NETWORKS:
        _IMPORTED_NETWORKS[name] = Network(name, _import("network", name, "Factory"), None)


def _import(kind: str, name: str, example: str) -> Callable[..., Any]:
    """What an import path names."""
    module, _, attribute = name.partition(":")
    try:
        found = functools.reduce(getattr, attribute.split("."), importlib.import_module(module))
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"cannot import the {kind} {name!r} ({error}); give pkg.module:{example}, and install it or set PYTHONPATH"
        ) from error
    if not callable(found):
        raise ValueError(f"the {kind} {name!r} is no {example.lower()} but {found!r}; name a class or a function")
    imported: Callable[..., Any] = found
    return imported


def get_augmentation(name: str) -> Callable[..., Any]:
    """The augmentation of a name.

    :param name: e.g. "random_shift", or ``pkg.module:Function``, which is imported: never a name that only a file holds
    :raises ValueError: for an unknown one, naming those that are known, or something that cannot be imported
    """
    return _import("augmentation", name, "Function") if is_import_path(name) else _AUGMENTATIONS.get(name)


def readers() -> dict[str, Reader]:
    """All readers of datasets by name, in the order of registration."""
    return _READERS.all()


def get_reader(name: str) -> Reader:
    """The reader of a name.

    :param name: e.g. "minari"
    :raises ValueError: for an unknown one, naming those that are known
    """
    return _READERS.get(name)


def get_traits(env_id: str) -> EnvTraits:
    """What is known of an environment.

    :param env_id: any id; one that nobody has registered traits for gets the defaults
    """
    load_plugins()
    return _TRAITS.get(env_id, _DEFAULT_TRAITS)


def name_package(module: str) -> None:
    """Note that the user has named a module: files may name what lies in its package from then on.

    :param module: dotted, or ``pkg.module:Factory``
    """
    _NAMED_PACKAGES.add(re.split("[.:]", module)[0])


def named_packages() -> frozenset[str]:
    """The top names of the packages that the user has named, by ``--packages`` or by installing a plugin."""
    return frozenset(_NAMED_PACKAGES)


@functools.cache
def load_plugins() -> None:
    """Import the modules that installed packages name in the entry point group ``sb3_abisim.plugins``, once.

    One that cannot be imported is left out with a warning, so that a broken plugin does not stop other work.
    """
    for entry_point in metadata.entry_points(group=PLUGIN_GROUP):
        try:
            entry_point.load()
            name_package(entry_point.value)
        except Exception as error:
            warnings.warn(
                f"the plugin {entry_point.name} ({entry_point.value}) cannot be loaded and is left out: {error!r}; "
                "mend or uninstall the package that brings it",
                stacklevel=2,
            )
