"""Eqs. 6 to 8 against loop-written derivations, gradient routing, and the fixed point on a chain solved by hand."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from objective_inputs import LineEncoder, change_weights
from torch import nn

from sb3_abisim.objectives.abisim import ActionBisimulation, ForwardModel, action_bisim_target
from sb3_abisim.objectives.base import TensorBatch

DISCRETE = gym.spaces.Discrete(2)
CONTINUOUS = gym.spaces.Box(-1, 1, (2,), np.float32)


def make(action_space=DISCRETE, **kwargs):
    """With a target encoder that differs from the encoder, as after some updates."""
    th.manual_seed(0)
    objective = ActionBisimulation(LineEncoder(3, 8), action_space, LineEncoder(5, 8), **kwargs)
    change_weights(objective.target_encoder)
    return objective


def make_batch(action_space=DISCRETE, n=6):
    generator = th.Generator().manual_seed(2)
    actions = (
        th.randint(0, 2, (n,), generator=generator)
        if isinstance(action_space, gym.spaces.Discrete)
        else 2 * th.rand(n, 2, generator=generator) - 1
    )
    return TensorBatch.of(th.rand(n, 1, 1, 4, generator=generator), actions, th.rand(n, 1, 1, 4, generator=generator))


def l1(x, y):
    return sum(abs(float(a) - float(b)) for a, b in zip(x, y, strict=True))


def test_target_weights_its_two_terms():
    assert float(action_bisim_target(th.tensor(3.0), th.tensor(5.0), 0.75)) == 0.25 * 3 + 0.75 * 5


@th.no_grad()
def test_behavior_loss_equals_loop():
    objective, batch = make(expectation="behavior", distance_loss="mse", c=0.7, l1_penalty=0.2), make_batch()
    phi = objective.encoder(batch.obs)
    psi = objective.base_encoder(batch.obs)
    phi_next = objective.target_encoder(batch.next_obs)
    errors, distances, targets = [], [], []
    for i in range(6):
        for j in range(6):
            if i != j and batch.actions[i] == batch.actions[j]:
                target = 0.3 * l1(psi[i], psi[j]) + 0.7 * l1(phi_next[i], phi_next[j])
                distances.append(l1(phi[i], phi[j])), targets.append(target)
                errors.append((distances[-1] - target) ** 2)
    assert 0 < len(errors) < 30, "the batch must hold pairs of both kinds"
    norm = sum(l1(phi[i], th.zeros(3)) for i in range(6)) / 6
    loss, terms = objective.loss(batch)
    assert float(loss) == pytest.approx(sum(errors) / len(errors) + 0.2 * norm, rel=1e-4)
    means = {"metric_loss": np.mean(errors), "distance": np.mean(distances), "target": np.mean(targets)}
    assert {name: float(term) for name, term in terms.items()} == pytest.approx({**means, "l1_norm": norm}, rel=1e-4)


@th.no_grad()
def test_uniform_loss_equals_loop():
    objective, batch = make(c=0.7), make_batch()
    phi = objective.encoder(batch.obs)
    psi = objective.base_encoder(batch.obs)
    phi_target = objective.target_encoder(batch.obs)
    total = 0.0
    for i in range(6):
        for j in range(6):
            if i == j:
                continue
            w1 = 0.0
            for action in th.eye(2):
                (mean_i, _), (mean_j, _) = (objective.forward_model(phi_target[k][None], action[None]) for k in (i, j))
                w1 += l1(mean_i[0], mean_j[0]) / 2
            total += abs(l1(phi[i], phi[j]) - 0.3 * l1(psi[i], psi[j]) - 0.7 * w1)
    assert float(objective.loss(batch)[1]["metric_loss"]) == pytest.approx(total / 30, rel=1e-4)


@th.no_grad()
def test_forward_nll_equals_loop():
    objective, batch = make(), make_batch()
    phi = objective.target_encoder(batch.obs)
    phi_next = objective.target_encoder(batch.next_obs)
    total = 0.0
    for i in range(6):
        action = [1.0 if k == int(batch.actions[i]) else 0.0 for k in range(2)]
        mean, std = objective.forward_model(phi[i][None], th.tensor([action]))
        for d in range(3):
            residual = (float(phi_next[i, d]) - float(mean[0, d])) / float(std[0, d])
            total += 0.5 * residual**2 + math.log(float(std[0, d])) + 0.5 * math.log(2 * math.pi)
    assert float(objective.loss(batch)[1]["forward_nll"]) == pytest.approx(total / 18, rel=1e-4)


@th.no_grad()
def test_the_forward_model_predicts_a_change():
    model = ForwardModel(3, 2)
    last = model.network[-1]
    last.weight.zero_()
    last.bias.copy_(th.tensor([0.5, -1.0, 2.0, 0.25, -9.0, 9.0]))
    phi = th.rand(4, 3)
    mean, std = model(phi, th.rand(4, 2))
    assert th.equal(mean, phi + th.tensor([0.5, -1.0, 2.0]))
    assert th.allclose(std, th.tensor([0.25, -5.0, 2.0]).exp().expand(4, 3))


def test_pairs_and_expected_distances_stay_on_the_device_of_their_inputs(monkeypatch):
    """Tensors of the device "meta" have no values, but mixing them with others fails as on a GPU."""
    objective, meta = make().to("meta"), th.device("meta")
    monkeypatch.setattr(th.Tensor, "nonzero", lambda self: th.zeros(9, 2, dtype=th.int64, device=self.device))
    i, j = objective._sample_pairs(th.zeros(4, dtype=th.int64, device=meta), th.rand(4, 5, device=meta))
    assert i.device == j.device == meta
    index = th.zeros(3, dtype=th.int64, device=meta)
    assert objective._expected_w1(th.rand(4, 3, device=meta), index, index).device == meta


def test_pairs_are_different_transitions_with_the_same_action():
    objective, actions = make(expectation="behavior", n_pairs=5), th.tensor([0, 1, 0, 1, 1, 0, 0])
    seen = set()
    for _ in range(50):
        i, j = objective._sample_pairs(actions, th.rand(len(actions), 5))
        assert len(i) == 5 and bool((actions[i] == actions[j]).all())
        sampled = {frozenset(pair) for pair in zip(i.tolist(), j.tolist(), strict=True)}
        assert len(sampled) == 5 and all(len(pair) == 2 for pair in sampled)
        seen |= sampled
    assert len(seen) == 6 + 3, "every pair with equal actions gets its turn"
    with pytest.raises(ValueError, match="same action"):
        objective._sample_pairs(th.tensor([0, 1]), th.rand(2, 5))


@th.no_grad()
def test_loss_of_nearest_pairs_equals_loop():
    # 12 states, 10 pairs: the 5 nearest in the base, and 5 at random, which this test reads from the generator.
    objective = make(expectation="behavior", distance_loss="l1", c=0.7, pairs="nearest", n_pairs=10)
    batch = make_batch(n=12)
    psi = objective.base_encoder(batch.obs)
    phi, phi_next = objective.encoder(batch.obs), objective.target_encoder(batch.next_obs)
    same = [(i, j) for i in range(12) for j in range(i + 1, 12) if batch.actions[i] == batch.actions[j]]
    assert len(same) > 20
    th.manual_seed(5)
    chosen = sorted(same, key=lambda pair: l1(psi[pair[0]], psi[pair[1]]))[:5]
    chosen += [same[k] for k in th.randperm(len(same))[:5].tolist()]
    mean = sum(l1(psi[i], psi[j]) for i, j in chosen) / 10
    errors = []
    for i, j in chosen:
        base = l1(psi[i], psi[j])
        target = 0.3 * base + 0.7 * l1(phi_next[i], phi_next[j])
        errors.append(mean / (base + 0.05 * mean) * abs(l1(phi[i], phi[j]) - target))
    th.manual_seed(5)
    assert float(objective.loss(batch)[0]) == pytest.approx(sum(errors) / 10, rel=1e-4)


def test_nearest_is_by_the_l1_norm():
    """The first two are nearest in the L2 norm, the last two in the L1 norm."""
    psi = th.tensor([[0.0, 0, 0], [0.6, 0.6, 0.6], [9.0, 0, 0], [10.1, 0, 0]])
    objective = make(pairs="nearest", n_pairs=2)
    i, j = objective._sample_pairs(th.zeros(4, dtype=th.int64), psi)
    assert (int(i[0]), int(j[0])) == (2, 3)


@th.no_grad()
def test_loss_of_nearest_pairs_of_a_collapsed_base_is_finite():
    objective = make(pairs="nearest")
    for parameter in objective.base_encoder.parameters():
        parameter.zero_()
    assert th.isfinite(objective.loss(make_batch())[0])


@pytest.mark.parametrize("expectation", ["uniform", "behavior"])
@pytest.mark.parametrize("space", [DISCRETE, CONTINUOUS], ids=["discrete", "continuous"])
def test_gradients_move_encoder_and_forward_model_only(expectation, space):
    objective = make(space, expectation=expectation, action_radius=1.0)
    objective.loss(make_batch(space))[0].backward()
    moved = {name.split(".")[0] for name, p in objective.named_parameters() if p.grad is not None}
    assert moved == {"encoder"} | ({"forward_model"} if expectation == "uniform" else set())
    assert all(not p.requires_grad for p in objective.base_encoder.parameters())
    assert all(not p.requires_grad for p in objective.target_encoder.parameters())


def test_metric_loss_gives_the_forward_model_no_gradient():
    """It would otherwise learn to make distances match instead of to predict."""
    objective, batch = make(), make_batch()
    objective.loss(batch)[0].backward()
    with_metric = [p.grad.clone() for p in objective.forward_model.parameters()]
    objective.zero_grad()
    phi, phi_next = objective.target_encoder(batch.obs), objective.target_encoder(batch.next_obs)
    objective.forward_model.nll(phi, objective.action_inputs(batch.actions), phi_next).backward()
    alone = [p.grad for p in objective.forward_model.parameters()]
    assert all(th.allclose(a, b) for a, b in zip(with_metric, alone, strict=True))


def test_target_encoder_is_a_moving_average():
    objective = make(tau=0.1)
    before = [p.clone() for p in objective.target_encoder.parameters()]
    objective.after_step()
    now = (objective.encoder.parameters(), objective.target_encoder.parameters())
    for old, online, new in zip(before, *now, strict=True):
        assert th.allclose(new, 0.9 * old + 0.1 * online)


def test_forward_model_reset():
    objective = make(forward_reset_interval=2)
    weights = [objective.forward_model.network[0].weight.clone()]
    for _ in range(2):
        objective.after_step()
        weights.append(objective.forward_model.network[0].weight.clone())
    assert th.equal(weights[0], weights[1])
    assert not th.equal(weights[1], weights[2])


def test_warm_start_copies_the_base():
    th.manual_seed(0)
    base = LineEncoder(3)
    for warm_start in (False, True):
        objective = ActionBisimulation(LineEncoder(3), DISCRETE, base, warm_start=warm_start)
        for copied, origin in ((objective.encoder, base), (objective.target_encoder, objective.encoder)):
            equal = all(th.equal(a, b) for a, b in zip(copied.parameters(), origin.parameters(), strict=True))
            assert equal == (warm_start or origin is not base)
    with pytest.raises(ValueError, match="warm_start"):
        make(warm_start=True)


def test_the_given_base_is_left_as_it_was():
    base = LineEncoder(5)
    objective = ActionBisimulation(LineEncoder(3), DISCRETE, base)
    assert all(parameter.requires_grad for parameter in base.parameters())
    assert objective.base_encoder.layers is not base.layers


def test_settings_that_nobody_gives():
    objective = ActionBisimulation(LineEncoder(3), DISCRETE, LineEncoder(5))
    names = ("c", "tau", "expectation", "distance_loss", "l1_penalty", "pairs", "n_pairs", "n_action_samples")
    expected = [0.9, 0.01, "uniform", "l1", 0.0, "random", 4096, 8]
    assert [getattr(objective, name) for name in names] == expected
    assert (objective.action_radius, objective.forward_reset_interval) == (0.2, None)
    assert objective.n_updates.dtype == th.int64


def test_the_least_and_the_most_of_each_setting():
    objective = make(CONTINUOUS, c=0.0, tau=1.0, n_pairs=1, n_action_samples=1, forward_reset_interval=1)
    objective.loss(make_batch(CONTINUOUS))[0].backward()
    before = objective.forward_model.network[0].weight.clone()
    objective.after_step()
    assert not th.equal(objective.forward_model.network[0].weight, before)
    for online, target in zip(objective.encoder.parameters(), objective.target_encoder.parameters(), strict=True):
        assert th.equal(online, target)


def chain():
    """Three states in a row; action 0 goes to the first, action 1 one to the right. psi sets the first apart by 1."""
    observations = th.zeros(3, 1, 1, 4)
    observations[range(3), 0, 0, range(3)] = 1.0
    following = {0: (0, 1), 1: (0, 2), 2: (0, 2)}
    s = [i for i in following for _ in range(2)] * 6
    actions = [0, 1] * 18
    s_next = [following[i][a] for i, a in zip(s, actions, strict=True)]
    batch = TensorBatch.of(observations[s], th.tensor(actions), observations[s_next])
    base = LineEncoder(1)
    base.layers = nn.Sequential(nn.Flatten(), nn.Linear(4, 1, bias=False))
    with th.no_grad():
        # The encoder maps 0..1 to -1..1, so half a weight makes psi differ by 1.
        base.layers[1].weight.copy_(th.tensor([[0.5, 0.0, 0.0, 0.0]]))
    return observations, batch, base


@pytest.mark.parametrize("expectation", ["uniform", "behavior"])
def test_converges_to_the_metric_of_a_chain(expectation):
    """By hand, with c = 1/2, p = d(0,1), q = d(0,2), r = d(1,2).

    Action 0 leads both states of a pair to state 0, at distance 0. Action 1 leads (0,1) to (1,2), (0,2) to (1,2) and
    (1,2) to (2,2). So r = 0, p = q = 1/2 * 1 + 1/2 * (0 + r)/2 = 1/2.
    """
    observations, batch, base = chain()
    th.manual_seed(0)
    objective = ActionBisimulation(
        LineEncoder(4, 32), DISCRETE, base, c=0.5, tau=0.05, expectation=expectation, distance_loss="mse"
    )
    optimizer = th.optim.Adam([p for p in objective.parameters() if p.requires_grad], lr=3e-3)
    for _ in range(1500):
        loss, _ = objective.loss(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        objective.after_step()
    distances = th.cdist(*(objective.encoder(observations),) * 2, p=1)
    expected = th.tensor([[0.0, 0.5, 0.5], [0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    assert th.allclose(distances, expected, atol=0.04), distances


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"c": 1.0}, "c must lie"),
        ({"n_pairs": 0}, "n_pairs"),
        ({"n_pairs": 8.0}, "n_pairs must be a whole number of at least 1, got 8.0"),
        ({"n_action_samples": 0}, "n_action_samples must be a whole number of at least 1, got 0"),
        ({"l1_penalty": math.nan}, "l1_penalty"),
        ({"l1_penalty": math.inf}, "l1_penalty must be a number of at least 0, got inf"),
        ({"c": -0.1}, "c must lie"),
        ({"tau": 0.0}, "tau"),
        ({"tau": 1.5}, "tau must lie in .*, got 1.5"),
        ({"expectation": "both"}, "expectation must be one of .*, got 'both'"),
        ({"distance_loss": "l3"}, "distance_loss must be one of .*, got 'l3'"),
        ({"pairs": "far"}, "pairs must be one of .*, got 'far'"),
        ({"forward_reset_interval": 0}, "forward_reset_interval"),
    ],
    ids=str,
)
def test_refuses_bad_settings(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)
