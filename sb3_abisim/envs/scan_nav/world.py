"""Where one can walk in ScanNav and how far it is: scenes, goals, starts.

Everything about a goal happens on a square grid of nodes around it, its *field*
(:mod:`~sb3_abisim.envs.shortest_paths`), which is as large as the view. Positions are in meters east and north of the
goal.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.shortest_paths import DistanceFields

NODE = 0.05  # m between neighboring nodes
# A goal is used if this share of points sampled in its view are starts, so that sampling one ends soon.
MIN_START_SHARE = 0.005
# Places of a scene that are tried as goals before it is refused.
MAX_GOALS_TRIED = 300
# Of all goals' fields, each of which is computed when it is first used.
MAX_FIELD_BYTES = 64 * 2**30
_N_SAMPLES = 16


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


class ScanWorld(DistanceFields):
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
        half, n_fields = int(reach / NODE), len(scans) * n_goals + n_custom
        if (n_bytes := n_fields * (2 * half + 3) ** 2 * 4) > MAX_FIELD_BYTES:
            raise ValueError(
                f"{n_goals} goals in each of {len(scans)} scenes would take {n_bytes / 2**30:.0f} GB; lower "
                "goals_per_scene or view_size"
            )
        super().__init__(half, NODE, n_fields)
        offsets = np.arange(-self._middle, self._middle + 1) * NODE
        self._straight = np.hypot(offsets[:, None], offsets)
        self._origins = np.array([scan.origin for scan in scans])
        self._places = [_places(scan, pitch) for scan in scans]
        self.custom_fields = np.arange(n_fields - n_custom, n_fields)
        self._ready = np.zeros(n_fields, dtype=bool)
        self.corners = np.zeros((n_fields, 2), dtype=np.int64)  # row and column of the goals
        for scene in range(len(scans)):
            self.prepare_goal(scene, 0)

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
        return self.compute_field(free)

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

    def fields_of(self, scenes: NDArray[np.int64], goals: NDArray[np.float64]) -> NDArray[np.int64]:
        """The fields of goals, computed where they were not needed before.

        :param scenes: index of each
        :param goals: x and y in m, in the scans' coordinates, (n, 2)
        :return: (n,)
        :raises ValueError: for one that is not of its scene's pool
        """
        wanted, which = np.unique(
            np.column_stack([scenes, self.corners_at(scenes, goals)]), axis=0, return_inverse=True
        )
        found = np.array([self._field_at(scene, (row, column)) for scene, row, column in wanted.tolist()])
        fields: NDArray[np.int64] = found[which]
        return fields

    def _field_at(self, scene: int, corner: tuple[int, int]) -> int:
        first = scene * self.n_goals
        pool = slice(first, first + self.n_goals)
        while True:
            there = np.flatnonzero(self._ready[pool] & (self.corners[pool] == corner).all(axis=1))
            if len(there):
                return first + int(there[0])
            missing = np.flatnonzero(~self._ready[pool])
            if not len(missing):
                raise ValueError(
                    f"{self.scans[scene].source}: the goal at the pixels' corner {corner} is none of its "
                    f"{self.n_goals}; take states of this setting, without the reset option goal"
                )
            self.prepare_goal(scene, int(missing[0]))

    def best_turns(
        self,
        fields: NDArray[np.int64],
        positions: NDArray[np.float64],
        headings: NDArray[np.float64],
        angle: float,
        length: float,
        sliding: bool,
    ) -> NDArray[np.int64]:
        """How many turns to the left lead to where a step forward gains most, the fewest of equal ones.

        :param fields: (n,)
        :param positions: (n, 2), open ones
        :param headings: in degrees, (n,)
        :param angle: of a turn, in degrees
        :param length: of the step, in m
        :param sliding: see :meth:`moves`
        :return: (n,), negative to the right
        """
        half = int(180 // angle)
        turns = np.array(sorted(range(-half, half + 1), key=abs))
        directions = headings[:, None] + turns * angle
        fields, positions = fields.repeat(len(turns)), positions.repeat(len(turns), axis=0)
        moved, _ = self.moves(fields, positions, directions.ravel(), length, sliding)
        left = self.distances(fields, moved).reshape(directions.shape)
        best: NDArray[np.int64] = turns[np.argmin(np.round(left, 6), axis=1)]
        return best

    def blocked(self, scenes: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether an agent's center cannot be at points of the scans.

        :param scenes: indices, (n,)
        :param points: x and y in m, in the scans' coordinates, (n, m, 2)
        :return: (n, m)
        """
        blocked = np.ones(points.shape[:2], dtype=bool)
        for k in np.unique(scenes).tolist():
            scan, here = self.scans[k], scenes == k
            column = np.floor((points[here, :, 0] - scan.origin[0]) / scan.meters_per_pixel).astype(np.int64)
            row = np.floor((scan.origin[1] - points[here, :, 1]) / scan.meters_per_pixel).astype(np.int64)
            height, width = scan.walkable.shape
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            walkable = scan.walkable[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
            blocked[here] = ~(inside & walkable)
        return blocked

    def reaches(self, field: int, position: NDArray[np.float64]) -> bool:
        """Whether any position, inside the view or not, has a way to the goal of a field.

        :param field: index
        :param position: (2,)
        """
        inside = bool((abs(position) <= self.half * NODE).all())
        return inside and bool(self.is_open(np.array([field]), position[None])[0])


def _places(scan: ScanMap, pitch: float) -> NDArray[np.int64]:
    """Walkable corners of observation pixels, (n, 2) rows and columns, in an order sampled once and for all."""
    walkable, ratio = scan.walkable, pitch / scan.meters_per_pixel
    rows, columns = (
        np.minimum((np.arange(int(n / ratio) + 1) * ratio).astype(np.int64), n - 1) for n in walkable.shape
    )
    corners: NDArray[np.int64] = np.random.default_rng(0).permutation(np.argwhere(walkable[rows[:, None], columns]))
    return corners
