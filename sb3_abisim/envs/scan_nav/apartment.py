"""Furnished apartments, sampled by a seed: what ScanNav shows where there is no scan.

An apartment is a mesh like that of a scan: a textured floor, walls with doors and windows, furniture, and ceilings,
which are seen from below only. It is made by rules of thumb and passes through the same code as a scan.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sb3_abisim.envs.scan_nav.furniture import ROOMS, Piece, Solid
from sb3_abisim.envs.scan_nav.mesh import ScanMesh
from sb3_abisim.envs.scan_nav.surfaces import Surface
from sb3_abisim.envs.scan_nav.textures import FLOOR_PIXELS, TEXTURE_SIZE, TEXTURES, planks, rug, texture, tiles

# Hashed into the names of cached maps: raise it where the same seed gives another apartment.
VERSION = 2
# Part of the seeds: another value gives other apartments.
_SEED_VERSION = 1
SEEDS = (0, 1, 2, 3, 4)
OUTER_WALL, INNER_WALL, WALL_HEIGHT = 0.3, 0.12, 2.6  # m
DOOR_WIDTH, DOOR_HEIGHT = 0.9, 2.05  # m
# Panes and doors end below the lintel. Were the two surfaces in one plane, none would be the first above the map's cut,
# and whether one sees a pane would be left to the order of the faces.
_GAP = 0.01  # m
_ROUND = 20  # sides of a cylinder
# Lengths here are whole centimeters, and edges exactly on the centers of a map's pixels would be left to rounding.
_OFFSET = (0.0037, 0.0043)  # m

Box = tuple[float, float, float, float]  # x0, y0, x1, y1


@dataclass
class _Room:
    kind: str
    box: Box  # between the walls
    taken: list[Box] = field(default_factory=list)

    @property
    def area(self) -> float:
        return (self.box[2] - self.box[0]) * (self.box[3] - self.box[1])


class _Builder:
    """Collects quadrilaterals by texture."""

    def __init__(self) -> None:
        self.polygons: dict[str, list[NDArray[np.float64]]] = {}

    def quad(self, points: list[tuple[float, float, float]], name: str) -> None:
        self.polygons.setdefault(name, []).append(np.array(points, dtype=np.float64))

    def box(self, box: Box, z0: float, z1: float, name: str) -> None:
        x0, y0, x1, y1 = box
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        self._prism(ring, z0, z1, name)

    def cylinder(self, x: float, y: float, radius: float, z0: float, z1: float, name: str) -> None:
        angles = np.arange(_ROUND) * 2 * np.pi / _ROUND
        ring = [(x + radius * float(np.cos(a)), y + radius * float(np.sin(a))) for a in angles]
        self._prism(ring, z0, z1, name)

    def _prism(self, ring: list[tuple[float, float]], z0: float, z1: float, name: str) -> None:
        """A solid on a counter-clockwise ring of points, closed on all sides."""
        for (xa, ya), (xb, yb) in zip(ring, ring[1:] + ring[:1], strict=True):
            self.quad([(xa, ya, z0), (xb, yb, z0), (xb, yb, z1), (xa, ya, z1)], name)
        for k in range(1, len(ring) - 1, 2):
            corners = [ring[0], ring[k], ring[k + 1], ring[min(k + 2, len(ring) - 1)]]
            self.quad([(x, y, z1) for x, y in corners], name)
            self.quad([(x, y, z0) for x, y in reversed(corners)], name)

    def mesh(self, textures: dict[str, NDArray[np.uint8]], floor_size: tuple[float, float]) -> ScanMesh:
        vertices, surfaces = [], []
        for name, polygons in self.polygons.items():
            points = np.concatenate(polygons)
            size = floor_size if name == "floor" else (TEXTURE_SIZE, TEXTURE_SIZE)
            triangles = points.reshape(-1, 4, 3)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)
            # The last triangle of an odd fan is empty.
            full = np.linalg.norm(
                np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
            )
            triangles = triangles[full > 1e-12]
            uv = (triangles[..., :2] / size).astype(np.float32)
            vertices.append(triangles.reshape(-1, 3))
            surfaces.append(Surface(len(triangles), textures[name], uv))
        stacked = np.concatenate(vertices)
        return ScanMesh(stacked, np.arange(len(stacked)).reshape(-1, 3), tuple(surfaces), {})


def apartment_mesh(seed: int) -> ScanMesh:
    """A furnished apartment: a hall with rooms on both sides, and a living room across its end.

    :param seed: at least 0
    :raises ValueError: for a seed that is none
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"the seed of an apartment must be a whole number of at least 0, got {seed!r}")
    rng = np.random.default_rng([_SEED_VERSION, seed])
    width, depth = float(rng.uniform(12.5, 14.5)), float(rng.uniform(9.2, 10.4))
    builder = _Builder()
    rooms, walls = _layout(rng, width, depth)
    # Mirrored apartments are different apartments; the rules need not know.
    mirror = rng.random(2) < 0.5
    for wall in walls:
        _build_wall(builder, wall)
        for start, end, kind in wall.openings:
            if kind == "door":
                _reserve_door(rooms, wall, start, end)
    rugs: list[Box] = []
    for room in rooms:
        _furnish(builder, rng, room, rugs)
        x0, y0, x1, y1 = room.box
        z = WALL_HEIGHT
        builder.quad([(x0, y0, z), (x0, y1, z), (x1, y1, z), (x1, y0, z)], "white")
    solid = [polygon for polygons in builder.polygons.values() for polygon in polygons]
    builder.quad([(0, 0, 0), (width, 0, 0), (width, depth, 0), (0, depth, 0)], "floor")
    textures = {
        name: texture(kind, colors[rng.integers(len(colors))], rng) for name, (kind, colors) in TEXTURES.items()
    }
    textures["floor"] = _floor_texture(rng, rooms, walls, rugs, solid, (width, depth))
    mesh = builder.mesh(textures, (width, depth))
    return _mirrored(mesh, mirror, (width, depth))


