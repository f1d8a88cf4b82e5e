"""Distances on grids, against a derivation written as loops."""

import heapq
import math

import numpy as np
import pytest

from sb3_abisim.envs.shortest_paths import DistanceFields, DistanceGrid, open_distances

# Each of the 16 ways, and the nodes between which it passes.
MOVES = [(dr, dc) for dr in range(-2, 3) for dc in range(-2, 3) if math.gcd(dr, dc) == 1]


def passed(row, column, dr, dc):
    """The nodes within half a node of the way from one node to another, its ends among them."""
    if abs(dr) == abs(dc) == 1:
        return [(row, column), (row + dr, column), (row, column + dc), (row + dr, column + dc)]
    between = {(round(dr * s / 4 + e), round(dc * s / 4 + e)) for s in range(5) for e in (-0.01, 0.01)}
    return [(row + r, column + c) for r, c in between]


def by_loops(free, goal, node):
    """Dijkstra's algorithm, node by node."""
    n = len(free)
    found = np.full((n, n), np.inf)
    found[goal] = 0.0
    heap = [(0.0, goal)]
    while heap:
        distance, (row, column) = heapq.heappop(heap)
        if distance > found[row, column]:
            continue
        for dr, dc in MOVES:
            there = row + dr, column + dc
            if not (0 <= there[0] < n and 0 <= there[1] < n):
                continue
            if not all(free[place] for place in passed(row, column, dr, dc)):
                continue
            longer = distance + node * math.hypot(dr, dc)
            if longer < found[there] - 1e-12:
                found[there] = longer
                heapq.heappush(heap, (longer, there))
    return found


@pytest.mark.parametrize("seed", [0, 1])
def test_distances_are_those_of_loops(seed):
    generator = np.random.default_rng(seed)
    free = generator.random((15, 15)) > 0.3
    goal = (3, 11)
    free[goal] = True
    found = DistanceGrid(7, 0.5).distances(free, goal)
    expected = by_loops(free, goal, 0.5)
    np.testing.assert_allclose(found[free], expected[free], rtol=1e-6)
    assert np.isfinite(found[free]).sum() > 20 and np.isinf(found[~free]).all()
    free[goal] = False
    assert np.isinf(DistanceGrid(7, 0.5).distances(free, goal)).all()


def test_open_distances_are_those_of_an_empty_grid():
    field = DistanceGrid(12, 0.25).distances(np.ones((25, 25), dtype=bool))
    rows, columns = np.indices((25, 25)) - 12
    np.testing.assert_allclose(open_distances(0.25 * np.stack([rows, columns], axis=-1)), field, rtol=1e-6)


def test_a_field_has_its_goal_where_it_was_placed():
    fields = DistanceFields(8, 0.5, 2)
    fields.set_field(1, np.ones((17, 17), dtype=bool), np.array((1.5, -2.0)))
    places = np.array([(1.5, -2.0), (3.5, -2.0), (1.5, 1.0)])
    np.testing.assert_allclose(fields.distances(np.full(3, 1), places), [0.0, 2.0, 3.0], atol=1e-6)
    wall = np.ones((17, 17), dtype=bool)
    wall[:, 8] = False
    fields.set_field(0, wall, np.array((1.5, 0.0)))
    assert fields.is_open(np.array([0, 0]), np.array([(1.0, 1.0), (-1.0, 1.0)])).tolist() == [True, False]
