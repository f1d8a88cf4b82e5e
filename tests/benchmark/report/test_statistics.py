"""The numbers of a report, against derivations by hand and by loops."""

import itertools

import numpy as np
import pytest

from sb3_abisim.benchmark.report import statistics

RNG = np.random.default_rng(5)
N_RESAMPLES = 200  # rliable is slow
SCORES = {"a": RNG.uniform(0.4, 1, (5, 3)), "b": RNG.uniform(0, 0.8, (4, 3))}


@pytest.fixture(autouse=True)
def _few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "N_RESAMPLES", N_RESAMPLES)


def test_interval_is_students() -> None:
    mean, half = statistics.mean_and_interval(np.array([[1.0, 5.0], [2.0, 5.0], [3.0, 5.0]]))
    # 4.302653 is the quantile for 2 degrees of freedom in any table of the t distribution.
    np.testing.assert_allclose(mean, [2, 5])
    np.testing.assert_allclose(half, [4.302653 / np.sqrt(3), 0], rtol=1e-6)


def test_one_run_has_no_interval() -> None:
    mean, half = statistics.mean_and_interval(np.array([[1.0, 5.0]]))
    assert mean.tolist() == [1, 5] and np.isnan(half).all()


def test_common_steps() -> None:
    curves = [(np.array([10, 20, 30]), np.array([0.0, 1.0, 2.0])), (np.array([15, 25, 35]), np.array([4.0, 6.0, 8.0]))]
    steps, values = statistics.on_common_steps(curves)
    assert steps.tolist() == [15, 20, 25, 30]
    np.testing.assert_allclose(values, [[0.5, 1, 1.5, 2], [4, 5, 6, 7]])
    with pytest.raises(ValueError, match=r"^the runs have no steps in common; compare runs of similar budgets$"):
        statistics.on_common_steps([curves[0], (np.array([40, 50]), np.zeros(2))])


def test_a_single_good_evaluation_reaches_no_threshold() -> None:
    steps = np.arange(1, 9) * 100
    values = np.array([0.0, 9.0, 0.0, 0.0, 5.0, 6.0, 7.0, 8.0])
    assert statistics.WINDOW == 3
    # Means of three: 3, 3, 1.67, 3.67, 6, 7, ending at steps 300 to 800.
    assert statistics.steps_to_threshold(steps, values, 6.0, 800) == 700
    assert statistics.steps_to_threshold(steps, values, 3.0, 800) == 300
    assert np.isnan(statistics.steps_to_threshold(steps, values, 6.0, 600)), "beyond the horizon nothing counts"
    assert np.isnan(statistics.steps_to_threshold(steps, values, 7.5, 800))


def test_share_of_wins_is_rliables_metric() -> None:
    from rliable import metrics

    rounded = {name: scores.round(1) for name, scores in SCORES.items()}  # with ties
    value = statistics.probability_of_improvement(rounded["a"], {"b": rounded["b"]})["b"][0]
    assert (rounded["a"][:, None] == rounded["b"]).any()
    assert value == pytest.approx(metrics.probability_of_improvement(rounded["a"], rounded["b"]))


def test_ratio_and_its_bootstrap() -> None:
    ratio = statistics.steps_ratio(np.array([100.0, 200.0]), np.array([400.0, 400.0]), (1000, 1000))
    # The mean of two draws from 100 and 200 is 100, 150 or 200.
    assert (ratio.value, ratio.low, ratio.high, ratio.bound) == (0.375, 0.25, 0.5, "")
    assert ratio.reached == (1, 1)


def test_the_bootstrap_resamples_the_runs_of_both_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    """All resamples by hand: either of the two outermost ratios has a chance of 1/16, more than the 2.5 % cut off."""
    monkeypatch.setattr(statistics, "N_RESAMPLES", 4000)
    reference, baseline = (100.0, 200.0), (300.0, 600.0)
    means = [[(a + b) / 2 for a, b in itertools.product(steps, steps)] for steps in (reference, baseline)]
    ratios = sorted(a / b for a, b in itertools.product(*means))
    ratio = statistics.steps_ratio(np.array(reference), np.array(baseline), (1000, 1000))
    assert (ratio.low, ratio.high) == pytest.approx((ratios[0], ratios[-1])) == (100 / 600, 200 / 300)
    assert ratio.value == pytest.approx(150 / 450)
    # Resampled alone, either method gives a narrower interval, and pairs of runs none at all.
    assert statistics.steps_ratio(np.array(reference), np.full(2, 450.0), (1000, 1000)).low == pytest.approx(100 / 450)
    assert statistics.steps_ratio(np.full(2, 150.0), np.array(baseline), (1000, 1000)).low == pytest.approx(150 / 600)


