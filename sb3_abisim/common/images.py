"""Images that something has gone wrong with before they came here, by the look of many of them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Of a progressive JPEG: each scan passes over all pixels, and takes few bytes. Ten scans are usual.
_MAX_PASSED, _FREE_SCANS = 2_000_000_000, 100

# An episode may begin in black, or with a few observations that are all the same.
N_DARK, N_SAME, N_SAME_BATCHES = 16, 64, 16


class ImageCheck:
    """Looks at the first images of a source until they are known to be images in 0..255.

    :param n_dark: so many images whose values never exceed 1, or that are all of one value, are suspicious
    :param n_same: so many images that are all the same are suspicious
    :param n_same_batches: and this many batches of them
    """

    def __init__(self, n_dark: int = N_DARK, n_same: int = N_SAME, n_same_batches: int = N_SAME_BATCHES) -> None:
        self._n_dark, self._n_same, self._n_same_batches = n_dark, n_same, n_same_batches
        self._n, self._n_batches = 0, 0
        self._largest = 0
        self._first: NDArray[np.uint8] | None = None
        self._one_value = self._all_same = True

    @property
    def is_settled(self) -> bool:
        """Whether the images are as they should be, so that no more have to be added."""
        return self._largest > 1 and not self._all_same

    def add(self, images: NDArray[np.uint8]) -> None:
        """Look at some more.

        :param images: uint8 (n, ...), all of one shape
        """
        if not images.size:
            return
        if self._first is None:
            self._first = images[0].copy()
        self._n, self._n_batches = self._n + len(images), self._n_batches + 1
        self._largest = max(self._largest, int(images.max()))
        self._one_value = self._one_value and bool((images == self._first.flat[0]).all())
        self._all_same = self._all_same and bool((images == self._first).all())

    def problem(self) -> str | None:
        """What is suspicious about those seen so far, with its likely cause; None for nothing, or too few of them."""
        if self._n >= self._n_dark and self._one_value and self._first is not None:
            return (
                f"all {self._n} observations are of one value, {int(self._first.flat[0])}: the environment renders "
                "nothing, or a wrapper has lost the image"
            )
        if self._n >= self._n_dark and self._largest <= 1:
            return (
                f"none of {self._n} observations exceeds 1, though images are uint8 in 0..255: were they scaled to "
                "0..1, or are they masks of 0 and 1? Multiply them by 255 before they become uint8"
            )
        if self._n >= self._n_same and self._n_batches >= self._n_same_batches and self._all_same:
            return f"all {self._n} observations are the same image: the environment does not draw what happens in it"
        return None


def fits(value: Any, dtype: np.dtype[Any], low: Any, high: Any) -> bool:
    """Whether an array of the declared shape holds what is declared: kind of number, and bounds, without NaN.

    :param value: the array
    :param dtype: declared; of floats, any is taken
    :param low: least values
    :param high: largest values
    """
    array = np.asarray(value)
    if not (np.can_cast(array.dtype, dtype, "same_kind") and (array.dtype.kind == "b") <= (dtype.kind == "b")):
        return False
    array = array.astype(dtype)
    return bool(((array >= low) & (array <= high)).all())


def too_many_passes(data: bytes, width: int, height: int) -> bool:
    """Whether a JPEG asks for far more passes over its pixels than programs write, which would take minutes.

    :param data: of a file in any format
    :param width: in pixels
    :param height: in pixels
    """
    n_scans = data.count(b"\xff\xda") if data.startswith(b"\xff\xd8") else 0
    return n_scans > _FREE_SCANS and n_scans * width * height > _MAX_PASSED
