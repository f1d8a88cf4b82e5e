"""Fine-tune an encoder that a model has held frozen so far."""

import copy
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_abisim.rl.extractors import PretrainedExtractor


def unfreeze_encoder(model: BaseAlgorithm) -> None:
    """Let a model train its frozen encoders from now on, in place.

    The optimizers take the new parameters at the place where a model built with ``freeze=False`` has them, so that it
    can be saved and loaded; what they know of all other parameters (Adam's averages) stays.

    :param model: any algorithm of Stable-Baselines3 or sb3-contrib that holds frozen encoders
    :raises ValueError: if it holds none
    """
    policy: Any = model.policy
    frozen = [module for module in policy.modules() if isinstance(module, PretrainedExtractor) and module.frozen]
    if not frozen:
        raise ValueError("the model holds no frozen encoder; make one with freeze=True, or use it as it is")
    kwargs = copy.deepcopy(model.policy_kwargs)
    arguments = kwargs.get("features_extractor_kwargs") or {}
    if not arguments.get("freeze"):
        raise ValueError(
            f"features_extractor_kwargs of the model hold no freeze=True, but {arguments}: it could not be loaded "
            "again; let the custom features extractor take freeze as an argument"
        )
    new = {id(parameter) for extractor in frozen for parameter in extractor.unfreeze()}
    for owner, parameters in _optimizers(policy):
        if any(id(parameter) in new for parameter in parameters):
            old: th.optim.Optimizer = owner.optimizer
            rate = old.param_groups[0]["lr"]
            owner.optimizer = policy.optimizer_class(parameters, lr=rate, **policy.optimizer_kwargs)
            owner.optimizer.state.update(old.state)
    # For save and load, which build the extractors again.
    arguments["freeze"] = False
    model.policy_kwargs = kwargs
    policy.features_extractor_kwargs = arguments


def _optimizers(policy: Any) -> list[tuple[Any, list[nn.Parameter]]]:
    """The modules that own an optimizer, each with the parameters that SB3 builds it for."""
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
