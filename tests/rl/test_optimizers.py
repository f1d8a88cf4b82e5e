"""A learning rate of their own for some parameters of any optimizer: the arithmetic, and what is refused."""

from collections.abc import Callable
from typing import Any

import pytest
import torch as th
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from sb3_abisim.rl.optimizers import OwnRate, only

LR = 0.01


class Nested(th.optim.Adam):
    """A step that calls its parent's, both with torch's hooks."""

    def step(self, closure: Callable[[], float] | None = None) -> Any:  # type: ignore[override]
        return super().step(closure)


class Counting(th.optim.SGD):
    """Keeps a number in its groups, as optimizers do that make their own schedule."""

    def step(self, closure: Callable[[], float] | None = None) -> Any:  # type: ignore[override]
        for group in self.param_groups:
            group["n_steps"] = group.get("n_steps", 0) + 1
        return super().step(closure)


OPTIMIZERS: list[tuple[Any, dict[str, Any]]] = [
    (th.optim.Adam, {}),
    (th.optim.Adam, {"eps": 1e-5, "weight_decay": 0.1, "betas": (0.5, 0.9)}),
    (th.optim.AdamW, {"amsgrad": True}),
    (th.optim.SGD, {}),
    (th.optim.SGD, {"momentum": 0.9, "nesterov": True}),
    (th.optim.RMSprop, {"centered": True}),
    (RMSpropTFLike, {"alpha": 0.9, "eps": 1e-5}),
    (Nested, {}),
]


def networks() -> tuple[nn.Linear, nn.Linear]:
    th.manual_seed(3)
    return nn.Linear(4, 3), nn.Linear(3, 2)


def backward(encoder: nn.Module, head: nn.Module, step: int) -> None:
    inputs = th.randn(5, 4, generator=th.Generator().manual_seed(step))
    (head(encoder(inputs)) - step).square().mean().backward()


def equal(one: nn.Module, other: nn.Module) -> bool:
    return all(th.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


@pytest.mark.parametrize("optimizer_class, kwargs", OPTIMIZERS)
def test_equals_two_optimizers_of_torch(optimizer_class: Any, kwargs: dict[str, Any]) -> None:
    encoder, head = networks()
    # Mixed order: an encoder's parameters stand wherever the policy has them.
    ours = optimizer_class([head.weight, *encoder.parameters(), head.bias], lr=1.0, **kwargs)
    plain_encoder, plain_head = networks()
    theirs = [
        optimizer_class(plain_encoder.parameters(), lr=1.0, **kwargs),
        optimizer_class(plain_head.parameters(), lr=1.0, **kwargs),
    ]
    seen: list[float] = []
    own = OwnRate(ours, encoder.parameters(), lambda lr: seen.append(lr) or lr / 8)  # type: ignore[func-returns-value]
    for step in range(6):
        if step == 4:
            own.remove()
        rate = LR / (step + 1)
        for group in ours.param_groups:  # what SB3 does in train()
            group["lr"] = rate
        for optimizer, factor in zip(theirs, (1 / 8 if step < 4 else 1.0, 1.0), strict=True):
            optimizer.param_groups[0]["lr"] = rate * factor
        for modules, optimizers in (((encoder, head), [ours]), ((plain_encoder, plain_head), theirs)):
            for optimizer in optimizers:
                optimizer.zero_grad()
            backward(*modules, step)
            for optimizer in optimizers:
                optimizer.step()
        # Between steps, it is the optimizer that Stable-Baselines3 has built, saves and loads.
        assert [(len(group["params"]), group["lr"]) for group in ours.param_groups] == [(4, rate)]
        assert equal(encoder, plain_encoder) and equal(head, plain_head)
    assert seen == [LR, LR / 2, LR / 3, LR / 4]
    fresh = optimizer_class([head.weight, *encoder.parameters(), head.bias], lr=1.0, **kwargs)
    fresh.load_state_dict(ours.state_dict())


def test_a_step_that_fails_is_undone() -> None:
    encoder, head = networks()
    optimizer = th.optim.Adam([*encoder.parameters(), *head.parameters()], lr=LR)
    groups = optimizer.param_groups
    own = OwnRate(optimizer, encoder.parameters(), lambda lr: lr / 2)

    def fail() -> float:
        raise RuntimeError("no loss")

    assert optimizer.step(lambda: 1.5) == 1.5
    assert optimizer.param_groups is groups
    with pytest.raises(RuntimeError, match="no loss"):
        optimizer.step(fail)
    assert optimizer.param_groups is not groups
    own.remove()
    assert optimizer.param_groups is groups


def test_groups_of_the_users_own_keep_their_settings() -> None:
    encoder, head = networks()
    groups = [{"params": encoder.weight, "momentum": 0.5}, {"params": [encoder.bias, *head.parameters()]}]
    optimizer = th.optim.SGD(groups, lr=LR)
    seen: list[list[tuple[int, float, float]]] = []
    OwnRate(optimizer, encoder.parameters(), lambda lr: lr / 2)
    optimizer.register_step_pre_hook(
        lambda *_: seen.append([(len(g["params"]), g["momentum"], g["lr"]) for g in optimizer.param_groups])
    )
    optimizer.step()
    assert seen == [[(1, 0.5, LR / 2), (2, 0, LR), (1, 0, LR / 2)]]
    assert [len(group["params"]) for group in optimizer.param_groups] == [1, 3]


def test_only_some_parameters_step() -> None:
    encoder, head = networks()
    optimizer = th.optim.Adam([*encoder.parameters(), *head.parameters()], lr=LR)
    backward(encoder, head, 1)
    old_encoder, old_head = networks()
    with only(optimizer, encoder.parameters()):
        optimizer.step()
    assert not equal(encoder, old_encoder) and equal(head, old_head)
    assert [len(group["params"]) for group in optimizer.param_groups] == [4]
    assert set(optimizer.state) == set(encoder.parameters())


def test_optimizers_that_change_their_groups_are_refused() -> None:
    encoder, head = networks()
    optimizer = Counting([*encoder.parameters(), *head.parameters()], lr=LR)
    own = OwnRate(optimizer, encoder.parameters(), lambda lr: lr)
    match = "Counting changes n_steps of its parameter groups .*choose another optimizer_class"
    with pytest.raises(ValueError, match=match):
        optimizer.step()
    own.remove()
    with pytest.raises(ValueError, match=match), only(optimizer, encoder.parameters()):
        optimizer.step()
