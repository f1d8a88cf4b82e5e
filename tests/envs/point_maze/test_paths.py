"""Shortest paths in rooms: solved by hand and by loops, and against what pushes do in the simulation."""

import heapq
import math

import numpy as np
import pytest

from sb3_abisim.envs.point_maze.distractors import DistractorPointMazeVectorEnv
from sb3_abisim.envs.point_maze.env import BALL_RADIUS, PointMazeVectorEnv
from sb3_abisim.envs.point_maze.paths import find_paths, solid_within
from sb3_abisim.envs.point_maze.top_down import DIRECTIONS

UP, DOWN, LEFT, RIGHT = range(4)
RADIUS, PUSH = 0.1, 1.0


def solve(agents, obstacles, goal=(0.0, 0.0)):
    n = len(agents)
    obstacles = np.repeat(np.array(obstacles, dtype=float)[None], n, axis=0)
    return find_paths(
        np.array(agents, dtype=float), obstacles, np.tile(np.array(goal, dtype=float), (n, 1)), RADIUS, PUSH
    )


def test_around_an_obstacle_solved_by_hand():
    # Three obstacles in a column left of the goal: from (-4, 0) the way leads around the upper or the lower end.
    wall = [(-2.0, -2.0), (-2.0, 0.0), (-2.0, 2.0)]
    paths = solve([(-4.0, 0.0), (-4.0, -1.0), (4.0, 0.0), (0.0, 4.0), (4.0, 4.0)], wall)
    around = math.hypot(1.0 - RADIUS, 3.0 + RADIUS) + (2.0 + 2 * RADIUS) + math.hypot(1.0 - RADIUS, 3.0 + RADIUS)
    assert around < paths.geodesic[0] < around * 1.06
    np.testing.assert_allclose(paths.geodesic[2:4], 4.0, rtol=1e-5)
    np.testing.assert_allclose(paths.straight, np.array([4.0, 4.123, 4.0, 4.0, 4 * math.sqrt(2)]), rtol=0.03)
    np.testing.assert_allclose((paths.geodesic - paths.straight)[2:], 0.0, atol=1e-5)
    best = [{a for a in range(4) if row[a]} for row in paths.optimal]
    assert best[0] in ({UP, DOWN, RIGHT}, {UP, DOWN}) and best[1] in ({UP, RIGHT}, {UP})
    assert best[2:] == [{LEFT}, {UP}, {UP, LEFT}]


def test_a_push_ends_at_what_is_in_the_way():
    # The agent touches the obstacle to its right, and the goal is behind that.
    paths = solve([(-3.15, 0.3)], [(-2.0, 0.0)])
    assert not paths.optimal[0, RIGHT] and paths.optimal[0, DOWN]


def test_obstacles_grow_by_the_radius():
    # A gap of a quarter meter lets a small ball through, and not one of 0.2 m radius.
    row = [(x, 2.0) for x in (-6.5, -4.5, -2.5, -0.5, 1.75, 3.75, 5.75)] + [(7.0, 2.0)]
    agents, obstacles, goals = np.array([(0.0, 4.0)]), np.array([row]), np.zeros((1, 2))
    assert find_paths(agents, obstacles, goals, 0.1, PUSH).geodesic[0] < 4.6
    assert np.isinf(find_paths(agents, obstacles, goals, 0.2, PUSH).geodesic[0])


def test_distances_in_a_room_are_those_of_loops():
    env = PointMazeVectorEnv(1, goal="random")
    env.reset(seed=3)
    factors = env.factors()
    boxes = factors["obstacles"][0].astype(float).tolist()
    (goal_x, goal_y), n, node = factors["goal"][0].tolist(), 121, 0.125
    at = [(i - 60) * node for i in range(n)]
    free = [
        [
            max(abs(x), abs(y)) <= 7.4 and not any(abs(x - bx) < 1.1 and abs(y - by) < 1.1 for bx, by in boxes)
            for x in at
        ]
        for y in at
    ]
    goal = round(goal_y / node) + 60, round(goal_x / node) + 60
    # Four ways of length 1, four of length sqrt(2), eight of length sqrt(5).
    ways = [(r, c) for r in range(-2, 3) for c in range(-2, 3) if math.gcd(r, c) == 1]
    found, heap = {goal: 0.0}, [(0.0, goal)]
    while heap:
        distance, (row, column) = heapq.heappop(heap)
        if distance > found[row, column]:
            continue
        for r, c in ways:
            sides = [(r, 0), (0, c)] if abs(r) == abs(c) else [(r // 2, c // 2), (-(-r // 2), -(-c // 2))]
            if all(free[row + a][column + b] for a, b in [*sides, (r, c)]):
                there, longer = (row + r, column + c), distance + node * math.hypot(r, c)
                if longer < found.get(there, math.inf):
                    found[there] = longer
                    heapq.heappush(heap, (longer, there))
    nodes = list(found)[:: max(1, len(found) // 200)]
    agents = np.array([(at[column], at[row]) for row, column in nodes])
    many = {name: np.repeat(factors[name], len(agents), axis=0) for name in ("obstacles", "goal")}
    paths = env.shortest_paths({**many, "agent": agents})
    np.testing.assert_allclose(paths.geodesic, [found[one] for one in nodes], rtol=1e-5, atol=1e-6)
    assert (paths.geodesic - paths.straight).max() > 0.5, "some way leads around something"


@pytest.mark.parametrize("momentum", [False, True])
def test_optimal_pushes_shorten_the_way_in_the_simulation(momentum):
    env = PointMazeVectorEnv(40, momentum=momentum)
    env.reset(seed=0)
    before = env.factors()
    starts = env._position.copy()
    states = [before]
    for action in range(4):
        env._position[:], env._velocity[:] = starts, 0.0
        env._advance(np.full(40, action))
        states.append(env.factors())
    factors = {name: np.concatenate([state[name] for state in states]) for name in before}
    paths = env.shortest_paths(factors)
    assert np.isfinite(paths.geodesic).all()
    left = paths.geodesic.reshape(5, 40)
    gains, optimal = left[0][:, None] - left[1:].T, paths.optimal[:40]
    assert 1.2 < optimal.sum(axis=1).mean() < 2.5
    # A ball that grazes a corner slides along it, and the straight push does not.
    assert ((gains > 0.125) == optimal).mean() > 0.95


def test_what_is_blocked_does_not_hang_on_the_background():
    plain, moving = PointMazeVectorEnv(5), DistractorPointMazeVectorEnv(5)
    for env in (plain, moving):
        env.reset(seed=1)
    factors, offsets = moving.factors(), np.array([(1, 0), (0, -2)])
    blocked = moving.blocked_around(factors, offsets)
    for k in range(5):
        for j, offset in enumerate(offsets):
            x, y = factors["agent"][k] + offset
            inside = [abs(x - bx) < 1 and abs(y - by) < 1 for bx, by in factors["obstacles"][k]]
            assert blocked[k, j] == (any(inside) or max(abs(x), abs(y)) > 7.5)
    np.testing.assert_array_equal(blocked, plain.blocked_around(plain.factors(), offsets))
    grown = solid_within(np.array([[(0.0, 1.05)]]), np.array([[(0.0, 0.0)]]), BALL_RADIUS)
    assert grown.all() and len(DIRECTIONS) == plain.shortest_paths(plain.factors()).optimal.shape[1]
