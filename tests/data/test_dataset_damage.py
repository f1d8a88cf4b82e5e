"""A dataset that is damaged, unfinished or forged."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_inputs import N, collect_index, rewrite_meta, tree, without_hashes

import sb3_abisim.data.dataset as dataset_module
from sb3_abisim.common.files import file_hash
from sb3_abisim.data import chains
from sb3_abisim.data.collect import collect
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CONFIG_NAME, CUT, HASH_KEY, INSIDE, META_NAME, TERMINATED, DatasetError, make_meta

CHAINED = {"format_version": 3, "shards_per_chain": 1}


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


def test_datasets_below_the_limit_are_hashed(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    meta = json.loads((copy / META_NAME).read_bytes())
    size = sum(entry["bytes"] for shard in meta["shards"] for entry in shard["files"].values())
    hashed: list[Path] = []
    monkeypatch.setattr(dataset_module, "file_hash", lambda path: hashed.append(path) or file_hash(path))
    for limit, n_hashed in ((size, 0), (size + 1, 9 * 6)):
        monkeypatch.setattr(dataset_module, "VERIFY_BELOW_BYTES", limit)
        TransitionDataset(copy)
        assert len(hashed) == n_hashed


def test_a_damaged_copy_is_not_taken_for_the_original(folder: Path, copy: Path) -> None:
    """Size, time and the hash that it should have are those of a file that this process has found right."""
    TransitionDataset(folder)
    path = copy / "frames-00002.npy"
    status, damaged = path.stat(), bytearray(path.read_bytes())
    damaged[-1] ^= 1
    path.write_bytes(damaged)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    with pytest.raises(DatasetError, match=r"frames-00002\.npy is damaged"):
        TransitionDataset(copy)


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


def test_a_header_that_never_ends_is_one_sentence(copy: Path) -> None:
    """NumPy reads it as Python, whose tokenizer raises an error of its own."""
    path = copy / "actions-00000.npy"
    path.write_bytes(b"\x93NUMPY\x01\x00\x40\x00" + b"(" * 200)
    rewrite_meta(copy, json.loads((copy / META_NAME).read_bytes()))
    with pytest.raises(DatasetError, match=r"actions-00000\.npy is not an array file of a dataset"):
        TransitionDataset(copy)


@pytest.mark.parametrize(
    ("change", "held"),
    [(lambda a: a.astype(np.int32), r"int32 \((\d+),\)"), (lambda a: np.stack([a, a], axis=1), r"int64 \(\d+, 2\)")],
    ids=["type", "shape"],
)
def test_arrays_of_another_type_or_shape_are_refused(copy: Path, change: Any, held: str) -> None:
    path = copy / "actions-00001.npy"
    np.save(path, change(np.load(path)))
    rewrite_meta(copy, json.loads((copy / META_NAME).read_bytes()))
    with pytest.raises(DatasetError, match=rf"actions-00001\.npy holds {held}, its manifest says <?int64 \(\d+,\)"):
        TransitionDataset(copy)


@pytest.mark.parametrize("shard", [0, 8])
@pytest.mark.parametrize("harm", ["one more", "unknown", "moved"])
def test_ends_that_contradict_the_manifest_are_refused(copy: Path, harm: str, shard: int) -> None:
    path = copy / f"ends-0000{shard}.npy"
    ends = np.load(path)
    if harm != "unknown":
        ends[np.flatnonzero(ends == INSIDE)[0]] = TERMINATED
    if harm != "one more":
        ends[-1] = CUT + 1 if harm == "unknown" else INSIDE
    np.save(path, ends)
    rewrite_meta(copy, json.loads((copy / META_NAME).read_bytes()))
    with pytest.raises(DatasetError, match=f"the episode ends of {copy} contradict its meta.json; it is damaged or"):
        TransitionDataset(copy)


@pytest.mark.parametrize(
    ("changes", "remedy"),
    [
        ({}, ""),
        ({"env_kwargs": {"size": 3}}, " with its --env-kwargs"),
        (CHAINED | {"preprocessing": {"frame_stack": 2}}, r" and its preprocessing, \{'frame_stack': 2\}"),
    ],
    ids=["plain", "arguments", "preprocessing"],
)
def test_the_remedy_is_the_command_that_collected(copy: Path, changes: dict[str, Any], remedy: str) -> None:
    rewrite_meta(copy, {**json.loads((copy / META_NAME).read_bytes()), **changes})
    (copy / "ends-00000.npy").unlink()
    command = f"sb3-abisim collect --env IndexEnv-v0 -n 420 --seed 3 --n-envs 4 -o {copy}"
    with pytest.raises(DatasetError, match=f"collects damaged shards anew: {command}{remedy}$"):
        TransitionDataset(copy)


def test_a_document_that_is_no_manifest_names_the_remedy(copy: Path) -> None:
    (copy / META_NAME).write_text("[]")
    remedy = "run the command that made the dataset again, in a new folder if it refuses"
    with pytest.raises(DatasetError, match=f"{META_NAME} is damaged, or not that of a dataset: .*; {remedy}$"):
        TransitionDataset(copy)


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


def test_a_damaged_config_does_not_alter_a_finished_dataset(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of its keys, the versions alone are not compared with the command's."""
    monkeypatch.setattr(chains, "SHARD_TRANSITIONS", 48)
    before, config = tree(copy), (copy / CONFIG_NAME).read_bytes()
    (copy / CONFIG_NAME).write_bytes(config.replace(b"\n", b"\r", 1).replace(b": ", b":\t", 1))
    assert (copy / CONFIG_NAME).read_bytes() != config
    collect("IndexEnv-v0", N, copy, n_envs=4, seed=3)
    assert tree(copy) == before
    versions = json.loads(config)["versions"]
    changed = {**json.loads(config), "versions": {**versions, "numpy": "0.0"}}
    (copy / CONFIG_NAME).write_text(json.dumps(changed))
    with pytest.raises(DatasetError, match=r"config\.json is damaged \(its versions are not those of meta\.json\)"):
        collect("IndexEnv-v0", N, copy, n_envs=4, seed=3)
