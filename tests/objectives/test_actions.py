"""Actions of every kind: as network inputs, predicted, sampled, compared; and that every objective learns from them."""

import itertools
import math

import action_spaces
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from action_spaces import SPACES, make_batch
from objective_inputs import LineEncoder, fit

from sb3_abisim.common.spaces import sample_actions
from sb3_abisim.networks.decoder import Decoder
from sb3_abisim.objectives.abisim import ActionBisimulation
from sb3_abisim.objectives.acro import ACRO
from sb3_abisim.objectives.actions import actions_of
from sb3_abisim.objectives.beta_vae import BetaVAE
from sb3_abisim.objectives.curl import CURL
from sb3_abisim.objectives.info_nce import InfoNCE
from sb3_abisim.objectives.ssi import InverseDynamics

CPU = th.device("cpu")
each_space = pytest.mark.parametrize("kind", SPACES)


def test_inputs():
    def inputs(kind, action):
        return actions_of(SPACES[kind]).inputs(th.as_tensor(np.array([action]))).tolist()[0]

    assert inputs("discrete", 6) == [0, 1, 0]
    assert inputs("multi_discrete", [3, -1]) == [0, 0, 1, 1, 0]
    assert inputs("multi_discrete_2d", [[1, 2], [0, 1]]) == [0, 1, 0, 0, 1, 1, 0, 0, 1]
    assert inputs("multi_binary", np.int8([1, 0, 1])) == [1, 0, 1]
    assert inputs("multi_binary_2d", np.int8([[1, 0], [0, 1]])) == [1, 0, 0, 1]
    assert inputs("box_2d_float64", [[25.0, 30.0], [-1.0, 3.5]]) == [-0.5, 1, -1, 0]
    assert inputs("box_scalar", np.float32(0.005)) == pytest.approx([0.5])


@each_space
def test_shapes(kind):
    space = SPACES[kind]
    actions, several = actions_of(space), th.as_tensor(sample_actions(space, (5, 2), np.random.default_rng(0)))
    inputs = actions.inputs(several)
    assert inputs.dtype == th.float32 and inputs.shape == (5, 2, actions.input_dim)
    assert th.equal(actions.inputs(several[:, 1]), inputs[:, 1])
    log_prob, accuracy = actions.score(th.randn(5, actions.n_outputs), several[:, 0])
    assert log_prob.shape == (5,) and accuracy.shape == ()


@each_space
def test_guessing_is_right_for_one_of_all_actions(kind):
    counts = {"discrete": 3, "multi_discrete": 6, "multi_discrete_2d": 24, "multi_binary": 8, "multi_binary_2d": 16}
    actions = actions_of(SPACES[kind])
    assert actions.count == counts.get(kind, math.inf)
    assert actions.chance == pytest.approx(1 / actions.count)


def test_a_number_with_equal_bounds_is_zero():
    space = gym.spaces.Box(np.float32([-1, 3]), np.float32([1, 3]))
    assert actions_of(space).inputs(th.tensor([[0.5, 3.0]])).tolist() == [[0.5, 0.0]]


def test_bounds_of_one_change_no_bit():
    space = gym.spaces.Box(-1, 1, (4,), np.float32)
    actions = th.as_tensor(sample_actions(space, (1000,), np.random.default_rng(0)))
    assert th.equal(actions_of(space).inputs(actions), actions)


@th.no_grad()
def test_log_likelihoods_add_up_over_components():
    generator = th.Generator().manual_seed(1)
    outputs = th.randn(6, 5, generator=generator)
    taken = th.tensor([[1, -1], [2, 0], [3, -1], [1, 0], [2, -1], [3, 0]])
    log_prob, accuracy = actions_of(SPACES["multi_discrete"]).score(outputs, taken)
    hits = 0
    for i in range(6):
        first, second = outputs[i, :3].tolist(), outputs[i, 3:].tolist()
        a, b = int(taken[i, 0]) - 1, int(taken[i, 1]) + 1
        expected = first[a] - math.log(sum(map(math.exp, first))) + second[b] - math.log(sum(map(math.exp, second)))
        assert float(log_prob[i]) == pytest.approx(expected, rel=1e-4)
        hits += first.index(max(first)) == a and second.index(max(second)) == b
    assert 0 < hits < 6 and float(accuracy) == pytest.approx(hits / 6)


@th.no_grad()
def test_bits_are_bernoulli():
    outputs = th.tensor([[2.0, -1.0, 0.5], [1.0, 1.0, -1.0]])
    log_prob, accuracy = actions_of(SPACES["multi_binary"]).score(outputs, th.tensor([[1, 0, 1], [1, 0, 1]]).char())
    for i, bits in enumerate(([1, 0, 1], [1, 0, 1])):
        expected = 0.0
        for logit, bit in zip(outputs[i].tolist(), bits, strict=True):
            p = 1 / (1 + math.exp(-logit))
            expected += math.log(p if bit else 1 - p)
        assert float(log_prob[i]) == pytest.approx(expected, rel=1e-4)
    assert float(accuracy) == 0.5, "one of two is right in all its bits"


