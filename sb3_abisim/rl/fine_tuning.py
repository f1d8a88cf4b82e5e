"""How an encoder is fine-tuned: at which learning rate, and by which loss."""

import math
from collections.abc import Callable
from typing import Any

from sb3_contrib import TRPO
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.rl.critic_routing import CriticRouting, check_routing
from sb3_abisim.rl.optimizers import OwnRate, policy_optimizers

Schedule = Callable[[float], float]
_LINEAR = "lin_"
# On the policy, which a second run of the same model has, too.
_ATTRIBUTE = "_sb3_abisim_fine_tuning"


def make_schedule(value: float | str | Schedule, name: str) -> Schedule:
    """A schedule in any of rl-zoo3's and Stable-Baselines3's forms.

    :param value: a number above 0, ``lin_NUMBER``, which falls to 0 in a straight line, or a function of the remaining
        progress (1 at the start, 0 at the end and in what a last rollout has beyond it)
    :param name: of the setting, for messages
    :raises ValueError: for anything else
    """
    if callable(value):
        return value
    text = str(value)
    try:
        initial = float(text.removeprefix(_LINEAR))
    except ValueError:
        initial = math.nan
    if isinstance(value, bool) or not (initial > 0 and math.isfinite(initial)):
        raise ValueError(
            f"{name} must be a number above 0, lin_NUMBER or a function of the remaining progress, got {value!r}; to "
            "keep the encoder as it is, give freeze=True in features_extractor_kwargs"
        )
    return (lambda progress: progress * initial) if text.startswith(_LINEAR) else (lambda progress: initial)


class FineTuning:
    """The settings of fine-tuning, put into a model for the time of a run.

    :param encoder_lr: the encoder's learning rate, in a form of :func:`make_schedule`; None for that of the rest
    :param encoder_lr_factor: the same, as a multiple of the learning rate of the rest
    :param encoder_trained_by: "critic" for :class:`~sb3_abisim.rl.critic_routing.CriticRouting`; None for what
        Stable-Baselines3 does
    :raises ValueError: for a setting of another form, or both learning rates
    """

    def __init__(
        self,
        encoder_lr: float | str | Schedule | None = None,
        encoder_lr_factor: float | str | Schedule | None = None,
        encoder_trained_by: str | None = None,
    ) -> None:
        given = {"encoder_lr": encoder_lr, "encoder_lr_factor": encoder_lr_factor}
        rates = {name: make_schedule(value, name) for name, value in given.items() if value is not None}
        if len(rates) == 2:
            raise ValueError(f"encoder_lr={encoder_lr!r} and encoder_lr_factor={encoder_lr_factor!r}: give one of them")
        if encoder_trained_by not in (None, "critic"):
            raise ValueError(
                f"encoder_trained_by must be 'critic', got {encoder_trained_by!r}; leave it out for the actor's loss"
            )
        self._rate_name = next(iter(rates), "")
        self._schedule = rates.get(self._rate_name)
        self.encoder_trained_by = encoder_trained_by
        self._installed: list[OwnRate | CriticRouting] = []

    @property
    def is_default(self) -> bool:
        """Whether all is as Stable-Baselines3 does it."""
        return self._schedule is None and self.encoder_trained_by is None

    def check(self, model: BaseAlgorithm, is_frozen: bool = False) -> None:
        """Refuse a model that cannot be fine-tuned like this.

        :param model: of any algorithm
        :param is_frozen: whether its encoders are frozen now and unfrozen later
        :raises ValueError: with the reason
        """
        policy: Any = model.policy
        if self.encoder_trained_by is not None:
            check_routing(model)
        if self._schedule is not None and isinstance(model, TRPO):
            raise ValueError(
                f"{self._rate_name} with {type(model).__name__}, whose policy is moved by a line search and not by an "
                f"optimizer; remove {self._rate_name}, or take PPO"
            )
        has_encoder = self._schedule is None or bool(_encoder_parameters(policy))
        has_shared = self.encoder_trained_by is None or any(True for _ in policy.critic.features_extractor.parameters())
        if not is_frozen and not (has_encoder and has_shared):
            raise ValueError(
                "encoder_lr, encoder_lr_factor and encoder_trained_by are for an encoder that RL trains, and the "
                "policy holds none; use a features extractor of sb3_abisim with freeze=False, or remove them"
            )

    def install(self, model: BaseAlgorithm) -> None:
        """Train the model's encoders like this from now on.

        :param model: with encoders that are not frozen
        :raises ValueError: as :meth:`check`
        """
        policy: Any = model.policy
        before = getattr(policy, _ATTRIBUTE, None)
        if before is not None:
            # Of a run that has failed.
            before.remove(model)
        self.check(model)
        if self.is_default:
            return
        setattr(policy, _ATTRIBUTE, self)
        if self._schedule is not None:
            parameters = _encoder_parameters(policy)
            ids = {id(parameter) for parameter in parameters}
            for owner, held in policy_optimizers(policy):
                if any(id(parameter) in ids for parameter in held):
                    self._installed.append(OwnRate(owner.optimizer, parameters, lambda lr: self._rate(model, lr)))
        if self.encoder_trained_by is not None:
            self._installed.append(CriticRouting(model))

    def remove(self, model: BaseAlgorithm) -> None:
        """Leave the model to Stable-Baselines3 again; a second call does nothing.

        :param model: of :meth:`install`
        """
        while self._installed:
            self._installed.pop().remove()
        if getattr(model.policy, _ATTRIBUTE, None) is self:
            delattr(model.policy, _ATTRIBUTE)

    def _rate(self, model: BaseAlgorithm, lr: float) -> float:
        assert self._schedule is not None
        # The last rollout may go beyond the steps asked for, where Stable-Baselines3's progress is negative.
        progress = max(model._current_progress_remaining, 0.0)
        value = float(self._schedule(progress))
        if not (value >= 0 and math.isfinite(value)):
            raise ValueError(
                f"{self._rate_name} is {value} at remaining progress {progress:g}; let its schedule give finite "
                "numbers that are not negative"
            )
        rate = value if self._rate_name == "encoder_lr" else lr * value
        model.logger.record("encoder/learning_rate", rate)
        return rate


def _encoder_parameters(policy: nn.Module) -> list[nn.Parameter]:
    encoders = [extractor.encoder for _, extractor in find_extractors(policy)]
    return [parameter for encoder in encoders for parameter in encoder.parameters()]
