"""The instrument that compares a learned distance with the exact one, itself compared with brute force."""

import json
import re

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_abisim.analysis import command as analyze
from sb3_abisim.analysis import nav2d_exact
from sb3_abisim.analysis.nav2d_exact import (
    GOAL_CELL,
    N_CELLS,
    SIZE,
    ExactReference,
    embed,
    eval_layouts,
    exact_maps,
    learned_maps,
    mean_map,
    observations,
    profile,
    reachable,
    spearman,
    step_profile,
)
from sb3_abisim.analysis.pixels import pixel_maps
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.networks.paper import Nav2DEncoder


@pytest.fixture(scope="module")
def base():
    return load_encoder("Nav2D-v0/ssi").encoder.eval()


@pytest.fixture
def few_cells(monkeypatch):
    """Toggle five cells instead of 224."""
    cells = np.array([0, 17, 100, 111, 127])
    monkeypatch.setattr(nav2d_exact, "_togglable", lambda: cells)
    monkeypatch.setattr(nav2d_exact, "MIN_SAMPLES", 1)
    return cells


@pytest.mark.parametrize("env_id", ["Nav2D-v0", "Nav2DCorridor-v0", "Nav2DMaze-v0"])
def test_states_are_those_of_the_environment(env_id):
    obstacles = eval_layouts(env_id, 1, seed=3)[0]
    env = gym.make(env_id)
    observation, _ = env.reset(seed=3)
    cells = set(reachable(obstacles))
    generator = np.random.default_rng(0)
    for _ in range(40):
        agent = int(observation[0].reshape(-1).argmax())
        assert agent in cells
        np.testing.assert_array_equal(observations(obstacles, np.array([agent]))[0], observation)
        observation, _, terminated, truncated, _ = env.step(int(generator.integers(4)))
        if terminated or truncated:
            break


def test_states_with_the_goal_elsewhere_are_refused():
    """They are rendered with it in the center."""
    with pytest.raises(ValueError, match=r"goal of Nav2DRandomGoal-v0 is not in the center, .*; give Nav2D-v0"):
        eval_layouts("Nav2DRandomGoal-v0", 1)
    env_id = "ContinuousPointMazeRandomGoal-v0"
    with pytest.raises(ValueError, match=f"goal of {env_id} is not in the center, .*; give ContinuousPointMaze-v0"):
        pixel_maps({}, env_id, 1)


def test_reachable_cells_by_flood_fill():
    obstacles = np.zeros(N_CELLS, dtype=bool)
    obstacles.reshape(SIZE, SIZE)[3] = True
    np.testing.assert_array_equal(reachable(obstacles), np.arange(4 * SIZE, N_CELLS))


@th.no_grad()
def test_exact_map_is_the_discounted_sum_over_action_sequences(base, few_cells):
    # Deterministic moves: the fixed point unrolls into base distances along common action sequences.
    obstacles = eval_layouts("Nav2D-v0", 1)[0]
    c, n_steps = 0.3, 6
    maps = exact_maps(base, obstacles[None], c)[0]
    agents = [agent for agent in reachable(obstacles) if agent not in few_cells][::40]
    for cell in few_cells[:2]:
        other = obstacles.copy()
        other[cell] = ~other[cell]
        for agent in agents:
            pairs, expected = [(agent, agent)], 0.0
            for step in range(n_steps):
                x = embed(base, observations(obstacles, np.array([i for i, _ in pairs])))
                y = embed(base, observations(other, np.array([j for _, j in pairs])))
                expected += (1 - c) * c**step * float((x - y).abs().sum(dim=1).mean())
                pairs = [(move(obstacles, i, a), move(other, j, a)) for i, j in pairs for a in range(4)]
            # What is cut off weighs c to the n_steps, and the iteration stops within 1e-3 of the largest distance.
            assert maps[agent, cell] == pytest.approx(expected, rel=0.02, abs=1.5)


def move(obstacles, cell, action):
    y, x = divmod(int(cell), SIZE)
    dx, dy = [(0, -1), (0, 1), (-1, 0), (1, 0)][action]
    inside = 0 <= x + dx < SIZE and 0 <= y + dy < SIZE
    return (y + dy) * SIZE + x + dx if inside and not obstacles[(y + dy) * SIZE + x + dx] else int(cell)


@th.no_grad()
def test_learned_map_is_the_distance_of_embeddings(base, few_cells):
    obstacles = eval_layouts("Nav2D-v0", 1)[0]
    maps = learned_maps(base, obstacles[None])[0]
    agents = reachable(obstacles)
    agent, cell = int(agents[0]), int(few_cells[1])
    other = obstacles.copy()
    other[cell] = ~other[cell]
    x = base(th.as_tensor(observations(obstacles, np.array([agent]))).float() / 255)
    y = base(th.as_tensor(observations(other, np.array([agent]))).float() / 255)
    assert maps[agent, cell] == pytest.approx(float((x - y).abs().sum()), rel=1e-4)
    assert np.isnan(np.delete(maps, few_cells, axis=1)).all()
    assert np.isnan(maps[np.flatnonzero(obstacles)]).all()


