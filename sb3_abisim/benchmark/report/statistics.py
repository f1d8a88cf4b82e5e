"""The numbers of a comparison, as pure functions of arrays with one row per run."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
N_RESAMPLES = 2000
# Steps to a threshold: evaluations that are averaged, since a single one may jump over it by chance.
WINDOW = 3


def mean_and_interval(values: Floats) -> tuple[Floats, Floats]:
    """Mean over runs and the half width of its 95 % confidence interval by Student's t.

    :param values: shape (n_runs, ...)
    :return: both of shape (...); the half width is NaN for a single run
    """
    import scipy.stats

    n = len(values)
    if n < 2:
        return values.mean(axis=0), np.full(values.shape[1:], np.nan)
    quantile = float(scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1))
    return values.mean(axis=0), quantile * values.std(axis=0, ddof=1) / np.sqrt(n)


def on_common_steps(curves: list[tuple[NDArray[np.int64], Floats]]) -> tuple[NDArray[np.int64], Floats]:
    """Curves with different steps, interpolated linearly, on the steps that all of them cover.

    :param curves: (steps, values) of each run, both of shape (n,)
    :return: steps, shape (m,), and values, shape (n_runs, m)
    :raises ValueError: if they have no steps in common
    """
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = np.unique(np.concatenate([steps for steps, _ in curves]))
    grid = grid[(grid >= first) & (grid <= last)]
    if not len(grid):
        raise ValueError("the runs have no steps in common; compare runs of similar budgets")
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in curves])


def steps_to_threshold(steps: NDArray[np.int64], values: Floats, threshold: float, horizon: int) -> float:
    """The step of the first evaluation at which the mean of the last :data:`WINDOW` reaches a threshold.

    :param steps: rising, shape (n,)
    :param values: shape (n,)
    :param threshold: in the unit of the values
    :param horizon: steps after which nothing counts
    :return: NaN if that does not happen
    """
    window = min(WINDOW, len(values))
    means = np.convolve(values, np.full(window, 1 / window), "valid")
    # The rounding of a mean must not decide.
    reached = (means >= threshold - 1e-9) & (steps[window - 1 :] <= horizon)
    return float(steps[window - 1 :][reached.argmax()]) if reached.any() else float("nan")


@dataclasses.dataclass(frozen=True)
class Ratio:
    """How many steps one method needs for each step of another.

    :param value: ratio of the mean steps; censored runs, which did not reach the threshold, count with their method's
        horizon, or, where runs of both are censored, with the shorter of the two
    :param low: of the 95 % interval; NaN with a single run
    :param high: of the interval
    :param bound: "" when no run is censored; "<=" when runs of the baseline alone are, so that the true ratio is
        smaller; ">=" when runs of the reference alone are; "~" when runs of both are
    :param reached: share of the runs that reached the threshold, of the reference and of the baseline
    :param steps: the mean steps of the reference and of the baseline
    """

    value: float
    low: float
    high: float
    bound: str
    reached: tuple[float, float]
    steps: tuple[float, float]


def steps_ratio(reference: Floats, baseline: Floats, horizons: tuple[int, int], seed: int = 0) -> Ratio:
    """Compare steps to a threshold; the interval is a percentile bootstrap over the runs of both.

    :param reference: steps of each run, NaN where it is censored
    :param baseline: likewise
    :param horizons: how long the runs of the reference and of the baseline are
    :param seed: of the resamples
    """
    censored = bool(np.isnan(reference).any()), bool(np.isnan(baseline).any())
    bound = {(False, False): "", (False, True): "<=", (True, False): ">=", (True, True): "~"}[censored]
    reached = float(1 - np.isnan(reference).mean()), float(1 - np.isnan(baseline).mean())
    if not any(reached):
        return Ratio(float("nan"), float("nan"), float("nan"), bound, reached, horizons)
    # Longer censored runs of one method make a closer bound; where runs of both are censored, they feign a difference.
    limits = (min(horizons),) * 2 if all(censored) else horizons
    a, b = (
        np.minimum(np.nan_to_num(steps, nan=limit), limit)
        for steps, limit in zip((reference, baseline), limits, strict=True)
    )
    low = high = float("nan")
    if len(a) > 1 and len(b) > 1:
        rng = np.random.default_rng(seed)
        means = [x[rng.integers(len(x), size=(N_RESAMPLES, len(x)))].mean(axis=1) for x in (a, b)]
        low, high = np.quantile(means[0] / means[1], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2]).tolist()
    steps = float(a.mean()), float(b.mean())
    return Ratio(steps[0] / steps[1], low, high, bound, reached, steps)


def area_under_curve(steps: NDArray[np.int64], values: Floats) -> Floats:
    """Mean height of curves over their steps.

    :param steps: shape (m,)
    :param values: shape (n_runs, m)
    :return: shape (n_runs,)
    """
    if len(steps) == 1:
        return values[:, 0]
    return np.trapezoid(values, steps) / (steps[-1] - steps[0])  # type: ignore[no-any-return]


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed NumPy's global generator for a block and restore it: rliable 1.2 samples from it whatever it is given.

    :param seed: of the block
    """
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)


Interval = tuple[float, float, float]


def iqm(scores: dict[str, Floats], seed: int = 0) -> dict[str, Interval]:
    """Interquartile mean over runs and environments with its stratified bootstrap interval (rliable).

    :param scores: method to normalized scores, shape (n_runs, n_envs)
    :param seed: of the resamples
    :return: method to (value, low, high)
    """
    from rliable import metrics

    return _intervals(scores, metrics.aggregate_iqm, seed)


def probability_of_improvement(reference: Floats, baselines: dict[str, Floats], seed: int = 0) -> dict[str, Interval]:
    """How probable it is that a run of the reference beats one of a baseline in the same environment (rliable).

    :param reference: shape (n_runs, n_envs)
    :param baselines: method to scores of the same environments
    :param seed: of the resamples
    :return: baseline to (value, low, high)
    """
    pairs: dict[str, Any] = {name: (reference, scores) for name, scores in baselines.items()}
    return _intervals(pairs, _share_of_wins, seed)


def _share_of_wins(x: Floats, y: Floats) -> np.floating[Any]:
    # rliable's metric goes through a Mann-Whitney test for each resample, which takes minutes; the number is the same.
    wins = np.sign(x[:, None] - y[None]) / 2 + 0.5
    return wins.mean()  # type: ignore[no-any-return]


def performance_profiles(
    scores: dict[str, Floats], taus: Floats, seed: int = 0
) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Share of runs above each score, with pointwise intervals (rliable).

    :param scores: as for :func:`iqm`
    :param taus: scores, shape (m,)
    :param seed: of the resamples
    :return: method to shares, shape (m,), and method to intervals, shape (2, m)
    """
    from rliable import library

    with seeded(seed):
        return library.create_performance_profile(scores, taus, reps=N_RESAMPLES)  # type: ignore[no-any-return]


def _intervals(scores: dict[str, Any], function: Callable[..., Any], seed: int) -> dict[str, Interval]:
    from rliable import library

    def statistic(*arrays: Floats) -> Floats:
        return np.array([function(*arrays)])

    with seeded(seed):
        points, intervals = library.get_interval_estimates(scores, statistic, reps=N_RESAMPLES)
    return {
        name: (float(points[name][0]), float(intervals[name][0, 0]), float(intervals[name][1, 0])) for name in scores
    }
