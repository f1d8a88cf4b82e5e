"""Eq. 5 against a loop-written derivation, its gradients, and that it learns what it must."""

import math

import pytest
import torch as th
from objective_inputs import CONTINUOUS, DISCRETE, LineEncoder, fit, hidden_dims, make_batch

from sb3_abisim.objectives.base import TensorBatch
from sb3_abisim.objectives.ssi import InverseDynamics, adaptive_beta, inverse_dynamics_loss


def test_loss_equals_loop():
    generator = th.Generator().manual_seed(1)
    log_prob = th.rand(3, generator=generator).log()
    psi, psi_next = (th.randn(3, 4, generator=generator) for _ in range(2))
    expected = 0.0
    for i in range(3):
        expected -= float(log_prob[i])
        for d in range(4):
            expected += 0.7 * (abs(float(psi[i, d])) + abs(float(psi_next[i, d])))
    loss, terms = inverse_dynamics_loss(log_prob, psi, psi_next, 0.7)
    assert float(loss) == pytest.approx(expected / 3, rel=1e-5)
    assert float(terms["inverse_nll"] + 0.7 * terms["l1_norm"]) == pytest.approx(float(loss), rel=1e-5)


@pytest.mark.parametrize("accuracy", [0.0, 0.3, 1.0])
def test_adaptive_beta(accuracy):
    alpha = th.tensor(accuracy)
    assert float(adaptive_beta(2.0, alpha, "paper")) == pytest.approx(2.0 * (1 - math.exp(-4 * accuracy**2)))
    assert float(adaptive_beta(2.0, alpha, "released")) == pytest.approx(2.0 * math.exp(-5 * (accuracy - 1) ** 2))
    skill = max(0.0, (accuracy - 0.25) / 0.75)
    expected = 2.0 * (1 - math.exp(-4 * skill**2))
    assert float(adaptive_beta(2.0, alpha, "chance_corrected", 0.25)) == pytest.approx(expected)
    assert float(adaptive_beta(2.0, alpha, "chance_corrected")) == float(adaptive_beta(2.0, alpha, "paper"))


@th.no_grad()
def test_discrete_prediction_term_is_cross_entropy():
    th.manual_seed(0)
    objective = InverseDynamics(LineEncoder(), DISCRETE, l1_penalty=0.0)
    batch = make_batch(DISCRETE, 7)
    psi, psi_next = objective.encoder(batch.obs), objective.encoder(batch.next_obs)
    total, hits = 0.0, 0
    for i in range(7):
        logits = objective.inverse_model(th.cat([psi[i], psi_next[i] - psi[i]])[None])[0]
        exponentials = [math.exp(float(x)) for x in logits]
        total -= math.log(exponentials[int(batch.actions[i])] / sum(exponentials))
        hits += exponentials.index(max(exponentials)) == int(batch.actions[i])
    loss, terms = objective.loss(batch)
    assert float(loss) == pytest.approx(total / 7, rel=1e-4)
    assert float(terms["accuracy"]) == pytest.approx(hits / 7)


def test_frames_that_transitions_share_count_for_each_of_them():
    th.manual_seed(0)
    frames, actions = th.rand(5, 1, 1, 4), th.tensor([0, 2, 1, 0])
    index, next_index = th.tensor([0, 1, 1, 3]), th.tensor([1, 2, 3, 4])
    obs, next_obs = frames[index], frames[next_index]
    gradients = []
    for batch in (TensorBatch(frames, actions, index, next_index), TensorBatch.of(obs, actions, next_obs)):
        th.manual_seed(1)
        objective = InverseDynamics(LineEncoder(), DISCRETE, l1_penalty=0.1)
        assert th.equal(batch.obs, obs) and th.equal(batch.next_obs, next_obs)
        loss, _ = objective.loss(batch)
        loss.backward()
        gradients.append([loss.detach(), *(p.grad for p in objective.parameters())])
    assert all(th.allclose(a, b, rtol=1e-4, atol=1e-6) for a, b in zip(*gradients, strict=True))


@th.no_grad()
def test_delta_scale():
    """A scale of 4: a quarter of the state and four times the change; 1 is the plain input, to the bit."""
    losses = []
    for scale in (4.0, 1.0, None):
        th.manual_seed(0)
        kwargs = {} if scale is None else {"delta_scale": scale}
        objective = InverseDynamics(LineEncoder(), DISCRETE, l1_penalty=0.0, **kwargs)
        batch = make_batch(DISCRETE, 7)
        losses.append(float(objective.loss(batch)[0]))
        if scale == 4.0:
            psi, psi_next = objective.encoder(batch.obs), objective.encoder(batch.next_obs)
            logits = objective.inverse_model(th.cat([0.25 * psi, 4 * psi_next - 4 * psi], dim=1))
            chosen = logits.log_softmax(dim=1)[th.arange(7), batch.actions]
            assert losses[0] == pytest.approx(-float(chosen.mean()), rel=1e-5)
    assert losses[1] == losses[2] != losses[0]
    for wrong in (0.0, math.inf, math.nan):
        with pytest.raises(ValueError, match=f"delta_scale must be a number above 0, got {wrong}"):
            InverseDynamics(LineEncoder(), DISCRETE, delta_scale=wrong)