@th.no_grad()
def test_numbers_are_scored_by_the_coefficient_of_determination():
    space = gym.spaces.Box(np.float32([0, -1]), np.float32([4, 1]))
    taken = th.tensor([[0.0, 0.5], [3.0, 1.0], [4.0, -1.0], [1.0, 0.25]])
    scaled = np.array([[-1, 0.5], [0.5, 1], [1, -1], [-0.5, 0.25]])
    guesses = scaled + np.array([[0.2, 0.1], [-0.3, 0.0], [0.1, 0.4], [0.0, -0.2]])
    total = sum((scaled[i, d] - scaled[:, d].mean()) ** 2 for i in range(4) for d in range(2))
    error = sum((scaled[i, d] - guesses[i, d]) ** 2 for i in range(4) for d in range(2))
    for means, expected in ((guesses, 1 - error / total), (scaled, 1.0), (-guesses, 0.0)):
        outputs = th.cat([th.as_tensor(means, dtype=th.float32), th.zeros(4, 2)], dim=1)
        assert float(actions_of(space).score(outputs, taken)[1]) == pytest.approx(expected, abs=1e-6)


@th.no_grad()
def test_a_logit_of_zero_predicts_a_bit_of_zero():
    actions = actions_of(SPACES["multi_binary"])
    accuracies = [float(actions.score(th.zeros(2, 3), th.tensor([[bit] * 3] * 2).char())[1]) for bit in (0, 1)]
    assert accuracies == [1, 0]


def test_a_single_component_is_what_discrete_actions_are():
    outputs, taken = th.randn(5, 3, generator=th.Generator().manual_seed(1)), th.tensor([0, 2, 1, 1, 0])
    one = actions_of(gym.spaces.MultiDiscrete([3])).score(outputs, taken[:, None])
    same = actions_of(gym.spaces.Discrete(3)).score(outputs, taken)
    assert th.allclose(one[0], same[0]) and th.equal(one[1], same[1]) and 0 < float(one[1]) < 1


@each_space
def test_everything_stays_on_the_device_of_its_inputs(kind, monkeypatch):
    """Tensors of the device "meta" have no values, but mixing them with others fails as on a GPU."""
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", False)  # which would look at values
    actions, space, meta = actions_of(SPACES[kind]), SPACES[kind], th.device("meta")
    taken = th.as_tensor(sample_actions(space, (4,), np.random.default_rng(0))).to(meta)
    found = [actions.inputs(taken), *actions.score(th.randn(4, actions.n_outputs, device=meta), taken)]
    found += [actions.sample(n, meta) for n in (1, 1000)]
    found.append(actions.greatest(th.randn(4, actions.input_dim, device=meta)))
    if (every := actions.enumerate(meta)) is not None:
        found.append(every)
    assert {tensor.device.type for tensor in found} == {"meta"}
    assert {tensor.dtype for tensor in found} == {th.float32}


def test_samples_are_all_actions_if_these_are_few():
    every = {
        "multi_discrete": [(*a, *b) for a, b in itertools.product(np.eye(3).tolist(), np.eye(2).tolist())],
        "multi_binary": list(itertools.product([0.0, 1.0], repeat=3)),
    }
    for kind, expected in every.items():
        sample = actions_of(SPACES[kind]).sample(len(expected), CPU)
        assert sorted(map(tuple, sample.tolist())) == sorted(map(tuple, expected))
    assert th.equal(actions_of(SPACES["discrete"]).sample(1, CPU), th.eye(3))


