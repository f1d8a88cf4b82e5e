"""The exact metric: by hand, the paper's theorems on random MDPs, and both transition paths against each other."""

import itertools
import sys

import numpy as np
import pytest

from sb3_abisim.analysis import exact_metric
from sb3_abisim.analysis.exact_metric import action_bisim_metric, behavior_weights

# Three states: 0 -> 1 by action 0 and stays by action 1; 1 -> 2 by both; 2 stays.
THREE = np.array([[1, 0], [2, 2], [2, 2]])
BASE = np.array([[0.0, 1.0, 5.0], [1.0, 0.0, 3.0], [5.0, 3.0, 0.0]])


def random_probabilities(rng: np.random.Generator, n: int, n_actions: int) -> np.ndarray:
    return rng.dirichlet(np.full(n, 0.3), size=(n, n_actions))


def random_base(rng: np.random.Generator, n: int) -> np.ndarray:
    points = rng.normal(size=(n, 2))
    return np.abs(points[:, None] - points[None]).sum(axis=2)


def test_three_states_by_hand() -> None:
    c = 0.5
    # d(1,2) = (1-c) 3, since both go to 2. d(0,2) = (1-c) 5 + c/2 (d(1,2) + d(0,2)).
    d12 = 0.5 * 3
    d02 = (0.5 * 5 + 0.25 * d12) / 0.75
    # d(0,1) = (1-c) 1 + c/2 (d(1,2) + d(0,2)).
    d01 = 0.5 * 1 + 0.25 * (d12 + d02)
    metric = action_bisim_metric(BASE, THREE, c=c, tol=1e-12)
    np.testing.assert_allclose(metric, [[0, d01, d02], [d01, 0, d12], [d02, d12, 0]], atol=1e-10)


def test_weights_of_actions() -> None:
    # With action 1 alone, state 0 stays: d(0,2) = (1-c) 5 + c d(0,2) = 5.
    metric = action_bisim_metric(BASE, THREE, c=0.5, action_weights=np.array([0.0, 1.0]), tol=1e-12)
    assert metric[0, 2] == pytest.approx(5.0)
    per_pair = np.broadcast_to([0.5, 0.5], (3, 3, 2)).copy()
    per_pair[0, 2] = 0.0, 1.0
    assert action_bisim_metric(BASE, THREE, c=0.5, action_weights=per_pair, tol=1e-12)[0, 2] == pytest.approx(5.0)


def test_behavior_weights() -> None:
    policy = np.array([[0.2, 0.8], [1.0, 0.0]])
    weights = behavior_weights(policy, policy)
    np.testing.assert_allclose(weights[0, 0], [0.04 / 0.68, 0.64 / 0.68])
    np.testing.assert_allclose(weights[0, 1], [1.0, 0.0])
    with pytest.raises(ValueError, match="states 1 and 0 never take the same action"):
        behavior_weights(policy, np.array([[0.0, 1.0]]))


@pytest.mark.parametrize("seed", range(5))
def test_contraction_and_uniqueness(seed: int) -> None:
    # Theorem 1. One application of the map is what c times nothing but the next distances adds.
    rng = np.random.default_rng(seed)
    n, c = 6, 0.8
    base, probs = random_base(rng, n), random_probabilities(rng, n, 3)
    metric = action_bisim_metric(base, probs, c=c, tol=1e-10)
    # A fixed point from any start: iterate from an unrelated metric by hand, with linear programs of our own.
    other = random_base(rng, n) * 10
    distances = []
    for _ in range(3):
        other = (1 - c) * base + c * np.mean(
            [[[w1(probs[i, a], probs[j, a], other) for j in range(n)] for i in range(n)] for a in range(3)], axis=0
        )
        distances.append(np.abs(other - metric).max())
    assert distances[1] <= c * distances[0] + 1e-9
    assert distances[2] <= c * distances[1] + 1e-9
    assert distances[0] > 0.1


