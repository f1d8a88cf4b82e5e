"""Checks of loaded models: what a model holds, compared with what was asked for."""

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_abisim.networks.encoder_file import EncoderNotFoundError, load_encoder
from sb3_abisim.rl.extractors import BaseEncoderExtractor, PretrainedExtractor


def find_extractors(policy: nn.Module) -> list[tuple[str, BaseEncoderExtractor]]:
    """The extractors of a policy by name, each object once, without those of target networks.

    :param policy: ``model.policy``
    """
    return [
        (name, module)
        for name, module in policy.named_modules()
        if isinstance(module, BaseEncoderExtractor) and not name.split(".")[0].endswith("_target")
    ]


def require_weights(model: BaseAlgorithm) -> None:
    """Raise if the model has an extractor whose encoder file was not found; call it before training.

    The first ``forward`` would raise as well, but off-policy algorithms first act at random for a while.

    :param model: an SB3 model
    :raises EncoderNotFoundError: (a ``FileNotFoundError``) listing the places searched
    """
    for _, extractor in find_extractors(model.policy):
        if isinstance(extractor, PretrainedExtractor):
            extractor.require_weights()


def check_trained_with(model: BaseAlgorithm, policy_kwargs: dict[str, Any]) -> None:
    """Refuse a model whose extractors are not those that ``policy_kwargs`` would build.

    An encoder file that is not there is taken for the model's: a saved model is complete without it. A custom extractor
    has to check what it holds by itself.

    :param model: an SB3 model
    :param policy_kwargs: as for a new model
    :raises ValueError: with both sides
    """
    asked_class = policy_kwargs.get("features_extractor_class")
    kwargs = policy_kwargs.get("features_extractor_kwargs") or {}
    here, hash, absent = "none of our extractors", None, False
    if asked_class is not None:
        if not (isinstance(asked_class, type) and issubclass(asked_class, BaseEncoderExtractor)):
            return
        if issubclass(asked_class, PretrainedExtractor):
            try:
                hash = load_encoder(kwargs["encoder"], kwargs.get("network")).hash
            except EncoderNotFoundError:
                absent = True
        here = _name(asked_class, bool(kwargs.get("freeze", False)), hash)
    extractors = [extractor for _, extractor in find_extractors(model.policy)]
    there = {_name(type(each), each.frozen, None if absent else each.hash) for each in extractors}
    there = there or {"none of our extractors"}
    if there != {here}:
        raise ValueError(f"it was trained with {' and '.join(sorted(there))}, not with {here}")


def _name(extractor: type[BaseEncoderExtractor], frozen: bool, hash: str | None) -> str:
    return extractor.__name__ + f", hash {hash}" * (hash is not None) + ", frozen" * frozen
