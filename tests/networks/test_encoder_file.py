"""The encoder file: what comes back, and what is refused."""

import hashlib
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch as th
from encoder_file_inputs import ACTIONS, DATASET_HASH, FRAMES, SPACE, forge, save, seeded_encoder
from gymnasium import spaces

from sb3_abisim import registry
from sb3_abisim._version import __version__
from sb3_abisim.networks import encoder_file
from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import (
    EncoderFileError,
    load_encoder,
    reference_batch,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save(tmp_path / "encoder.safetensors")
    return tmp_path / "encoder.safetensors"


def test_round_trip(tmp_path: Path) -> None:
    encoder = seeded_encoder()
    hash = save(tmp_path / "e.safetensors", encoder)
    file = load_encoder(str(tmp_path / "e.safetensors"))
    assert (file.path, file.hash) == (tmp_path / "e.safetensors", hash)
    assert file.encoder.spec() == encoder.spec() and not file.encoder.training and file.encoder.is_pretrained
    for name, weight in encoder.state_dict().items():
        assert th.equal(file.encoder.state_dict()[name], weight), name
    versions = file.metadata.pop("versions")
    assert versions.keys() == {"sb3_abisim", "torch", "stable_baselines3", "gymnasium", "safetensors", "numpy"}
    assert versions["sb3_abisim"] == __version__
    assert versions["torch"] == th.__version__.split("+")[0] or versions["torch"] == th.__version__
    assert file.metadata == {
        "preprocessing": {},
        "observation_space": {
            "type": "Box",
            "shape": [3, 15, 15],
            "dtype": "uint8",
            "low": 0,
            "high": 255,
            "channel_order": "CHW",
        },
        "action_space": {"type": "Box", "shape": [2], "dtype": "float32", "low": [-1, -2], "high": [3, 4]},
        "env_id": "Nav2D-v0",
        "env_kwargs": {"n_obstacles": 3},
        "objective": "ssi",
        "settings": {"beta": 0.5, "digest": "0" * 64},
        "dataset_hash": DATASET_HASH,
    }


def test_reference_batch_is_what_the_network_makes_of_images_over_255(path: Path) -> None:
    tensors = safetensors.torch.load_file(path)
    assert np.array_equal(tensors["golden.observations"].numpy(), FRAMES)
    with th.no_grad():
        expected = seeded_encoder()(th.from_numpy(FRAMES).float() / 255)
    assert th.allclose(tensors["golden.embeddings"], expected, rtol=0, atol=1e-6)
    observations, embeddings = reference_batch(load_encoder(path))
    assert np.array_equal(observations, FRAMES) and np.array_equal(embeddings, tensors["golden.embeddings"].numpy())


def test_hash_is_sha256_with_its_bytes_blank(path: Path) -> None:
    hash = load_encoder(path).hash
    data = path.read_bytes()
    assert data.count(bytes.fromhex(hash)) == 1
    assert hashlib.sha256(data.replace(bytes.fromhex(hash), bytes(32))).hexdigest() == hash


def test_names_from_before_they_were_changed_are_read_as_todays(tmp_path: Path) -> None:
    old = {
        "holdout": 0.05,
        "dataset_digest": "0" * 64,
        "objective_kwargs": {"pairs": "near", "expectation": "behaviour"},
    }
    save(tmp_path / "e", settings=old, env_kwargs={"recolour": False})
    metadata = load_encoder(tmp_path / "e").metadata
    assert metadata["settings"] == {
        "eval_fraction": 0.05,
        "dataset_hash": "0" * 64,
        "objective_kwargs": {"pairs": "nearest", "expectation": "behavior"},
    }
    assert metadata["env_kwargs"] == {"color_jitter": False}


def test_same_arguments_same_bytes(tmp_path: Path) -> None:
    for i in range(10):
        save(tmp_path / f"{i}")
    assert len({(tmp_path / f"{i}").read_bytes() for i in range(10)}) == 1
    assert save(tmp_path / "other", seeded_encoder(1)) != save(tmp_path / "0")
    assert save(tmp_path / "other", settings={"beta": 0.25}) != save(tmp_path / "0")
    hash = save(tmp_path / "other", settings={"beta": 0.5, "c": 1})
    assert save(tmp_path / "other", settings={"c": 1, "beta": 0.5}) == hash, "the order of settings means nothing"
    hash = save(tmp_path / "other")
    assert save(tmp_path / "other", reference_observations=np.asfortranarray(FRAMES)) == hash


def test_saving_and_loading_leave_encoder_and_random_state_alone(tmp_path: Path) -> None:
    encoder = seeded_encoder().train()
    before = th.get_rng_state()
    save(tmp_path / "e", encoder)
    load_encoder(tmp_path / "e")
    assert all(module.training for module in encoder.modules()) and th.equal(th.get_rng_state(), before)


def test_no_flipped_bit_loads(path: Path) -> None:
    good = path.read_bytes()
    header_size = 8 + int.from_bytes(good[:8], "little")
    rng = np.random.default_rng(1)
    positions = [*range(0, header_size, 13), *rng.integers(0, len(good), 400).tolist(), len(good) - 1]
    for position in positions:
        bad = bytearray(good)
        bad[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        with pytest.raises(EncoderFileError) as raised:
            load_encoder(path)
        assert str(path) in str(raised.value) and "sb3-abisim pretrain" in str(raised.value)
    path.write_bytes(good)
    load_encoder(path)


@pytest.mark.parametrize("length", [0, 1, 7, 8, 9, 100, 2000, -4000, -1])
def test_truncated(path: Path, length: int) -> None:
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(EncoderFileError, match="again"):
        load_encoder(path)


def test_appended_bytes(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(EncoderFileError, match="damaged"):
        load_encoder(path)


class Payload:
    """Writes a file when unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.write_text, (self.marker, "executed"))


def test_pickle_is_not_executed(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    (tmp_path / "e.safetensors").write_bytes(pickle.dumps(Payload(marker)))
    pickle_message = r"/e\.safetensors is a pickle, which is never read, not an encoder file \(.*\); copy it again"
    with pytest.raises(EncoderFileError, match=pickle_message):
        load_encoder(tmp_path / "e.safetensors")
    th.save(Payload(marker), tmp_path / "f.safetensors")
    zip_message = r"/f\.safetensors is a zip archive \(a saved SB3 model, or a torch file\), not an encoder file \("
    with pytest.raises(EncoderFileError, match=zip_message):
        load_encoder(tmp_path / "f.safetensors")
    assert not marker.exists()


def test_zip_and_other_safetensors(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(EncoderFileError, match=r"model\.zip.*SB3 model"):
        load_encoder(tmp_path / "model.zip")
    safetensors.torch.save_file({"weight": th.ones(2)}, tmp_path / "plain")
    with pytest.raises(EncoderFileError, match="not an encoder file"):
        load_encoder(tmp_path / "plain")


@pytest.mark.parametrize(
    "header", [b"[]", b"{", b"\xff\xff", b"[" * 100_000, b"null", b'{"digest":{"dtype":"U8","data_offsets":[0,1e999]}}']
)
def test_malformed_header(tmp_path: Path, header: bytes) -> None:
    (tmp_path / "e").write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(EncoderFileError, match="again"):
        load_encoder(tmp_path / "e")


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (b"", r"is damaged or not an encoder file \(no header of a safetensors file, or cut short\); copy it again"),
        (b"1", r"is damaged or not an encoder file \(the header is not a JSON object\); copy it again"),
        (b"{}", "has no valid hash: not an encoder file, or damaged; copy it again"),
    ],
    ids=["none", "a number", "no hash"],
)
def test_the_smallest_headers(tmp_path: Path, header: bytes, message: str) -> None:
    (tmp_path / "e").write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(EncoderFileError, match=f"/e {message}"):
        load_encoder(tmp_path / "e")


def test_a_hash_of_another_type_is_none(path: Path) -> None:
    data = path.read_bytes()
    at = data.index(b'"digest":')
    forged = data[:at] + data[at:].replace(b'"dtype":"U8"', b'"dtype":"I8"', 1)
    path.write_bytes(forged)
    with pytest.raises(EncoderFileError, match="has no valid hash"):
        load_encoder(path)


def test_a_file_of_the_largest_size_is_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = path.stat().st_size
    monkeypatch.setattr(encoder_file, "MAX_FILE_BYTES", size)
    load_encoder(path)
    monkeypatch.setattr(encoder_file, "MAX_FILE_BYTES", size - 1)
    with pytest.raises(EncoderFileError, match=f"{path} has {size} bytes, more than {size - 1}; not an encoder file"):
        load_encoder(path)


def test_preprocessing_and_an_unknown_action_space(path: Path) -> None:
    assert b"preprocessing" not in path.read_bytes(), "as in files of before"
    save(path, preprocessing={"frame_stack": 4}, action_space=None)
    file = load_encoder(path)
    assert file.metadata["preprocessing"] == {"frame_stack": 4} and file.metadata["action_space"] is None
    file.check(SPACE, spaces.Discrete(4))


def test_arguments_of_a_network_that_is_no_default(tmp_path: Path) -> None:
    th.manual_seed(0)
    encoder = make_encoder(SPACE, "small", features_dim=7)
    save(tmp_path / "e", encoder)
    again = load_encoder(tmp_path / "e", network="small").encoder
    assert again.spec() == encoder.spec() and again.features_dim == 7


def test_a_network_that_cannot_be_built_without_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def factory(space: spaces.Box) -> th.nn.Module:
        if th.zeros(1).is_meta:
            raise ValueError("needs values")
        return th.nn.Sequential(th.nn.Flatten(), th.nn.Linear(675, 2))

    registry.networks()
    monkeypatch.setattr(registry._NETWORKS, "by_name", dict(registry._NETWORKS.by_name))
    registry.register_network("valued", factory)
    save(tmp_path / "e", make_encoder(SPACE, "valued"))
    assert load_encoder(tmp_path / "e").encoder.spec()["name"] == "valued"


def test_save_refuses(tmp_path: Path) -> None:
    broken = seeded_encoder()
    with th.no_grad():
        next(broken.parameters())[0] = th.nan
    with pytest.raises(ValueError, match=r"not finite.*layers\.0\.weight"):
        save(tmp_path / "e", broken)
    with pytest.raises(ValueError, match="reference_observations must be uint8"):
        save(tmp_path / "e", reference_observations=FRAMES / 255)
    with pytest.raises(ValueError, match="reference_observations must be uint8"):
        save(tmp_path / "e", reference_observations=FRAMES[:0])
    with pytest.raises(ValueError, match="JSON"):
        save(tmp_path / "e", settings={"path": Path("x")})
    with pytest.raises(ValueError, match="JSON"):
        save(tmp_path / "e", settings={"beta": float("nan")})
    with pytest.raises(ValueError, match="uint8 images"):
        save(tmp_path / "e", observation_space=spaces.Box(0, 1, (3, 15, 15)))
    assert not list(tmp_path.iterdir())


def test_full_disk_keeps_the_old_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = path.read_bytes()

    def fsync(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fsync)
    with pytest.raises(OSError, match="No space"):
        save(path, seeded_encoder(7))
    assert path.read_bytes() == old and list(path.parent.iterdir()) == [path]


def test_check_prints_both_sides(path: Path) -> None:
    file = load_encoder(path)
    file.check(SPACE, ACTIONS)
    file.check(SPACE)
    with pytest.raises(ValueError, match=r"on Nav2D-v0 with .*\[3, 15, 15\].*\[3, 16, 15\].*; use an encoder"):
        file.check(spaces.Box(0, 255, (3, 16, 15), np.uint8))
    with pytest.raises(ValueError, match=r"'high': 255.*'high': 254"):
        file.check(spaces.Box(0, 254, (3, 15, 15), np.uint8))
    with pytest.raises(ValueError, match=r"action_space.*float32.*Discrete"):
        file.check(SPACE, spaces.Discrete(4))


def test_embeddings_that_are_all_zero_agree_with_themselves(tmp_path: Path) -> None:
    encoder = seeded_encoder()
    with th.no_grad():
        for parameter in encoder.parameters():
            parameter.zero_()
    save(tmp_path / "zero", encoder)
    assert not load_encoder(tmp_path / "zero").encoder(th.rand(1, 3, 15, 15)).any()


@pytest.mark.parametrize("change", [lambda e: e[:, :5], lambda e: e[:3], lambda e: e.double()])
def test_reference_embeddings_of_another_shape_or_type_are_refused(
    path: Path, change: Callable[[th.Tensor], th.Tensor]
) -> None:
    def edit(tensors: dict[str, th.Tensor], document: dict[str, Any]) -> None:
        tensors["golden.embeddings"] = change(tensors["golden.embeddings"]).contiguous()

    forge(path, edit)
    with pytest.raises(EncoderFileError, match=r"the reference embeddings have shape \(\d, \d+\); copy it again"):
        load_encoder(path)
