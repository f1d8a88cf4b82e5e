"""Methods: which features extractor a zoo run uses, as hyperparameters, and as the record that a run keeps of it."""

import contextlib
import importlib
import importlib.util
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.paths import resource_path
from sb3_abisim.common.yaml_text import read_yaml_file
from sb3_abisim.networks.encoder_file import EncoderFile, load_encoder
from sb3_abisim.networks.encoder_name import EncoderNotFoundError, pinned_name
from sb3_abisim.registry import get_augmentation, get_method, methods
from sb3_abisim.rl.combined import CombinedEncoderExtractor
from sb3_abisim.rl.file_network import check_objective, network_arguments, stored_network
from sb3_abisim.zoo.preprocessing import check_preprocessing, class_name, frame_stack_of, items

ENCODING_WRAPPER = "sb3_abisim.VecEncodeObservations"
ENCODER_CALLBACK = "sb3_abisim.EncoderCallback"
# Beside config.yml in a run's folder.
RECORD_NAME = "method.json"
# What may stand after a method as ",name=value", in this order, and the type of the value.
_OPTIONS: dict[str, Callable[[str], Any]] = {"task_features_dim": int, "augment": str}
# Of policy_kwargs: what a YAML names by its dotted path.
_CLASS_KEYS = ("features_extractor_class", "optimizer_class", "activation_fn")


def grammar() -> str:
    """How a method spec is written, for messages."""
    options = "".join(f"[,{name}=VALUE]" for name in _OPTIONS)
    return f"METHOD[=ENCODER][,frozen]{options} with METHOD one of {', '.join(methods())}"


