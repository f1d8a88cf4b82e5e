"""Pretraining curves, read from the cards beside encoder files."""

import json
from typing import Any

from sb3_abisim.networks.encoder_file import EncoderFile

# What to show of an objective, the first of these that its card has, else the training loss.
TERMS = ("test/accuracy", "test/metric", "test/reconstruction", "train/loss")


def curves(files: dict[str, EncoderFile]) -> dict[str, Any]:
    """The main curve of each card, and all the others.

    :param files: encoders by name
    :return: per encoder: ``objective``, ``term`` (which curve is the main one) and ``curves`` (all of the card)
    :raises ValueError: for an encoder without card
    """
    encoders = {}
    for name, file in files.items():
        path = file.path.with_suffix(".json")
        if not path.is_file():
            raise ValueError(f"{name} has no card {path}, which holds the curves; copy it there as well")
        try:
            all_curves = json.loads(path.read_text(encoding="utf-8"))["curves"]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"the card {path} is damaged ({error!r}); copy or pretrain it again") from error
        term = next((term for term in TERMS if term in all_curves), None)
        if term is None:
            raise ValueError(f"the card {path} holds none of the curves {', '.join(TERMS)}")
        origin = {"hash": file.hash, "objective": file.metadata["objective"]}
        encoders[name] = {**origin, "term": term, "curves": all_curves}
    return {"encoders": encoders}