def _mirrored(mesh: ScanMesh, mirror: NDArray[np.bool_], size: tuple[float, float]) -> ScanMesh:
    vertices = mesh.vertices.copy()
    vertices[:, :2] = np.where(mirror, np.array(size) - vertices[:, :2], vertices[:, :2]) + _OFFSET
    if mirror[0] == mirror[1]:
        return ScanMesh(vertices, mesh.faces, mesh.surfaces, {})
    surfaces = tuple(Surface(s.n_faces, s.texture, s.coordinates[:, ::-1]) for s in mesh.surfaces)
    return ScanMesh(vertices, mesh.faces[:, ::-1], surfaces, {})


@dataclass
class _Wall:
    along: int  # 0: east-west, 1: north-south
    at: float  # the wall's middle, on the other axis
    start: float
    end: float
    thickness: float
    openings: list[tuple[float, float, str]] = field(default_factory=list)

    def box(self, start: float, end: float, thickness: float | None = None) -> Box:
        half = (self.thickness if thickness is None else thickness) / 2
        if self.along == 0:
            return start, self.at - half, end, self.at + half
        return self.at - half, start, self.at + half, end


def _layout(rng: np.random.Generator, width: float, depth: float) -> tuple[list[_Room], list[_Wall]]:
    """Rooms, and walls with their doors and windows; the living room is in the east."""
    o, i = OUTER_WALL, INNER_WALL
    hall_width = float(rng.uniform(1.35, 1.6))
    end = width - float(rng.uniform(4.4, 5.2))
    south = depth / 2 + float(rng.uniform(-0.5, 0.5)) - hall_width / 2
    north = south + hall_width
    south_at, north_at, end_at = south - i / 2, north + i / 2, end + i / 2
    rooms = [_Room("living room", (end + i, o, width - o, depth - o)), _Room("hall", (o, south, end, north))]
    walls = [
        _Wall(0, o / 2, 0, width, o),
        _Wall(0, depth - o / 2, 0, width, o),
        _Wall(1, o / 2, 0, depth, o),
        _Wall(1, width - o / 2, 0, depth, o),
        _Wall(0, south_at, o, end, i),
        _Wall(0, north_at, o, end, i),
        _Wall(1, end_at, o, depth - o, i),
    ]
    walls[6].openings.append((south + 0.15, north - 0.15, "door"))
    walls[2].openings.append((south + 0.2, south + 0.2 + DOOR_WIDTH, "entrance"))
    kinds = list(rng.permutation(["bedroom", "child's room", "study"])), ["bathroom", "kitchen"]
    for row, (low, high) in enumerate(((o, south - i), (north + i, depth - o))):
        names = [kinds[1][row], *(kinds[0][:2] if row == 0 else kinds[0][2:])]
        weights = np.array([0.72 if n == "bathroom" else 1.0 for n in names]) * rng.uniform(0.95, 1.05, len(names))
        order = rng.permutation(len(names))
        edges = o - i / 2 + np.append(0, np.cumsum(weights[order] / weights.sum())) * (end - o + i)
        inner, outer = walls[4 + row], walls[row]
        for k, n in enumerate(order):
            x0, x1 = float(edges[k]) + i / 2, float(edges[k + 1]) - i / 2
            rooms.append(_Room(str(names[n]), (x0, low, x1, high)))
            door = float(rng.uniform(x0 + 0.1, x1 - DOOR_WIDTH - 0.1))
            inner.openings.append((door, door + DOOR_WIDTH, "door"))
            middle, half = (x0 + x1) / 2, 0.3 if names[n] == "bathroom" else 0.7
            outer.openings.append((middle - half, middle + half, "window"))
            if k:
                walls.append(_Wall(1, float(edges[k]), low, high, i))
    for wall, share in ((walls[3], 0.28), (walls[3], 0.72)):
        wall.openings.append((depth * share - 0.9, depth * share + 0.9, "window"))
    # A second way into the living room makes a loop.
    if rng.random() < 0.6:
        low = float(rng.uniform(o + 0.3, south - DOOR_WIDTH - 0.3))
        walls[6].openings.append((low, low + DOOR_WIDTH, "door"))
    return rooms, walls


