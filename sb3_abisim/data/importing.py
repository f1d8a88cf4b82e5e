"""Import what something else has recorded, by any registered reader, and say what was understood."""

import inspect
import os
import warnings
from typing import Any

import numpy as np

from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CUT, TERMINATED, TRUNCATED
from sb3_abisim.data.image_warning import warn_of_images
from sb3_abisim.registry import Reader, get_reader

# Keys of a dataset's ``source`` that the report reads. Readers write what they know.
CHANNELS_KEY = "channels"  # "first", "last" or "none", as the source has them
LOSSY_KEY = "lossy"  # what altered the observations before the import; None for nothing
LEFT_OUT_KEY = "left_out"  # list of texts
# Episodes whose end the source does not show.
UNSEEN_ENDS_KEY = "unseen_ends"


def import_dataset(
    reader: str, source: Any, folder: str | os.PathLike[str], *, verbose: int = 1, **options: Any
) -> str:
    """Make a dataset folder of what something else has recorded; rewards are dropped.

    :param reader: name of a registered one: "arrays", "buffer", "lerobot", "minari", or yours
    :param source: what it reads: a path, an id, or in Python an object
    :param folder: new or empty
    :param verbose: 1 prints a report of what was understood, 0 nothing
    :param options: of the reader, such as ``env_id`` and ``image_key``; None leaves one out
    :return: the hash of the new dataset
    :raises ValueError: for an unknown reader or option, or if anything does not fit
    :raises ImportError: without a package that the reader needs, naming the command that installs it
    """
    record = get_reader(reader)
    given = {name: value for name, value in options.items() if value is not None}
    _check_options(record, given)
    hash = record.read_fn(source, folder, **given)
    dataset = TransitionDataset(folder, eval_fraction=0.0, verify=False)
    _warn_without_ends(dataset)
    warn_of_images(dataset)
    if verbose:
        print(import_report(folder))
    return hash


def _check_options(record: Reader, given: dict[str, Any]) -> None:
    parameters = inspect.signature(record.read_fn).parameters.values()
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    known = [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]
    for name in given:
        if name not in known:
            raise ValueError(f"reader {record.name!r} takes no {name}; it takes {', '.join(known) or 'no options'}")


def _warn_without_ends(dataset: TransitionDataset) -> None:
    if np.isin(dataset.ends, (TERMINATED, TRUNCATED)).any() or _said(dataset, UNSEEN_ENDS_KEY):
        return
    warnings.warn(
        f"no episode ends among the {dataset.n_transitions} transitions in {dataset.path}, as far as its source says: "
        "they may show only the first steps of episodes; record terminations and truncations",
        stacklevel=3,
    )


def _said(dataset: TransitionDataset, key: str) -> Any:
    # What else has written it may say of its source whatever it likes.
    source = dataset.meta["source"]
    return source.get(key) if isinstance(source, dict) else None


def import_report(folder: str | os.PathLike[str]) -> str:
    """What a reader understood, in a few lines.

    :param folder: of a dataset that was imported
    :raises DatasetError: if it is not a finished dataset
    """
    dataset = TransitionDataset(folder, eval_fraction=0.0, verify=False)
    source = dataset.meta["source"]
    known = isinstance(source, dict)
    space, ends = dataset.observation_space, dataset.ends
    counts = {name: int((ends == end).sum()) for name, end in _ENDS.items()}
    lossy, left_out = _said(dataset, LOSSY_KEY), _said(dataset, LEFT_OUT_KEY)
    factors = [f"{name} {tuple(row['shape']) or ''}".strip() for name, row in dataset.meta["factors"].items()]
    lines = {
        "environment": dataset.env_id,
        "observations": f"{space.dtype} {space.shape}, {_CHANNELS.get(str(_said(dataset, CHANNELS_KEY)), _STORED)}",
        "actions": f"{dataset.action_space}",
        "episodes": f"{sum(counts.values())}: {', '.join(f'{n} {name}' for name, n in counts.items())}",
        "transitions": f"{dataset.n_transitions}",
        "factors": ", ".join(factors) or "none",
        "lossy": f"yes, {lossy}" if lossy else "no" if known and LOSSY_KEY in source else _UNSAID,
        "left out": "; ".join(left_out) or "nothing" if isinstance(left_out, list) else _UNSAID,
    }
    title = f"{dataset.path}: imported (hash {dataset.hash[:16]}); rewards were dropped"
    return "\n".join([title, *(f"  {name:12}  {text}" for name, text in lines.items())])


_ENDS = {"terminated": TERMINATED, "truncated": TRUNCATED, "cut": CUT}
_STORED = "channels first"
_CHANNELS = {
    "first": _STORED,
    "last": f"{_STORED} (last in the source)",
    "none": f"{_STORED} (gray without channels in the source)",
}
_UNSAID = "the reader does not say"
