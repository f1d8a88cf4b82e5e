"""Where one can walk in ScanNav and how far it is: goals, geodesic distances, starts, steps.

Everything about a goal happens on a square grid of nodes around it, its *field*: the geodesic distance of each node to
the goal, infinite where there is no way inside the view. Positions are in meters east and north of the goal.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap

NODE = 0.05  # m between neighboring nodes
# A goal is used if this share of points sampled in its view are starts, so that sampling one ends soon.
MIN_START_SHARE = 0.005
# Places of a scene that are tried as goals before it is refused.
MAX_GOALS_TRIED = 300
# Of all goals' fields, each of which is computed when it is first used.
MAX_FIELD_BYTES = 64 * 2**30
_SUBSTEP = NODE / 2
_N_SAMPLES = 16
_CORNERS = np.array(((0, 0), (0, 1), (1, 0), (1, 1)))
# (rows, columns) of each way, and the nodes that it passes by and that must be free as well.
_WAYS: tuple[tuple[tuple[int, int], tuple[tuple[int, int], ...]], ...] = (
    ((0, 1), ()),
    ((1, 0), ()),
    ((1, 1), ((0, 1), (1, 0))),
    ((1, -1), ((0, -1), (1, 0))),
    ((1, 2), ((0, 1), (1, 1))),
    ((2, 1), ((1, 0), (1, 1))),
    ((1, -2), ((0, -1), (1, -1))),
    ((2, -1), ((1, 0), (1, -1))),
)


class DistanceGrid:
    """Geodesic distances to the middle of a square grid of nodes.

    Ways lead to 16 neighbors (those of a king and of a knight in chess), so a distance is too long by 2.7 % at most.

    :param half: nodes on each side of the middle one
    """

    def __init__(self, half: int) -> None:
        self.size = 2 * half + 1
        self._middle = half * self.size + half
        rows, columns = np.indices((self.size, self.size))
        self._edges = []
        for (down, right), passed in _WAYS:
            there = (rows + down < self.size) & (columns + right >= 0) & (columns + right < self.size)
            begin = (rows * self.size + columns)[there]
            others = [begin + down * self.size + right, *(begin + r * self.size + c for r, c in passed)]
            self._edges.append((begin, others, NODE * float(np.hypot(down, right))))

    def distances(self, free: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Length of the shortest way from each node to the middle one.

        :param free: nodes that a way may touch, (size, size)
        :return: in m, (size, size), infinite where there is no way
        """
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra

        flat = free.ravel()
        begins, ends, lengths = [], [], []
        for begin, others, length in self._edges:
            passable = flat[begin]
            for other in others:
                passable = passable & flat[other]
            begins.append(begin[passable])
            ends.append(others[0][passable])
            lengths.append(np.full(len(begins[-1]), length))
        nodes = (np.concatenate(begins), np.concatenate(ends))
        graph = csr_array((np.concatenate(lengths), nodes), shape=(flat.size, flat.size))
        found = dijkstra(graph, directed=False, indices=self._middle)
        if not flat[self._middle]:
            found[self._middle] = np.inf
        field: NDArray[np.float32] = found.astype(np.float32).reshape(self.size, self.size)
        return field


@dataclass(frozen=True)
class StartRule:
    """Which points are starts; Habitat's rule.

    :param min_geodesic: least geodesic distance, in m
    :param max_geodesic: greatest geodesic distance, in m
    :param min_ratio: points whose geodesic distance divided by the straight one, r, is less are kept with probability
        20 (r - 0.98)^2; None keeps all
    """

    min_geodesic: float
    max_geodesic: float
    min_ratio: float | None

    def weights(self, distances: NDArray[Any], straight: NDArray[np.float64]) -> NDArray[np.float64]:
        """The probabilities with which points are kept.

        :param distances: geodesic, may be infinite
        :param straight: Euclidean, of the same shape
        """
        keep = np.where((distances >= self.min_geodesic) & (distances <= self.max_geodesic), 1.0, 0.0)
        if self.min_ratio is not None:
            ratio = distances / np.maximum(straight, NODE)
            # A distance is interpolated, so the ratio can be a little under 1; never use the parabola's other arm.
            rate = np.clip(20 * (np.clip(ratio, 1.0, 2.0) - 0.98) ** 2, 0, 1)
            keep *= np.where(ratio < self.min_ratio, rate, 1.0)
        return keep


