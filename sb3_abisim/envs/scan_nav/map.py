"""A scanned place seen from straight above: colors, heights, and where one can walk.

An orthographic camera that looks straight down at a place that does not change sees, wherever it is, a part of one
and the same picture. :class:`ScanMap` is that picture. It is made once from a mesh (:meth:`ScanMap.from_mesh`,
:meth:`ScanMap.apartment`) and kept in a cache, or comes as a ``.npz`` file from elsewhere.
"""

import hashlib
import json
import os
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.files import file_hash, write_atomic
from sb3_abisim.common.paths import CACHE_VARIABLE, cache_folder
from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.mesh import LEVEL_BIN, ScanMesh, level_areas, load_mesh, warn_missing
from sb3_abisim.envs.scan_nav.raster import Nearest, contour_pixels, fragments, shade

FORMAT = "sb3_abisim scan map 1"
MAX_PIXELS = 64_000_000
MIN_WALKABLE_AREA = 1.0  # m2
# A level is a floor if it has this share of the largest level's area, and floors are this far apart.
FLOOR_SHARE = 0.25
FLOOR_DISTANCE = 1.5  # m
# Vertical walls are found by cutting the mesh at heights this far apart.
SLICE_DISTANCE = 0.1  # m
# Pinholes of a scan's floor up to this wide do not stop anyone.
PINHOLE = 0.06  # m
# Part of the cache's keys: raise it where the same mesh gives another map.
_VERSION = 5


