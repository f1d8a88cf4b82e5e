"""Goal progress: targets against loop-written derivations, an MDP solved by hand, and what each part is for."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from objective_inputs import CONTINUOUS, LineEncoder, change_weights, loss_without_values
from torch import nn

from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.objectives.actions import actions_of
from sb3_abisim.objectives.base import TensorBatch
from sb3_abisim.objectives.goal_progress import (
    HORIZON,
    GoalHead,
    GoalProgress,
    goal_progress_loss,
    progress_targets,
    value_targets,
)

DISCRETE = gym.spaces.Discrete(3)
N_STATES, GAMMA = 6, 0.8


def make(action_space=DISCRETE, **kwargs) -> GoalProgress:
    """With goals, and a target network that differs from the online one, as after some updates."""
    th.manual_seed(0)
    kwargs = {"n_goals": 5, "goal_share": 0.2, "warm_start": False} | kwargs
    objective = GoalProgress(LineEncoder(7, 8), action_space, LineEncoder(4, 8), **kwargs)
    objective.prepare(th.rand(30, 1, 1, 4))
    change_weights(objective.target_encoder)
    change_weights(objective.target_head, seed=5)
    return objective


def make_batch(action_space=DISCRETE, n=6) -> TensorBatch:
    generator = th.Generator().manual_seed(2)
    actions = (
        th.randint(0, 3, (n,), generator=generator)
        if isinstance(action_space, gym.spaces.Discrete)
        else 2 * th.rand(n, 2, generator=generator) - 1
    )
    return TensorBatch.of(th.rand(n, 1, 1, 4, generator=generator), actions, th.rand(n, 1, 1, 4, generator=generator))


def test_targets_equal_loops() -> None:
    generator = np.random.default_rng(0)
    values, next_values = generator.random((2, 4, 3))
    values[0, 0], next_values[1, 1] = 1e-9, 1.0
    least = GAMMA**HORIZON
    expected = np.empty((4, 3))
    for i, j in itertools.product(range(4), range(3)):
        before = -math.log(max(values[i, j], least)) / math.log(1 / GAMMA)
        after = -math.log(max(next_values[i, j], least)) / math.log(1 / GAMMA)
        expected[i, j] = min(1.0, max(-1.0, before - after))
    found = progress_targets(th.tensor(values), th.tensor(next_values), GAMMA)
    assert np.allclose(found, expected) and (np.abs(expected) < 1).any()
    assert np.allclose(value_targets(th.tensor(next_values), GAMMA), GAMMA * next_values)


@pytest.mark.parametrize("action_space", [DISCRETE, CONTINUOUS])
def test_the_loss_equals_a_loop(action_space: gym.Space) -> None:
    objective, batch = make(action_space, value_weight=3.0, progress_weight=0.5), make_batch(action_space)
    with th.no_grad():
        loss, terms = objective.loss(batch)
        total_value = total_progress = 0.0
        all_values, all_progress = [], []
        for i, g in itertools.product(range(6), range(5)):
            sides = []
            for obs in (batch.obs[i : i + 1], batch.next_obs[i : i + 1]):
                distance = (objective.base_encoder(obs)[0] - objective.goals[g]).abs().sum()
                factors = objective.target_head.linear(objective.target_encoder(obs))[0].view(5, -1)[g]
                if isinstance(action_space, gym.spaces.Discrete):
                    best = float(factors[0]) + max(factors[1:].tolist())
                else:
                    corners = itertools.product((-1, 1), repeat=2)
                    best = max(float(factors[0] + factors[1] * x + factors[2] * y) for x, y in corners)
                sides.append(1.0 if distance <= objective.radii[g] else min(1.0, max(0.0, best)))
            value, next_value = sides
            least = 0.9**HORIZON
            progress = (math.log(max(next_value, least)) - math.log(max(value, least))) / -math.log(0.9)
            progress = min(1.0, max(-1.0, progress))
            all_values.append(value), all_progress.append(progress)
            phi, action = objective.encoder(batch.obs[i : i + 1]), batch.actions[i]
            terms_of = th.cat([th.ones(1), nn.functional.one_hot(action, 3).float() if action.dim() == 0 else action])
            for head, target in ((objective.value_head, 0.9 * next_value), (objective.progress_head, progress)):
                error = float((head.linear(phi)[0].view(5, -1)[g] * terms_of).sum()) - target
                total_value += error**2 * (head is objective.value_head)
                total_progress += error**2 * (head is objective.progress_head)
    assert float(terms["value_loss"]) == pytest.approx(total_value / 30, rel=1e-4)
    assert float(terms["progress_loss"]) == pytest.approx(total_progress / 30, rel=1e-4)
    assert float(loss) == pytest.approx((3.0 * total_value + 0.5 * total_progress) / 30, rel=1e-4)
    assert float(terms["value"]) == pytest.approx(np.mean(all_values), rel=1e-4)
    unexplained = total_progress / 30 / np.var(all_progress)
    assert float(terms["progress_r2"]) == pytest.approx(1 - unexplained, rel=1e-4)


def test_the_loss_of_unequal_weights() -> None:
    ones, zeros = th.ones(2, 3), th.zeros(2, 3)
    loss, _ = goal_progress_loss(2 * ones, zeros, 3 * ones, zeros, 10.0, 0.1)
    assert float(loss) == pytest.approx(10 * 4 + 0.1 * 9)


@pytest.mark.parametrize("action_space", [DISCRETE, CONTINUOUS])
def test_gradients_reach_the_encoder_and_both_heads_alone(action_space: gym.Space) -> None:
    objective = make(action_space)
    objective.loss(make_batch(action_space))[0].backward()
    moved = {name for name, parameter in objective.named_parameters() if parameter.grad is not None}
    assert {name.split(".")[0] for name in moved} == {"encoder", "value_head", "progress_head"}


def test_each_head_reaches_the_encoder() -> None:
    for weights in ({"value_weight": 0.0}, {"progress_weight": 0.0}):
        objective = make(**weights)
        objective.loss(make_batch())[0].backward()
        assert any(bool(parameter.grad.abs().max() > 0) for parameter in objective.encoder.parameters())


def test_the_target_network_follows_by_tau() -> None:
    objective = make(tau=0.25)
    before = [p.clone() for p in (*objective.target_encoder.parameters(), *objective.target_head.parameters())]
    online = [*objective.encoder.parameters(), *objective.value_head.parameters()]
    objective.after_step()
    after = [*objective.target_encoder.parameters(), *objective.target_head.parameters()]
    for old, now, new in zip(before, online, after, strict=True):
        assert th.allclose(new, 0.75 * old + 0.25 * now, atol=1e-6)


def test_the_loss_stays_on_the_device_of_its_inputs() -> None:
    assert loss_without_values(make(), make_batch()) == {"meta"}


# Goals.


def test_each_goal_holds_its_share_of_the_states() -> None:
    objective = make(n_goals=20, goal_share=0.1)
    states = th.rand(500, 1, 1, 4, generator=th.Generator().manual_seed(3))
    objective.prepare(states)
    with th.no_grad():
        inside = objective.in_goals(objective.base_encoder(states)).sum(dim=0)
    # The state that the goal is made of counts beside them.
    assert inside.tolist() == [51] * 20
    assert len({tuple(goal) for goal in objective.goals.tolist()}) == 20


def test_goals_follow_the_seed_and_need_enough_states() -> None:
    objective, states = make(), th.rand(40, 1, 1, 4)
    goals = []
    for seed in (0, 0, 1):
        th.manual_seed(seed)
        objective.prepare(states)
        goals.append(objective.goals.clone())
    assert th.equal(goals[0], goals[1]) and not th.equal(goals[0], goals[2])
    with pytest.raises(ValueError, match="n_goals=5, but there are 5 states to choose from; lower it"):
        objective.prepare(states[:5])


# An MDP solved by hand: a chain with a wall at each end, and three actions: left, stay, right.


class ChainEncoder(Encoder):
    """The state itself, one-hot: both heads are tables."""

    def __init__(self) -> None:
        super().__init__(nn.Flatten(), N_STATES, "ChainEncoder", {}, (1, 1, N_STATES))


def chain() -> tuple[TensorBatch, np.ndarray]:
    """All transitions, and the distance between any two states."""
    pairs = list(itertools.product(range(N_STATES), range(3)))
    following = [min(N_STATES - 1, max(0, s + a - 1)) for s, a in pairs]
    onehot = th.eye(N_STATES).view(N_STATES, 1, 1, N_STATES)
    obs, next_obs = onehot[[s for s, _ in pairs]], onehot[following]
    states = np.arange(N_STATES)
    return TensorBatch.of(obs, th.tensor([a for _, a in pairs]), next_obs), np.abs(states[:, None] - states)


def solve(**kwargs) -> GoalProgress:
    th.manual_seed(0)
    encoder = ChainEncoder()
    settings = {"n_goals": N_STATES - 1, "goal_share": 0.01, "gamma": GAMMA, "tau": 0.1, "warm_start": False} | kwargs
    objective = GoalProgress(encoder, DISCRETE, ChainEncoder(), **settings)
    objective.prepare(th.eye(N_STATES).view(N_STATES, 1, 1, N_STATES))
    # Each goal is one state: the nearest other one is 2 away in the L1 norm.
    objective.radii.fill_(0.5)
    batch, _ = chain()
    optimizer = th.optim.Adam(objective.parameters(), lr=0.03)
    for update in range(1500):
        for group in optimizer.param_groups:
            group["lr"] = 0.03 * (1 - update / 1500)
        loss, _ = objective.loss(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        objective.after_step()
    return objective


def test_values_converge_to_gamma_to_the_distance_and_progress_to_the_exact_one() -> None:
    objective = solve()
    batch, distance = chain()
    goals = objective.goals.argmax(dim=1).numpy()
    states, following = batch.obs.flatten(1).argmax(dim=1).numpy(), batch.next_obs.flatten(1).argmax(dim=1).numpy()
    with th.no_grad():
        values, _ = objective.values(batch)
        progress = objective.progress_head.of_action(
            objective.encoder(batch.obs), objective.action_inputs(batch.actions)
        )
    assert np.allclose(values, GAMMA ** distance[states][:, goals], atol=0.02)
    exact = distance[states][:, goals] - distance[following][:, goals]
    assert np.allclose(progress, exact, atol=0.1)
    # Blocked by a wall, or staying: nothing was gained.
    still = states == following
    assert still.sum() == 8 and np.allclose(progress[still], 0.0, atol=0.1)


def test_a_blocked_move_is_an_exact_zero_before_anything_is_learned() -> None:
    objective = make()
    batch = make_batch()
    still = TensorBatch.of(batch.obs, batch.actions, batch.obs)
    values, next_values = objective.values(still)
    assert th.equal(progress_targets(values, next_values, 0.9), th.zeros(6, 5))


def test_without_the_progress_loss_the_progress_is_not_learned() -> None:
    objective = solve(progress_weight=0.0)
    batch, _ = chain()
    assert float(objective.loss(batch)[1]["progress_r2"]) < 0.2
    assert float(solve().loss(batch)[1]["progress_r2"]) > 0.95


# Networks.


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Discrete(4, start=2),
        gym.spaces.MultiDiscrete([2, 3]),
        gym.spaces.MultiBinary(3),
        gym.spaces.Box(np.array([0.0, 10.0], np.float32), np.array([4.0, 30.0], np.float32)),
    ],
)
def test_the_greedy_action_is_the_best_of_all(space: gym.Space) -> None:
    actions = actions_of(space)
    head, phi = GoalHead(4, 3, actions), th.rand(5, 4)
    tried = {
        "Discrete": [2, 3, 4, 5],
        "MultiDiscrete": list(itertools.product(range(2), range(3))),
        "MultiBinary": list(itertools.product(range(2), repeat=3)),
        "Box": list(itertools.product(np.linspace(0, 4, 5), np.linspace(10, 30, 5))),
    }[type(space).__name__]
    dtype = th.float32 if isinstance(space, gym.spaces.Box) else th.int64
    with th.no_grad():
        numbers = [head.of_action(phi, actions.inputs(th.tensor([one] * 5, dtype=dtype))) for one in tried]
        assert th.allclose(head.greedy(phi), th.stack(numbers).amax(dim=0), atol=1e-5)


def test_it_begins_with_the_layers_that_the_base_has() -> None:
    space = gym.spaces.Box(0, 255, (3, 64, 64), np.uint8)
    base = make_encoder(space)
    encoder = make_encoder(space, None, features="trunk", hidden_dim=16)
    fresh = encoder.state_dict()["layers.6.weight"].clone()
    objective = GoalProgress(encoder, DISCRETE, base)
    weights = objective.encoder.state_dict()
    for name in ("layers.0.weight", "layers.2.bias"):
        assert th.equal(weights[name], base.state_dict()[name])
    assert th.equal(weights["layers.6.weight"], fresh)
    with pytest.raises(ValueError, match=r"LineEncoder.* has no layer of its base .*; give .* or warm_start: false$"):
        GoalProgress(LineEncoder(7, 8), DISCRETE, base)


def test_the_given_base_is_left_as_it_was() -> None:
    base = LineEncoder()
    objective = GoalProgress(LineEncoder(), DISCRETE, base, warm_start=False)
    copies = (objective.base_encoder, objective.target_encoder, objective.target_head)
    for module, frozen in ((base, False), *((module, True) for module in copies)):
        assert {not parameter.requires_grad for parameter in module.parameters()} == {frozen}
    with th.no_grad():
        next(base.parameters()).zero_()
    assert bool(next(objective.base_encoder.parameters()).any())


def test_settings_that_nobody_gives() -> None:
    objective = GoalProgress(LineEncoder(), DISCRETE, LineEncoder())
    names = ("n_goals", "goal_share", "gamma", "tau", "value_weight", "progress_weight")
    assert [getattr(objective, name) for name in names] == [128, 0.02, 0.9, 0.02, 10.0, 1.0]


def test_the_least_and_the_most_of_each_setting() -> None:
    objective = make(n_goals=1, tau=1.0, value_weight=0.0, progress_weight=0.0)
    assert float(objective.loss(make_batch())[0].detach()) == 0.0
    objective.after_step()
    for online, target in zip(objective.value_head.parameters(), objective.target_head.parameters(), strict=True):
        assert th.equal(online, target)


def test_the_base_is_the_plain_network() -> None:
    kwargs = {"features_dim": 64, "features": "trunk", "hidden_dim": 512}
    assert GoalProgress.base_network_kwargs(kwargs) == {"features_dim": 64}


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_goals": 0}, "n_goals must be a whole number"),
        ({"n_goals": 5.0}, "n_goals must be a whole number of at least 1, got 5.0"),
        ({"goal_share": 1.0}, "goal_share must lie between 0 and 1, got 1.0"),
        ({"gamma": 0.0}, "gamma must lie between 0 and 1"),
        ({"tau": 0.0}, "tau must lie in"),
        ({"tau": 1.5}, r"tau must lie in \(0, 1\], got 1.5"),
        ({"value_weight": -1.0}, "value_weight must be a number of at least 0"),
        ({"progress_weight": math.inf}, "progress_weight must be a number of at least 0"),
    ],
)
def test_settings_that_mean_nothing_are_refused(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**kwargs)
