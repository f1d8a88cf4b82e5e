"""A dataset that is damaged, unfinished or forged."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from dataset_inputs import collect_index, rewrite_meta, without_hashes

import sb3_abisim.data.dataset as dataset_module
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import HASH_KEY, META_NAME, DatasetError, make_meta


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return collect_index(tmp_path_factory.mktemp("data") / "index")


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def test_every_flipped_bit_is_detected(copy: Path) -> None:
    rng = np.random.default_rng(1)
    meta = json.loads((copy / META_NAME).read_bytes())
    names = [n for n in os.listdir(copy) if n.endswith(".npy") or n == META_NAME]
    detected = 0
    for name in [*rng.choice(names, size=150), *[META_NAME] * 50]:
        path = copy / name
        original = path.read_bytes()
        damaged = bytearray(original)
        damaged[rng.integers(len(damaged))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            # A flip that turns one white space of the document into another means nothing.
            assert TransitionDataset(copy).meta == meta
            assert name == META_NAME
        except DatasetError as error:
            assert name in str(error)
            detected += 1
        path.write_bytes(original)
    assert detected >= 190
    TransitionDataset(copy)


def test_truncated_and_missing_files_are_named(copy: Path) -> None:
    path = copy / "actions-00001.npy"
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(
        DatasetError, match=rf"actions-00001.npy has {len(content) - 1} bytes.*sb3-abisim collect --env"
    ):
        TransitionDataset(copy, verify=False)
    path.unlink()
    with pytest.raises(DatasetError, match=r"actions-00001\.npy is missing"):
        TransitionDataset(copy, verify=False)


def test_large_datasets_are_hashed_on_request_only(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset_module, "VERIFY_BELOW_BYTES", 1000)
    path = copy / "frames-00002.npy"
    damaged = bytearray(path.read_bytes())
    damaged[-1] ^= 1
    path.write_bytes(damaged)
    TransitionDataset(copy)
    with pytest.raises(DatasetError, match=r"frames-00002\.npy is damaged"):
        TransitionDataset(copy, verify=True)


def test_a_process_hashes_a_file_once_unless_it_changed(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hashed = []
    real = dataset_module.file_hash
    monkeypatch.setattr(dataset_module, "file_hash", lambda path: hashed.append(path) or real(path))
    TransitionDataset(copy)
    assert len(hashed) == 9 * 6
    TransitionDataset(copy)
    assert len(hashed) == 9 * 6
    os.utime(copy / "ends-00000.npy", ns=(0, 0))
    TransitionDataset(copy)
    assert hashed[9 * 6 :] == [copy / "ends-00000.npy"]


def test_a_pickle_in_place_of_an_array_is_not_run(copy: Path, tmp_path: Path) -> None:
    class Payload:
        def __reduce__(self) -> tuple[object, ...]:
            return Path.touch, (tmp_path / "executed",)

    meta = json.loads((copy / META_NAME).read_bytes())
    np.save(copy / "actions-00000.npy", np.array([Payload()], dtype=object), allow_pickle=True)
    rewrite_meta(copy, meta)
    with pytest.raises(DatasetError, match=r"actions-00000\.npy is not an array file of a dataset"):
        TransitionDataset(copy)
    assert not (tmp_path / "executed").exists()


def test_a_forged_manifest_does_not_lead_out_of_the_folder(copy: Path) -> None:
    meta = json.loads((copy / META_NAME).read_bytes())
    meta["factors"]["../../secret"] = {"dtype": "<f4", "shape": []}
    rewrite_meta(copy, meta)
    with pytest.raises(DatasetError, match="factor names"):
        TransitionDataset(copy)


def test_what_is_not_a_finished_dataset_is_refused_with_the_remedy(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"nothing is not a folder.*sb3-abisim collect"):
        TransitionDataset(tmp_path / "nothing")
    (tmp_path / "other").mkdir()
    with pytest.raises(DatasetError, match="other is not a dataset"):
        TransitionDataset(tmp_path / "other")
    meta = json.loads((copy / META_NAME).read_bytes())
    (copy / META_NAME).write_text(json.dumps(meta | {"format_version": 4}))
    with pytest.raises(DatasetError, match="format version 4, this version reads"):
        TransitionDataset(copy)
    (copy / META_NAME).unlink()
    with pytest.raises(DatasetError, match="unfinished"):
        TransitionDataset(copy)


def test_hash_depends_on_data_and_arguments_but_not_on_versions(copy: Path) -> None:
    meta = json.loads((copy / META_NAME).read_bytes())
    config, shards = without_hashes(meta), meta["shards"]
    assert make_meta(config, shards)[HASH_KEY] == meta[HASH_KEY]
    assert make_meta(config | {"versions": {"numpy": "0"}}, shards)[HASH_KEY] == meta[HASH_KEY]
    assert make_meta(config | {"seed": 4}, shards)[HASH_KEY] != meta[HASH_KEY]
    assert make_meta(config, shards[::-1])[HASH_KEY] != meta[HASH_KEY]
