"""``policy_kwargs`` of Stable-Baselines3's algorithms, read from encoder files."""

import os
from collections.abc import Mapping
from typing import Any

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.networks.encoder_name import pinned_name
from sb3_abisim.rl.combined import CombinedEncoderExtractor
from sb3_abisim.rl.extractors import EncoderExtractor
from sb3_abisim.rl.file_network import stored_network

_File = str | os.PathLike[str]


def policy_kwargs(
    encoder: _File | Mapping[str, _File],
    freeze: bool = False,
    *,
    network: str | None = None,
    extractor_kwargs: Mapping[str, Any] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """``policy_kwargs`` for an encoder file; a new dictionary at every call, since SB3 writes into it.

    What the file knows is read from it. Its network stands in the result, so that a saved model loads where the file
    is absent. A name on the Hub gets the commit that it leads to now.

    :param encoder: as for :class:`~sb3_abisim.rl.extractors.EncoderExtractor`; for dictionary observations a mapping
        of image keys to such files
    :param freeze: True keeps the weights as they are; False lets the RL algorithm train them
    :param network: ``pkg.module:Factory``, for a file that names a network of yours, which is imported
    :param extractor_kwargs: further arguments of the features extractor: ``task_features_dim``, ``augment``
    :param more: further entries, such as ``net_arch``
    :raises FileNotFoundError: if there is no such encoder
    :raises ValueError: for a damaged file, or an entry that this function sets
    """
    taken = sorted(name for name in more if name.startswith("features_extractor_"))
    if taken:
        raise ValueError(
            f"policy_kwargs sets {', '.join(taken)} from the file; leave it out (further arguments of the extractor "
            "are extractor_kwargs), or write the dict by hand"
        )
    extractor: type = EncoderExtractor
    kwargs: dict[str, Any]
    if isinstance(encoder, Mapping):
        extractor = CombinedEncoderExtractor
        names = {key: pinned_name(file) for key, file in encoder.items()}
        kwargs = {
            "encoders": names,
            "networks": {key: stored_network(load_encoder(name, network)) for key, name in names.items()},
        }
    else:
        name = pinned_name(encoder)
        kwargs = {"encoder": name, **stored_network(load_encoder(name, network))}
    return {
        "features_extractor_class": extractor,
        "features_extractor_kwargs": {**kwargs, "freeze": freeze, **(extractor_kwargs or {})},
        **more,
    }
