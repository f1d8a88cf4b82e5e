"""Methods: which features extractor a zoo run uses, as a word of the command and as hyperparameters."""

import contextlib
import importlib.util
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sb3_abisim.networks.encoder_file import EncoderFile, load_encoder
from sb3_abisim.networks.encoder_name import EncoderNotFoundError, pinned_name
from sb3_abisim.registry import get_augmentation, get_method, methods
from sb3_abisim.rl.combined import CombinedEncoderExtractor
from sb3_abisim.rl.file_network import check_objective, network_arguments, stored_network
from sb3_abisim.zoo.auxiliary import auxiliary_text, parse_auxiliary
from sb3_abisim.zoo.entries import ENCODER_CALLBACK, ENCODING_WRAPPER
from sb3_abisim.zoo.named import read_text
from sb3_abisim.zoo.preprocessing import check_preprocessing, class_name, frame_stack_of, items

# What may stand after a method as ",name=value", in this order, and the type of the value.
_OPTIONS: dict[str, Callable[[str], Any]] = {"task_features_dim": int, "augment": str, "auxiliary": str}
# The same, but it says what is observed and is no part of the method.
_IMAGE_KEY = "image_key"
# Of these, what stands in the entry's callbacks and so behind a file, too; all others are arguments of the extractor.
_CALLBACK_OPTIONS = ("auxiliary",)


