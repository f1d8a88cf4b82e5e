"""The exact action-bisimulation metric on finite MDPs (the paper's Eq. 4), a reference for encoders.

``d(i, j) = (1 - c) base(i, j) + c E_a[W_1(d)(p(.|i, a), p(.|j, a))]``, iterated to its fixed point. The map contracts
by the factor c in the largest difference, so there is one fixed point, and a step's size bounds what is left to go.
Where transitions are deterministic, W_1 is the distance of the two next states; elsewhere it is an optimal-transport
problem per pair and action, solved exactly by POT (``pip install sb3_abisim[analysis]``), for small MDPs.

States i and j may belong to two MDPs that share their actions, such as a grid and the same grid with one cell changed:
only distances across are needed then, and only those are computed.
"""

import importlib
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.extras import needs_extra

Floats = NDArray[np.floating[Any]]


def action_bisim_metric(
    base_distance: Floats,
    transitions: NDArray[Any],
    other_transitions: NDArray[Any] | None = None,
    c: float = 0.9,
    action_weights: Floats | None = None,
    tol: float = 1e-6,
) -> Floats:
    """The fixed point, in the float type of ``base_distance``.

    :param base_distance: of state i of the first MDP and j of the second, (n, m), at least 0
    :param transitions: of the first MDP: next states, integers (n, n_actions), or probabilities, floats
        (n, n_actions, n) that add up to 1
    :param other_transitions: of the second MDP, in the same form with m for n; None for the first one's
    :param c: weight of the recursive term, 0 <= c < 1
    :param action_weights: the distribution that E_a takes, (n_actions,) or one per pair, (n, m, n_actions); None
        for the uniform one. See :func:`behavior_weights`
    :param tol: largest error of the result, relative to the largest base distance
    :return: (n, m)
    :raises ValueError: for shapes that do not fit, or values out of range
    :raises ImportError: for probabilities, where POT is not installed
    """
    if other_transitions is None:
        other_transitions = transitions
    _check(base_distance, transitions, other_transitions, c, tol)
    n_actions = transitions.shape[1]
    weights = np.full(n_actions, 1.0 / n_actions) if action_weights is None else action_weights
    if weights.shape not in ((n_actions,), (*base_distance.shape, n_actions)):
        raise ValueError(f"action_weights must be {(n_actions,)} or one per pair, got shape {weights.shape}")
    if weights.min() < 0 or not np.allclose(weights.sum(axis=-1), 1.0):
        raise ValueError("action_weights must be at least 0 and add up to 1 over actions")
    weights = weights.astype(base_distance.dtype)
    deterministic = np.issubdtype(transitions.dtype, np.integer)
    expected_w1 = _expected_next if deterministic else _expected_transport
    base = (1.0 - c) * base_distance
    distance = base_distance.copy()
    largest = float(base_distance.max(initial=0.0))
    # c^n / (1 - c) bounds the error after n steps, relative to `largest`, the largest possible first step.
    n_steps = math.ceil(math.log(tol * (1.0 - c)) / math.log(c)) if c > 0 else 1
    for _ in range(n_steps):
        following = base + c * expected_w1(distance, transitions, other_transitions, weights)
        step = float(np.abs(following - distance).max(initial=0.0))
        distance = following
        if step * c <= tol * (1.0 - c) * largest:
            break
    return distance


def behavior_weights(policy: Floats, other_policy: Floats) -> Floats:
    """The distribution of the common action where two states' actions are sampled from behavior policies and agree.

    This is what pairs of recorded transitions that took the same action follow.

    :param policy: action probabilities in each state, (n, n_actions)
    :param other_policy: of the other MDP's states, (m, n_actions)
    :return: (n, m, n_actions)
    :raises ValueError: for a pair of states that never take the same action
    """
    joint = policy[:, None] * other_policy[None]
    total = joint.sum(axis=2, keepdims=True)
    if not total.all():
        i, j, _ = (int(k[0]) for k in np.nonzero(total == 0))
        raise ValueError(f"states {i} and {j} never take the same action, so their distance is not defined")
    weights: Floats = joint / total
    return weights


def _expected_next(distance: Floats, nexts: NDArray[Any], other_nexts: NDArray[Any], weights: Floats) -> Floats:
    """E_a[d(next of i, next of j)], (n, m)."""
    expected = np.zeros_like(distance)
    for action in range(nexts.shape[1]):
        rows = distance.take(nexts[:, action], axis=0)
        expected += weights[..., action] * rows.take(other_nexts[:, action], axis=1)
    return expected


def _expected_transport(distance: Floats, probs: NDArray[Any], other_probs: NDArray[Any], weights: Floats) -> Floats:
    """E_a[W_1] by exact optimal transport, (n, m)."""
    with needs_extra("analysis", "the exact metric of stochastic transitions"):
        ot = importlib.import_module("ot")
    cost = distance.astype(np.float64)
    expected = np.zeros_like(distance)
    per_pair = np.broadcast_to(weights, (*distance.shape, probs.shape[1]))
    for i, j, action in np.argwhere(per_pair > 0):
        # Only states that can follow take part; the solver's time grows with the number of states.
        sources, sinks = np.flatnonzero(probs[i, action]), np.flatnonzero(other_probs[j, action])
        p, q = probs[i, action][sources].astype(np.float64), other_probs[j, action][sinks].astype(np.float64)
        expected[i, j] += per_pair[i, j, action] * ot.emd2(p, q / q.sum() * p.sum(), cost[np.ix_(sources, sinks)])
    return expected


def _check(base: Floats, transitions: NDArray[Any], other: NDArray[Any], c: float, tol: float) -> None:
    if not 0 <= c < 1:
        raise ValueError(f"c must lie in [0, 1), got {c}: the recursion has no fixed point otherwise")
    if not 0 < tol < 1:
        raise ValueError(f"tol must lie in (0, 1), got {tol}")
    if base.ndim != 2 or not np.issubdtype(base.dtype, np.floating) or not base.min(initial=0.0) >= 0:
        raise ValueError(f"base_distance must be floats (n, m) of at least 0, got {base.dtype} {base.shape}")
    if transitions.dtype.kind != other.dtype.kind:
        raise ValueError(f"both MDPs need the same form of transitions, got {transitions.dtype} and {other.dtype}")
    for n, array in zip(base.shape, (transitions, other), strict=True):
        if array.dtype.kind in "iu":
            if array.ndim != 2 or len(array) != n or not ((array >= 0) & (array < n)).all():
                raise ValueError(f"next states must be (n, n_actions) in 0..n-1 with n = {n}, got shape {array.shape}")
        elif array.ndim != 3 or array.shape[::2] != (n, n) or not np.allclose(array.sum(axis=2), 1.0):
            raise ValueError(f"probabilities must be (n, n_actions, n), n = {n}, adding up to 1; got {array.shape}")
        elif array.min() < 0:
            raise ValueError(f"probabilities must be at least 0, got {array.min()}")
    if transitions.shape[1] != other.shape[1]:
        raise ValueError(f"both MDPs need the same actions, got {transitions.shape[1]} and {other.shape[1]}")
