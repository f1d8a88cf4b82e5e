"""What was understood of a scan, and whether it can be a place where people live.

A file does not say what its unit is, which way is up, or whether its faces show their fronts. The numbers of a
:class:`ScanReport` do mostly.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.build import MapSettings, find_floors
from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.images import MAX_KEPT_BYTES
from sb3_abisim.envs.scan_nav.mesh import ScanMesh
from sb3_abisim.envs.scan_nav.upright import (
    AXES,
    LEVEL_BIN,
    LEVEL_NORMAL,
    MIN_LEVEL_AREA,
    MIN_UP_RATIO,
    level_areas,
    turned,
)

# From a floor to its ceiling, in m.
MIN_STOREY, MAX_STOREY = 1.8, 5.0
# A ceiling has this share of its floor's area.
_CEILING_SHARE, _LEAST_CEILING = 0.5, 0.5
# What stands on a floor lies between these heights above it, and what hangs from a ceiling so far below, in m.
_FURNITURE = (0.2, 1.3)
# Signs of a scan that stands on its head: this share of the floor's area hangs, and so much more than stands.
_HANGING_SHARE = 0.01
# Not more of all faces' area lies below the lowest floor (by more than half a meter).
_MAX_BELOW = 0.4
_MIN_UP_SHARE = 0.15
_MIN_WALKABLE_SHARE = 0.05
UNKNOWN_UNIT = "taken for meters (no storey that would show it)"
_UNITS = (("feet", 0.3048), ("decimeters", 0.1), ("inches", 0.0254), ("centimeters", 0.01), ("millimeters", 0.001))


@dataclass(frozen=True)
class ScanReport:
    """What was understood of a scan; lengths in m, areas in m2.

    :param up: the file's upward axis
    :param lean: in degrees, taken away
    :param size: east, north, up
    :param floors: heights of the floors
    :param floor_area: level area that faces up at the chosen floor
    :param storey_height: from there to the ceiling, the next floor, or the tops of walls; None where there is none
    :param storey_from: which of these
    :param up_share: of the area of level faces, the share that faces up
    :param standing: level area between 0.2 and 1.3 m above the floor that faces up, less what faces down
    :param hanging: level area between 0.2 and 1.3 m below the ceiling that faces down, less what faces up
    :param below_share: of the area of all faces, what lies below the lowest floor
    :param unit: "meters", or the unit in which the storey would be that of a house; UNKNOWN_UNIT without a storey
    :param n_faces: that are not transparent
    :param n_transparent: faces that are left out, since one sees through them
    :param n_textures: decoded
    :param texture_factor: by which their width and height were divided, so that all of them fit into memory
    :param walkable_area: None before the map is made
    :param walkable_share: of the floor that is seen from above
    """

    up: str
    lean: float
    size: tuple[float, float, float]
    floors: tuple[float, ...]
    floor_area: float
    storey_height: float | None
    storey_from: str
    up_share: float
    standing: float
    hanging: float
    below_share: float
    unit: str
    n_faces: int
    n_transparent: int
    n_textures: int
    texture_factor: int = 1
    walkable_area: float | None = None
    walkable_share: float | None = None

    def problems(self) -> list[str]:
        """What no place has that people live in, most telling first; empty for a plausible scan."""
        found = []
        if self.below_share > _MAX_BELOW:
            found.append(f"{self.below_share:.0%} of its surface lies below its floor")
        if self.hanging > max(_HANGING_SHARE * self.floor_area, self.standing, 0.05):
            found.append(
                f"its furniture hangs from the ceiling ({self.hanging:.1f} m2, and {max(self.standing, 0):.1f} m2 "
                "stand on the floor)"
            )
        if self.storey_height is not None and not MIN_STOREY <= self.storey_height <= MAX_STOREY:
            unit = "" if self.unit == "meters" else f", as if its unit were {self.unit}"
            found.append(f"its storey is {self.storey_height:.2f} m high (to the {self.storey_from}){unit}")
        if self.up_share < _MIN_UP_SHARE:
            found.append(f"only {self.up_share:.0%} of its level faces look up")
        if self.walkable_share is not None and self.walkable_share < _MIN_WALKABLE_SHARE:
            found.append(f"only {self.walkable_share:.1%} of its floor can be walked on")
        return found

    def json(self) -> dict[str, Any]:
        """As JSON types, rounded to what is known; ``texture_factor`` where textures were reduced alone."""
        known = {name: _rounded(value) for name, value in asdict(self).items()}
        if self.texture_factor == 1:
            del known["texture_factor"]
        return known

    def lines(self, source: str) -> str:
        """For people, three lines, and a fourth where textures were reduced.

        :param source: the scan
        """
        storey = "no ceiling, no walls"
        if self.storey_height is not None:
            storey = f"{self.storey_height:.2f} m to the {self.storey_from}"
        lean = f", {self.lean:.1f} degrees of lean taken away" if self.lean else ""
        walkable = ""
        if self.walkable_area is not None and self.walkable_share is not None:
            walkable = f", {self.walkable_area:.1f} m2 walkable ({self.walkable_share:.0%} of the floor seen)"
        left_out = f" ({self.n_transparent} transparent ones left out)" if self.n_transparent else ""
        unknown = ""
        if self.storey_from == "ceiling" and max(self.standing, self.hanging) <= _HANGING_SHARE * self.floor_area:
            unknown = " (an empty room: whether it stands on its head is not known)"
        reduced = ""
        if self.texture_factor > 1:
            reduced = (
                f"\n  the width and height of its textures were divided by {self.texture_factor}, since together they "
                f"would take more than {MAX_KEPT_BYTES >> 20} MiB of memory"
            )
        east, north, high = self.size
        return (
            f"{source}: {east:.1f} x {north:.1f} x {high:.1f} m, {self.up} up{lean}, {self.n_faces} faces{left_out}, "
            f"{self.n_textures} textures\n"
            f"  floors at {', '.join(f'{z:z.2f}' for z in self.floors)} m; storey: {storey}; "
            f"{self.floor_area:.1f} m2 of floor{walkable}\n"
            f"  {self.up_share:.0%} of the level faces look up; {max(self.standing, 0):z.1f} m2 stand on the floor, "
            f"{max(self.hanging, 0):z.1f} m2 hang from the ceiling{unknown}; unit: {self.unit}{reduced}"
        )


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 4)
    return [_rounded(each) for each in value] if isinstance(value, tuple) else value


class _Levels:
    """Level area by height, in bins together with their two neighbors, of what faces up and what faces down."""

    def __init__(self, corners: NDArray[np.float64]) -> None:
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        areas = np.linalg.norm(normals, axis=1)
        middle = corners[..., 2].mean(axis=1)
        level = abs(normals[:, 2]) > LEVEL_NORMAL * areas
        bins = np.floor(middle / LEVEL_BIN).astype(np.int64)
        self.first = int(bins.min()) - 1
        n = int(bins.max()) - self.first + 2
        up, down = level & (normals[:, 2] > 0), level & (normals[:, 2] < 0)
        self._up = np.bincount(bins[up] - self.first, areas[up], minlength=n)
        self._down = np.bincount(bins[down] - self.first, areas[down], minlength=n)
        self.up = np.convolve(self._up, np.ones(3), mode="same")
        self.down = np.convolve(self._down, np.ones(3), mode="same")
        self.heights = (np.arange(n) + self.first + 0.5) * LEVEL_BIN
        self.middle, self.areas, self._faces_down = middle, areas, down
        steep = abs(normals[:, 2]) < 0.3 * areas
        self.tops, self.wall_areas = corners[steep, :, 2].max(axis=1), areas[steep]

    def down_height(self, height: float) -> float:
        """The mean height of what faces down, from two bins below a height to three above it."""
        near = self._faces_down & (abs(self.middle - height - LEVEL_BIN / 2) < 2.5 * LEVEL_BIN)
        return float(np.average(self.middle[near], weights=self.areas[near]))

    def more_up(self, low: float, high: float) -> float:
        """Area that faces up between two heights, less that which faces down."""
        between = (self.heights >= low) & (self.heights <= high)
        return float(self._up[between].sum() - self._down[between].sum())

    @property
    def up_share(self) -> float:
        total = self._up.sum() + self._down.sum()
        return float(self._up.sum() / total) if total > 0 else 0.0


def make_report(mesh: ScanMesh, floors: list[float], floor: int) -> ScanReport:
    """The report of a scan.

    :param mesh: z up, in m
    :param floors: heights, lowest first
    :param floor: index of the one that the map shows
    """
    corners = mesh.corners()
    levels = _Levels(corners)
    base = floors[min(floor, len(floors) - 1)]
    at_base = int(np.argmin(abs(levels.heights - base)))
    floor_area = float(levels.up[max(at_base - 1, 0) : at_base + 2].max())
    storey, found_from = _storey(levels, floors, base, floor_area)
    ceilings = levels.heights[levels.down >= max(_CEILING_SHARE * floor_area, _LEAST_CEILING)]
    hanging = 0.0
    if len(ceilings) and (top := float(ceilings.max())) > base + _FURNITURE[0]:
        hanging = -levels.more_up(top - _FURNITURE[1], top - _FURNITURE[0])
    size = np.ptp(mesh.vertices, axis=0)
    notes = mesh.notes
    return ScanReport(
        up=str(notes.get("up", "z")),
        lean=float(notes.get("lean", 0.0)),
        size=(float(size[0]), float(size[1]), float(size[2])),
        floors=tuple(floors),
        floor_area=floor_area,
        storey_height=storey,
        storey_from=found_from,
        up_share=levels.up_share,
        standing=levels.more_up(base + _FURNITURE[0], base + _FURNITURE[1]),
        hanging=hanging,
        below_share=float(levels.areas[levels.middle < floors[0] - 0.5].sum() / levels.areas.sum()),
        unit=_unit(storey),
        n_faces=len(mesh.faces),
        n_transparent=int(notes.get("transparent_faces", 0)),
        n_textures=int(notes.get("textures", 0)),
        texture_factor=int(notes.get("texture_factor", 1)),
    )


def _storey(levels: _Levels, floors: list[float], base: float, floor_area: float) -> tuple[float | None, str]:
    """How high the storey is, and to what."""
    low = levels.heights <= base + 2 * LEVEL_BIN
    ceilings = levels.heights[(levels.down >= max(_CEILING_SHARE * floor_area, _LEAST_CEILING)) & ~low]
    above = [z for z in floors if z > base]
    if len(ceilings) and (not above or ceilings[0] < above[0] + 1):
        return levels.down_height(float(ceilings[0])) - base, "ceiling"
    if above:
        return above[0] - base, "next floor"
    high = levels.tops > base + 1.0
    if levels.wall_areas[high].sum() < 1.0:
        return None, "nothing"
    order = np.argsort(levels.tops[high])
    total = np.cumsum(levels.wall_areas[high][order])
    top = levels.tops[high][order][np.searchsorted(total, 0.5 * total[-1])]
    return float(top - base), "tops of walls"


def _unit(storey: float | None) -> str:
    """The unit in which a storey that is no house's would be one's."""
    if storey is None:
        return UNKNOWN_UNIT
    if storey <= MAX_STOREY:
        return "meters"
    return next((name for name, meters in _UNITS if MIN_STOREY <= storey * meters <= MAX_STOREY), "unknown")


def plausible_report(mesh: ScanMesh, path: Path, settings: MapSettings) -> ScanReport:
    """The report of a scan before its map is made.

    :param mesh: z up, in m
    :param path: of the scan, for messages
    :param settings: of the map
    :raises SceneError: for a scan that is not plausible, unless the settings allow it; with what would make it so
    """
    report = make_report(mesh, find_floors(mesh.corners()), settings.floor)
    _refuse(report, path, settings, mesh)
    if settings.up == "auto" and not settings.allow_implausible:
        _refuse_on_its_side(report, path, mesh)
    return report


def with_walkable(report: ScanReport, fields: dict[str, Any], path: Path, settings: MapSettings) -> ScanReport:
    """The report after the map is made.

    :param report: from before
    :param fields: of the map
    :param path: of the scan, for messages
    :param settings: of the map
    :raises SceneError: for hardly any walkable floor, unless the settings allow it
    """
    pixel = settings.meters_per_pixel**2
    seen = float(np.count_nonzero(abs(fields["height"]) <= settings.max_climb)) * pixel
    area = float(np.count_nonzero(fields["walkable"])) * pixel
    report = replace(report, walkable_area=area, walkable_share=min(1.0, area / max(seen, pixel)))
    if area >= 1:  # less is refused in any case
        _refuse(report, path, settings, None)
    return report


def _refuse(report: ScanReport, path: Path, settings: MapSettings, mesh: ScanMesh | None) -> None:
    problems = report.problems()
    if settings.allow_implausible or not problems:
        return
    if meters := dict(_UNITS).get(report.unit):
        ways = [f"meters_per_unit={meters}"]
    else:
        ways = [] if mesh is None else _remedies(mesh)
    ways.append("allow_implausible=True if it is meant")
    raise SceneError(f"{path} cannot be a place as it is read: {'; '.join(problems)}; give {', or '.join(ways)}")


def _refuse_on_its_side(report: ScanReport, path: Path, mesh: ScanMesh) -> None:
    """Where the axis was found: refuse a scan that has a larger and plausible floor on another side of it."""
    as_stored = _from_up(mesh.vertices, report.up)
    for up in AXES:
        if up[-1] == report.up[-1]:
            continue
        other = replace(mesh, vertices=turned(as_stored, up))
        if level_areas(other.corners())[1].max() <= MIN_UP_RATIO * report.floor_area:
            continue
        beside = make_report(other, find_floors(other.corners()), 0)
        if not beside.problems():
            raise SceneError(
                f"{path} could stand on either side: {report.floor_area:.1f} m2 of floor with {report.up} up and "
                f"{beside.floor_area:.1f} m2 with {up} up; give up='{report.up}' or up='{up}'"
            )


def _remedies(mesh: ScanMesh) -> list[str]:
    """Other ways to read a scan under which nothing is implausible; of several, those with the largest floors."""
    read_as = str(mesh.notes.get("up", "z"))
    as_stored = _from_up(mesh.vertices, read_as)
    found = {}
    for up in (read_as, *(axis for axis in AXES if axis != read_as)):
        for flip in (False, True):
            if up == read_as and not flip:
                continue
            faces = mesh.faces[:, ::-1] if flip else mesh.faces
            other = replace(mesh, vertices=turned(as_stored, up), faces=faces)
            report = make_report(other, find_floors(other.corners()), 0)
            if report.floor_area >= MIN_LEVEL_AREA and not report.problems():
                found[" and ".join([f"up='{up}'"] * (up != read_as) + ["flip_faces=True"] * flip)] = report.floor_area
    return [way for way, area in found.items() if area > 0.9 * max(found.values())]


def _from_up(vertices: NDArray[np.float64], up: str) -> NDArray[np.float64]:
    """The inverse of :func:`turned`."""
    if up == "z":
        return vertices
    axes = turned(np.eye(3), up)  # rows: where x, y and z of the file go
    return np.asarray(vertices @ axes.T)
