"""Textures of scans: decoded to colors and alpha, once each, after their declared sizes have been counted."""

import hashlib
import io
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.images import too_many_passes
from sb3_abisim.envs.scan_nav.files import (
    MAX_IMAGE_SIDE,
    MAX_WEBP_PIXELS,
    REEXPORT,
    Budget,
    FileSpan,
    ScanFiles,
    SceneError,
)

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA")
# Pillow's modes of 8 bits per channel, whose conversion to RGB changes no color.
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "YCbCr")

# What the textures of one scan may keep in memory, shades and alpha included: a quarter of 1 GB. Pillow takes as much
# again for the largest texture while it is decoded, and a large map takes half of 1 GB.
MAX_KEPT_BYTES = 2**28

Image = tuple[NDArray[np.uint8], NDArray[np.uint8] | None]


class Images:
    """The textures of one scan.

    Before a texture is decoded, what it will keep in memory is counted. From :data:`MAX_KEPT_BYTES` on nothing more is
    decoded, and arrays of zeros that take no memory stand for textures. After a whole scan :meth:`least_factor` says by
    how much its textures have to be smaller, and it is read again with that factor.

    :param files: those of the scan
    :param budget: counts what they declare
    :param factor: by which width and height of each texture are divided
    """

    def __init__(self, files: ScanFiles, budget: Budget, factor: int = 1) -> None:
        self._files, self._budget, self._factor = files, budget, factor
        self._known: dict[str, Image] = {}
        self._seen: frozenset[bytes] = frozenset()
        self._shaded: dict[tuple[str, tuple[float, ...]], NDArray[np.uint8]] = {}
        self._veils: dict[str, NDArray[np.uint8]] = {}
        # Width, height and channels of what is kept, each as often as it is.
        self._kept: Counter[tuple[int, int, int]] = Counter()
        self._n_bytes = 0

    @property
    def n_decoded(self) -> int:
        """How many textures were decoded."""
        return len(self._known)

    def least_factor(self) -> int:
        """The least factor that is needed to keep what was asked for; 1 where everything was kept."""
        factors = range(1, MAX_IMAGE_SIDE + 1)
        return next((k for k in factors if _n_bytes(self._kept, k) <= MAX_KEPT_BYTES), MAX_IMAGE_SIDE)

    def read(self, found: str) -> Image:
        """A texture beside the scan.

        :param found: by :meth:`ScanFiles.find`
        """
        if found not in self._known:
            self._budget.check_image_file(found, self._files.size(found))
            self._known[found] = self._decode(self._files.read(found), found)
        return self._known[found]

    def decode(self, data: bytes | FileSpan, name: str) -> Image:
        """A texture inside the scan.

        :param data: a PNG, JPEG or WebP file
        :param name: for messages, and to decode it once
        """
        if name not in self._known:
            self._budget.check_image_file(name, len(data))
            self._known[name] = self._decode(data[:], name)
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
                self._shaded[key] = self._by_strips(rgb, rgb.shape, lambda strip: strip * (factor / 255))
        return self._shaded[key]

    def veil(self, found: str) -> NDArray[np.uint8]:
        """How solid a texture is by the file that holds its transparency: that file's alpha, else its brightness.

        :param found: by :meth:`ScanFiles.find`
        :return: (height, width)
        """
        rgb, alpha = self.read(found)
        if alpha is not None:
            return alpha
        if found not in self._veils:
            self._veils[found] = self._by_strips(rgb, rgb.shape[:2], lambda strip: strip.mean(axis=2))
        return self._veils[found]

    def _keep(self, width: int, height: int, channels: int) -> bool:
        """Count an array before it is made; whether it may be."""
        self._kept[width, height, channels] += 1
        self._n_bytes += width * height * channels
        return self._n_bytes <= MAX_KEPT_BYTES

    def _by_strips(
        self, rgb: NDArray[np.uint8], shape: tuple[int, ...], change: Callable[[NDArray[np.float32]], NDArray[Any]]
    ) -> NDArray[np.uint8]:
        """A texture changed in strips, since floats take four times the memory."""
        if not self._keep(rgb.shape[1], rgb.shape[0], 3 if len(shape) == 3 else 1):
            return _stand_in(*shape)
        changed = np.empty(shape, dtype=np.uint8)
        for row in range(0, len(rgb), 256):
            changed[row : row + 256] = np.rint(change(rgb[row : row + 256].astype(np.float32))).astype(np.uint8)
        return changed

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
        if image.format == "WEBP" and image.width * image.height > MAX_WEBP_PIXELS:
            raise SceneError(
                f"{self._files.path}: the texture {name} has {image.width} x {image.height} pixels, and one of WebP "
                f"may have {MAX_WEBP_PIXELS // 10**6} million; save it as PNG or JPEG"
            )
        if too_many_passes(data, *image.size):
            raise SceneError(unreadable)
        if image.mode not in _MODES:
            raise SceneError(
                f"{self._files.path}: the texture {name} has colors of the kind {image.mode}, which are not read; "
                "save it as PNG or JPEG in RGB with 8 bits per channel"
            )
        width, height = (max(1, side // self._factor) for side in image.size)
        with_alpha = "A" in image.getbands() or "transparency" in image.info
        if not self._keep(width, height, 4 if with_alpha else 3):
            return _stand_in(height, width, 3), _stand_in(height, width) if with_alpha else None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                if self._factor > 1:
                    image.draft(image.mode, (width, height))  # a JPEG is decoded to a half, a fourth or an eighth
                return _channels(image, width, height, with_alpha)
        except Exception as error:
            raise SceneError(unreadable) from error


def _n_bytes(kept: Mapping[tuple[int, int, int], int], factor: int) -> int:
    return sum(n * max(1, w // factor) * max(1, h // factor) * channels for (w, h, channels), n in kept.items())


def _stand_in(*shape: int) -> NDArray[np.uint8]:
    """Zeros of that shape, in one byte."""
    return np.broadcast_to(np.uint8(0), shape)


def _channels(image: Any, width: int, height: int, with_alpha: bool) -> Image:
    """Colors and alpha in that size, in strips: Pillow keeps four bytes of each pixel, and copies them on the way."""
    image.load()
    rgb = np.empty((height, width, 3), dtype=np.uint8)
    alpha = np.empty((height, width), dtype=np.uint8) if with_alpha else None
    n_rows = max(1, 256 * height // image.height)
    for top in range(0, height, n_rows):
        bottom = min(top + n_rows, height)
        strip = image.crop((0, top * image.height // height, image.width, bottom * image.height // height))
        rgb[top:bottom] = _averaged(strip.convert("RGB"), width, bottom - top)
        if alpha is not None:
            alpha[top:bottom] = _averaged(strip.convert("RGBA").getchannel("A"), width, bottom - top)
    return rgb, alpha


def _averaged(image: Any, width: int, height: int) -> Any:
    from PIL import Image as Pillow

    return image if image.size == (width, height) else image.resize((width, height), Pillow.Resampling.BOX)