def w1(p: np.ndarray, q: np.ndarray, cost: np.ndarray) -> float:
    """Optimal transport as a linear program, without POT."""
    from scipy.optimize import linprog

    n, m = cost.shape
    rows = np.kron(np.eye(n), np.ones(m))
    columns = np.kron(np.ones(n), np.eye(m))
    result = linprog(cost.ravel(), A_eq=np.vstack([rows, columns])[:-1], b_eq=np.concatenate([p, q])[:-1])
    assert result.success
    return float(result.fun)


@pytest.mark.parametrize("seed", range(5))
def test_metric_axioms(seed: int) -> None:
    rng = np.random.default_rng(seed)
    metric = action_bisim_metric(random_base(rng, 6), random_probabilities(rng, 6, 2), c=0.9)
    assert np.allclose(np.diag(metric), 0)
    assert np.allclose(metric, metric.T, atol=1e-6)
    for i, j, k in itertools.product(range(6), repeat=3):
        assert metric[i, k] <= metric[i, j] + metric[j, k] + 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_uncontrollable_features_do_not_count(seed: int) -> None:
    # Theorem 2: states (controllable x, uncontrollable u); u moves by itself and the base ignores it.
    rng = np.random.default_rng(seed)
    n_x, n_u = 3, 2
    probs_x, probs_u = random_probabilities(rng, n_x, 2), random_probabilities(rng, n_u, 1)[:, 0]
    probs = np.einsum("xay,uv->xuayv", probs_x, probs_u).reshape(n_x * n_u, 2, n_x * n_u)
    base_x = random_base(rng, n_x)
    base = base_x.repeat(n_u, axis=0).repeat(n_u, axis=1)
    metric = action_bisim_metric(base, probs, c=0.8).reshape(n_x, n_u, n_x, n_u)
    alone = action_bisim_metric(base_x, probs_x, c=0.8)
    np.testing.assert_allclose(metric, np.broadcast_to(alone[:, None, :, None], metric.shape), atol=1e-5)
    assert alone.max() > 0.1


@pytest.mark.parametrize("c", [0.0, 0.5, 0.99])
def test_both_transition_paths_agree(c: float) -> None:
    rng = np.random.default_rng(0)
    nexts, other_nexts = rng.integers(0, 4, (4, 2)), rng.integers(0, 3, (3, 2))
    base = rng.random((4, 3))
    metric = action_bisim_metric(base, nexts, other_nexts, c=c)
    transported = action_bisim_metric(base, np.eye(4)[nexts], np.eye(3)[other_nexts], c=c)
    assert metric.shape == (4, 3)
    np.testing.assert_allclose(transported, metric, atol=1e-5)


def test_across_two_mdps_is_a_block_of_their_union() -> None:
    rng = np.random.default_rng(1)
    nexts, other_nexts = rng.integers(0, 5, (5, 3)), rng.integers(0, 4, (4, 3))
    base = random_base(rng, 9)
    union = action_bisim_metric(base, np.concatenate([nexts, other_nexts + 5]))
    np.testing.assert_allclose(action_bisim_metric(base[:5, 5:], nexts, other_nexts), union[:5, 5:], atol=1e-5)


def test_error_stays_below_the_tolerance() -> None:
    rng = np.random.default_rng(2)
    nexts, base = rng.integers(0, 20, (20, 2)), rng.random((20, 20))
    exact = action_bisim_metric(base, nexts, c=0.95, tol=1e-13)
    error = np.abs(action_bisim_metric(base, nexts, c=0.95, tol=1e-3) - exact).max() / base.max()
    assert 0 < error <= 1e-3


@pytest.mark.parametrize("c", [0.5, 0.9, 0.99])
def test_enough_steps_where_the_error_shrinks_by_no_more_than_c(c: float) -> None:
    # Two states that swap, compared with one that stays: d_0 = (1 - c) + c d_1 and d_1 = c d_0.
    base = np.array([[1.0], [0.0]])
    metric = action_bisim_metric(base, np.array([[1], [0]]), np.array([[0]]), c=c, tol=1e-9)
    np.testing.assert_allclose(metric, [[1 / (1 + c)], [c / (1 + c)]], atol=1e-9, rtol=0)


