"""Perturbation figures on encoders whose answers are known."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from analysis_inputs import Masked, file_of, identity

from sb3_abisim.analysis import nav2d_exact, perturbation
from sb3_abisim.analysis.nav2d_exact import GOAL_CELL, eval_layouts
from sb3_abisim.analysis.perturbation import FAR, NEAR, nav2d_maps, near_and_far, structure_maps, sweep_maps
from sb3_abisim.envs.nav2d import LAYOUTS, SIZE

SHAPE = (3, SIZE, SIZE)


@pytest.fixture
def few_cells(monkeypatch):
    """Toggle some cells instead of 224."""
    monkeypatch.setattr(nav2d_exact, "_togglable", lambda: np.array([0, 17, 80, 81, 100, 111, 113, 127, 142, 217]))
    monkeypatch.setattr(nav2d_exact, "MIN_SAMPLES", 1)
    monkeypatch.setattr(perturbation, "MIN_PAIRS", 1)


def test_pixels_as_embedding_feel_every_cell_alike(few_cells):
    (result,) = nav2d_maps({"identity": identity(SHAPE)}, "Nav2D-v0", 1)["encoders"].values()
    seen = np.array(result["map"])[~np.isnan(result["map"])]
    np.testing.assert_allclose(seen, 1.0, rtol=1e-4)
    np.testing.assert_allclose(result["profile"], 1.0, rtol=1e-4)


def test_a_block_is_four_cells_and_an_agent_two(few_cells):
    result = near_and_far({"identity": identity(SHAPE)}, "Nav2D-v0", 20)
    one = result["encoders"]["identity"]
    assert len(one["near"]) == len(one["far"]) == result["n"] > 10
    np.testing.assert_allclose(one["near"] + one["far"], 4 / 2, rtol=1e-4)
    assert one["near_share"] == 0.0


def test_blocks_lie_in_their_region():
    generator = np.random.default_rng(0)
    for obstacles in eval_layouts("Nav2D-v0", 5):
        agent = int(generator.choice(np.flatnonzero(~obstacles)))
        ay, ax = divmod(agent, SIZE)
        for near in (True, False):
            expected = set()
            for y in range(SIZE - 1):
                for x in range(SIZE - 1):
                    cells = [(y + j, x + i) for j in (0, 1) for i in (0, 1)]
                    far = [max(abs(cy - ay), abs(cx - ax)) for cy, cx in cells]
                    region = max(far) <= NEAR if near else min(far) >= FAR
                    numbers = [cy * SIZE + cx for cy, cx in cells]
                    if region and not obstacles[numbers].any() and not {agent, GOAL_CELL} & set(numbers):
                        expected.add(y * (SIZE - 1) + x)
            assert set(perturbation._new_blocks(obstacles, agent, near)) == expected


def test_encoder_that_sees_the_reachable_part_alone(few_cells):
    structure = np.array([list(row) for row in LAYOUTS["corridor"]])
    mask = np.ones(SHAPE)
    mask[1] = structure == "."
    encoders = {"all": identity(SHAPE), "reachable": file_of(Masked(mask), SHAPE)}
    results = structure_maps(encoders, "Nav2DCorridor-v0", 1)["encoders"]
    assert results["all"]["kinds"] == pytest.approx({"reachable": 1, "walls": 1, "out of reach": 1}, rel=1e-4)
    assert results["reachable"]["kinds"] == pytest.approx({"reachable": 1, "walls": 0, "out of reach": 0}, abs=1e-4)
    far = np.array(results["reachable"]["profiles"]["out of reach"])
    np.testing.assert_allclose(far[~np.isnan(far)], 0, atol=1e-4)


@pytest.mark.parametrize(
    ("env_id", "message"), [("Nav2D-v0", "Nav2D-v0 has no fixed structure"), ("PointMaze-v0", "Nav2D alone")]
)
def test_structures_need_a_structure(env_id, message):
    with pytest.raises(ValueError, match=message):
        structure_maps({}, env_id, 1)


def test_a_structure_is_that_of_the_environment_whatever_its_id(monkeypatch):
    spec = copy.copy(gym.spec("Nav2DMaze-v0"))
    spec.id = "MyGrid-v0"
    monkeypatch.setitem(gym.registry, spec.id, spec)
    assert structure_maps({}, spec.id, 1)["structure"] == list(LAYOUTS["maze"])


def test_sweep_compares_each_c_with_its_metric(few_cells):
    # At c = 0 the metric is the base distance, which is what the base itself shows.
    base = identity(SHAPE)
    results = sweep_maps({0.0: base, 0.5: base}, base.encoder, "Nav2D-v0", 1)["encoders"]
    none, half = results["c = 0"], results["c = 0.5"]
    np.testing.assert_allclose(none["map"], none["exact_map"], rtol=1e-3)
    assert half["exact_profile"][0] == pytest.approx(1.0)
    assert not np.allclose(half["exact_map"], half["map"], rtol=1e-2, equal_nan=True)
