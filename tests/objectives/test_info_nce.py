"""The contrastive base against loop-written derivations, its gradients, and that it ranks the action first."""

import math
import re

import pytest
import torch as th
from objective_inputs import CONTINUOUS, DISCRETE, LineEncoder, fit, hidden_dims, loss_without_values, make_batch

from sb3_abisim.objectives.base import TensorBatch
from sb3_abisim.objectives.info_nce import InfoNCE, info_nce_loss


def as_sequences(batch):
    return TensorBatch.of(batch.obs, batch.actions[:, None], batch.next_obs)


def distance(x, y):
    return math.sqrt(sum((float(a) - float(b)) ** 2 for a, b in zip(x, y, strict=True)))


def test_loss_equals_loop():
    generator = th.Generator().manual_seed(1)
    pairs, candidates = th.randn(4, 6, generator=generator), th.randn(3, 6, generator=generator)
    positives = th.tensor([1, 0, 0, 1])
    excluded = th.tensor([[True, False, True], [False, False, True], [False, False, False], [False, False, False]])
    total = 0.0
    for i in range(4):
        allowed = [j for j in range(3) if j == positives[i] or not excluded[i, j]]
        weights = {j: math.exp(-distance(pairs[i], candidates[j])) for j in allowed}
        total -= math.log(weights[int(positives[i])] / sum(weights.values()))
    loss, _ = info_nce_loss(pairs, candidates, positives, excluded)
    assert float(loss) == pytest.approx(total / 4, rel=1e-5)


@th.no_grad()
def test_discrete_negatives_are_all_other_actions():
    th.manual_seed(0)
    objective, batch = InfoNCE(LineEncoder(), DISCRETE, l1_penalty=0.3), as_sequences(make_batch(DISCRETE, 5))
    psi, psi_next = objective.encoder(batch.obs), objective.encoder(batch.next_obs)
    total = norms = hits = 0.0
    for i in range(5):
        pair = th.cat([psi[i], psi_next[i] - psi[i]])
        scores = [-distance(pair, objective.action_encoder(th.eye(3)[a : a + 1])[0]) for a in range(3)]
        total -= scores[int(batch.actions[i, 0])] - math.log(sum(math.exp(s) for s in scores))
        hits += scores.index(max(scores)) == int(batch.actions[i, 0])
        norms += sum(abs(float(x)) for x in th.cat([psi[i], psi_next[i]]))
    loss, terms = objective.loss(batch)
    assert float(loss) == pytest.approx((total + 0.3 * norms) / 5, rel=1e-4)
    expected = {"info_nce": total / 5, "l1_norm": norms / 5, "accuracy": hits / 5}
    assert {name: float(term) for name, term in terms.items()} == pytest.approx(expected, rel=1e-4)
    assert 0 < hits < 5


@pytest.mark.parametrize("space", [DISCRETE, CONTINUOUS], ids=["discrete", "continuous"])
@th.no_grad()
def test_negatives_of_sequences_are_the_others_of_the_batch_that_differ(space):
    th.manual_seed(0)
    objective, single = InfoNCE(LineEncoder(), space, k=2), make_batch(space, 6)
    actions = th.stack([single.actions, single.actions.flip(0)], dim=1)
    actions[3] = actions[1]  # an equal sequence is no negative
    batch = TensorBatch.of(single.obs, actions, single.next_obs)
    psi, psi_next = objective.encoder(batch.obs), objective.encoder(batch.next_obs)
    sequences = [th.cat([objective.action_inputs(a)[t] for t in range(2)]) for a in actions]
    total = 0.0
    for i in range(6):
        pair = th.cat([psi[i], psi_next[i] - psi[i]])
        weights = []
        for j in range(6):
            if j == i or not th.equal(actions[i], actions[j]):
                weights.append((j, math.exp(-distance(pair, objective.action_encoder(sequences[j][None])[0]))))
        total -= math.log(dict(weights)[i] / sum(w for _, w in weights))
    assert float(objective.loss(batch)[0]) == pytest.approx(total / 6, rel=1e-4)


def test_gradients_reach_both_encoders():
    objective = InfoNCE(LineEncoder(), DISCRETE)
    objective.loss(as_sequences(make_batch(DISCRETE)))[0].backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in objective.parameters())


@pytest.mark.parametrize(("space", "chance"), [(DISCRETE, 1 / 3), (CONTINUOUS, 1 / 64)], ids=["discrete", "continuous"])
def test_ranks_the_action_of_unseen_transitions_first(space, chance):
    th.manual_seed(0)
    objective = fit(InfoNCE(LineEncoder(), space), as_sequences(make_batch(space, 256)), 400)
    accuracy = float(objective.loss(as_sequences(make_batch(space, 64, seed=9)))[1]["accuracy"])
    assert accuracy > min(0.9, 15 * chance)


def test_learns_nothing_from_actions_that_do_nothing():
    th.manual_seed(0)
    batch = as_sequences(make_batch(DISCRETE, 512))
    still = TensorBatch.of(batch.obs, batch.actions, batch.obs)
    objective = fit(InfoNCE(LineEncoder(), DISCRETE), still, 100)
    unseen = as_sequences(make_batch(DISCRETE, 512, seed=9))
    unseen = TensorBatch.of(unseen.obs, unseen.actions, unseen.obs)
    assert float(objective.loss(unseen)[1]["accuracy"]) < 0.45


@pytest.mark.parametrize("k", [1, 2])
def test_the_loss_stays_on_the_device_of_its_inputs(k):
    batch = make_batch(DISCRETE, 4)
    sequences = TensorBatch.of(batch.obs, batch.actions[:, None].expand(-1, k), batch.next_obs)
    assert loss_without_values(InfoNCE(LineEncoder(), DISCRETE, k=k), sequences) == {"meta"}


def test_actions_are_encoded_with_a_hidden_layer():
    assert hidden_dims(InfoNCE(LineEncoder(), DISCRETE).action_encoder) == [256]


def test_refuses_bad_settings():
    for penalty in (-1.0, math.inf):
        with pytest.raises(ValueError, match=f"l1_penalty must be a number of at least 0, got {penalty}"):
            InfoNCE(LineEncoder(), DISCRETE, l1_penalty=penalty)
    InfoNCE.check_k(1), InfoNCE.check_k(4)
    with pytest.raises(ValueError, match=re.escape("[1, 4]")):
        InfoNCE.check_k([1, 4])


@pytest.mark.parametrize(
    ("space", "k", "n_candidates"), [(DISCRETE, 1, 3), (DISCRETE, 2, 9), (DISCRETE, 6, 256), (CONTINUOUS, 1, 256)]
)
def test_accuracy_of_guessing(space, k, n_candidates):
    assert InfoNCE(LineEncoder(), space, k=k).chance_accuracy(256) == 1 / n_candidates
