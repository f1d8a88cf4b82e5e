"""Textures of scans: decoded to colors and alpha, once each, after their declared sizes have been counted."""

import hashlib
import io
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.images import too_many_passes
from sb3_abisim.envs.scan_nav.files import REEXPORT, Budget, ScanFiles, SceneError

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA")
# Pillow's modes of 8 bits per channel, whose conversion to RGB changes no color.
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "YCbCr")

Image = tuple[NDArray[np.uint8], NDArray[np.uint8] | None]


class Images:
    """The textures of one scan.

    :param files: those of the scan
    :param budget: counts what they declare
    """

    def __init__(self, files: ScanFiles, budget: Budget) -> None:
        self._files, self._budget = files, budget
        self._known: dict[str, Image] = {}
        self._seen: frozenset[bytes] = frozenset()
        self._shaded: dict[tuple[str, tuple[float, ...]], NDArray[np.uint8]] = {}

    @property
    def n_decoded(self) -> int:
        """How many textures were decoded."""
        return len(self._known)

    def read(self, found: str) -> Image:
        """A texture beside the scan.

        :param found: by :meth:`ScanFiles.find`
        """
        if found not in self._known:
            self._known[found] = self._decode(self._files.read(found), found)
        return self._known[found]

    def decode(self, data: bytes, name: str) -> Image:
        """A texture inside the scan.

        :param data: a PNG, JPEG or WebP file
        :param name: for messages, and to decode it once
        """
        if name not in self._known:
            self._known[name] = self._decode(data, name)
        return self._known[name]

    def shaded(self, name: str, factor: NDArray[np.float32]) -> NDArray[np.uint8]:
        """A texture's colors times a factor; textures of the same factor are one array.

        :param name: of a texture that was read or decoded
        :param factor: RGB, 0..255
        """
        key = (name, tuple(factor.tolist()))
        if key not in self._shaded:
            rgb = self._known[name][0]
            if (factor == 255).all():
                self._shaded[key] = rgb
            else:
                self._budget.add_image(f"{name} in another shade", rgb.shape[1], rgb.shape[0], 0)
                shaded = np.empty_like(rgb)
                for row in range(0, len(rgb), 256):  # in strips, since floats take four times the memory
                    strip = rgb[row : row + 256].astype(np.float32) * (factor / 255)
                    shaded[row : row + 256] = np.rint(strip).astype(np.uint8)
                self._shaded[key] = shaded
        return self._shaded[key]

    def _new_bytes(self, data: bytes) -> int:
        """Of a file: the same bytes grant no more pixels under another name."""
        content_hash = hashlib.sha256(data).digest()
        known, self._seen = content_hash in self._seen, self._seen | {content_hash}
        return 0 if known else len(data)

    def _decode(self, data: bytes, name: str) -> Image:
        from PIL import Image as Pillow

        unreadable = f"{self._files.path}: the texture {name} cannot be decoded; {REEXPORT}"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of its size, which is counted here
                image = Pillow.open(io.BytesIO(data), formats=_FORMATS)
        except Exception as error:  # what Pillow raises depends on where the damage is
            raise SceneError(unreadable) from error
        self._budget.add_image(name, *image.size, self._new_bytes(data))
        if too_many_passes(data, *image.size):
            raise SceneError(unreadable)
        if image.mode not in _MODES:
            raise SceneError(
                f"{self._files.path}: the texture {name} has colors of the kind {image.mode}, which are not read; "
                "save it as PNG or JPEG in RGB with 8 bits per channel"
            )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return _channels(image)
        except Exception as error:
            raise SceneError(unreadable) from error


def _channels(image: Any) -> Image:
    """Colors and alpha, in strips: Pillow keeps four bytes of each pixel, and copies them on the way."""
    image.load()
    width, height = image.size
    rgb, alpha = np.empty((height, width, 3), dtype=np.uint8), None
    if "A" in image.getbands() or "transparency" in image.info:
        alpha = np.empty((height, width), dtype=np.uint8)
    for top in range(0, height, 256):
        strip = image.crop((0, top, width, min(top + 256, height)))
        rgb[top : top + 256] = strip.convert("RGB")
        if alpha is not None:
            alpha[top : top + 256] = strip.convert("RGBA").getchannel("A")
    return rgb, alpha
