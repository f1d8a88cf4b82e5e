"""NumPy's .npz archives, whose declared shapes are compared with what is there before memory is taken."""

import io
import lzma
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.files import is_of_system

MAX_BYTES = 1 << 28
# What NumPy and zipfile raise, beside OSError, for bytes that are damaged: a header is parsed as Python.
ARRAY_ERRORS = (
    EOFError, KeyError, ValueError, TypeError, IndexError, SyntaxError, NotImplementedError, RuntimeError, MemoryError,
    OverflowError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, tokenize.TokenError,
)  # fmt: skip


def read_npz(
    path: str | os.PathLike[str], max_bytes: int = MAX_BYTES, names: Sequence[str] | None = None
) -> dict[str, NDArray[Any]]:
    """The arrays of an archive.

    :param path: the file
    :param max_bytes: that they may take together
    :param names: of those to read; None for all
    :raises ValueError: naming the file, when it is damaged, being written or larger
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(info.file_size for info in archive.infolist())
            if size > max_bytes:
                raise ValueError(f"it holds {size} bytes, more than {max_bytes}")
            found = [name.removesuffix(".npy") for name in archive.namelist()] if names is None else names
            return {name: _read_npy(archive.read(f"{name}.npy")) for name in found}
    except (OSError, *ARRAY_ERRORS) as error:
        if isinstance(error, FileNotFoundError) or is_of_system(error):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            f"{Path(path)} is damaged or being written ({reason}); try again, copy it again, or leave it out"
        ) from error


def _read_npy(data: bytes) -> NDArray[Any]:
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    left = len(data) - file.tell()
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"an array of {dtype} {shape} does not have {left} bytes")
    file.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array
