"""A learning rate of its own for some of an optimizer's parameters, whatever the optimizer's class.

Stable-Baselines3 writes one learning rate into every parameter group at each ``train()``, and it loads an optimizer's
state only into the groups that it builds by itself. So an optimizer keeps its groups, and is given others while it
steps: those of :class:`OwnRate`, with the parameters that have another rate in a group of their own. Averages and
momenta belong to parameters, not to groups, and stay where they are. A saved model is one of plain Stable-Baselines3.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

# A group and the part of it that is stepped with.
_Pairs = list[tuple[dict[str, Any], dict[str, Any]]]
# What a part has of its own.
_OURS = ("params", "lr")


def policy_optimizers(policy: Any) -> list[tuple[Any, list[nn.Parameter]]]:
    """The modules of a policy that own an optimizer, each with the parameters that SB3 builds it for.

    :param policy: ``model.policy``
    """
    found: list[tuple[Any, list[nn.Parameter]]] = []
    actor, critic = getattr(policy, "actor", None), getattr(policy, "critic", None)
    owner: Any
    for owner in (policy, actor, critic):
        if getattr(owner, "optimizer", None) is None:
            continue
        # Value-based policies optimize one of their two networks.
        network = getattr(policy, "q_net", None) or getattr(policy, "quantile_net", None) or owner
        named = network.named_parameters()
        # A shared extractor is the actor's, except in TD3, which gives it to both optimizers.
        if owner is critic and policy.share_features_extractor and not isinstance(policy, TD3Policy):
            named = ((name, parameter) for name, parameter in named if "features_extractor" not in name)
        found.append((owner, [parameter for _, parameter in named]))
    return found


class OwnRate:
    """While an optimizer steps, some of its parameters have another learning rate.

    :param optimizer: of any class of ``torch.optim.Optimizer`` that keeps nothing but settings in its groups
    :param parameters: those that have it; others that the optimizer does not hold are left alone
    :param rate: makes it of the learning rate of all else; called before each step
    :raises ValueError: in the first step, for an optimizer that changes other things of its groups
    """

    def __init__(
        self, optimizer: th.optim.Optimizer, parameters: Iterable[nn.Parameter], rate: Callable[[float], float]
    ) -> None:
        self.optimizer = optimizer
        self._ids = {id(parameter) for parameter in parameters}
        self._rate = rate
        self._pairs: _Pairs = []
        self._groups: list[dict[str, Any]] | None = None
        self._depth = 0
        self._hooks = [
            optimizer.register_step_pre_hook(self._before),
            optimizer.register_step_post_hook(self._after),
        ]

    def remove(self) -> None:
        """Leave the optimizer as it was, also after a step that has failed."""
        for hook in self._hooks:
            hook.remove()
        if self._groups is not None:
            self.optimizer.param_groups = self._groups
        self._groups, self._depth = None, 0

    def _before(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        # A class whose step calls that of its parent runs the hooks twice, one pair within the other.
        self._depth += 1
        if self._depth > 1:
            return
        self._groups = optimizer.param_groups
        self._pairs = [(group, part) for group in self._groups for part in self._split(group)]
        optimizer.param_groups = [part for _, part in self._pairs]

    def _after(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        self._depth -= 1
        if self._depth == 0 and self._groups is not None:
            optimizer.param_groups, self._groups = self._groups, None
            _require_settings_alone(optimizer, self._pairs)

    def _split(self, group: dict[str, Any]) -> Iterator[dict[str, Any]]:
        ours = [parameter for parameter in group["params"] if id(parameter) in self._ids]
        rest = [parameter for parameter in group["params"] if id(parameter) not in self._ids]
        if rest:
            yield {**group, "params": rest}
        if ours:
            yield {**group, "params": ours, "lr": self._rate(group["lr"])}


@contextmanager
def only(optimizer: th.optim.Optimizer, parameters: Iterable[nn.Parameter]) -> Iterator[None]:
    """Let an optimizer hold nothing but some of its parameters for a while.

    :param optimizer: as for :class:`OwnRate`
    :param parameters: those that it keeps
    :raises ValueError: as :class:`OwnRate`
    """
    ids = {id(parameter) for parameter in parameters}
    groups = optimizer.param_groups
    pairs = [(group, {**group, "params": [p for p in group["params"] if id(p) in ids]}) for group in groups]
    optimizer.param_groups = [part for _, part in pairs if part["params"]]
    try:
        yield
    finally:
        optimizer.param_groups = groups
    _require_settings_alone(optimizer, pairs)


def _require_settings_alone(optimizer: th.optim.Optimizer, pairs: _Pairs) -> None:
    """Refuse an optimizer that counts or adapts in its groups: it would have done so in a copy."""
    changed = sorted(
        {key for group, part in pairs for key in part if key not in _OURS and part[key] is not group.get(key, part)}
    )
    if changed:
        raise ValueError(
            f"{type(optimizer).__name__} changes {', '.join(changed)} of its parameter groups in each step, so no "
            "parameter can have a learning rate or a loss of its own; choose another optimizer_class, or remove "
            "encoder_lr, encoder_lr_factor and encoder_trained_by"
        )
