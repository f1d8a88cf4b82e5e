"""What a pretraining run is made of: the settings, read from the YAML files keyed by environment id."""

import dataclasses
import math
from typing import Any

from sb3_abisim.common.method_settings import settings_entry

# Batches of the eval split that a row of the log is the mean of.
N_EVAL_BATCHES = 8
# What encoders and decoders compute in while they train; the first is the default.
PRECISIONS = ("float32", "bf16")
# Arguments of an objective that follow from other settings.
FOLLOWING = {"k", "encoder", "action_space", "base_encoder"}


@dataclasses.dataclass(frozen=True)
class PretrainConfig:
    """The settings of one pretraining run; the keys of the YAML files are these names.

    :param n_updates: optimizer steps; 0 leaves the weights as they begin, standardized: the control of an encoder
    :param batch_size: transitions per update
    :param learning_rate: of Adam; a number keeps it constant, ``lin_NUMBER`` lowers it in a straight line to 0, as in
        the zoo's files
    :param k: steps between the two observations of a transition; ``[fewest, most]`` takes all pairs of observations
        with a number of steps in this range
    :param chunk_length: batches are made of chunks of this many transitions that follow each other in an episode.
        Above 1, objectives that embed both observations have fewer to embed (docs/pretraining.md)
    :param precision: "float32", or "bf16", which computes encoders and decoders in bfloat16 while they train
        (docs/pretraining.md)
    :param eval_fraction: share of the episodes that is only evaluated on, 0 <= eval_fraction < 1
    :param log_interval: updates between two rows of the log
    :param checkpoint_interval: least updates between two checkpoints, each written at a row of the log
    :param network: name of the encoder network, None for the default of the observation's shape
    :param network_kwargs: its constructor arguments
    :param objective_kwargs: constructor arguments of the objective
    """

    n_updates: int = 20_000
    batch_size: int = 256
    learning_rate: float | str = 1e-4
    k: int | list[int] = 1
    chunk_length: int = 1
    precision: str = PRECISIONS[0]
    eval_fraction: float = 0.05
    log_interval: int = 500
    checkpoint_interval: int = 1_000
    network: str | None = None
    network_kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)
    objective_kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("n_updates", "batch_size", "chunk_length", "log_interval", "checkpoint_interval"):
            value, least = getattr(self, name), 0 if name == "n_updates" else 1
            if not _is_count(value, least):
                raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
        bounds = self.k if isinstance(self.k, list) and len(self.k) == 2 else [self.k, self.k]
        if not all(map(_is_count, bounds)) or bounds[0] > bounds[1]:  # type: ignore[operator]
            raise ValueError(f"k must be a whole number of at least 1, or [fewest, most], got {self.k!r}")
        if not 0 < self.learning_rate_at(0) < math.inf:
            raise ValueError(f"learning_rate must be a number above 0, got {self.learning_rate!r}")
        if not isinstance(self.eval_fraction, int | float) or not 0 <= self.eval_fraction < 1:
            raise ValueError(f"eval_fraction must lie in [0, 1), got {self.eval_fraction!r}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"precision must be one of {PRECISIONS}, got {self.precision!r}")
        for name in ("network_kwargs", "objective_kwargs"):
            if not isinstance(getattr(self, name), dict):
                raise ValueError(f"{name} must be a mapping, got {getattr(self, name)!r}")

    def learning_rate_at(self, n_updates: int) -> float:
        """The learning rate of an update.

        :param n_updates: how many updates came before it
        """
        if isinstance(self.learning_rate, int | float):
            return self.learning_rate
        if not isinstance(self.learning_rate, str):
            raise ValueError(f"learning_rate must be a number or lin_NUMBER, got {self.learning_rate!r}")
        try:
            initial = float(self.learning_rate.removeprefix("lin_"))
        except ValueError:
            initial = 0.0
        if not self.learning_rate.startswith("lin_") or not initial > 0:
            raise ValueError(f"learning_rate must be a number or lin_NUMBER, got {self.learning_rate!r}")
        return initial * (1.0 - n_updates / max(self.n_updates, 1))

    def as_settings(self) -> dict[str, Any]:
        """The settings by name, as encoder files hold them.

        Those of files from before ``chunk_length`` and ``precision`` existed stay equal to those of the same run now.
        """
        settings = dataclasses.asdict(self)
        if self.chunk_length == 1:
            del settings["chunk_length"]
        if self.precision == PRECISIONS[0]:
            del settings["precision"]
        return settings

    @classmethod
    def from_mapping(cls, mapping: dict[str, Any]) -> "PretrainConfig":
        """Build from YAML or keyword settings.

        :param mapping: setting to value
        :raises ValueError: for a key that is no setting
        """
        known = {field.name for field in dataclasses.fields(cls)}
        unknown = sorted(set(mapping) - known)
        if unknown:
            raise ValueError(f"unknown pretraining setting {', '.join(unknown)}; known are {', '.join(sorted(known))}")
        return cls(**mapping)


def _is_count(value: Any, least: int = 1) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def load_config(objective: str, env_id: str, overrides: dict[str, Any] | None = None) -> PretrainConfig:
    """The settings for a method and an environment, from the method's YAML file.

    :param objective: name of the method
    :param env_id: key in the file; an id that is not there gets the entry ``default``, or without a file the defaults
        of :class:`PretrainConfig`
    :param overrides: settings that replace those of the file; a dotted name such as ``objective_kwargs.c`` replaces
        one entry of a nested setting
    :raises ValueError: for an unknown method or setting
    """
    _, mapping = settings_entry(objective, env_id)
    for name, value in (overrides or {}).items():
        outer, _, inner = name.partition(".")
        if inner and not isinstance(mapping.get(outer, {}), dict):
            raise ValueError(f"{outer} has no parts, so {name!r} cannot be set")
        mapping[outer] = {**mapping.get(outer, {}), inner: value} if inner else value
    return PretrainConfig.from_mapping(mapping)