def test_mean_map_and_profile_sort_by_offset():
    # The value of a pair is its offset, coded; agents everywhere.
    y, x = np.divmod(np.arange(N_CELLS), SIZE)
    dy, dx = y[None] - y[:, None], x[None] - x[:, None]
    means = mean_map((100.0 * dy + dx)[None])
    assert means[SIZE - 1 + 2, SIZE - 1 - 3] == pytest.approx(197.0)
    assert np.isnan(means[0, 0]), "only one agent sees this offset"
    steps = (np.abs(dy) + np.abs(dx)).astype(float)
    np.testing.assert_allclose(profile(7 * steps[None])[:4], [1, 2, 3, 4])


def test_spearman_by_hand():
    assert spearman(np.array([1, 2, 3, 4]), np.array([0.0, 1.0, 10.0, 1000.0])) == pytest.approx(1.0)
    # Ranks 1, 2.5, 2.5 and 1, 3, 2: covariance 1.5 over the root of 1.5 times 2.
    assert spearman(np.array([0, 5, 5]), np.array([0.0, 9.0, 1.0])) == pytest.approx(1.5 / np.sqrt(1.5 * 2))
    assert np.isnan(spearman(np.ones(3), np.arange(3)))


def test_layouts_have_seeds_of_their_own():
    layouts = eval_layouts("Nav2D-v0", 2, seed=8)
    assert (layouts[0] != layouts[1]).any()
    np.testing.assert_array_equal(layouts[1], eval_layouts("Nav2D-v0", 1, seed=9)[0])


def test_base_encoder_agrees_with_the_metric_at_c_0(base, few_cells):
    comparison = ExactReference(base, c=0.0, n_layouts=1).compare(base)
    # Not to the last digit: rounding swaps the ranks of cells that count nearly the same.
    assert comparison.map_correlation == pytest.approx(1.0, abs=3e-3)
    assert comparison.state_correlation == pytest.approx(1.0, abs=3e-3)
    assert comparison.profile_error == pytest.approx(0.0, abs=1e-4)
    assert comparison.step_profile == pytest.approx(comparison.exact_step_profile, rel=1e-3)


def test_the_step_profile_is_relative_to_the_mean_of_the_layout():
    apart = np.abs(np.subtract.outer(np.arange(4), np.arange(4))).astype(np.float32)
    found = step_profile([apart, 5 * apart], [apart, apart])
    mean = (6 * 1 + 4 * 2 + 2 * 3) / 12
    np.testing.assert_allclose(found[:3], np.array([1, 2, 3]) / mean)
    assert np.isnan(found[3]), "nothing is four steps apart"


def test_short_sighted_encoder_has_a_profile_error(base, few_cells):
    # The base sees less of what is farther away than its metric does.
    comparison = ExactReference(base, c=0.9, n_layouts=1).compare(base)
    assert all(learned <= exact for learned, exact in zip(comparison.profile, comparison.exact_profile, strict=True))
    assert comparison.profile_error > 0.1


def test_untrained_encoder_does_not_agree(base, few_cells):
    th.manual_seed(0)
    reference, untrained = ExactReference(base, c=0.9, n_layouts=1), Nav2DEncoder().eval()
    comparison = reference.compare(untrained)
    assert comparison.map_correlation < 0.9
    assert comparison.profile_error > 0.2
    assert reference.terms(untrained) == {
        "exact/map_correlation": comparison.map_correlation,
        "exact/state_correlation": comparison.state_correlation,
        "exact/profile_error": comparison.profile_error,
    }


def test_goal_is_never_toggled():
    assert GOAL_CELL not in nav2d_exact._togglable()
    assert len(nav2d_exact._togglable()) == N_CELLS - 1


def test_command_writes_table_and_numbers(few_cells, tmp_path, capsys):
    analyze.main(["exact", "Nav2D-v0/abisim", "--n-layouts", "1", "-o", str(tmp_path / "out.json")])
    assert "| Nav2D-v0/abisim |" in capsys.readouterr().out
    results = json.loads((tmp_path / "out.json").read_text())
    assert results["encoders"]["Nav2D-v0/abisim"]["hash"] == load_encoder("Nav2D-v0/abisim").hash
    assert len(results["encoders"]["Nav2D-v0/abisim"]["profile"]) == len(results["bins"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["PointMaze-v0/ssi"], "observation"),
        (["no/such"], "no/such"),
        (["Nav2D-v0/ssi", "--n-layouts", "0"], "at least 1, got 0"),
        (["PointMaze-v0/ssi", "--env", "PointMaze-v0"], "Nav2D alone, got 'PointMaze-v0'"),
        (["Nav2D-v0/ssi", "-c", "1", "--n-layouts", "1"], r"\[0, 1\), got 1.0"),
    ],
)
def test_command_refuses(words, message, capsys):
    with pytest.raises(SystemExit):
        analyze.main(["exact", *words])
    assert re.search(message, capsys.readouterr().err)


def test_other_environments_have_no_exact_metric():
    with pytest.raises(ValueError, match="PointMaze-v0"):
        eval_layouts("PointMaze-v0", 1)