@th.no_grad()
def test_continuous_prediction_term_is_gaussian():
    th.manual_seed(0)
    objective = InverseDynamics(LineEncoder(), CONTINUOUS, l1_penalty=0.0)
    batch = make_batch(CONTINUOUS, 5)
    psi, psi_next = objective.encoder(batch.obs), objective.encoder(batch.next_obs)
    total = 0.0
    for i in range(5):
        out = [float(x) for x in objective.inverse_model(th.cat([psi[i], psi_next[i] - psi[i]])[None])[0]]
        for d in range(2):
            mean, std = out[d], math.exp(out[2 + d])
            residual = (float(batch.actions[i, d]) - mean) / std
            total += 0.5 * residual**2 + math.log(std) + 0.5 * math.log(2 * math.pi)
    assert float(objective.loss(batch)[0]) == pytest.approx(total / 5, rel=1e-4)


def test_gradients_reach_encoder_and_head():
    objective = InverseDynamics(LineEncoder(), DISCRETE)
    objective.loss(make_batch(DISCRETE))[0].backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in objective.parameters())


@pytest.mark.parametrize("space", [DISCRETE, CONTINUOUS], ids=["discrete", "continuous"])
def test_learns_the_action_on_unseen_transitions(space):
    th.manual_seed(0)
    objective = fit(InverseDynamics(LineEncoder(), space, l1_penalty=0.0), make_batch(space, 512))
    assert float(objective.loss(make_batch(space, 512, seed=9))[1]["accuracy"]) > 0.9


def test_penalty_makes_the_embedding_ignore_what_actions_do_not_move():
    """Theorem 2's premise: uncontrollable numbers leave the embedding when the penalty is on, and only then."""
    sensitivity = {}
    for penalty in (0.0, 0.1):
        th.manual_seed(0)
        objective = fit(InverseDynamics(LineEncoder(), DISCRETE, l1_penalty=penalty), make_batch(DISCRETE, 512), 500)
        batch = make_batch(DISCRETE, 256, seed=3)
        change = {}
        for name, column in (("controlled", 0), ("uncontrolled", 2)):
            moved = batch.obs.clone()
            moved[..., column] += 0.3
            change[name] = float((objective.encoder(moved) - objective.encoder(batch.obs)).abs().sum().detach())
        sensitivity[penalty] = change["uncontrolled"] / change["controlled"]
    assert sensitivity[0.1] < 0.4 * sensitivity[0.0]


@pytest.mark.parametrize(("space", "chance"), [(DISCRETE, 1 / DISCRETE.n), (CONTINUOUS, 0.0)])
def test_chance_is_that_of_the_action_space(space, chance):
    objective = InverseDynamics(LineEncoder(), space, l1_penalty=0.5, adaptive="chance_corrected")
    objective.accuracy.fill_(0.4)
    expected = 0.5 * (1 - math.exp(-4 * ((0.4 - chance) / (1 - chance)) ** 2))
    assert float(objective.loss(make_batch(space))[1]["beta"]) == pytest.approx(expected)
    objective.accuracy.fill_(chance)
    assert float(objective.loss(make_batch(space))[1]["beta"]) == 0.0


def test_adaptive_beta_follows_the_previous_accuracy():
    objective = InverseDynamics(LineEncoder(), DISCRETE, l1_penalty=0.5, adaptive="paper")
    batch = make_batch(DISCRETE)
    first, second = objective.loss(batch)[1], objective.loss(batch)[1]
    assert float(first["beta"]) == 0.0
    assert float(second["beta"]) == pytest.approx(0.5 * (1 - math.exp(-4 * float(first["accuracy"]) ** 2)))
    objective.eval()
    before = objective.accuracy.clone()
    objective.loss(make_batch(DISCRETE, seed=5))
    assert objective.accuracy == before, "evaluation must not change the schedule"


@pytest.mark.parametrize(
    "kwargs",
    [{"l1_penalty": -1.0}, {"l1_penalty": math.nan}, {"l1_penalty": math.inf}, {"adaptive": "sometimes"}],
    ids=str,
)
def test_refuses_bad_settings(kwargs):
    with pytest.raises(ValueError, match=str(next(iter(kwargs.values())))):
        InverseDynamics(LineEncoder(), DISCRETE, **kwargs)


def test_settings_that_nobody_gives():
    objective = InverseDynamics(LineEncoder(), DISCRETE)
    assert (objective.l1_penalty, objective.adaptive, objective.delta_scale) == (1e-4, None, 1.0)
    assert hidden_dims(objective.inverse_model) == [256]


@pytest.mark.parametrize(("space", "chance"), [(DISCRETE, 1 / 3), (CONTINUOUS, 0.0)])
def test_accuracy_of_guessing(space, chance):
    assert InverseDynamics(LineEncoder(), space).chance_accuracy(256) == chance