class ScanWorld:
    """Goals of several scenes with their fields, and what can be asked about positions in them.

    Field ``scene * n_goals + k`` is that of the scene's goal k, computed when it is first needed; the last
    ``n_custom`` fields belong to goals that are placed by hand.

    :param scans: the scenes' maps
    :param pitch: m per pixel of the observations; goals lie on corners of these pixels
    :param reach: half the side of the square around a goal that belongs to it, in m
    :param n_goals: per scene
    :param n_custom: number of further fields
    :param rule: for starts
    :raises SceneError: for a scene without a goal that has enough starts
    """

    def __init__(
        self, scans: list[ScanMap], pitch: float, reach: float, n_goals: int, n_custom: int, rule: StartRule
    ) -> None:
        self.scans, self.pitch, self.n_goals, self.rule = scans, pitch, n_goals, rule
        self.half = int(reach / NODE)
        self._grid = DistanceGrid(self.half)
        # A ring of blocked nodes is the wall around the view.
        self._across, self._middle = self._grid.size + 2, self.half + 1
        offsets = np.arange(-self._middle, self._middle + 1) * NODE
        self._straight = np.hypot(offsets[:, None], offsets)
        self._origins = np.array([scan.origin for scan in scans])
        self._places = [_places(scan, pitch) for scan in scans]
        n_fields = len(scans) * n_goals + n_custom
        if (n_bytes := n_fields * self._across**2 * 4) > MAX_FIELD_BYTES:
            raise ValueError(
                f"{n_goals} goals in each of {len(scans)} scenes would take {n_bytes / 2**30:.0f} GB; lower "
                "goals_per_scene or view_size"
            )
        self.custom_fields = np.arange(n_fields - n_custom, n_fields)
        # Memory that is never written is never taken.
        self._fields = np.empty((n_fields, self._across, self._across), dtype=np.float32)
        self._ready = np.zeros(n_fields, dtype=bool)
        self.corners = np.zeros((n_fields, 2), dtype=np.int64)  # row and column of the goals
        for scene in range(len(scans)):
            self.prepare_goal(scene, 0)

    @property
    def _flat(self) -> NDArray[np.float32]:
        """A view of the fields; kept as an attribute, a copy of the world would have one of something else."""
        return self._fields.reshape(-1)

    def __getstate__(self) -> dict[str, Any]:
        """For ``copy`` and ``pickle``: of the fields, those that have been computed."""
        return {**self.__dict__, "_fields": self._fields[self._ready]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._fields = np.empty((len(self._ready), self._across, self._across), dtype=np.float32)
        self._fields[self._ready] = state["_fields"]

    def prepare_goal(self, scene: int, k: int) -> int:
        """The field of a scene's goal k.

        Goal k is the first good one of the scene's places k, k + n, k + 2 n, ..., and then of all: which one does not
        depend on the order in which goals are used.

        :param scene: index
        :param k: 0 to ``n_goals`` - 1
        :return: its index
        """
        field = scene * self.n_goals + k
        if self._ready[field]:
            return field
        places = self._places[scene]
        # The constructor has found that goal 0 exists, so the search for any other ends.
        candidates = places[:MAX_GOALS_TRIED] if k == 0 else np.concatenate([places[k :: self.n_goals], places])
        for corner in candidates:
            distances = self._compute(scene, corner)
            if self._start_share(distances) >= MIN_START_SHARE:
                self._fields[field], self.corners[field], self._ready[field] = distances, corner, True
                return field
        raise SceneError(
            f"{self.scans[scene].source}: none of {len(candidates)} goals has enough starts at a walking distance of "
            f"{self.rule.min_geodesic} to {self.rule.max_geodesic} m inside its view; lower min_geodesic, raise "
            "view_size, or take another scan"
        )

    def place_goal(self, scene: int, goal: NDArray[np.float64], copies: NDArray[np.int64]) -> None:
        """Make a point the goal of the custom fields of some copies.

        :param scene: index
        :param goal: x and y in m, in the scan's coordinates; moved to the nearest corner of a pixel
        :param copies: indices
        :raises ValueError: where one cannot walk there
        """
        corner = self.corners_at(np.array([scene]), goal[None])[0]
        distances = self._compute(scene, corner)
        if not np.isfinite(distances[self._middle, self._middle]):
            raise ValueError(f"the goal {goal.tolist()} is not on the walkable floor of {self.scans[scene].source}")
        fields = self.custom_fields[copies]
        self._fields[fields], self.corners[fields], self._ready[fields] = distances, corner, True

    def goal_positions(self, scenes: NDArray[np.int64], fields: NDArray[np.int64]) -> NDArray[np.float64]:
        """x and y of goals in m, in the scans' coordinates, (n, 2).

        :param scenes: of each field
        :param fields: (n,)
        """
        places: NDArray[np.float64] = self._origins[scenes] + self.corners[fields][:, ::-1] * (self.pitch, -self.pitch)
        return places

    def corners_at(self, scenes: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[np.int64]:
        """The corners of pixels nearest to points, the inverse of :meth:`goal_positions`: rows and columns, (n, 2).

        :param scenes: index of each
        :param points: x and y in m, in the scans' coordinates, (n, 2)
        """
        offsets = (points - self._origins[scenes]) * (1, -1) / self.pitch
        corners: NDArray[np.int64] = np.rint(offsets).astype(np.int64)[:, ::-1]
        return corners

    def _compute(self, scene: int, corner: NDArray[np.int64]) -> NDArray[np.float32]:
        scan, offsets = self.scans[scene], np.arange(-self.half, self.half + 1) * NODE
        scale, (height, width) = scan.meters_per_pixel, scan.walkable.shape
        rows, columns = (np.floor((k * self.pitch + offsets) / scale).astype(np.int64) for k in corner)
        known = ((rows >= 0) & (rows < height))[:, None] & (columns >= 0) & (columns < width)
        free = scan.walkable[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)] & known
        return np.pad(self._grid.distances(free), 1, constant_values=np.inf)

    def _start_share(self, distances: NDArray[np.float32]) -> float:
        """The probability that a point sampled uniformly in the view becomes a start."""
        return float(self.rule.weights(distances, self._straight).mean())

    def has_starts(self, field: int) -> bool:
        """Whether :meth:`sample_start` ends soon.

        :param field: index
        """
        return self._start_share(self._fields[field]) >= MIN_START_SHARE

    def sample_start(self, field: int, generator: np.random.Generator) -> NDArray[np.float64]:
        """A start, uniformly over all points that the rule keeps.

        :param field: index of one that has starts
        :param generator: samples it
        :return: (2,)
        """
        reach, fields = (self.half + 0.5) * NODE, np.full(_N_SAMPLES, field)
        while True:
            samples = generator.random((_N_SAMPLES, 3))
            positions = (2 * samples[:, :2] - 1) * reach
            distances = np.where(self.is_open(fields, positions), self.distances(fields, positions), np.inf)
            weights = self.rule.weights(distances, np.hypot(positions[:, 0], positions[:, 1]))
            taken = np.flatnonzero(samples[:, 2] < weights)
            if len(taken):
                return np.asarray(positions[taken[0]])

    def distances(self, fields: NDArray[np.int64], positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Geodesic distances: bilinear between four nodes; beside obstacles, the best way over one of them.

        :param fields: (n,)
        :param positions: (n, 2)
        :return: in m, (n,), infinite where no node near has a way
        """
        cells = positions[:, ::-1] * (-1 / NODE, 1 / NODE) + self._middle
        upper_left = np.floor(cells)
        # Shares (n, 4, 2) of the way from each of the four nodes, by row and column.
        away = abs((cells - upper_left)[:, None] - _CORNERS)
        first = fields * self._across**2 + (upper_left @ (self._across, 1)).astype(np.int64)
        nodes = self._flat[first[:, None] + _CORNERS @ (self._across, 1)].astype(np.float64)
        weights = (1 - away).prod(axis=2)
        known = nodes < np.inf
        if known.all():
            return np.asarray((nodes * weights).sum(axis=1))
        smooth = (np.where(known, nodes, 0) * weights).sum(axis=1)
        over_one = (nodes + NODE * np.hypot(away[..., 0], away[..., 1])).min(axis=1)
        return np.asarray(np.where(known.all(axis=1), smooth, over_one))

    def is_open(self, fields: NDArray[np.int64], positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether one can stand there: the nearest node has a way to the goal.

        :param fields: (...)
        :param positions: (..., 2), not further than a node's distance outside the view
        """
        nodes = np.rint(positions * (1 / NODE, -1 / NODE)).astype(np.int64) + self._middle
        index = fields * self._across**2 + nodes[..., 1] * self._across + nodes[..., 0]
        opened: NDArray[np.bool_] = self._flat[index] < np.inf
        return opened

    def reaches(self, field: int, position: NDArray[np.float64]) -> bool:
        """Whether any position, inside the view or not, has a way to the goal of a field.

        :param field: index
        :param position: (2,)
        """
        inside = bool((abs(position) <= self.half * NODE).all())
        return inside and bool(self.is_open(np.array([field]), position[None])[0])

    def moves(
        self,
        fields: NDArray[np.int64],
        positions: NDArray[np.float64],
        headings: NDArray[np.float64],
        length: float,
        sliding: bool,
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Where steps forward lead.

        :param fields: (n,)
        :param positions: (n, 2), open ones
        :param headings: in degrees, 0 is north and 90 west, (n,)
        :param length: of the step, in m
        :param sliding: whether to go on along obstacles
        :return: the new positions (n, 2), and whether something was in the way (n,)
        """
        n_steps = math.ceil(length / _SUBSTEP)
        angles = np.deg2rad(headings)
        step = np.stack([-np.sin(angles), np.cos(angles)], axis=1) * (length / n_steps)
        track = positions[:, None] + step[:, None] * np.arange(1, n_steps + 1)[:, None]
        # A long step may leave the field; nothing beyond its blocked ring is looked at.
        limit = self._middle * NODE
        free = self.is_open(fields[:, None], np.clip(track, -limit, limit))
        collided = np.asarray(~free.all(axis=1))
        moved = track[:, -1].copy()
        for i in np.flatnonzero(collided).tolist():
            # The part of the way before the obstacle is known to be free.
            n_free = int(np.argmin(free[i]))
            start = track[i, n_free - 1] if n_free else positions[i]
            moved[i] = self._creep(int(fields[i]), start.tolist(), step[i].tolist(), n_steps - n_free, sliding)
        return moved, collided

    def _creep(
        self, field: int, position: list[float], step: list[float], n_steps: int, sliding: bool
    ) -> tuple[float, float]:
        """Small steps along an obstacle, with whichever of the two coordinates goes on; plain numbers are fastest."""
        nodes, middle = self._fields[field], self._middle
        (x, y), (east, north) = position, step
        ways = [(east, north)]
        if sliding:
            ways += [(east, 0.0), (0.0, north)] if abs(east) >= abs(north) else [(0.0, north), (east, 0.0)]
        for _ in range(n_steps):
            for dx, dy in ways:
                if nodes[round((y + dy) * (-1 / NODE)) + middle, round((x + dx) * (1 / NODE)) + middle] < np.inf:
                    x, y = x + dx, y + dy
                    break
            else:
                break
        return x, y


def _places(scan: ScanMap, pitch: float) -> NDArray[np.int64]:
    """Walkable corners of observation pixels, (n, 2) rows and columns, in an order sampled once and for all."""
    walkable, ratio = scan.walkable, pitch / scan.meters_per_pixel
    rows, columns = (
        np.minimum((np.arange(int(n / ratio) + 1) * ratio).astype(np.int64), n - 1) for n in walkable.shape
    )
    corners: NDArray[np.int64] = np.random.default_rng(0).permutation(np.argwhere(walkable[rows[:, None], columns]))
    return corners
