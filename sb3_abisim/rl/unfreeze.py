"""Fine-tune an encoder that a model has held frozen so far."""

import copy
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_abisim.rl.extractors import PretrainedExtractor
from sb3_abisim.rl.optimizers import policy_optimizers


def unfreeze_encoder(model: BaseAlgorithm) -> None:
    """Let a model train its frozen encoders from now on, in place.

    The optimizers take the new parameters at the place where a model built with ``freeze=False`` has them, so that it
    can be saved and loaded; what they know of all other parameters (Adam's averages) stays.

    :param model: any algorithm of Stable-Baselines3 or sb3-contrib that holds frozen encoders
    :raises ValueError: as :func:`require_unfreezable`
    """
    policy: Any = model.policy
    frozen = require_unfreezable(model)
    kwargs = copy.deepcopy(model.policy_kwargs)
    arguments = kwargs["features_extractor_kwargs"]
    new = {id(parameter) for extractor in frozen for parameter in extractor.unfreeze()}
    for owner, parameters in policy_optimizers(policy):
        if any(id(parameter) in new for parameter in parameters):
            old: th.optim.Optimizer = owner.optimizer
            rate = old.param_groups[0]["lr"]
            owner.optimizer = policy.optimizer_class(parameters, lr=rate, **policy.optimizer_kwargs)
            owner.optimizer.state.update(old.state)
    # For save and load, which build the extractors again.
    arguments["freeze"] = False
    model.policy_kwargs = kwargs
    policy.features_extractor_kwargs = arguments


def require_unfreezable(model: BaseAlgorithm) -> list[PretrainedExtractor]:
    """The frozen encoders of a model that :func:`unfreeze_encoder` can unfreeze, those of target networks included.

    :param model: any algorithm
    :raises ValueError: if it holds none, or none that a saved model could be built with again
    """
    frozen = [m for m in model.policy.modules() if isinstance(m, PretrainedExtractor) and m.frozen]
    if not frozen:
        raise ValueError("the model holds no frozen encoder; make one with freeze=True, or use it as it is")
    arguments = model.policy_kwargs.get("features_extractor_kwargs") or {}
    if not arguments.get("freeze"):
        raise ValueError(
            f"features_extractor_kwargs of the model hold no freeze=True, but {arguments}: it could not be loaded "
            "again; let the custom features extractor take freeze as an argument"
        )
    return frozen
