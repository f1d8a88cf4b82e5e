"""Archives of arrays whose headers promise more than they hold, or that are damaged."""

import contextlib
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sb3_abisim.common.arrays import read_npz
from sb3_abisim.data.readers.arrays import import_arrays


def header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})
    return file.getvalue()


def write(path: Path, data: bytes, compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("a.npy", data)
    return path


def test_what_numpy_wrote_is_read(tmp_path: Path) -> None:
    arrays = {"a/b": np.arange(6).reshape(2, 3), "c": np.asfortranarray(np.ones((2, 2))), "d": np.array("text")}
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    found = read_npz(tmp_path / "x.npz")
    assert set(found) == set(arrays) and all(np.array_equal(found[name], arrays[name]) for name in arrays)
    assert list(read_npz(tmp_path / "x.npz", names=["c"])) == ["c"]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (header((10**12,)) + bytes(8), r"an array of float64 \(1000000000000,\) does not have 8 bytes"),
        (header((2,)) + bytes(24), "does not have 24 bytes"),
        (header((1,), "|O") + bytes(8), "an array of object"),
        (b"\x93NUMPY\x01\x00", "damaged"),
        (b"", "damaged"),
        (header((1,)).replace(b"'shape'", b"'sh\x00pe'") + bytes(8), "damaged"),
    ],
)
def test_promises_are_compared_with_what_is_there(tmp_path: Path, data: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        read_npz(write(tmp_path / "x.npz", data))
    assert "x.npz is damaged or being written" in str(refused.value)


def test_bombs_and_absent_files(tmp_path: Path) -> None:
    bomb = write(tmp_path / "x.npz", header((10**7,), "|u1") + bytes(10**7), zipfile.ZIP_DEFLATED)
    assert bomb.stat().st_size < 20_000
    with pytest.raises(ValueError, match=r"more than 1000000\)"):
        read_npz(bomb, max_bytes=10**6)
    with pytest.raises(ValueError, match=r"no item named 'b\.npy'"):
        read_npz(bomb, names=["b"])
    with pytest.raises(FileNotFoundError):
        read_npz(tmp_path / "absent.npz")


@pytest.mark.parametrize("compression", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damage_of_every_compression_is_one_sentence(tmp_path: Path, compression: int) -> None:
    """Each raises exceptions of its own."""
    data = write(tmp_path / "x.npz", header((4000,)) + np.random.default_rng(0).bytes(32000), compression).read_bytes()
    for at in (*range(30, 70), *range(70, len(data), 997)):
        (tmp_path / "x.npz").write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        with contextlib.suppress(ValueError):
            read_npz(tmp_path / "x.npz")


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damaged_episodes_of_every_compression_are_one_sentence(tmp_path: Path, compression: int) -> None:
    path = tmp_path / "x.npz"
    frames = np.random.default_rng(0).integers(0, 255, (40, 3, 9, 9), dtype=np.uint8)
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, array in (("observations", frames), ("actions", np.zeros(39, np.int64))):
            file = io.BytesIO()
            np.save(file, array)
            archive.writestr(f"{name}.npy", file.getvalue())
    data = path.read_bytes()
    for at in (60, 70, 90, 2000):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        with pytest.raises(ValueError, match=r"x\.npz"):
            import_arrays(path, tmp_path / "out")
