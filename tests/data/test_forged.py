"""Datasets and encoder files with right hashes and wrong content: refused in one sentence, within memory."""

import copy
import json
import random
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch as th
from dataset_inputs import collect_index
from zoo_inputs import write_encoder

from sb3_abisim.common.spaces import MAX_SPACE_SIZE, space_from_json
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import DOCUMENT_HASH_KEY, HASH_KEY, DatasetError, make_meta
from sb3_abisim.networks import bounded, encoder_file
from sb3_abisim.networks.bounded import BoundedTensors

VALUES = [None, -1, 0, 10**12, 1.5, float(2**70), "x", [], {}, [1], [10**6] * 3, True, "os:system", [[[]]], {"a": 1}]
_DELETED = object()
_COMPUTED = ("n_transitions", "n_frames", "shards", HASH_KEY, DOCUMENT_HASH_KEY)


def places(document: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    pairs = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    return [place for key, value in pairs for place in [(*at, key), *places(value, (*at, key))]]


def changed(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    document = copy.deepcopy(document)
    part = document
    for key in place[:-1]:
        part = part[key]
    if value is _DELETED:
        del part[place[-1]]
    else:
        part[place[-1]] = value
    return document


def peak_megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def test_a_dataset_with_any_value_in_any_place(tmp_path: Path) -> None:
    folder = collect_index(tmp_path / "d")
    meta = json.loads((folder / "meta.json").read_bytes())
    draw, before = random.Random(0), peak_megabytes()
    for place in places(meta):
        if place[0] in _COMPUTED and place[0] != "shards":
            continue
        for value in [*draw.sample(VALUES, 3), _DELETED]:
            forged = changed(meta, place, value)
            try:
                config = {key: forged[key] for key in forged if key not in _COMPUTED}
                forged = make_meta(config, forged["shards"])
            except (KeyError, TypeError, AttributeError):
                pass  # not even a hash can be made of it
            (folder / "meta.json").write_text(json.dumps(forged))
            try:
                TransitionDataset(folder, verify=False).frames(np.arange(2))
            except ValueError:
                continue
    assert peak_megabytes() - before < 300


def test_nested_without_end(tmp_path: Path) -> None:
    folder = collect_index(tmp_path / "d")
    (folder / "meta.json").write_text("[" * 100_000)
    with pytest.raises(DatasetError, match=r"meta\.json is damaged"):
        TransitionDataset(folder)


def test_an_array_whose_header_promises_more(tmp_path: Path) -> None:
    folder = collect_index(tmp_path / "d")
    path = folder / "actions-00000.npy"
    whole = path.read_bytes()
    size = int(np.load(path).shape[0])
    forged = whole.replace(f"({size},)".encode(), f"({10**11},)".encode(), 1)
    # The padding of a header makes room for the number.
    missing = len(forged) - len(whole)
    path.write_bytes(forged.replace(b" " * missing + b"\n", b"\n", 1))
    assert path.stat().st_size == len(whole)
    with pytest.raises(DatasetError, match=r"actions-00000\.npy is not an array file of a dataset"):
        TransitionDataset(folder, verify=False)


def test_spaces_are_bounded() -> None:
    box = {"type": "Box", "low": 0, "high": 255, "dtype": "uint8"}
    assert space_from_json({**box, "shape": [3, 2000, 2000]}).shape == (3, 2000, 2000)
    for document in ({**box, "shape": [3, 10**5, 10**5]}, {**box, "shape": [0]}, {"type": "MultiBinary", "n": 10**12}):
        with pytest.raises(ValueError, match=f"is empty, or larger than {MAX_SPACE_SIZE}"):
            space_from_json(document)


@pytest.mark.parametrize("network", [None, "small"])
def test_an_encoder_with_any_value_in_any_place(tmp_path: Path, network: str | None) -> None:
    path = tmp_path / "e.safetensors"
    write_encoder(path, "Nav2D-v0", **({} if network is None else {"name": network}))
    data = path.read_bytes()
    header = encoder_file._header(path, data)
    document = json.loads(header["__metadata__"][encoder_file._DOCUMENT_KEY])
    tensors = safetensors.torch.load(data)
    tensors.pop(encoder_file._HASH_KEY)
    draw, before = random.Random(0), peak_megabytes()
    sizes = [(("network", "kwargs", name), 10**9) for name in ("width", "hidden_dim", "features_dim", "depth")]
    for place, value in [*((place, draw.choice(VALUES)) for place in places(document)), *sizes]:
        path.write_bytes(encoder_file._serialize(tensors, json.dumps(changed(document, place, value)))[0])
        try:
            encoder_file.load_encoder(path)
        except ValueError:
            continue
    assert peak_megabytes() - before < 300


def test_networks_larger_than_their_file(monkeypatch: pytest.MonkeyPatch) -> None:
    with BoundedTensors(1000):
        th.nn.Linear(100, 100)
    for build in (lambda: th.nn.Linear(10**5, 10**6), lambda: th.nn.LSTM(10**5, 10**5), lambda: th.zeros(10**12)):
        with pytest.raises(ValueError, match="larger networks than the file has weights for"), BoundedTensors(1000):
            build()
    monkeypatch.setattr(bounded, "_ROOM_BYTES", 1 << 20)
    with pytest.raises(ValueError, match="larger networks"), BoundedTensors(0):
        th.nn.Sequential(*(th.nn.Linear(1, 1) for _ in range(10**6)))
