"""A scanned place seen from straight above: colors, heights, and where one can walk.

An orthographic camera that looks straight down at a place that does not change sees, wherever it is, a part of one
map. :class:`ScanMap` is that map. It is made once from a mesh (:meth:`ScanMap.from_mesh`, :meth:`ScanMap.apartment`)
and kept in a cache, or comes as a ``.npz`` file from elsewhere.
"""

import hashlib
import json
import os
import sys
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.arrays import read_npz
from sb3_abisim.common.extras import require_extra
from sb3_abisim.common.files import file_hash, is_of_system, write_atomic
from sb3_abisim.common.paths import CACHE_VARIABLE, cache_folder
from sb3_abisim.common.vocabulary import current_scan_map
from sb3_abisim.envs.scan_nav.build import MapSettings, map_fields
from sb3_abisim.envs.scan_nav.files import SceneError, warn_missing
from sb3_abisim.envs.scan_nav.mesh import load_mesh
from sb3_abisim.envs.scan_nav.report import plausible_report, with_walkable

FORMAT = "sb3_abisim scan map 1"
MIN_WALKABLE_AREA = 1.0  # m2
# Hashed into the names of cached maps: raise it where the same mesh gives another map.
_VERSION = 7


@dataclass(frozen=True, eq=False)
class ScanMap:
    """A place seen from straight above. Rows run from north to south, columns from west to east.

    :param orthophoto: uint8 (height, width, 3), RGB, black where there is no surface
    :param height: float32 (height, width), above the floor in m, nan where there is no surface
    :param walkable: bool (height, width), where the agent's center can be
    :param meters_per_pixel: the size of a pixel
    :param origin: x (east) and y (north) of the map's north-western corner in the scan's coordinates, in m
    :param source: where it comes from
    :param settings: how it was made, JSON types
    :raises SceneError: where the parts do not fit together, or less than 1 m2 is walkable
    """

    orthophoto: NDArray[np.uint8]
    height: NDArray[np.float32]
    walkable: NDArray[np.bool_]
    meters_per_pixel: float
    origin: tuple[float, float]
    source: str
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = self.walkable.shape
        for name, dtype, expected in (
            ("orthophoto", np.uint8, (*shape, 3)),
            ("height", np.float32, shape),
            ("walkable", np.bool_, shape),
        ):
            array = getattr(self, name)
            if array.dtype != dtype or array.shape != expected or len(shape) != 2:
                raise SceneError(
                    f"{self.source}: {name} must be {np.dtype(dtype).name} of shape {expected}, got {array.dtype.name} "
                    f"of shape {array.shape}; write it in the documented format"
                )
        if np.isinf(self.height).any():
            raise SceneError(f"{self.source}: height is infinite somewhere; use nan where there is no surface")
        if not (np.isfinite([self.meters_per_pixel, *self.origin]).all() and 0 < self.meters_per_pixel <= 1):
            raise SceneError(
                f"{self.source}: meters_per_pixel {self.meters_per_pixel} must be above 0 and at most 1, and origin "
                f"{self.origin} finite"
            )
        area = float(self.walkable.sum()) * self.meters_per_pixel**2
        if area < MIN_WALKABLE_AREA:
            raise SceneError(
                f"{self.source}: only {area:.2f} m2 of the floor can be walked on, less than {MIN_WALKABLE_AREA} m2; "
                "check the scan's units and floor, or take a smaller agent_radius or another floor"
            )

    @property
    def content_hash(self) -> str:
        """sha256 over everything that an environment can show."""
        sha256 = hashlib.sha256(repr((self.meters_per_pixel, self.origin)).encode())
        for array in (self.orthophoto, self.height, self.walkable):
            sha256.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        return sha256.hexdigest()

    @classmethod
    def from_mesh(cls, path: str | os.PathLike[str], cache: bool = True, **settings: Any) -> "ScanMap":
        """Make the map of a scan, or take it from the cache.

        :param path: a .glb, .gltf, .obj or .ply file with textures or vertex colors
        :param cache: whether to look in the cache, and write to it
        :param settings: those of :class:`MapSettings`
        :raises SceneError: for whatever is wrong with the file, see docs/scan_nav.md
        """
        require_extra("scan", "a map of a scan", "scipy", "PIL")
        path, given = Path(path), _settings(settings)
        content = [file_hash(path), path.name] if path.is_file() else None

        def make() -> ScanMap:
            mesh = load_mesh(path, given.up, given.meters_per_unit, given.flip_faces)
            report = plausible_report(mesh, path, given)
            fields = map_fields(mesh, str(path), given)
            report = with_walkable(report, fields, path, given)
            fields["settings"]["report"] = report.json()
            made = cls(**fields)
            print(report.lines(str(path)), file=sys.stderr)
            return made

        return _cached(content, given, make, path.parent) if cache and content else make()

    @classmethod
    def apartment(cls, seed: int = 0, cache: bool = True, **settings: Any) -> "ScanMap":
        """Make the map of a furnished apartment, see :func:`~sb3_abisim.envs.scan_nav.apartment.apartment_mesh`.

        :param seed: determines the apartment
        :param cache: whether to look in the cache, and write to it
        :param settings: those of :class:`MapSettings`, but those of files
        """
        require_extra("scan", "a map", "scipy", "PIL")
        from sb3_abisim.envs.scan_nav.apartment import VERSION, apartment_mesh

        for name in ("up", "meters_per_unit", "flip_faces", "allow_implausible"):
            if name in settings:
                raise ValueError(f"an apartment stands upright, it takes no {name}; got {settings[name]!r}")
        given = _settings({"up": "z"} | settings)
        content = ["apartment", VERSION, seed]

        def make() -> ScanMap:
            return cls(**map_fields(apartment_mesh(seed), f"apartment {seed}", given))

        return _cached(content, given, make, Path()) if cache else make()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a ``.npz`` file, whole or not at all.

        :param path: the file; its folder must exist
        """
        write_atomic(
            path,
            lambda file: np.savez_compressed(
                file,
                format=FORMAT,
                orthophoto=self.orthophoto,
                height=self.height,
                walkable=self.walkable,
                meters_per_pixel=self.meters_per_pixel,
                origin=np.array(self.origin, dtype=np.float64),
                source=self.source,
                settings=json.dumps(self.settings, sort_keys=True),
            ),
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "ScanMap":
        """Read a ``.npz`` file.

        :param path: written by :meth:`save`, or in the same format by another program (docs/scan_nav.md)
        :raises SceneError: for a file that is absent, damaged or something else
        """
        path = Path(path)
        if not path.is_file():
            raise SceneError(f"there is no scan map {path}; check the path")
        try:
            with zipfile.ZipFile(path) as archive:
                there = [name.removesuffix(".npy") for name in archive.namelist()]
            names = current_scan_map({name: name for name in there})
            # Of the arrays that another program may have added, none is read.
            arrays = read_npz(path, names=[names[key] for key in _KEYS])
            if str(arrays["format"]) != FORMAT:
                raise SceneError(f"{path} has the format {str(arrays['format'])!r}, this version reads {FORMAT!r}")
            origin = arrays["origin"]
            return cls(
                arrays["orthophoto"],
                arrays["height"],
                arrays["walkable"],
                float(arrays[names["meters_per_pixel"]]),
                (float(origin[0]), float(origin[1])),
                str(arrays["source"]),
                current_scan_map(dict(json.loads(str(arrays["settings"])))),
            )
        except SceneError:
            raise
        except _UNREADABLE as error:
            if is_of_system(error):
                raise
            raise SceneError(f"{path} is not a scan map ({error}); copy or write it again") from error


_KEYS = ("format", "orthophoto", "height", "walkable", "meters_per_pixel", "origin", "source", "settings")
# Beside what read_npz says: of parts that are there and are something else.
_UNREADABLE = (
    OSError, KeyError, ValueError, IndexError, TypeError, AttributeError, RuntimeError, OverflowError,
    zipfile.BadZipFile,
)  # fmt: skip


def _settings(settings: dict[str, Any]) -> MapSettings:
    try:
        return MapSettings(**settings)
    except TypeError as error:
        known = ", ".join(MapSettings.__dataclass_fields__)
        raise ValueError(f"{error}; the settings of a map are {known}") from error


def _cached(content: list[Any], settings: MapSettings, make: Callable[[], ScanMap], folder: Path) -> ScanMap:
    """The map from the cache, or made and put there.

    :param content: what determines the map, beside the settings and the files that the map names
    :param folder: those files' folder
    """
    text = json.dumps([_VERSION, FORMAT, content, vars(settings)])
    path = cache_folder("scans") / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"
    try:
        kept = ScanMap.load(path)
    except (SceneError, OSError):
        kept = None  # absent, damaged or not to be read: made anew
    if kept is not None and all(_hash(folder / name) == hash for name, hash in kept.settings["files"].items()):
        warn_missing(kept.source, (name for name, hash in kept.settings["files"].items() if not hash))
        return kept
    made = make()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        made.save(path)
    except OSError as error:
        warnings.warn(
            f"cannot keep the map of {made.source} ({error}); set {CACHE_VARIABLE} to a folder that can be written",
            stacklevel=4,
        )
    return made


def _hash(path: Path) -> str:
    return file_hash(path) if path.is_file() else ""
