"""An encoder that actor and critic share, trained by the critic's loss instead of the actor's.

In SAC, TD3 and TQC with ``share_features_extractor=True``, Stable-Baselines3 computes the critic's features without
gradients, and the actor's loss alone trains the encoder. DrQ, CURL and SAC-AE do the reverse. Here that is arranged
around Stable-Baselines3's own ``train()`` by hooks:

* the critic computes its features with gradients where its actions come from the replay buffer, which is the critic's
  loss, and without where they come from the actor, which is the actor's;
* everything else, the actor first of all, is given features that are detached;
* where the actor's optimizer holds the encoder (SAC, TQC), that one steps it when the critic's has stepped. It goes on
  holding the encoder's state, so that the model is saved and loaded as any other. In TD3 the critic's holds it, too.
"""

from typing import Any

import torch as th
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_abisim.rl.optimizers import only


def check_routing(model: BaseAlgorithm) -> None:
    """Refuse a model whose encoder the critic's loss cannot be made to train alone.

    :param model: of any algorithm
    :raises ValueError: with the reason
    """
    policy: Any = model.policy
    name = type(model).__name__
    if not isinstance(policy, SACPolicy | TD3Policy | TQCPolicy):
        raise ValueError(
            f"encoder_trained_by='critic' is for SAC, TD3 and TQC, where actor and critic have a loss each; {name} has "
            "one loss or optimizes the policy otherwise: remove encoder_trained_by"
        )
    if not policy.share_features_extractor:
        raise ValueError(
            f"encoder_trained_by='critic', but actor and critic of this {name} have an encoder each, trained by their "
            "own losses; add share_features_extractor=True to policy_kwargs, or remove encoder_trained_by"
        )


class CriticRouting:
    """Lets the critic's loss train the shared features extractor, and the actor's not, until it is removed.

    :param model: SAC, TD3, TQC or a subclass, with a shared extractor that is not frozen
    :raises ValueError: as :func:`check_routing`
    """

    def __init__(self, model: BaseAlgorithm) -> None:
        check_routing(model)
        policy: Any = model.policy
        self._actor, self._critic = policy.actor, policy.critic
        extractor = self._critic.features_extractor
        self._parameters: list[nn.Parameter] = list(extractor.parameters())
        self._critic_learns = False
        self._hooks: list[Any] = [
            self._critic.register_forward_pre_hook(self._before_critic),
            self._critic.register_forward_hook(self._after_critic, always_call=True),
            extractor.register_forward_hook(self._detach),
        ]
        held = {id(p) for group in self._critic.optimizer.param_groups for p in group["params"]}
        if not all(id(parameter) in held for parameter in self._parameters):
            self._hooks.append(self._critic.optimizer.register_step_post_hook(self._step_encoder))

    def remove(self) -> None:
        """Leave everything to Stable-Baselines3 again."""
        for hook in self._hooks:
            hook.remove()

    def _before_critic(self, critic: Any, inputs: tuple[th.Tensor, th.Tensor]) -> None:
        self._critic_learns = th.is_grad_enabled() and not inputs[1].requires_grad
        # Stable-Baselines3's own switch for the gradients of the critic's features.
        critic.share_features_extractor = not self._critic_learns

    def _after_critic(self, critic: Any, *_: Any) -> None:
        self._critic_learns = False
        critic.share_features_extractor = True

    def _detach(self, extractor: nn.Module, inputs: Any, features: th.Tensor) -> th.Tensor | None:
        # Also because the critic's step changes weights that the actor's graph, which is older, would need.
        return None if self._critic_learns else features.detach()

    def _step_encoder(self, *_: Any) -> None:
        # The hook of a step that calls its parent's runs twice.
        if all(parameter.grad is None for parameter in self._parameters):
            return
        with only(self._actor.optimizer, self._parameters):
            self._actor.optimizer.step()
        # The next loss of the critic starts from nothing, and the actor's step finds nothing to do.
        for parameter in self._parameters:
            parameter.grad = None