def _build_wall(builder: _Builder, wall: _Wall) -> None:
    at = wall.start
    for start, end, kind in sorted(wall.openings):
        builder.box(wall.box(at, start), 0, WALL_HEIGHT, "wall")
        builder.box(wall.box(start, end), DOOR_HEIGHT, WALL_HEIGHT, "wall")
        if kind == "window":
            builder.box(wall.box(start, end), 0, 0.9, "sill")
            builder.box(wall.box(start, end, 0.05), 0.9, DOOR_HEIGHT - _GAP, "water")
        elif kind == "entrance":
            builder.box(wall.box(start, end, 0.06), 0, DOOR_HEIGHT - _GAP, "door")
        elif end - start <= DOOR_WIDTH + 1e-6:
            # An open leaf, at right angles to the wall, into one of the two rooms.
            x0, y0, x1, y1 = wall.box(start, start + 0.05, 0)
            leaf = (x0, y0, x1, y1 + 0.86) if wall.along == 0 else (x0 - 0.86, y0, x1, y1)
            builder.box(leaf, 0, DOOR_HEIGHT - 0.03, "door")
        at = end
    builder.box(wall.box(at, wall.end), 0, WALL_HEIGHT, "wall")


def _reserve_door(rooms: list[_Room], wall: _Wall, start: float, end: float) -> None:
    zone = wall.box(start - 0.05, end + 0.05, 2.0)
    for room in rooms:
        if _overlap(room.box, zone):
            room.taken.append(zone)


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _furnish(builder: _Builder, rng: np.random.Generator, room: _Room, rugs: list[Box]) -> None:
    if room.kind in ("living room", "bedroom", "child's room", "study"):
        x0, y0, x1, y1 = room.box
        middle, half = ((x0 + x1) / 2, (y0 + y1) / 2), np.minimum(rng.uniform(0.2, 0.3, 2) * (x1 - x0, y1 - y0), 1.3)
        rugs.append((middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1]))
    for make in ROOMS[room.kind]:
        _place(builder, rng, room, make(rng))


