"""Material libraries of OBJ files, as programs write them; what is not known to change nothing is refused."""

import posixpath
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import ScanFiles, SceneError
from sb3_abisim.envs.scan_nav.surfaces import CLAMP, REPEAT

# They are about gloss, light and bumps.
_HARMLESS = re.compile(
    "k[asm]|n[si]|tf|illum|sharpness|aniso|anisor|p[rmsc]|pcr|map_(k[sn]|n[si]|p[rmsc]|pcr|aat|ao|bump|norm|disp|refl)|"
    "map_(roughness|metallic)|bump|norm|disp|refl"
)
# Options of a texture: how many numbers or words follow.
_OPTIONS = {"-blendu": 1, "-blendv": 1, "-boost": 1, "-texres": 1, "-imfchan": 1, "-bm": 1, "-clamp": 1, "-cc": 1,
            "-type": 1, "-mm": 2}  # fmt: skip
_VECTORS = ("-o", "-s", "-t")
# Of a statement; its words are taken one by one.
_MAX_LETTERS = 4096
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")


@dataclass(frozen=True)
class Texture:
    """A texture as a material names it.

    :param name: as it is written
    :param found: where it lies, see :class:`ScanFiles`; None for one that is not there
    :param offset: added to the coordinates, after the scale
    :param scale: of the coordinates
    :param wrap: see :class:`Surface`
    """

    name: str
    found: str | None
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    wrap: tuple[str, str] = (REPEAT, REPEAT)


@dataclass
class Material:
    """What a material shows.

    :param color: RGB in 0..255, or None
    :param texture: instead of the color
    :param alpha: 1 for solid
    :param alpha_texture: what makes parts of it transparent
    """

    color: NDArray[np.float32] | None = None
    texture: Texture | None = None
    alpha: float = 1.0
    alpha_texture: Texture | None = None


def read_library(files: ScanFiles, found: str) -> dict[str, Material]:
    """The materials of a library.

    :param files: those of the scan
    :param found: the library, by :meth:`ScanFiles.find`
    :raises SceneError: for what is not known to be read right
    """
    reader = _Reader(files, found)
    text = files.read(found).decode("utf-8-sig", errors="surrogateescape")
    for line in text.splitlines():
        words = line.split(None, 1)
        if words and not words[0].startswith("#"):
            reader.take(words[0].lower(), words[1].strip() if len(words) > 1 else "")
    return {name: reader.material(statements) for name, statements in reader.statements.items()}