def grammar() -> str:
    """How a method spec is written, for messages."""
    options = "".join(f"[,{name}=VALUE]" for name in (*_OPTIONS, _IMAGE_KEY))
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
    :param auxiliary: objective that trains the encoder, too (:mod:`sb3_abisim.zoo.auxiliary`); None for none
    :param image_key: the image of a ``Dict`` of observations that the method is for; all else there is passed on. None
        for what the encoder file has recorded, else for observations that are one image
    :raises ValueError: for an unknown method, or an encoder or ``frozen`` for an untrained one
    """

    name: str
    encoder: str | None = None
    frozen: bool = False
    task_features_dim: int = 0
    augment: str | None = None
    auxiliary: str | None = None
    image_key: str | None = None

    def __post_init__(self) -> None:
        if self.name not in methods():
            raise ValueError(f"unknown method {self.name!r}; give {grammar()}")
        if self.encoder == "":
            raise ValueError(f"no encoder after '{self.name}='; give {grammar()}")
        if self.task_features_dim < 0:
            raise ValueError(f"task_features_dim must be at least 0, got {self.task_features_dim}; give {grammar()}")
        if self.augment is not None:
            get_augmentation(self.augment)
        if self.auxiliary is not None:
            self._check_auxiliary(self.auxiliary)
        if self.image_key == "":
            raise ValueError(f"no key after '{_IMAGE_KEY}='; give {grammar()}")
        if not get_method(self.name).has_encoder_file and (self.encoder is not None or self.frozen):
            raise ValueError(
                f"{self.name!r} trains its network from scratch: it takes neither an encoder nor ',frozen'"
            )

    def _check_auxiliary(self, text: str) -> None:
        kwargs = parse_auxiliary(text)
        if self.frozen and kwargs.get("weight") != 0:
            raise ValueError(
                f"',frozen' keeps the encoder as it is, and auxiliary={text} would train it; leave one of the two out, "
                "or give weight=0, which measures only"
            )
        # The same settings in the same words: they decide which runs are alike.
        object.__setattr__(self, "auxiliary", auxiliary_text(kwargs))

    @classmethod
    def parse(cls, text: str) -> "MethodSpec":
        """Read ``METHOD[=ENCODER][,frozen][,option=value]``, in any order of what follows a comma.

        :param text: e.g. "ssi", "abisim,frozen,task_features_dim=64" or "abisim=runs/mine.safetensors"
        :raises ValueError: for anything else
        """
        rest, given = split_options(text)
        head, equals, encoder = rest.partition("=")
        return cls(head, encoder if equals else None, **given)

    @property
    def options(self) -> dict[str, Any]:
        """What it says beyond method, encoder and ``frozen``, by name."""
        return given_options(self)

    @property
    def extractor_options(self) -> dict[str, Any]:
        """Those of :attr:`options` that are arguments of the features extractor."""
        return {name: value for name, value in self.options.items() if name not in _CALLBACK_OPTIONS}

    @property
    def suffix(self) -> str:
        """What stands behind method and encoder: ",frozen,task_features_dim=64"."""
        return suffix_of(self)

    @property
    def embeds_in_env(self) -> bool:
        """Whether ``VecEncodeObservations`` embeds each observation once: nothing else needs the observation."""
        return self.frozen and not self.options

    @classmethod
    def of_conf_file(cls, config: str) -> "MethodSpec | None":
        """The method that ``--conf-file`` names; None when it names a file or a module, as in plain rl-zoo3.

        :param config: the word after ``--conf-file``
        :raises ValueError: when it is none of these
        """
        if re.split("[=,]", config)[0] in methods():
            return cls.parse(config)
        config, given = split_options(config)
        others = [name for name in given if name not in _CALLBACK_OPTIONS]
        if others:
            raise ValueError(f"--conf-file {config!r} is no method, which {', '.join(others)} need; give {grammar()}")
        module = config.partition(".")[0]
        if (
            config
            and not config.endswith((".yml", ".yaml", ".py"))
            and not (module and importlib.util.find_spec(module))
        ):
            raise ValueError(
                f"--conf-file {config!r} is no YAML or Python file, module or method; a method is {grammar()}"
            )
        return None

    def hyperparameters(self, entry: Mapping[str, Any], given: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """What this method puts in place of an entry's values; all else stays.

        :param entry: of a zoo YAML; ``policy_kwargs`` may be a text, as rl-zoo3's mostly are
        :param given: hyperparameters that the user sets
        :return: ``policy_kwargs``; ``policy`` and, for a frozen encoder without task features and augmentation,
            ``vec_env_wrapper``; ``frame_stack``, where a frozen encoder's observations are stacked before it;
            ``callback``, where the entry has no ``EncoderCallback``
        :raises ValueError: when the method has no encoder, the policy takes none, the method sets what the user sets,
            or a frozen encoder would be shown other stacks than in pretraining
        """
        given = given or {}
        kwargs = entry.get("policy_kwargs") or {}
        if isinstance(kwargs, str):
            # Read, not evaluated, so that the run's config.yml holds what the model is made of.
            kwargs = read_text(kwargs, "the entry of the hyperparameters")
        encoder = _encoder_name(kwargs)
        replaced: dict[str, Any] = {"policy_kwargs": self.policy_kwargs(kwargs)}
        file = self._file(encoder)
        key = self._key(file)
        if self.embeds_in_env and key is None:
            wrapper = {ENCODING_WRAPPER: {"encoder": self._encoder(encoder), "objective": self.name}}
            replaced["vec_env_wrapper"] = [*items(entry.get("vec_env_wrapper")), wrapper]
        if self.embeds_in_env or "policy" not in given:
            replaced["policy"] = self._policy(str(entry.get("policy")), key)
        for name in sorted(replaced.keys() & set(given)):
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
        key = self._key(file)
        if key is not None:
            replaced["features_extractor_class"] = f"sb3_abisim.{CombinedEncoderExtractor.__name__}"
            replaced["features_extractor_kwargs"] = self._combined(key, file, shipped)
        elif not self.embeds_in_env:
            replaced["features_extractor_class"] = f"sb3_abisim.{method.extractor}"
            arguments = self.extractor_options
            if method.has_encoder_file:
                network = {} if file is None else network_arguments(file)
                frozen = {"freeze": True} if self.frozen else {}
                arguments = {"encoder": self._encoder(shipped), **network, **frozen, **arguments}
            if arguments:
                replaced["features_extractor_kwargs"] = arguments
        return replaced

    def _combined(self, key: str, file: EncoderFile | None, shipped: str | None) -> dict[str, Any]:
        """Of a Dict: an encoder for one of its images, and everything else passed on."""
        method = get_method(self.name)
        arguments: dict[str, Any] = {"encoders": {key: None}, "untrained": True}
        if method.has_encoder_file:
            arguments |= {"encoders": {key: self._encoder(shipped)}, "freeze": self.frozen}
        if file is not None:
            check_objective(file, self.name)
            arguments["networks"] = {key: stored_network(file)}
        if method.augment is not None:
            arguments["augment"] = method.augment
        return {**arguments, **self.extractor_options}

    def _key(self, file: EncoderFile | None) -> str | None:
        """Which image of a Dict the method is for; None for observations that are one image."""
        recorded = None if file is None else file.metadata["preprocessing"].get("image_key")
        if file is None or recorded is None:
            return self.image_key
        if self.image_key not in (None, recorded):
            raise ValueError(
                f"{file.path} was pretrained on the image {recorded!r}, not {self.image_key!r}; leave --image-key out, "
                f"or collect with --image-key {self.image_key} and pretrain again"
            )
        return str(recorded)

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
            if "MultiInput" in policy:
                raise ValueError(
                    f"--conf-file {self.name} needs a policy for one image observation, and {policy} is none; choose "
                    "one of the images of the Dict with --image-key"
                )
            raise ValueError(
                f"--conf-file {self.name} needs a policy for one image observation, and {policy} is none; choose "
                "another algorithm with --algo, or write a YAML file for this environment"
            )
        return replaced


def split_options(text: str) -> tuple[str, dict[str, Any]]:
    """What stands before ``,frozen`` and ``,option=value`` in the word after ``--conf-file``, and these.

    :param text: e.g. "abisim=mine.safetensors,frozen", "mine.yml,auxiliary=ssi"
    :raises ValueError: for an option that is given twice, or a value that is none of its
    """
    rest, given = text, dict[str, Any]()
    # From the end: a path may hold commas and equals signs, and so may a value.
    options: dict[str, Callable[[str], Any]] = {**_OPTIONS, _IMAGE_KEY: str}
    while match := re.fullmatch(rf"(.*),(?:(frozen)|({'|'.join(options)})=(.*))", rest):
        rest, frozen, option, value = match.groups()
        if (frozen or option) in given:
            raise ValueError(f"{text!r} says {frozen or option} twice; give {grammar()}")
        try:
            given[frozen or option] = True if frozen else options[option](value)
        except ValueError as error:
            raise ValueError(f"{option} takes no {value!r} in {text!r}; give {grammar()}") from error
    return rest, given


def given_options(given: Any) -> dict[str, Any]:
    """The options that are given, by name.

    :param given: has each as an attribute, which is false where it is not given
    """
    return {name: value for name in _OPTIONS if (value := getattr(given, name))}


def suffix_of(given: Any) -> str:
    """What stands behind method and encoder: ",frozen,task_features_dim=64".

    :param given: see :func:`given_options`; and ``frozen``
    """
    return (",frozen" if given.frozen else "") + "".join(
        f",{name}={value}" for name, value in given_options(given).items()
    )


def _encoder_name(policy_kwargs: Mapping[str, Any]) -> str | None:
    encoder = (policy_kwargs.get("features_extractor_kwargs") or {}).get("encoder")
    return None if encoder is None else str(encoder)