def _place(builder: _Builder, rng: np.random.Generator, room: _Room, piece: Piece) -> None:
    """Stand a piece against a wall where it fits; a room without space goes without."""
    x0, y0, x1, y1 = room.box
    for _ in range(60):
        side = int(rng.integers(4))
        length = (x1 - x0, y1 - y0)[side % 2]
        if length < piece.width:
            continue
        offset = float(rng.uniform(0, length - piece.width))
        # Corners are popular.
        offset = float(rng.choice([0.0, offset, length - piece.width]))
        place = _frame(room.box, side, offset)
        needed = place(0, 0, piece.width, piece.depth + piece.front)
        inside = needed[0] >= x0 - 1e-6 and needed[1] >= y0 - 1e-6 and needed[2] <= x1 + 1e-6 and needed[3] <= y1 + 1e-6
        if not inside or any(_overlap(needed, other) for other in room.taken):
            continue
        room.taken.append(needed)
        for solid in piece.solids:
            _add(builder, solid, place)
        return


def _frame(box: Box, side: int, offset: float) -> Callable[[float, float, float, float], Box]:
    """Turns a box in the coordinates of a piece, standing at a wall of the room, into one of the apartment."""
    x0, y0, x1, y1 = box

    def place(u0: float, v0: float, u1: float, v1: float) -> Box:
        near, far = ((y0 + v0, y0 + v1), (x0 + v0, x0 + v1), (y1 - v1, y1 - v0), (x1 - v1, x1 - v0))[side]
        start = (x0, y0)[side % 2] + offset
        return (start + u0, near, start + u1, far) if side % 2 == 0 else (near, start + u0, far, start + u1)

    return place


def _add(builder: _Builder, solid: Solid, place: Callable[[float, float, float, float], Box]) -> None:
    *numbers, name = solid
    values = [float(k) for k in numbers]
    if len(values) == 6:
        builder.box(place(*values[:4]), values[4], values[5], str(name))
    else:
        u, v, radius, z0, z1 = values
        x0, y0, x1, y1 = place(u - radius, v - radius, u + radius, v + radius)
        builder.cylinder((x0 + x1) / 2, (y0 + y1) / 2, radius, z0, z1, str(name))


def _floor_texture(
    rng: np.random.Generator,
    rooms: list[_Room],
    walls: list[_Wall],
    rugs: list[Box],
    solids: list[NDArray[np.float64]],
    size: tuple[float, float],
) -> NDArray[np.uint8]:
    """The texture of the whole floor: planks, tiles, rugs, and the shade beside walls and furniture."""
    shape = round(size[1] * FLOOR_PIXELS), round(size[0] * FLOOR_PIXELS)
    colors = np.full((*shape, 3), 150.0)
    oak = [(178, 140, 98), (150, 110, 74), (196, 168, 130), (128, 96, 72)][rng.integers(4)]
    for room in rooms:
        rows, columns = _pixels(room.box, shape, margin=0.2)
        n = rows.stop - rows.start, columns.stop - columns.start
        if room.kind in ("bathroom", "kitchen"):
            colors[rows, columns] = tiles(rng, n)
        else:
            colors[rows, columns] = planks(rng, n, oak)
    for box in rugs:
        rows, columns = _pixels(box, shape)
        colors[rows, columns] = rug(rng, (rows.stop - rows.start, columns.stop - columns.start))
    occupied = np.zeros(shape)
    for points in solids:
        if points[:, 2].max() < 0.1 or points[:, 2].min() > 1.0:
            continue
        box = (points[:, 0].min(), points[:, 1].min(), points[:, 0].max(), points[:, 1].max())
        occupied[_pixels(box, shape)] = 1
    shade = 1 - 0.55 * ndimage.gaussian_filter(occupied, 0.14 * FLOOR_PIXELS)
    light = np.zeros(shape)
    for wall in walls:
        for start, end, kind in wall.openings:
            if kind == "window":
                light[_pixels(wall.box(start, end, 1.6), shape)] = 1
    shade *= 0.92 + 0.35 * ndimage.gaussian_filter(light, 0.6 * FLOOR_PIXELS)
    # Textures run downwards, y upwards.
    return np.asarray(np.clip(colors * shade[..., None], 0, 255).astype(np.uint8)[::-1])


def _pixels(box: Box, shape: tuple[int, int], margin: float = 0.0) -> tuple[slice, slice]:
    x0, y0, x1, y1 = (
        round(k * FLOOR_PIXELS) for k in (box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin)
    )
    return slice(max(y0, 0), min(max(y1, y0 + 1), shape[0])), slice(max(x0, 0), min(max(x1, x0 + 1), shape[1]))
