"""Making a map from a mesh: the floors, what is seen from above, and where one can walk."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.mesh import ScanMesh
from sb3_abisim.envs.scan_nav.raster import Nearest, shade, solid_contour_pixels, solid_fragments
from sb3_abisim.envs.scan_nav.surfaces import Surface
from sb3_abisim.envs.scan_nav.upright import LEVEL_BIN, UP_AXES, level_areas

MAX_PIXELS = 16_000_000
_PIXELS_AT_A_TIME = 2_000_000
MIN_METERS_PER_PIXEL, MAX_METERS_PER_PIXEL = 0.0005, 1.0
# Pixels that the faces may cover in all, each face for itself: so many for each face, and these in any case, which take
# a quarter of a minute. Large scans have many faces; a few that cover a map again and again are there to take time.
FRAGMENTS_PER_FACE, FREE_FRAGMENTS, MAX_FRAGMENTS = 500, 200_000_000, 3_000_000_000
# A level is a floor if it has this share of the largest level's area, and floors are this far apart.
FLOOR_SHARE = 0.25
FLOOR_DISTANCE = 1.5  # m
# Vertical walls are found by cutting the mesh at heights this far apart.
SLICE_DISTANCE = 0.1  # m
# Pinholes of a scan's floor up to this wide do not stop anyone.
PINHOLE = 0.06  # m


@dataclass(frozen=True)
class MapSettings:
    """How a mesh becomes a map; Habitat's numbers where Habitat has some.

    :param meters_per_pixel: of the map
    :param up: the file's upward axis, "x", "y", "z", one of these with a minus, or "auto", which takes "y" or "z"
    :param floor: which storey, 0 being the lowest
    :param cut_height: what hangs higher than this above the floor is taken away, in m
    :param agent_radius: distance that the agent's center keeps from obstacles, in m
    :param agent_height: what is higher than this does not stop it, in m
    :param max_climb: what is lower than this does not stop it, in m
    :param meters_per_unit: the file's unit, 1 for meters
    :param flip_faces: whether the file's faces show their backs
    :param allow_implausible: whether a scan is taken that looks upside down, inside out or of another unit
    """

    meters_per_pixel: float = 0.02
    up: str = "auto"
    floor: int = 0
    cut_height: float = 2.0
    agent_radius: float = 0.1
    agent_height: float = 1.5
    max_climb: float = 0.2
    meters_per_unit: float = 1.0
    flip_faces: bool = False
    allow_implausible: bool = False

    def __post_init__(self) -> None:
        for name in ("meters_per_pixel", "cut_height", "agent_radius", "agent_height", "max_climb", "meters_per_unit"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1000:
                raise ValueError(f"{name} must be a number of meters above 0, got {value!r}")
        if not MIN_METERS_PER_PIXEL <= self.meters_per_pixel <= MAX_METERS_PER_PIXEL:
            raise ValueError(
                f"meters_per_pixel must lie between {MIN_METERS_PER_PIXEL} and {MAX_METERS_PER_PIXEL}, got "
                f"{self.meters_per_pixel!r}"
            )
        if isinstance(self.floor, bool) or not isinstance(self.floor, int) or self.floor < 0:
            raise ValueError(f"floor must be a whole number of at least 0, got {self.floor!r}")
        if self.up not in UP_AXES:
            raise ValueError(f"up must be one of {', '.join(UP_AXES)}, got {self.up!r}")
        for name in ("flip_faces", "allow_implausible"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")
        if not self.max_climb < self.agent_height <= self.cut_height:
            raise ValueError(
                f"max_climb {self.max_climb} < agent_height {self.agent_height} <= cut_height {self.cut_height} must "
                "hold"
            )


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


def map_fields(mesh: ScanMesh, source: str, settings: MapSettings) -> dict[str, Any]:
    """The fields of the :class:`~sb3_abisim.envs.scan_nav.map.ScanMap` of a mesh.

    What is shown at a pixel: the highest up-facing surface below the cut. Where the first surface above the cut faces
    up, the cut goes through a solid thing (a wall, a wardrobe), and the top of that is shown instead.

    :param mesh: z up, in meters
    :param source: for messages and the map
    :param settings: how to make it
    :return: name to value
    :raises SceneError: for a floor that is not there, or too many pixels
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
    # Columns, rows and heights above the floor; a mirrored axis inverts the faces' orientation.
    grid = (corners - (west, top, base)) / (scale, -scale, 1)
    faces_up = _turn(grid) < 0
    others = np.array([z - base for k, z in enumerate(floors) if k != settings.floor])
    _check_layers(source, grid, width * height)
    seen = _look(grid, mesh.surfaces, faces_up, height, width, settings, others)
    shown, face, inside = seen["height"], seen["face"], seen["inside"]
    orthophoto = _colors(grid, mesh.surfaces, face, width)
    walkable = _walkable(
        seen["floor"].reshape(height, width), (seen["obstacle"] | inside).reshape(height, width), settings
    )
    return {
        "orthophoto": orthophoto.reshape(height, width, 3),
        "height": np.where(face >= 0, shown, np.nan).astype(np.float32).reshape(height, width),
        "walkable": walkable,
        "meters_per_pixel": scale,
        "origin": (float(west), float(top)),
        "source": source,
        "settings": {**vars(settings), "floor_height": base, "files": mesh.files},
    }