class _Reader:
    def __init__(self, files: ScanFiles, found: str) -> None:
        self._files, self._found = files, found
        self.statements: dict[str, dict[str, str]] = {}
        self._current: dict[str, str] | None = None

    def _bad(self, what: str) -> SceneError:
        return SceneError(f"{self._files.path}: its material library {self._found} {what}")

    def take(self, key: str, value: str) -> None:
        if len(value) > _MAX_LETTERS:
            raise self._bad(
                f"has a statement {key[:20]!r} of {len(value)} letters, more than {_MAX_LETTERS}; shorten it"
            )
        if key == "newmtl":
            name = material_name(value)
            if name in self.statements:
                raise self._bad(f"has two materials of the name {name!r}; rename one")
            self._current = self.statements.setdefault(name, {})
        elif not _HARMLESS.fullmatch(key):
            if self._current is None:
                raise self._bad(f"begins with {key!r} before its first newmtl; write newmtl first")
            self._current[key] = value

    def material(self, statements: dict[str, str]) -> Material:
        known = dict(statements)
        color, glow = self._color(known.pop("kd", None)), self._color(known.pop("ke", None))
        maps = {key: known.pop(key, None) for key in ("map_kd", "map_ke", "map_ka", "map_d")}
        alpha = self._alpha(known.pop("d", None), known.pop("tr", None))
        if known:
            raise self._bad(
                f"has the statement {next(iter(known))!r}, which is not known to change no color; delete the line if "
                "it does not"
            )
        # Light that a surface gives off is shown where it is all that there is to see.
        if color is not None and glow is not None and not color.any():
            color = glow
        shown = next((maps[key] for key in ("map_kd", "map_ke", "map_ka") if maps[key]), None)
        texture = None if shown is None else self._texture(shown)
        veil = None if not maps["map_d"] else self._texture(maps["map_d"])
        return Material(color, texture, alpha, veil)

    def _color(self, text: str | None) -> NDArray[np.float32] | None:
        if text is None:
            return None
        words = text.split("#")[0].split()
        if len(words) == 1:
            words *= 3
        if len(words) != 3 or not all(_NUMBER.match(word) for word in words):
            raise self._bad(f"has the color {text!r}, which is not three numbers; write it as R G B in 0..1")
        values = np.array(words, dtype=np.float64)
        if values.max() > 1.001:
            raise self._bad(f"has the color {text!r}, which is not in 0..1; rescale it")
        # Rounded as programs with 8 bits per channel do.
        return np.asarray(np.rint(np.clip(values, 0, 1) * 255), dtype=np.float32)

    def _alpha(self, dissolve: str | None, transparency: str | None) -> float:
        if dissolve is not None:
            return self._number("d", dissolve.replace("-halo", " "))
        if transparency is None:
            return 1.0
        value = self._number("Tr", transparency)
        if value > 0.5:
            # Some programs write 1 for solid, others for invisible.
            raise self._bad(f"has 'Tr {value:g}' without 'd', which programs read in two ways; write d instead")
        return 1 - value

    def _number(self, key: str, text: str) -> float:
        words = text.split("#")[0].split()
        if len(words) != 1 or not _NUMBER.match(words[0]) or not 0 <= float(words[0]) <= 1:
            raise self._bad(f"has '{key} {text}', which is not a number in 0..1")
        return float(words[0])

    def _texture(self, text: str) -> Texture:
        words, values = text.split(), dict.fromkeys(_VECTORS, (0.0, 0.0)) | {"-s": (1.0, 1.0)}
        wrap, rest = REPEAT, text
        while words and words[0].lower() in (*_OPTIONS, *_VECTORS):
            option = words.pop(0).lower()
            rest = rest.split(None, 1)[1] if len(rest.split(None, 1)) > 1 else ""
            n = _OPTIONS.get(option, 0)
            if option in _VECTORS:
                while n < 3 and n < len(words) - 1 and _NUMBER.match(words[n]):
                    n += 1
            given, words = words[:n], words[n:]
            for _ in given:
                rest = rest.split(None, 1)[1] if len(rest.split(None, 1)) > 1 else ""
            if option in _VECTORS:
                default = 1.0 if option == "-s" else 0.0
                values[option] = (float(given[0]) if given else default, float(given[1]) if n > 1 else default)
            elif option == "-clamp":
                wrap = CLAMP if given == ["on"] else REPEAT
            elif (
                (option == "-cc" and given == ["on"])
                or option == "-type"
                or (option == "-mm" and [float(k) for k in given] != [0, 1])
            ):
                raise self._bad(f"has the texture option '{option} {' '.join(given)}', which is not supported; bake it")
        if values["-t"] != (0.0, 0.0):
            raise self._bad("has a texture with turbulence (-t), which is not supported; bake it")
        name, found = self._find(rest.strip())
        return Texture(name, found, values["-o"], values["-s"], (wrap, wrap))

    def _find(self, text: str) -> tuple[str, str | None]:
        """A texture's file: the text as it is, without quotes, without a comment behind it."""
        spoken = [text, text.strip("\"'")]
        if " #" in text:
            spoken += [part for each in tuple(spoken) if (part := each.split(" #")[0].strip().strip("\"'"))]
        before = len(self._files.missing)
        folder = posixpath.dirname(self._found)
        for name in dict.fromkeys(spoken):
            if (found := self._files.find(name, folder)) is not None:
                del self._files.missing[before:]
                return name, found
        del self._files.missing[before:]
        self._files.missing.append(spoken[-1])
        return spoken[-1], None


def material_name(text: str) -> str:
    """A material's name as it is compared: MeshLab writes tabs, others several blanks.

    :param text: what follows newmtl or usemtl
    """
    return " ".join(text.split())
