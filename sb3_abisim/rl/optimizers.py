"""An optimizer that gives a fine-tuned encoder its own learning rate.

Stable-Baselines3 writes one learning rate into every parameter group at each ``train()``, so rates of single groups do
not last. Here each group keeps a factor, which is applied within ``step``.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch as th
from torch import nn

_MARK = "sb3_abisim_encoder"


def mark_encoder(encoder: nn.Module) -> None:
    """Tell optimizers built later that these are an encoder's parameters; the extractors call it.

    :param encoder: the network
    """
    for parameter in encoder.parameters():
        setattr(parameter, _MARK, True)


class EncoderLRAdam(th.optim.Adam):
    """Adam whose learning rate for the encoder is a multiple of that for all else.

    In ``policy_kwargs``: ``optimizer_class=EncoderLRAdam, optimizer_kwargs={"encoder_lr_factor": 0.1, "eps": 1e-5}``.
    Stable-Baselines3 sets ``eps=1e-5`` for PPO and A2C only while ``optimizer_kwargs`` is left out, so a run that is to
    differ in nothing else has to name it there.

    The factor is saved with the optimizer's state; like Adam's other settings it then comes from the saved model.

    :param params: parameters, those of an encoder marked by their features extractor
    :param lr: learning rate of all that is not the encoder
    :param encoder_lr_factor: the encoder's learning rate divided by ``lr``, above 0
    :param kwargs: passed to ``torch.optim.Adam``
    :raises ValueError: for a factor that is not above 0, or if no parameter is an encoder's: the extractor is not one
        of this package, it is frozen, or it is shared with the actor, whose optimizer alone then trains it
    """

    def __init__(
        self, params: Iterable[th.Tensor], lr: float = 1e-3, encoder_lr_factor: float = 1.0, **kwargs: Any
    ) -> None:
        if not (encoder_lr_factor > 0 and math.isfinite(encoder_lr_factor)):
            raise ValueError(
                f"encoder_lr_factor must be a number above 0, got {encoder_lr_factor}; to keep the encoder as it is, "
                "give freeze=True in features_extractor_kwargs"
            )
        params = list(params)
        encoder = [parameter for parameter in params if hasattr(parameter, _MARK)]
        rest = [parameter for parameter in params if not hasattr(parameter, _MARK)]
        if not encoder:
            raise ValueError(
                f"encoder_lr_factor={encoder_lr_factor}, but none of {len(params)} parameters is an encoder's; use a "
                "features extractor of sb3_abisim with freeze=False (and share_features_extractor=False in SAC and "
                "TQC), or remove optimizer_class and encoder_lr_factor from policy_kwargs"
            )
        groups = [{"params": rest, "lr_factor": 1.0}, {"params": encoder, "lr_factor": encoder_lr_factor}]
        super().__init__(groups, lr=lr, **kwargs)

    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step of Adam, with the encoder's learning rate for the encoder.

        :param closure: computes the loss anew, as in torch
        :return: the loss, if there is a closure
        """
        rates = [group["lr"] for group in self.param_groups]
        for group in self.param_groups:
            group["lr"] = group["lr"] * group["lr_factor"]
        try:
            loss: float | None = super().step(closure)
            return loss
        finally:
            for group, rate in zip(self.param_groups, rates, strict=True):
                group["lr"] = rate