def test_a_censored_run_counts_in_the_resamples() -> None:
    ratio = statistics.steps_ratio(np.array([100.0, 100.0]), np.array([300.0, np.nan]), (1000, 1000))
    assert (ratio.low, ratio.value, ratio.high) == pytest.approx((100 / 1000, 100 / 650, 100 / 300))


@pytest.mark.parametrize(
    ("reference", "baseline", "bound", "value"),
    [
        ([100, 300], [400, np.nan], "<=", 200 / 700),
        ([100, np.nan], [400, 600], ">=", 550 / 500),
        ([100, np.nan], [400, np.nan], "~", 550 / 700),
        ([100, 300], [np.nan, np.nan], "<=", 0.2),
    ],
)
def test_censored_runs_make_a_bound(reference: list, baseline: list, bound: str, value: float) -> None:
    ratio = statistics.steps_ratio(np.array(reference, float), np.array(baseline, float), (1000, 1000))
    assert ratio.bound == bound and ratio.value == pytest.approx(value)


@pytest.mark.parametrize(
    ("reference", "baseline", "bound", "value"),
    [
        ([100, 300], [1600, np.nan], "<=", 200 / 2800),
        ([100, np.nan], [1600, 2400], ">=", 550 / 2000),
        ([100, np.nan], [1600, np.nan], "~", 550 / 1000),
    ],
)
def test_a_longer_baseline_makes_the_bound_closer(reference: list, baseline: list, bound: str, value: float) -> None:
    ratio = statistics.steps_ratio(np.array(reference, float), np.array(baseline, float), (1000, 4000))
    assert ratio.bound == bound and ratio.value == pytest.approx(value)


def test_no_ratio_where_all_are_censored_or_interval_without_runs() -> None:
    assert statistics.steps_ratio(np.array([100, np.nan]), np.array([1600, np.nan]), (1000, 4000)).steps == (550, 1000)
    nobody = statistics.steps_ratio(np.full(3, np.nan), np.full(3, np.nan), (1000, 1000))
    assert np.isnan(nobody.value) and nobody.reached == (0, 0)
    single = statistics.steps_ratio(np.array([100.0]), np.array([400.0, 300.0]), (1000, 1000))
    assert single.value == pytest.approx(100 / 350) and np.isnan(single.low)


def test_area() -> None:
    area = statistics.area_under_curve(np.array([0, 10, 40]), np.array([[0.0, 2.0, 2.0], [1.0, 1.0, 1.0]]))
    np.testing.assert_allclose(area, [(10 * 1 + 30 * 2) / 40, 1])


def test_iqm_is_the_mean_of_the_middle_half() -> None:
    for name, (value, low, high) in statistics.iqm(SCORES).items():
        ordered = sorted(SCORES[name].ravel())
        cut = len(ordered) // 4
        assert value == pytest.approx(sum(ordered[cut:-cut]) / (len(ordered) - 2 * cut))
        assert low < value < high


def test_probability_of_improvement_counts_pairs() -> None:
    a, b = SCORES["a"], SCORES["b"]
    wins = [[x > y for x, y in itertools.product(a[:, task], b[:, task])] for task in range(3)]
    (value, low, high) = statistics.probability_of_improvement(a, {"b": b})["b"]
    assert value == pytest.approx(np.mean(wins)) and low < value <= high


def test_profiles_count_runs_above() -> None:
    taus = np.array([0.0, 0.45, 0.9])
    shares, intervals = statistics.performance_profiles(SCORES, taus)
    for name, scores in SCORES.items():
        assert shares[name] == pytest.approx([np.mean([s > tau for s in scores.ravel()]) for tau in taus])
        assert (intervals[name][0] <= shares[name] + 1e-9).all() and (shares[name] <= intervals[name][1] + 1e-9).all()


@pytest.mark.parametrize(
    "function",
    [
        lambda seed: statistics.iqm(SCORES, seed),
        lambda seed: statistics.probability_of_improvement(SCORES["a"], {"b": SCORES["b"]}, seed),
        lambda seed: statistics.performance_profiles(SCORES, np.linspace(0, 1, 7), seed)[1]["a"].tolist(),
    ],
)
def test_intervals_repeat_whatever_the_global_generator_is_at(function) -> None:
    np.random.seed(1)
    first, after = function(3), np.random.random()
    np.random.seed(2)
    assert function(3) == first
    assert function(4) != first, "the seed is used"
    np.random.seed(1)
    assert np.random.random() == after, "the global generator is left as it was"


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_rliable_needs_this() -> None:
    """When it honors random_state, `seeded` can go."""
    from rliable import library

    def interval() -> list:
        state = np.random.RandomState(0)
        return library.get_interval_estimates(
            {"a": SCORES["a"]}, lambda x: np.array([x.mean()]), reps=50, random_state=state
        )[1]["a"].tolist()

    assert interval() != interval()


