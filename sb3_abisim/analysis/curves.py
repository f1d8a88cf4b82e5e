"""Pretraining curves, read from the model cards beside encoder files."""

from typing import Any

from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.pretraining.card import read_card
from sb3_abisim.registry import methods

LOSS = "train/loss"


def curves(files: dict[str, EncoderFile]) -> dict[str, Any]:
    """The main curve of each model card, and all the others.

    :param files: encoders by name
    :return: per encoder: ``objective``, ``term`` (which curve is the main one: what its method names, of the eval split
        where there is one, else the training loss) and ``curves`` (all of the card)
    :raises ValueError: for an encoder without a model card, or a damaged one
    """
    known, encoders = methods(), {}
    for name, file in files.items():
        path = file.path.with_suffix(".json")
        if not path.is_file():
            raise ValueError(f"{name} has no model card {path}, which holds the curves; copy it there as well")
        all_curves = read_card(path)["curves"]
        objective = file.metadata["objective"]
        main = [f"{split}/{known[objective].curve}" for split in ("eval", "train")] if objective in known else []
        term = next((term for term in (*main, LOSS) if term in all_curves), None)
        if term is None:
            raise ValueError(f"the model card {path} holds none of the curves {', '.join((*main, LOSS))}")
        encoders[name] = {"hash": file.hash, "objective": objective, "term": term, "curves": all_curves}
    return {"encoders": encoders}