@dataclass(frozen=True)
class MethodSpec:
    """Which features extractor a run is to use.

    :param name: a registered method
    :param encoder: a file, a shipped encoder's name or ``hf://owner/repository``; None for the shipped encoder of
        this method and the environment
    :param frozen: whether the weights stay as they are during RL
    :param task_features_dim: size of the trainable network beside the encoder, 0 for none
    :param augment: name of an augmentation; None for that of the method
    :raises ValueError: for an unknown method, or an encoder or ``frozen`` for an untrained one
    """

    name: str
    encoder: str | None = None
    frozen: bool = False
    task_features_dim: int = 0
    augment: str | None = None

    def __post_init__(self) -> None:
        if self.name not in methods():
            raise ValueError(f"unknown method {self.name!r}; give {grammar()}")
        if self.encoder == "":
            raise ValueError(f"no encoder after '{self.name}='; give {grammar()}")
        if self.task_features_dim < 0:
            raise ValueError(f"task_features_dim must be at least 0, got {self.task_features_dim}; give {grammar()}")
        if self.augment is not None:
            get_augmentation(self.augment)
        if not get_method(self.name).has_encoder_file and (self.encoder is not None or self.frozen):
            raise ValueError(
                f"{self.name!r} trains its network from scratch: it takes neither an encoder nor ',frozen'"
            )

    @classmethod
    def parse(cls, text: str) -> "MethodSpec":
        """Read ``METHOD[=ENCODER][,frozen][,option=value]``, in any order of what follows a comma.

        :param text: e.g. "ssi", "abisim,frozen,task_features_dim=64" or "abisim=runs/mine.safetensors"
        :raises ValueError: for anything else
        """
        rest, given = text, dict[str, Any]()
        # From the end: a path may hold commas and equals signs.
        while match := re.fullmatch(rf"(.*),(?:(frozen)|({'|'.join(_OPTIONS)})=([^,]*))", rest):
            rest, frozen, option, value = match.groups()
            if (frozen or option) in given:
                raise ValueError(f"{text!r} says {frozen or option} twice; give {grammar()}")
            try:
                given[frozen or option] = True if frozen else _OPTIONS[option](value)
            except ValueError as error:
                raise ValueError(f"{option} takes no {value!r} in {text!r}; give {grammar()}") from error
        head, equals, encoder = rest.partition("=")
        return cls(head, encoder if equals else None, **given)

    @property
    def options(self) -> dict[str, Any]:
        """What it says beyond method, encoder and ``frozen``, by name."""
        return _given_options(self)

    @property
    def suffix(self) -> str:
        """What stands behind method and encoder: ",frozen,task_features_dim=64"."""
        return _suffix(self)

    @property
    def embeds_in_env(self) -> bool:
        """Whether ``VecEncodeObservations`` embeds each observation once: nothing else needs the observation."""
        return self.frozen and not self.task_features_dim and not self.augment

    @classmethod
    def of_conf_file(cls, config: str) -> "MethodSpec | None":
        """The method that ``--conf-file`` names; None when it names a file or a module, as in plain rl-zoo3.

        :param config: the word after ``--conf-file``
        :raises ValueError: when it is none of these
        """
        if re.split("[=,]", config)[0] in methods():
            return cls.parse(config)
        module = config.partition(".")[0]
        if not config.endswith((".yml", ".yaml", ".py")) and not (module and importlib.util.find_spec(module)):
            raise ValueError(
                f"--conf-file {config!r} is no YAML or Python file, module or method; a method is {grammar()}"
            )
        return None

    def hyperparameters(self, entry: Mapping[str, Any], given: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """What this method puts in place of an entry's values; all else stays.

        :param entry: of a zoo YAML
        :param given: hyperparameters that the user sets
        :return: ``policy_kwargs``, unless the entry gives them as a text: :meth:`policy_kwargs` takes them once rl-zoo3
            has evaluated it; ``policy`` and, for a frozen encoder without task features and augmentation,
            ``vec_env_wrapper``; ``frame_stack``, where a frozen
            encoder's observations are stacked before it; ``callback``, where the entry has no ``EncoderCallback``
        :raises ValueError: when the method has no encoder, the policy takes none, the method sets what the user sets,
            or a frozen encoder would be shown other stacks than in pretraining
        """
        given = given or {}
        replaced: dict[str, Any] = {}
        kwargs, encoder = entry.get("policy_kwargs") or {}, None
        if isinstance(kwargs, Mapping):
            encoder = _encoder_name(kwargs)
            replaced["policy_kwargs"] = self.policy_kwargs(kwargs)
        file = self._file(encoder)
        if self.embeds_in_env and _image_key(file) is None:
            wrapper = {ENCODING_WRAPPER: {"encoder": self._encoder(encoder), "objective": self.name}}
            replaced["vec_env_wrapper"] = [*items(entry.get("vec_env_wrapper")), wrapper]
        if self.embeds_in_env or "policy" not in given:
            replaced["policy"] = self._policy(str(entry.get("policy")), _image_key(file))
        for name in sorted({"policy_kwargs", *replaced} & set(given)):
            raise ValueError(f"-params {name} would undo --conf-file {self.name}; give one of the two")
        settings = {**entry, **given}
        if "vec_env_wrapper" in replaced and file is not None and (settings.get("frame_stack") or 1) > 1:
            if frame_stack_of(file) != settings["frame_stack"]:
                check_preprocessing(file, settings, frozen=True)
            # The wrapper stacks observations; rl-zoo3 would stack embeddings once more.
            replaced["frame_stack"] = None
        callbacks = items(entry.get("callback"))
        if "callback" not in given and ENCODER_CALLBACK.rpartition(".")[2] not in map(class_name, callbacks):
            replaced["callback"] = [*callbacks, ENCODER_CALLBACK]
        return replaced

    def policy_kwargs(self, kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """``policy_kwargs`` with this method's features extractor in place of theirs, its class by the dotted path.

        :param kwargs: of an entry; where they name a shipped encoder ("Nav2D-v0/abisim"), a method without an encoder
            takes the one of the same environment that it has trained
        :raises ValueError: when the method needs an encoder, and there is none
        """
        replaced = {name: value for name, value in kwargs.items() if not name.startswith("features_extractor_")}
        method = get_method(self.name)
        shipped = _encoder_name(kwargs)
        file = self._file(shipped)
        key = _image_key(file)
        if file is not None and key is not None:
            # Of a Dict: an encoder for its image, and everything else passed on.
            check_objective(file, self.name)
            replaced["features_extractor_class"] = f"sb3_abisim.{CombinedEncoderExtractor.__name__}"
            arguments = {"encoders": {key: self._encoder(shipped)}, "networks": {key: stored_network(file)}}
            replaced["features_extractor_kwargs"] = {**arguments, "freeze": self.frozen, **self.options}
        elif not self.embeds_in_env:
            replaced["features_extractor_class"] = f"sb3_abisim.{method.extractor}"
            arguments = self.options
            if method.has_encoder_file:
                network = {} if file is None else network_arguments(file)
                frozen = {"freeze": True} if self.frozen else {}
                arguments = {"encoder": self._encoder(shipped), **network, **frozen, **arguments}
            if arguments:
                replaced["features_extractor_kwargs"] = arguments
        return replaced

    def _encoder(self, shipped: str | None) -> str:
        if self.encoder is not None:
            # The run says which commit it used. Where there is none to be had, whoever needs the file says so.
            with contextlib.suppress(EncoderNotFoundError):
                return pinned_name(self.encoder)
            return self.encoder
        if shipped is None:
            raise ValueError(
                f"no encoder ships for this environment; pretrain one and give its file: --conf-file {self.name}=FILE"
                + self.suffix
            )
        return f"{shipped.rpartition('/')[0]}/{self.name}"

    def _file(self, shipped: str | None) -> EncoderFile | None:
        """The encoder's file; None for a method without one, or where it is not there: whoever needs it says so."""
        if not get_method(self.name).has_encoder_file:
            return None
        try:
            return load_encoder(self._encoder(shipped))
        except EncoderNotFoundError:
            # A saved model that is continued is complete without it.
            return None

    def _policy(self, policy: str, image_key: str | None) -> str:
        if image_key is not None:
            return re.sub("Mlp|Cnn", "MultiInput", policy)
        # An entry for vectors, as rl-zoo3's "default" is, has the policy without an extractor for images.
        wrong, right = ("Cnn", "Mlp") if self.embeds_in_env else ("Mlp", "Cnn")
        replaced = policy.replace(wrong, right)
        # A dotted path is a custom policy.
        if right not in replaced and "." not in replaced:
            raise ValueError(
                f"--conf-file {self.name} needs a policy for one image observation, and {policy} is none; choose "
                "another algorithm with --algo, or write a YAML file for this environment"
            )
        return replaced


@dataclass(frozen=True)
class MethodRecord:
    """What a run used, written beside its configuration as JSON; reports read it.

    :param method: a registered name; None for a features extractor of no method
    :param frozen: whether the weights stayed as they were
    :param encoder: path or name of the encoder file; None without one
    :param encoder_hash: sha256 of the encoder file; None without one
    :param preprocessing: hyperparameters that stand between the environment and the encoder, where they are given
    :param task_features_dim: size of the trainable network beside the encoder, 0 for none
    :param augment: name of an augmentation; None for that of the method
    """

    method: str | None
    frozen: bool
    encoder: str | None
    encoder_hash: str | None
    preprocessing: dict[str, Any]
    task_features_dim: int = 0
    augment: str | None = None

    @property
    def label(self) -> str | None:
        """What reports call it: "abisim", "abisim,frozen,task_features_dim=64"; None for no method."""
        return None if self.method is None else self.method + _suffix(self)

    def write(self, folder: str | Path) -> None:
        """Write it into the folder of ``config.yml``.

        :param folder: exists
        """
        # Wrappers of a Python configuration may be classes.
        text = json.dumps(asdict(self), indent=1, sort_keys=True, default=str) + "\n"
        write_atomic(Path(folder) / RECORD_NAME, lambda file: file.write(text.encode()))

    @classmethod
    def read(cls, folder: str | Path) -> "MethodRecord | None":
        """Read it; None where there is none, as in runs of plain rl-zoo3.

        :param folder: of ``config.yml``
        :raises ValueError: for a damaged file
        """
        path = Path(folder) / RECORD_NAME
        if not path.is_file():
            return None
        try:
            record = cls(**json.loads(path.read_bytes()))
            texts = record.method, record.encoder, record.encoder_hash, record.augment
            if not all(value is None or (isinstance(value, str) and value.isprintable()) for value in texts):
                raise TypeError("a name is no text")
            if not isinstance(record.frozen, bool) or not isinstance(record.preprocessing, dict):
                raise TypeError("frozen is no bool, or preprocessing no mapping")
            if type(record.task_features_dim) is not int:
                raise TypeError("task_features_dim is no whole number")
            return record
        except (ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} is damaged ({error}); leave the run out, or copy the file again") from error


def _given_options(given: MethodSpec | MethodRecord) -> dict[str, Any]:
    return {name: value for name in _OPTIONS if (value := getattr(given, name))}


def _suffix(given: MethodSpec | MethodRecord) -> str:
    return ",frozen" * given.frozen + "".join(f",{name}={value}" for name, value in _given_options(given).items())


def hyperparameters_file(algo: str, env_id: str) -> Path | None:
    """The YAML file of this package with hyperparameters of an algorithm for an environment.

    :param algo: rl-zoo3's name of the algorithm, e.g. "ppo"
    :param env_id: any id
    :return: None for an environment that is in none of the files
    :raises ValueError: when only other algorithms have some, naming these
    """
    files = [path for path in sorted(resource_path("hyperparams").glob("*.yml")) if env_id in read_entries(path)]
    for path in files:
        if path.stem == algo:
            return path
    if not files:
        return None
    known = ", ".join(path.stem for path in files)
    raise ValueError(
        f"sb3_abisim has no hyperparameters of {algo} for {env_id}, only of: {known}; "
        "choose one of these with --algo, or give a custom YAML file with --conf-file"
    )


def hyperparameters_entry(algo: str, env_id: str) -> dict[str, Any]:
    """The hyperparameters of an algorithm for an environment: this package's, else rl-zoo3's own.

    :param algo: rl-zoo3's name of the algorithm
    :param env_id: a registered id
    :raises ValueError: when there are none
    """
    path = hyperparameters_file(algo, env_id)
    if path is not None:
        return dict(read_entries(path)[env_id])
    exp_manager: Any = importlib.import_module("rl_zoo3.exp_manager")
    path = zoo_hyperparams() / f"{algo}.yml"
    entries = read_entries(path) if path.is_file() else {}
    key = "atari" if exp_manager.ExperimentManager.is_atari(env_id) else "default"
    # As there: no default for Atari.
    for name in (env_id, key):
        if name in entries:
            return dict(entries[name])
    raise ValueError(f"rl-zoo3 has no hyperparameters of {algo} for {env_id}; choose another with --algo")


def policy_of(algo: str, policy: str) -> str:
    """The algorithm's policy of a kind, which rl-zoo3's default entry for RecurrentPPO calls as PPO does.

    :param algo: rl-zoo3's name of the algorithm
    :param policy: such as "MlpPolicy", or the dotted path of a custom one
    :return: such as "MlpLstmPolicy"
    :raises ValueError: when there is none
    """
    from rl_zoo3.utils import ALGOS  # type: ignore[import-untyped, unused-ignore]

    known = ALGOS[algo].policy_aliases
    if "." in policy or policy in known:
        return policy
    kind = re.match("Cnn|Mlp|MultiInput", policy)
    found = [name for name in known if kind is not None and name.startswith(kind[0])]
    if len(found) != 1:
        raise ValueError(f"{algo} has no policy {policy!r}, only {', '.join(known)}; choose another with --algo")
    return str(found[0])


def zoo_hyperparams() -> Path:
    """The folder of rl-zoo3's own hyperparameters."""
    module: Any = importlib.import_module("rl_zoo3")
    return Path(module.__file__).parent / "hyperparams"


def read_entries(path: Path) -> dict[str, Any]:
    """The entries of a zoo YAML by environment id; empty for a file of another form.

    :param path: the file
    """
    content = read_yaml_file(path)
    return content if isinstance(content, dict) else {}


def resolve_classes(policy_kwargs: Any) -> Any:
    """Import what ``policy_kwargs`` name by a dotted path, such as ``activation_fn: torch.nn.ReLU``.

    :param policy_kwargs: of a zoo entry, a mapping; anything else is returned as it is
    :return: a new dictionary
    :raises ValueError: for a path that cannot be imported
    """
    if not isinstance(policy_kwargs, Mapping):
        return policy_kwargs
    kwargs = dict(policy_kwargs)
    for key in _CLASS_KEYS:
        if isinstance(kwargs.get(key), str):
            module, _, name = kwargs[key].rpartition(".")
            try:
                kwargs[key] = getattr(importlib.import_module(module), name)
            except (ImportError, AttributeError, ValueError) as error:
                raise ValueError(
                    f"policy_kwargs: cannot import {key} {kwargs[key]!r} ({error}); give its dotted path"
                ) from error
    return kwargs


def encoding_kwargs(hyperparams: Mapping[str, Any]) -> dict[str, Any] | None:
    """The arguments of ``VecEncodeObservations`` in a zoo entry, None where it is not used.

    :param hyperparams: of a zoo entry, or of a run's ``config.yml``
    """
    for wrapper in items(hyperparams.get("vec_env_wrapper")):
        if isinstance(wrapper, dict) and class_name(wrapper) == ENCODING_WRAPPER.rpartition(".")[2]:
            kwargs: dict[str, Any] = next(iter(wrapper.values()))
            return kwargs
    return None


def unfreezes(hyperparams: Mapping[str, Any]) -> bool:
    """Whether the ``EncoderCallback`` of a zoo entry unfreezes a frozen encoder at some step.

    :param hyperparams: of a zoo entry, or of a run's ``config.yml``
    """
    for item in items(hyperparams.get("callback")):
        if isinstance(item, Mapping) and class_name(item) == ENCODER_CALLBACK.rpartition(".")[2]:
            return (next(iter(item.values())) or {}).get("unfreeze_at") is not None
    return False


def _encoder_name(policy_kwargs: Mapping[str, Any]) -> str | None:
    encoder = (policy_kwargs.get("features_extractor_kwargs") or {}).get("encoder")
    return None if encoder is None else str(encoder)


def _image_key(file: EncoderFile | None) -> str | None:
    """Which key of a Dict an encoder was pretrained on; None for observations that are one image."""
    key = None if file is None else file.metadata["preprocessing"].get("image_key")
    return None if key is None else str(key)