# What a report rests on, at the edges.


def test_two_runs_have_an_interval() -> None:
    mean, half = statistics.mean_and_interval(np.array([1.0, 3.0]))
    # 12.7062 is the quantile for 1 degree of freedom; the standard deviation is the square root of 2.
    assert float(mean) == 2 and float(half) == pytest.approx(12.7062, rel=1e-5)


def test_one_run_has_as_many_missing_intervals_as_numbers() -> None:
    assert statistics.mean_and_interval(np.zeros((1, 4, 3)))[1].shape == (4, 3)


def test_a_threshold_is_reached_by_what_equals_it_up_to_the_horizon() -> None:
    steps = np.array([10, 20, 30, 40])
    assert statistics.steps_to_threshold(steps, np.full(4, 0.1) + 0.2, 0.3, 30) == 30
    # The mean of the last three is 0.3 + 5.6e-17, and as much below for other orders.
    assert statistics.steps_to_threshold(steps, np.array([0.0, 0.3, 0.3, 0.3]), 0.3 + 5e-10, 40) == 40


def test_a_ratio_repeats_by_its_seed_and_is_the_95_percent_interval() -> None:
    rng = np.random.default_rng(0)
    reference, baseline = rng.uniform(50, 150, 12), rng.uniform(200, 500, 15)
    a, b = (np.array([rng.choice(x, len(x)).mean() for _ in range(20000)]) for x in (reference, baseline))
    ratio = statistics.steps_ratio(reference, baseline, (1000, 1000))
    assert ratio == statistics.steps_ratio(reference, baseline, (1000, 1000), seed=0)
    assert ratio != statistics.steps_ratio(reference, baseline, (1000, 1000), seed=1)
    below, above = (a / b <= ratio.low).mean(), (a / b >= ratio.high).mean()
    assert below == pytest.approx(0.025, abs=0.005) and above == pytest.approx(0.025, abs=0.005)


def test_a_ratio_of_runs_that_are_all_censored_is_said_to_be_none() -> None:
    never = np.array([np.nan, np.nan])
    ratio = statistics.steps_ratio(never, never, (70, 50))
    assert np.isnan([ratio.value, ratio.low, ratio.high]).all()
    assert (ratio.bound, ratio.reached, ratio.steps) == ("~", (0.0, 0.0), (70, 50))


@pytest.mark.parametrize("sizes", [(1, 3), (3, 1)])
def test_a_ratio_with_a_single_run_has_no_interval(sizes: tuple[int, int]) -> None:
    ratio = statistics.steps_ratio(np.full(sizes[0], 50.0), np.full(sizes[1], 100.0), (200, 200))
    assert ratio.value == 0.5 and np.isnan([ratio.low, ratio.high]).all()


def test_area_of_one_and_of_two_evaluations() -> None:
    values = np.array([[1.0, 5.0], [2.0, 2.0]])
    assert statistics.area_under_curve(np.array([10]), values[:, :1]).tolist() == [1, 2]
    assert statistics.area_under_curve(np.array([10, 30]), values).tolist() == [3, 2]


def test_aggregates_take_the_seed_0_and_all_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    assert statistics.iqm(SCORES) == statistics.iqm(SCORES, seed=0) != statistics.iqm(SCORES, seed=1)
    wins = [statistics.probability_of_improvement(SCORES["a"], {"b": SCORES["b"]}, *seed) for seed in ((), (0,), (1,))]
    assert wins[0] == wins[1] != wins[2]
    taus = np.linspace(0, 1, 3)
    profiles = [statistics.performance_profiles(SCORES, taus, *seed)[1]["a"] for seed in ((), (0,), (1,))]
    assert np.array_equal(profiles[0], profiles[1]) and not np.array_equal(profiles[0], profiles[2])
    from rliable import library

    seen = []
    monkeypatch.setattr(library, "create_performance_profile", lambda *a, reps, **k: seen.append(reps) or ({}, {}))
    statistics.performance_profiles(SCORES, taus)
    assert seen == [N_RESAMPLES]
