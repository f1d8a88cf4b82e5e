"""Shortest paths: what an environment may tell of its states, and geodesic distances on a square grid of nodes.

A grid's positions are in meters east and north of its middle. The *field* of a goal holds the geodesic distance of each
node to it, infinite where there is no way on the grid.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.extras import needs_extra

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


class ShortestPaths(NamedTuple):
    """What leads to the goal from some states.

    :param optimal: which actions lead on along a shortest path, bool (n, n_actions); where actions are continuous,
        of a few that stand for them
    :param geodesic: how far the goal is, in any unit of length, (n,)
    :param straight: how far it would be if nothing were in the way, in the same unit, (n,)
    """

    optimal: NDArray[np.bool_]
    geodesic: NDArray[np.floating[Any]]
    straight: NDArray[np.floating[Any]]


class DistanceGrid:
    """Geodesic distances to a node of a square grid of nodes.

    Ways lead to 16 neighbors (those of a king and of a knight in chess), so a distance is too long by 2.7 % at most.

    :param half: nodes on each side of the middle one
    :param node: m between neighboring nodes
    """

    def __init__(self, half: int, node: float) -> None:
        self.size = 2 * half + 1
        self._middle = (half, half)
        rows, columns = np.indices((self.size, self.size))
        self._edges = []
        for (down, right), passed in _WAYS:
            there = (rows + down < self.size) & (columns + right >= 0) & (columns + right < self.size)
            begin = (rows * self.size + columns)[there]
            others = [begin + down * self.size + right, *(begin + r * self.size + c for r, c in passed)]
            self._edges.append((begin, others, node * float(np.hypot(down, right))))

    def distances(self, free: NDArray[np.bool_], goal: tuple[int, int] | None = None) -> NDArray[np.float32]:
        """Length of the shortest way from each node to the goal.

        :param free: nodes that a way may touch, (size, size)
        :param goal: row and column of a node; None for the middle one
        :return: in m, (size, size), infinite where there is no way
        """
        with needs_extra("analysis", "a shortest path"):
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
        row, column = self._middle if goal is None else goal
        index = row * self.size + column
        found = dijkstra(graph, directed=False, indices=index)
        if not flat[index]:
            found[index] = np.inf
        field: NDArray[np.float32] = found.astype(np.float32).reshape(self.size, self.size)
        return field


def open_distances(offsets: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """The distances of a :class:`DistanceGrid` where nothing is in the way.

    :param offsets: from one point to the other, (..., 2)
    :return: in the unit of ``offsets``, (...)
    """
    near, far = np.moveaxis(np.sort(np.abs(offsets.astype(np.float64)), axis=-1), -1, 0)
    # The two of the 16 directions that the offset lies between share the way.
    by_knight = np.where(far > 2 * near, far - 2 * near + near * np.sqrt(5), 0.0)
    diagonal = (far - near) * np.sqrt(5) + (2 * near - far) * np.sqrt(2)
    distances: NDArray[np.float64] = np.where(far > 2 * near, by_knight, diagonal)
    return distances


class DistanceFields:
    """The fields of several goals on grids of one size, and what can be asked about positions in them.

    :param half: nodes on each side of the middle one
    :param node: m between neighboring nodes
    :param n_fields: how many; memory that is never written is never taken
    """

    def __init__(self, half: int, node: float, n_fields: int) -> None:
        self.half, self.node = half, node
        self._grid = DistanceGrid(half, node)
        # A ring of blocked nodes is the wall around the grid.
        self._across, self._middle = self._grid.size + 2, half + 1
        self._fields = np.empty((n_fields, self._across, self._across), dtype=np.float32)

    @property
    def _flat(self) -> NDArray[np.float32]:
        """A view of the fields; kept as an attribute, a copy of this would have one of something else."""
        return self._fields.reshape(-1)

    def compute_field(self, free: NDArray[np.bool_], goal: tuple[int, int] | None = None) -> NDArray[np.float32]:
        """A field with its ring, (size + 2, size + 2).

        :param free: see :meth:`DistanceGrid.distances`
        :param goal: see there
        """
        return np.pad(self._grid.distances(free, goal), 1, constant_values=np.inf)

    def set_field(self, field: int, free: NDArray[np.bool_], goal: NDArray[np.floating[Any]]) -> None:
        """Compute a field.

        :param field: index
        :param free: nodes that a way may touch, (size, size), rows from north to south
        :param goal: (2,); moved to the nearest node
        """
        column, row = np.rint(goal * np.array((1, -1)) / self.node).astype(np.int64) + self.half
        self._fields[field] = self.compute_field(free, (int(row), int(column)))

    def distances(self, fields: NDArray[np.int64], positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Geodesic distances: bilinear between four nodes; beside obstacles, the best way over one of them.

        :param fields: (n,)
        :param positions: (n, 2)
        :return: in m, (n,), infinite where no node near has a way
        """
        cells = positions[:, ::-1] * (-1 / self.node, 1 / self.node) + self._middle
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
        over_one = (nodes + self.node * np.hypot(away[..., 0], away[..., 1])).min(axis=1)
        return np.asarray(np.where(known.all(axis=1), smooth, over_one))

    def is_open(self, fields: NDArray[np.int64], positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether one can stand there: the nearest node has a way to the goal.

        :param fields: (...)
        :param positions: (..., 2), not further than a node's distance outside the grid
        """
        nodes = np.rint(positions * (1 / self.node, -1 / self.node)).astype(np.int64) + self._middle
        index = fields * self._across**2 + nodes[..., 1] * self._across + nodes[..., 0]
        opened: NDArray[np.bool_] = self._flat[index] < np.inf
        return opened

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
        n_steps = math.ceil(length / (self.node / 2))
        angles = np.deg2rad(headings)
        step = np.stack([-np.sin(angles), np.cos(angles)], axis=1) * (length / n_steps)
        track = positions[:, None] + step[:, None] * np.arange(1, n_steps + 1)[:, None]
        # A long step may leave the field; nothing beyond its blocked ring is looked at.
        limit = self._middle * self.node
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
        nodes, middle, scale = self._fields[field], self._middle, 1 / self.node
        (x, y), (east, north) = position, step
        ways = [(east, north)]
        if sliding:
            ways += [(east, 0.0), (0.0, north)] if abs(east) >= abs(north) else [(0.0, north), (east, 0.0)]
        for _ in range(n_steps):
            for dx, dy in ways:
                if nodes[round((y + dy) * -scale) + middle, round((x + dx) * scale) + middle] < np.inf:
                    x, y = x + dx, y + dy
                    break
            else:
                break
        return x, y
