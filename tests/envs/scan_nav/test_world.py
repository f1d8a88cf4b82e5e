"""Geodesic distances, goals and starts of ScanNav."""

import numpy as np
import pytest
from scan_inputs import map_of_a_room  # noqa: F401

from sb3_abisim.envs.scan_nav.env import ScanNavVectorEnv
from sb3_abisim.envs.scan_nav.world import NODE, StartRule
from sb3_abisim.envs.shortest_paths import DistanceGrid


def test_distances_against_straight_lines_and_a_corner():
    half = 40
    grid, rng = DistanceGrid(half, NODE), np.random.default_rng(0)
    field = grid.distances(np.ones((81, 81), dtype=bool))
    rows, columns = rng.integers(0, 81, (2, 200))
    straight = NODE * np.hypot(rows - half, columns - half)
    assert (field[rows, columns] >= straight - 1e-4).all()
    assert (field[rows, columns] <= straight * 1.0275 + 1e-4).all()
    # A wall to the east of the middle, from the north down to two rows south of it.
    free = np.ones((81, 81), dtype=bool)
    free[: half + 3, half + 10] = False
    expected = NODE * (np.hypot(3, 10) + np.hypot(3, 20))
    assert grid.distances(free)[half, half + 30] == pytest.approx(expected, rel=0.03)
    free[:, half + 10] = False
    assert np.isinf(grid.distances(free)[half, half + 30])


def test_interpolated_distances_are_straight_ones_in_the_open(room):
    env = ScanNavVectorEnv(scenes=room)
    env.reset(seed=0, options={"goal": (4.0, 3.0), "start": (4.0, 2.0)})
    rng = np.random.default_rng(0)
    positions = rng.uniform(-2.2, 2.2, (500, 2))
    distances = env._world.distances(np.repeat(env._field, 500), positions)
    straight = np.hypot(*positions.T)
    assert (distances <= 1.0275 * straight + 0.02).all() and (distances >= straight - 1e-6).all()


def test_starts_follow_the_rule():
    for min_ratio in (None, 1.1):
        env = ScanNavVectorEnv(200, scenes=2, goals_per_scene=8, min_geodesic=1.5, max_geodesic=4, min_ratio=min_ratio)
        env.reset(seed=0)
        assert (env._distance >= 1.5).all() and (env._distance <= 4).all()
        straight = np.hypot(*(env.factors()["agent"] - env.factors()["goal"]).T)
        detours = (env._distance / straight >= 1.1).mean()
        if min_ratio is None:
            plain = detours
    assert detours > plain + 0.15
    rule = StartRule(1, 30, 1.1)
    weights = rule.weights(np.array([0.5, 2.0, 2.1, 2.4, 31, np.inf]), np.array([0.5, 2.0, 2.0, 2.0, 20, 2.0]))
    assert weights == pytest.approx([0, 20 * 0.02**2, 20 * 0.07**2, 1, 0, 0])


def test_goals_do_not_depend_on_the_order_of_use(room):
    one, other = (ScanNavVectorEnv(scenes=room, goals_per_scene=6) for _ in range(2))
    for k in range(6):
        one._world.prepare_goal(0, k)
    for k in reversed(range(6)):
        other._world.prepare_goal(0, k)
    assert np.array_equal(one._world.corners, other._world.corners)
    assert len(np.unique(one._world.corners[:6], axis=0)) > 3


@pytest.mark.parametrize("stop", ["auto", "action"])
def test_shortest_paths_are_those_of_the_agent_that_knows_the_map(room, stop):
    env, other = (ScanNavVectorEnv(12, scenes=[room, 2], goals_per_scene=3, stop=stop) for _ in range(2))
    env.reset(seed=0)
    factors = env.factors()
    # Another one, which has not been at these goals.
    paths = other.shortest_paths(factors)
    assert paths.optimal.sum(axis=1).tolist() == [1] * 12
    assert np.array_equal(paths.optimal.argmax(axis=1), env.oracle_actions())
    assert len(set(env.oracle_actions())) > 1
    np.testing.assert_allclose(paths.geodesic, env._distance, atol=1e-6)
    straight = np.hypot(*(factors["agent"] - factors["goal"]).T)
    assert (paths.straight >= straight - 1e-9).all() and (paths.straight <= 1.0275 * straight).all()
    assert (paths.geodesic > paths.straight - 0.02).all()
    env.reset(options={"goal": (4.0, 3.0)})
    with pytest.raises(ValueError, match="is none of its 3; take states of this setting"):
        env.shortest_paths(env.factors())