@pytest.mark.parametrize("kind", [kind for kind in SPACES if kind != "discrete"])
def test_samples_are_uniform(kind):
    th.manual_seed(0)
    space = SPACES[kind]
    actions, n = actions_of(space), 4000
    if actions.count <= n:
        n = int(actions.count) - 1
        assert actions.sample(n, CPU).shape == (n, actions.input_dim), "fewer than all"
    sample = th.cat([actions.sample(n, CPU) for _ in range(4000 // n)])
    taken = actions.inputs(th.as_tensor(sample_actions(space, (4000,), np.random.default_rng(0))))
    assert (sample.mean(dim=0) - taken.mean(dim=0)).abs().max() < 0.06
    assert (sample.std(dim=0) - taken.std(dim=0)).abs().max() < 0.03


def test_same_is_equality_of_all_components():
    same = actions_of(SPACES["multi_discrete"]).same(th.tensor([[1, 0], [1, -1], [1, 0], [2, 0]]), 0.2)
    assert same.tolist() == [[i == j or {i, j} == {0, 2} for j in range(4)] for i in range(4)]
    bits = th.tensor([[[1, 0], [0, 1]], [[1, 0], [1, 1]], [[1, 0], [0, 1]]]).char()
    assert actions_of(SPACES["multi_binary_2d"]).same(bits, 0.2).tolist()[0] == [True, False, True]
    numbers = th.tensor([[0.0, 0.0], [0.5, 0.0], [0.0, -0.75]])
    same = actions_of(gym.spaces.Box(-1, 1, (2,), np.float32)).same(numbers, 0.5)
    assert same[0].tolist() == [True, True, False], "a distance of the radius is the same"


@pytest.mark.parametrize("unit", [0.01, 1.0, 1000.0])
def test_same_does_not_depend_on_the_unit(unit):
    actions = unit * th.tensor([[0.0, 0.0], [0.1, 0.0], [0.0, 0.5]])
    expected = [[True, True, False], [True, True, False], [False, False, True]]
    assert actions_of(gym.spaces.Box(-unit, unit, (2,), np.float32)).same(actions, 0.2).tolist() == expected


@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_losses_do_not_depend_on_the_unit(unit):
    losses = []
    for scale in (1.0, unit):
        space = gym.spaces.Box(-scale, scale, (2,), np.float64)
        for make in (InverseDynamics, InfoNCE, lambda *args: ActionBisimulation(*args, LineEncoder())):
            th.manual_seed(0)
            objective = make(LineEncoder(), space)
            batch = make_batch(space, 64, sequences=objective.reads_action_sequences)
            losses.append(float(objective.loss(batch)[0].detach()))
    assert losses[:3] == pytest.approx(losses[3:], rel=1e-4)


@each_space
@pytest.mark.parametrize("objective_class", [InverseDynamics, ACRO, InfoNCE], ids=lambda c: c.name)
def test_learns_the_action_on_unseen_transitions(objective_class, kind):
    th.manual_seed(0)
    space, sequences = SPACES[kind], objective_class.reads_action_sequences
    objective = objective_class(LineEncoder(8), space, l1_penalty=0.0)
    before = float(objective.loss(make_batch(space, 128, seed=9, sequences=sequences))[1]["accuracy"])
    fit(objective, make_batch(space, 256, sequences=sequences), 200)
    accuracy = float(objective.loss(make_batch(space, 128, seed=9, sequences=sequences))[1]["accuracy"])
    chance = objective.chance_accuracy(128)
    assert accuracy > max(before, min(0.6, 6 * chance) if chance else 0.3)


@each_space
@pytest.mark.parametrize("expectation", ["uniform", "behavior"])
def test_action_bisimulation_learns(expectation, kind):
    th.manual_seed(0)
    space = SPACES[kind]
    objective = ActionBisimulation(
        LineEncoder(5), space, LineEncoder(5), expectation=expectation, c=0.5, action_radius=0.6
    )
    unseen = make_batch(space, 128, seed=9)
    before = objective.loss(unseen)[1]
    fit(objective, make_batch(space, 256), 150)
    after = objective.loss(unseen)[1]
    assert float(after["metric_loss"] / after["target"]) < 0.6 * float(before["metric_loss"] / before["target"])
    if expectation == "uniform":
        assert float(after["forward_nll"]) < float(before["forward_nll"]) - 0.5


@each_space
def test_objectives_that_read_no_actions_take_them(kind):
    th.manual_seed(0)
    objective = fit(CURL(LineEncoder(), SPACES[kind]), make_batch(SPACES[kind], 64), 100)
    assert float(objective.loss(make_batch(SPACES[kind], 64, seed=9))[1]["accuracy"]) > 5 / 64
    assert isinstance(BetaVAE(LineEncoder(), SPACES[kind]).decoder, Decoder)


def exchanged(space):
    space.low, space.high = space.high, space.low
    return space


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gym.spaces.Text(3), "Discrete, MultiDiscrete, MultiBinary or a Box of floats, got Text.*TransformAction"),
        (gym.spaces.Box(0, 9, (2,), np.int64), "a Box of floats, got Box"),
        (gym.spaces.Box(-np.inf, 1, (2,), np.float32), "need bounds, got Box.*rescale it with a wrapper"),
        (gym.spaces.Discrete(10**9), "takes 1000000000 outputs to predict, more than 100000; group"),
        (gym.spaces.Box(0, 1, (0,), np.float32), "must hold a number at least, got Box"),
        (gym.spaces.Box(0, 1, (2, 0), np.float32), "must hold a number at least, got Box"),
        (exchanged(gym.spaces.Box(-1, 1, (2,), np.float32)), "a lower bound above the upper one, Box.*exchange them"),
    ],
    ids=str,
)
def test_refuses_what_cannot_be_predicted(space, message):
    with pytest.raises(ValueError, match=message):
        InverseDynamics(LineEncoder(), space)


def test_the_environment_shows_every_component():
    for kind, space in SPACES.items():
        actions = sample_actions(space, (50,), np.random.default_rng(0))
        shown = action_spaces.shown(space, actions)
        assert len(np.unique(shown, axis=0)) == len(np.unique(actions, axis=0)) or kind.startswith("box")