def test_enough_steps_around_a_cycle() -> None:
    """Compared with a state that stays, base 1 at one of 20 states that follow each other: nearly all is error."""
    n, c, tol = 20, 0.9, 1e-3
    base = np.eye(n)[:, :1]
    metric = action_bisim_metric(base, (np.arange(n)[:, None] + 1) % n, np.array([[0]]), c=c, tol=tol)
    expected = [(1 - c) * c ** ((n - i) % n) / (1 - c**n) for i in range(n)]
    np.testing.assert_allclose(metric[:, 0], expected, atol=tol, rtol=0)


@pytest.mark.parametrize("unit", [2.0**-12, 2.0**12])
def test_the_unit_of_the_base_makes_no_difference(unit: float) -> None:
    nexts, base = np.random.default_rng(4).integers(0, 6, (6, 2)), np.random.default_rng(5).random((6, 6))
    np.testing.assert_array_equal(action_bisim_metric(unit * base, nexts), unit * action_bisim_metric(base, nexts))


def test_it_ends_when_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, plain = [], exact_metric._expected_next
    monkeypatch.setattr(exact_metric, "_expected_next", lambda *args: calls.append(1) or plain(*args))
    metric = action_bisim_metric(BASE, np.array([[2], [2], [2]]), c=0.5)
    np.testing.assert_array_equal(metric, BASE / 2)
    assert len(calls) == 2


def test_no_states_have_no_distances() -> None:
    assert action_bisim_metric(np.zeros((0, 3)), np.zeros((0, 2), int), THREE).shape == (0, 3)


def test_ends_where_the_tolerance_is_finer_than_the_floats() -> None:
    metric = action_bisim_metric(BASE.astype(np.float32), THREE, c=0.99, tol=1e-12)
    np.testing.assert_allclose(metric, action_bisim_metric(BASE, THREE, c=0.99, tol=1e-12), rtol=1e-5)
    assert metric.dtype == np.float32


def test_probabilities_that_add_up_to_one_but_for_rounding() -> None:
    probs = np.eye(3)[THREE]
    probs[0, 0] *= 1 + 8e-6
    exact = action_bisim_metric(BASE, np.eye(3)[THREE], c=0.5)
    np.testing.assert_allclose(action_bisim_metric(BASE, probs, c=0.5), exact, atol=1e-4)


def test_probabilities_need_pot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ot", None)
    remedy = r"^the exact metric of stochastic transitions needs more packages .*pip install 'sb3_abisim\[analysis\]'$"
    with pytest.raises(ImportError, match=remedy):
        action_bisim_metric(BASE, np.eye(3)[THREE])
    action_bisim_metric(BASE, THREE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c": 1.0}, "got 1.0"),
        ({"tol": 0.0}, "got 0.0"),
        ({"tol": 1.0}, r"tol must lie in \(0, 1\), got 1.0"),
        ({"base_distance": -BASE}, "at least 0"),
        ({"base_distance": np.where(BASE == 5, np.nan, BASE)}, "at least 0"),
        ({"base_distance": BASE.astype(int)}, "int64"),
        ({"transitions": THREE + 1}, "0..n-1"),
        ({"transitions": THREE - 1}, "0..n-1"),
        ({"transitions": THREE[:2]}, "n = 3"),
        ({"other_transitions": THREE[:, :1]}, "same actions, got 2 and 1"),
        ({"other_transitions": np.eye(3)[THREE]}, "same form"),
        ({"transitions": np.full((3, 2, 3), 0.5)}, "adding up to 1"),
        ({"transitions": np.full((3, 2, 3, 1), 1 / 3)}, "adding up to 1"),
        ({"transitions": np.eye(3)[THREE] * 2 - 1 / 3}, "at least 0, got -0.33"),
        ({"action_weights": np.ones(3) / 3}, r"got shape \(3,\)"),
        ({"action_weights": np.ones(2)}, "^action_weights must be at least 0 and add up to 1 over actions$"),
    ],
)
def test_wrong_input_is_named(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        action_bisim_metric(**({"base_distance": BASE, "transitions": THREE} | change))
