"""Names inside files that were written before they were renamed, mapped to today's names, in this one place.

Files keep their bytes, and so their hashes: whoever reads settings, curves or results of a file passes them through
here.
"""

from typing import Any

# Settings of pretraining, and of objectives.
_SETTINGS = {
    "run_length": "chunk_length",
    "holdout": "eval_fraction",
    "change_weight": "delta_scale",
    "dataset_digest": "dataset_hash",
    "base_digest": "base_hash",
}
# Values of a setting.
_VALUES = {
    ("adaptive", "above_chance"): "chance_corrected",
    ("expectation", "behaviour"): "behavior",
    ("pairs", "near"): "nearest",
}
# Keyword arguments of environments.
_ENV_KWARGS = {"recolour": "color_jitter"}
# Fields of a scan map, and its settings.
_SCAN_MAP = {"metres_per_pixel": "meters_per_pixel"}
# What a model card says of its dataset.
_DATASET = {"digest": "hash", "fingerprint": "content_hash"}
# Prefixes and terms of logs.
_PREFIXES = {"test": "eval"}
_TERMS = {"prediction": "inverse_nll", "contrast": "info_nce", "metric": "metric_loss"}
# Ways of acting in final evaluations.
_MODES = {"sampled": "stochastic"}


def current_settings(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of pretraining under today's names.

    :param settings: as a file holds them, or today's
    """
    return {_SETTINGS.get(name, name): _current_value(name, value) for name, value in settings.items()}


def _current_value(name: str, value: Any) -> Any:
    if isinstance(value, dict):
        return current_settings(value)
    return _VALUES.get((name, value), value) if isinstance(value, str) else value


def current_env_kwargs(env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """Keyword arguments of an environment under today's names.

    :param env_kwargs: as a file holds them, or today's
    """
    return {_ENV_KWARGS.get(name, name): value for name, value in env_kwargs.items()}


def current_scan_map(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields or settings of a scan map under today's names.

    :param fields: as a file holds them, or today's
    """
    return {_SCAN_MAP.get(name, name): value for name, value in fields.items()}


def current_dataset(dataset: dict[str, Any]) -> dict[str, Any]:
    """What a model card says of its dataset, under today's names.

    :param dataset: as a file holds it, or today's
    """
    named = {_DATASET.get(name, name): value for name, value in dataset.items()}
    return {**named, "env_kwargs": current_env_kwargs(named["env_kwargs"])}


def current_term(name: str) -> str:
    """The name of a log's column, or of a term without its prefix.

    :param name: such as "test/metric", "train/loss" or "metric"
    """
    prefix, slash, term = name.rpartition("/")
    return _PREFIXES.get(prefix, prefix) + slash + _TERMS.get(term, term)


def current_result(name: str) -> str:
    """The name of an array of final evaluations.

    :param name: such as "sampled/eval/results"
    """
    mode, slash, rest = name.partition("/")
    return _MODES.get(mode, mode) + slash + rest
