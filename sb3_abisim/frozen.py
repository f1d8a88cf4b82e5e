"""From a model trained on embeddings (``VecEncodeObservations``) to the equal one that acts on pictures."""

import argparse
import io
from pathlib import Path
from typing import Any, TypeVar

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, recursive_setattr

from sb3_abisim.checkpoint import RUN_COPY, load_encoder
from sb3_abisim.dataset_format import space_from_json
from sb3_abisim.extractors import extractor_class
from sb3_abisim.vec_env import EncodedBox

AlgorithmT = TypeVar("AlgorithmT", bound=BaseAlgorithm)


def fuse(model: AlgorithmT, encoder: str) -> AlgorithmT:
    """Put the encoder into a model that was trained on its embeddings.

    The result has the same heads on a frozen features extractor, as if it had been trained through the pixels; it acts
    the same and can be trained further. Saved, it is complete: it loads where the encoder file is absent.

    :param model: of any pixel algorithm, trained on ``VecEncodeObservations``; it is left as it was. A loaded one
        does not know whether its environment normalised observations: only a model that has it is refused for that
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
    if model.observation_space.digest != file.digest:
        raise ValueError(
            f"the model was trained on the embeddings of the encoder with digest {model.observation_space.digest}, "
            f"but {file.path} has {file.digest}; give the file that it was trained on"
        )
    normalize = model.get_vec_normalize_env()
    if normalize is not None and normalize.norm_obs:
        raise ValueError("the model was trained on normalised embeddings; train it with VecNormalize(norm_obs=False)")
    network = file.encoder.spec()
    # Through the format of a saved model, which knows what belongs to one.
    buffer = io.BytesIO()
    model.save(buffer)
    data: Any
    params: Any
    data, params, variables = load_from_zip_file(buffer, device=model.device)
    data["observation_space"] = space_from_json(file.contract["observation_space"])
    data["policy_kwargs"] |= {
        "features_extractor_class": extractor_class(file.contract["objective"]),
        "features_extractor_kwargs": {
            "encoder": encoder,
            "freeze": True,
            "network": network["name"],
            "network_kwargs": network["kwargs"],
        },
    }
    data["_last_obs"] = data["_last_original_obs"] = None
    # As SB3's load does it, except that the features extractor has its weights from the file.
    fused = type(model)(data["policy_class"], None, device=model.device, _init_setup_model=False)  # type: ignore[call-arg]
    fused.__dict__.update(data)
    fused._setup_model()
    params["policy"] = fused.policy.state_dict() | params["policy"]
    fused.set_parameters(params, exact_match=True, device=model.device)
    for name, value in (variables or {}).items():
        recursive_setattr(fused, f"{name}.data", value.data)
    if fused.use_sde:
        fused.policy.reset_noise()  # type: ignore[operator]
    return fused


def main(argv: list[str] | None = None) -> None:
    """Fuse a saved model.

    :param argv: the program's arguments by default
    """
    from rl_zoo3 import ALGOS

    parser = argparse.ArgumentParser(prog="python -m sb3_abisim.frozen", description=__doc__)
    parser.add_argument("model", type=Path, help="zip of a model trained on a frozen encoder's embeddings")
    parser.add_argument("-o", "--output", type=Path, required=True, help="zip to write, for its algorithm's load()")
    parser.add_argument("--algo", choices=sorted(ALGOS), required=True, help="algorithm, by rl-zoo3's name")
    parser.add_argument("-e", "--encoder", help="encoder file (default: the copy in the zoo's run folder)")
    args = parser.parse_args(argv)
    if not args.model.is_file():
        parser.error(f"there is no model {args.model}; give the zip in the folder of a run that has ended")
    encoder = args.encoder
    if encoder is None:
        copies = sorted(args.model.parent.glob(f"*/{RUN_COPY}"))
        if len(copies) != 1:
            parser.error(f"{args.model.parent} holds {len(copies)} encoder files */{RUN_COPY}; give --encoder")
        encoder = str(copies[0])
    # As Stable-Baselines3 does.
    output = args.output if args.output.suffix else args.output.with_suffix(".zip")
    try:
        fuse(ALGOS[args.algo].load(args.model, device="cpu"), encoder).save(output)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(f"Wrote {output}, a model that acts on pictures")


if __name__ == "__main__":
    main()