def _colors(
    grid: NDArray[np.float64], surfaces: tuple[Surface, ...], face: NDArray[Any], width: int
) -> NDArray[np.uint8]:
    """What each pixel shows, (n, 3)."""
    orthophoto = np.zeros((len(face), 3), dtype=np.uint8)
    for begin in range(0, len(face), _PIXELS_AT_A_TIME):
        part = begin + np.flatnonzero(face[begin : begin + _PIXELS_AT_A_TIME] >= 0)
        rows, columns = np.divmod(part, width)
        orthophoto[part] = shade(grid, surfaces, face[part], columns + 0.5, rows + 0.5)
    return orthophoto


def _check_layers(source: str, grid: NDArray[np.float64], n_pixels: int) -> None:
    """Refuse what would take hours: faces that lie on top of one another hundreds of times."""
    size = np.ptp(grid, axis=1)
    covered = float((abs(_turn(grid)) / 2).sum() + 2 * len(range(15)) * size[:, :2].max(axis=1).sum())
    granted = min(MAX_FRAGMENTS, max(FRAGMENTS_PER_FACE * len(grid), FREE_FRAGMENTS))
    if covered > granted:
        raise SceneError(
            f"{source}: its faces cover {covered:.3g} pixels in all, more than {granted:.3g}, of a map of {n_pixels}; "
            "raise meters_per_pixel, or decimate the scan"
        )


def _look(
    grid: NDArray[np.float64],
    surfaces: tuple[Surface, ...],
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
    for face, pixel, z in solid_fragments(grid, surfaces, height, width):
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
        if level > grid[..., 2].max():
            break
        obstacle[solid_contour_pixels(grid, surfaces, level + 1e-4, height, width)] = True
    # A sheet with two sides, such as a thin ceiling, is no solid: the tolerance keeps its upper side from winning.
    inside = top.height < ceiling.height - 1e-3
    # In place: of a large map, each of these arrays takes a tenth of a gigabyte.
    np.copyto(below.height, top.height, where=inside)
    np.copyto(below.face, top.face, where=inside)
    return {
        "height": below.height,
        "face": below.face,
        "inside": inside,
        "floor": floor,
        "obstacle": obstacle,
    }


def _walkable(floor: NDArray[np.bool_], obstacle: NDArray[np.bool_], settings: MapSettings) -> NDArray[np.bool_]:
    """The largest connected part of the floor that keeps the agent's radius from everything else."""
    from scipy import ndimage

    size = max(1, round(PINHOLE / settings.meters_per_pixel))
    closed = ndimage.binary_closing(np.pad(floor, size), np.ones((size, size)))[size:-size, size:-size]
    free = (floor | closed) & ~obstacle
    islands, n_islands = ndimage.label(_far_enough(free, settings))
    if n_islands == 0:
        return np.zeros_like(floor)
    rows = max(1, _PIXELS_AT_A_TIME // free.shape[1])
    sizes = np.zeros(n_islands + 1, dtype=np.int64)
    for row in range(0, len(islands), rows):
        sizes += np.bincount(islands[row : row + rows].ravel(), minlength=n_islands + 1)
    sizes[0] = 0
    walkable: NDArray[np.bool_] = islands == sizes.argmax()
    return walkable


def _far_enough(free: NDArray[np.bool_], settings: MapSettings) -> NDArray[np.bool_]:
    """Where the nearest pixel that is not free is further away than the agent's radius."""
    from scipy import ndimage

    far = np.zeros_like(free)
    margin = int(settings.agent_radius / settings.meters_per_pixel) + 1
    rows = max(1, _PIXELS_AT_A_TIME // free.shape[1])
    for row in range(0, len(free), rows):
        # In strips that overlap by more than the radius: distances take fifty bytes a pixel.
        first, last = max(row - margin, 0), min(row + rows + margin, len(free))
        distance = ndimage.distance_transform_edt(np.pad(free[first:last], 1))[1:-1, 1:-1]
        near = distance * settings.meters_per_pixel > settings.agent_radius
        far[row : row + rows] = near[row - first : row - first + rows]
    return far