@dataclass(frozen=True)
class MapSettings:
    """How a mesh becomes a map; Habitat's numbers where Habitat has some.

    :param meters_per_pixel: of the map
    :param up: the file's upward axis, "y", "z" or "auto"
    :param floor: which storey, 0 being the lowest
    :param cut_height: what hangs higher than this above the floor is taken away, in m
    :param agent_radius: distance that the agent's center keeps from obstacles, in m
    :param agent_height: what is higher than this does not stop it, in m
    :param max_climb: what is lower than this does not stop it, in m
    """

    meters_per_pixel: float = 0.02
    up: str = "auto"
    floor: int = 0
    cut_height: float = 2.0
    agent_radius: float = 0.1
    agent_height: float = 1.5
    max_climb: float = 0.2

    def __post_init__(self) -> None:
        for name in ("meters_per_pixel", "cut_height", "agent_radius", "agent_height", "max_climb"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1000:
                raise ValueError(f"{name} must be a number of meters above 0, got {value!r}")
        if isinstance(self.floor, bool) or not isinstance(self.floor, int) or self.floor < 0:
            raise ValueError(f"floor must be a whole number of at least 0, got {self.floor!r}")
        if not self.max_climb < self.agent_height <= self.cut_height:
            raise ValueError(
                f"max_climb {self.max_climb} < agent_height {self.agent_height} <= cut_height {self.cut_height} must "
                "hold"
            )


@dataclass(frozen=True, eq=False)
class ScanMap:
    """A place seen from straight above. Rows run from north to south, columns from west to east.

    :param orthophoto: uint8 (height, width, 3), RGB, black where there is no surface
    :param height: float32 (height, width), above the floor in m, nan where there is no surface
    :param walkable: bool (height, width), where the agent's center can be
    :param meters_per_pixel: the size of a pixel
    :param origin: x (east) and y (north) of the map's north-western corner in the scan's own coordinates, in m
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
        if not (np.isfinite([self.meters_per_pixel, *self.origin]).all() and self.meters_per_pixel > 0):
            raise SceneError(
                f"{self.source}: meters_per_pixel {self.meters_per_pixel} must be above 0 and origin {self.origin} "
                "finite"
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
        path, given = Path(path), _settings(settings)
        key = [file_hash(path), path.name] if path.is_file() else None

        def make() -> ScanMap:
            mesh = load_mesh(path, given.up)
            return build_map(mesh, str(path), given)

        return _cached(key, given, make, path.parent) if cache and key else make()

    @classmethod
    def apartment(cls, seed: int = 0, cache: bool = True, **settings: Any) -> "ScanMap":
        """Make the map of a furnished flat, see :func:`~sb3_abisim.envs.scan_nav.apartment.apartment_mesh`.

        :param seed: determines the flat
        :param cache: whether to look in the cache, and write to it
        :param settings: those of :class:`MapSettings`, without ``up``
        """
        from sb3_abisim.envs.scan_nav.apartment import VERSION, apartment_mesh

        if "up" in settings:
            raise ValueError(f"a flat stands upright, it takes no up; got {settings['up']!r}")
        given = _settings({"up": "z"} | settings)
        key = ["apartment", VERSION, seed]

        def make() -> ScanMap:
            return build_map(apartment_mesh(seed), f"apartment {seed}", given)

        return _cached(key, given, make, Path()) if cache else make()

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
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
                if str(data["format"]) != FORMAT:
                    raise SceneError(f"{path} has the format {str(data['format'])!r}, this version reads {FORMAT!r}")
                origin = data["origin"]
                return cls(
                    data["orthophoto"],
                    data["height"],
                    data["walkable"],
                    float(data["meters_per_pixel"]),
                    (float(origin[0]), float(origin[1])),
                    str(data["source"]),
                    json.loads(str(data["settings"])),
                )
        except SceneError:
            raise
        except _UNREADABLE as error:
            raise SceneError(f"{path} is not a scan map ({error}); copy or write it again") from error


# What NumPy raises for damaged files, by where the damage is.
_UNREADABLE = (
    OSError, EOFError, KeyError, ValueError, IndexError, TypeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError,
)  # fmt: skip


def _settings(settings: dict[str, Any]) -> MapSettings:
    try:
        return MapSettings(**settings)
    except TypeError as error:
        known = ", ".join(MapSettings.__dataclass_fields__)
        raise ValueError(f"{error}; the settings of a map are {known}") from error


def _cached(key: list[Any], settings: MapSettings, make: Callable[[], ScanMap], folder: Path) -> ScanMap:
    text = json.dumps([_VERSION, FORMAT, key, vars(settings)])
    path = cache_folder("scans") / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"
    try:
        kept = ScanMap.load(path)
    except SceneError:
        kept = None  # absent, or damaged: made anew
    if kept is not None and all(_digest(folder / name) == sha for name, sha in kept.settings["files"].items()):
        warn_missing(kept.source, (name for name, sha in kept.settings["files"].items() if not sha))
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


def _digest(path: Path) -> str:
    return file_hash(path) if path.is_file() else ""


def find_floors(corners: NDArray[np.float64]) -> list[float]:
    """Heights of the floors, lowest first.

    :param corners: of the faces, (m, 3, 3), z up
    """
    heights, areas = level_areas(corners)
    floors: list[float] = []
    for k in np.argsort(-areas, kind="stable"):
        if areas[k] < FLOOR_SHARE * areas.max():
            break
        if all(abs(heights[k] - other) >= FLOOR_DISTANCE for other in floors):
            floors.append(float(heights[k]))
    flat = np.ptp(corners[..., 2], axis=1) < LEVEL_BIN
    sizes = _turn(corners)
    middle = corners[..., 2].mean(axis=1)
    return sorted(_median(middle, np.where(flat & (abs(middle - z) < 2 * LEVEL_BIN), sizes, 0), z) for z in floors)


def _turn(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the area of each face seen along z, positive for counter-clockwise corners."""
    a, b = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _median(values: NDArray[np.float64], weights: NDArray[np.float64], otherwise: float) -> float:
    """Weighted median; negative weights (faces that look down) count nothing."""
    order = np.argsort(values)
    total = np.cumsum(np.maximum(weights[order], 0))
    return float(values[order][np.searchsorted(total, total[-1] / 2)]) if total[-1] > 0 else otherwise


def build_map(mesh: ScanMesh, source: str, settings: MapSettings) -> ScanMap:
    """Make the map of a mesh.

    What is shown at a pixel: the highest up-facing surface below the cut. Where the first surface above the cut faces
    up, the cut goes through a solid thing (a wall, a wardrobe), and its own top is shown instead.

    :param mesh: z up, in meters
    :param source: for messages and the map
    :param settings: how to make it
    :raises SceneError: for a floor that is not there, too many pixels, or nowhere to walk
    """
    corners = mesh.corners()
    floors = find_floors(corners)
    if settings.floor >= len(floors):
        listed = ", ".join(f"{z:.2f} m" for z in floors)
        raise SceneError(f"{source} has no floor {settings.floor}: there are {len(floors)}, at heights {listed}")
    scale, base = settings.meters_per_pixel, floors[settings.floor]
    # A hair's breadth of tolerance: the same scan in another format has other roundings.
    west, south = np.floor(mesh.vertices[:, :2].min(axis=0) / scale + 1e-3) * scale
    east, north = mesh.vertices[:, :2].max(axis=0)
    width, height = (int(np.ceil(k / scale - 1e-3)) for k in (east - west, north - south))
    if width * height > MAX_PIXELS:
        enough = scale * (width * height / MAX_PIXELS) ** 0.5
        raise SceneError(
            f"{source}: a map of {width} x {height} pixels is larger than {MAX_PIXELS // 10**6} million; raise "
            f"meters_per_pixel from {scale} to {np.ceil(enough * 1000) / 1000:g} or more"
        )
    top = south + height * scale
    # Columns, rows and heights above the floor; a mirrored axis turns the faces' orientation round.
    grid = (corners - (west, top, base)) / (scale, -scale, 1)
    faces_up = _turn(grid) < 0
    others = np.array([z - base for k, z in enumerate(floors) if k != settings.floor])
    seen = _look(grid, faces_up, height, width, settings, others)
    shown, face, inside = seen["height"], seen["face"], seen["inside"]
    pixels = np.flatnonzero(face >= 0)
    orthophoto = np.zeros((height * width, 3), dtype=np.uint8)
    rows, columns = np.divmod(pixels, width)
    orthophoto[pixels] = shade(grid, mesh.surfaces, face[pixels], columns + 0.5, rows + 0.5)
    walkable = _walkable(
        seen["floor"].reshape(height, width), (seen["obstacle"] | inside).reshape(height, width), settings
    )
    return ScanMap(
        orthophoto.reshape(height, width, 3),
        np.where(face >= 0, shown, np.nan).astype(np.float32).reshape(height, width),
        walkable,
        scale,
        (float(west), float(top)),
        source,
        {**vars(settings), "floor_height": base, "files": mesh.files},
    )


def _look(
    grid: NDArray[np.float64],
    faces_up: NDArray[np.bool_],
    height: int,
    width: int,
    settings: MapSettings,
    other_floors: NDArray[np.float64],
) -> dict[str, NDArray[Any]]:
    """What is at each pixel: the shown surface's height and face (-1 for none), inside, floor, obstacle."""
    n = height * width
    below, top, ceiling = Nearest(n, highest=True), Nearest(n), Nearest(n)
    floor, obstacle = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    for face, pixel, z in fragments(grid, height, width):
        up, high = faces_up[face], z > settings.cut_height
        obstacle[pixel[(z > settings.max_climb) & (z < settings.agent_height)]] = True
        floor[pixel[up & (abs(z) <= settings.max_climb)]] = True
        shown, capped = up & ~high, ~up & high
        below.add(face[shown], pixel[shown], z[shown])
        # The floor above, seen through a hole in the ceiling, is nobody's top.
        storey = (abs(z[:, None] - other_floors) < 0.3).any(axis=1)
        topmost = up & high & ~storey
        top.add(face[topmost], pixel[topmost], z[topmost])
        ceiling.add(face[capped], pixel[capped], z[capped])
    for level in np.arange(settings.max_climb, settings.agent_height, SLICE_DISTANCE):
        obstacle[contour_pixels(grid, level + 1e-4, height, width)] = True
    # A sheet with two sides, such as a thin ceiling, is no solid: the tolerance keeps its upper side from winning.
    inside = top.height < ceiling.height - 1e-3
    return {
        "height": np.where(inside, top.height, below.height),
        "face": np.where(inside, top.face, below.face),
        "inside": inside,
        "floor": floor,
        "obstacle": obstacle,
    }


def _walkable(floor: NDArray[np.bool_], obstacle: NDArray[np.bool_], settings: MapSettings) -> NDArray[np.bool_]:
    """The largest connected part of the floor that keeps the agent's radius from everything else."""
    from scipy import ndimage

    size = max(1, round(PINHOLE / settings.meters_per_pixel))
    closed = ndimage.binary_closing(np.pad(floor, size), np.ones((size, size)))[size:-size, size:-size]
    free = np.pad((floor | closed) & ~obstacle, 1)
    distance = ndimage.distance_transform_edt(free)[1:-1, 1:-1] * settings.meters_per_pixel
    islands, n_islands = ndimage.label(distance > settings.agent_radius)
    if n_islands == 0:
        return np.zeros_like(floor)
    sizes = np.bincount(islands.ravel())
    sizes[0] = 0
    walkable: NDArray[np.bool_] = islands == sizes.argmax()
    return walkable
