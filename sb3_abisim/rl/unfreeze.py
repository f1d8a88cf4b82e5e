"""Fine-tune an encoder that a model has held frozen so far."""

import copy
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
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
    new = {id(parameter) for extractor in frozen for parameter in extractor.unfreeze()}
    for owner, trained in _optimizers(policy):
        _extend(owner, trained, new, policy)
    # For save and load, which build the extractors again.
    kwargs = copy.deepcopy(model.policy_kwargs)
    kwargs["features_extractor_kwargs"]["freeze"] = False
    model.policy_kwargs = kwargs
    policy.features_extractor_kwargs = kwargs["features_extractor_kwargs"]


def _optimizers(policy: Any) -> list[tuple[nn.Module, list[tuple[str, nn.Parameter]]]]:
    """The modules that own an optimizer, each with the parameters that SB3 lets it train, by name."""
    found = []
    for owner in (policy, getattr(policy, "actor", None), getattr(policy, "critic", None)):
        if getattr(owner, "optimizer", None) is None:
            continue
        # Value-based policies optimize one of their two networks.
        network = getattr(policy, "q_net", None) or getattr(policy, "quantile_net", None) or owner
        named = list(network.named_parameters())
        if owner is getattr(policy, "critic", None) and policy.share_features_extractor:
            named = [(name, parameter) for name, parameter in named if "features_extractor" not in name]
        found.append((owner, named))
    return found


def _extend(owner: Any, trained: list[tuple[str, nn.Parameter]], new: set[int], policy: Any) -> None:
    old: th.optim.Optimizer = owner.optimizer
    parameters = [parameter for _, parameter in trained]
    if not new & {id(parameter) for parameter in parameters}:
        return
    rate = old.param_groups[0]["lr"]
    owner.optimizer = policy.optimizer_class(parameters, lr=rate, **policy.optimizer_kwargs)
    owner.optimizer.state.update(old.state)
