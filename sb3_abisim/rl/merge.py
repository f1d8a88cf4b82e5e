"""From a model trained on embeddings (``VecEncodeObservations``) to the equal one that acts on observations."""

import io
from typing import Any, TypeVar

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, recursive_setattr

from sb3_abisim.common.spaces import space_from_json
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.extractor_classes import extractor_class
from sb3_abisim.rl.vec_encode import EncodedBox

AlgorithmT = TypeVar("AlgorithmT", bound=BaseAlgorithm)


def merge_encoder(model: AlgorithmT, encoder: str) -> AlgorithmT:
    """Put the encoder into a model that was trained on its embeddings.

    The result has the same heads on a frozen features extractor, as if it had been trained through the pixels; it acts
    the same and can be trained further. Saved, it is complete: it loads where the encoder file is absent.

    :param model: of any pixel algorithm, trained on ``VecEncodeObservations``; it is left as it was. Normalized
        embeddings are refused only while the model has its environment: a loaded model does not know of them
    :param encoder: the encoder file that it was trained on, as for ``VecEncodeObservations``
    :return: a model of the same class without an environment, on the same device
    :raises FileNotFoundError: if there is no such encoder
    :raises ValueError: for a model that was trained on something else
    """
    file = load_encoder(encoder)
    if not isinstance(model.observation_space, EncodedBox):
        raise ValueError(
            f"the model was trained on {model.observation_space}, not on the embeddings of an encoder; "
            "wrap its environment in VecEncodeObservations and train it with MlpPolicy"
        )
    if model.observation_space.hash != file.hash:
        raise ValueError(
            f"the model was trained on the embeddings of the encoder with hash {model.observation_space.hash}, "
            f"but {file.path} has {file.hash}; give the file that it was trained on"
        )
    normalize = model.get_vec_normalize_env()
    if normalize is not None and normalize.norm_obs:
        raise ValueError("the model was trained on normalized embeddings; train it with VecNormalize(norm_obs=False)")
    network = file.encoder.spec()
    # Through the format of a saved model, which knows what belongs to one.
    buffer = io.BytesIO()
    model.save(buffer)
    data: Any
    params: Any
    data, params, variables = load_from_zip_file(buffer, device=model.device)
    data["observation_space"] = space_from_json(file.metadata["observation_space"])
    data["policy_kwargs"] |= {
        "features_extractor_class": extractor_class(file.metadata["objective"]),
        "features_extractor_kwargs": {
            "encoder": encoder,
            "freeze": True,
            "network": network["name"],
            "network_kwargs": network["kwargs"],
        },
    }
    data["_last_obs"] = data["_last_original_obs"] = None
    # As SB3's load does it, except that the features extractor has its weights from the file.
    merged = type(model)(data["policy_class"], None, device=model.device, _init_setup_model=False)  # type: ignore[call-arg]
    merged.__dict__.update(data)
    merged._setup_model()
    params["policy"] = merged.policy.state_dict() | params["policy"]
    merged.set_parameters(params, exact_match=True, device=model.device)
    for name, value in (variables or {}).items():
        recursive_setattr(merged, f"{name}.data", value.data)
    if merged.use_sde:
        merged.policy.reset_noise()  # type: ignore[operator]
    return merged
