"""Colors of vertices and faces, which programs write in several ranges."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import SceneError

MISSING_COLOR = (160, 160, 160)
# Between these two, a largest number is neither that of 0..1 nor that of 0..255.
_UNIT, _LEAST_BYTES = 1.001, 16.0
_RANGES = (255.0, 65535.0)


def to_bytes(colors: NDArray[Any], what: str) -> NDArray[np.float32]:
    """Colors as whole numbers in 0..255.

    Integers of 8 and 16 bits fill their range. Other numbers are in 0..1, 0..255 or 0..65535, by the largest of all.

    :param colors: (n, channels), nan where there is none
    :param what: they are, for messages
    :raises SceneError: for another range
    """
    if colors.dtype.kind == "u" and colors.dtype.itemsize <= 2:
        if colors.dtype.itemsize == 1:
            return colors.astype(np.float32)
        return np.asarray(np.rint(colors / 65535 * 255), dtype=np.float32)
    known = colors[~np.isnan(colors)] if colors.dtype.kind == "f" else colors
    least, largest = float(known.min(initial=0)), float(known.max(initial=0))
    whole = colors.dtype.kind in "iu"
    if least < -1e-3 or not largest <= _RANGES[-1] or (_UNIT < largest < _LEAST_BYTES and not whole):
        raise SceneError(
            f"{what} lie between {least:g} and {largest:g}, which is neither 0..1 nor 0..255 nor 0..65535; rescale them"
        )
    top = 1.0 if largest <= _UNIT and not whole else next(k for k in _RANGES if largest <= k)
    scaled = np.clip(colors.astype(np.float64) / top, 0, 1) * 255
    return np.asarray(np.rint(scaled), dtype=np.float32)
