"""The networks on images inside an objective, and how to change what calling them does for a while.

They take nearly all of the time of pretraining, so what makes it faster changes these alone.
"""

import contextlib
from collections.abc import Callable, Iterator

import torch as th
from torch import nn

from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.decoder import Decoder

Forward = Callable[[th.Tensor], th.Tensor]


@contextlib.contextmanager
def wrap_forward(module: nn.Module, *wrappers: Callable[[Forward], Forward]) -> Iterator[None]:
    """Wrap the ``forward`` of all encoders and decoders for the duration of a ``with`` block.

    :param module: an objective
    :param wrappers: the first one is the innermost
    """
    parts = [part for part in module.modules() if isinstance(part, Encoder | Decoder)]
    for part in parts:
        forward: Forward = part.forward
        for wrapper in wrappers:
            forward = wrapper(forward)
        # On the instance, so that the names of weights stay as they are.
        part.forward = forward  # type: ignore[method-assign, assignment]
    try:
        yield
    finally:
        for part in parts:
            del part.forward


def in_bfloat16(forward: Forward) -> Forward:
    """Compute in bfloat16 what PyTorch's autocast does; weights, gradients and the result stay float32.

    :param forward: of a network
    """

    def call(rows: th.Tensor) -> th.Tensor:
        with th.autocast(rows.device.type, th.bfloat16):
            return forward(rows).float()

    return call


def require_bfloat16(device: th.device) -> None:
    """Refuse a device that cannot.

    :param device: to train on
    :raises ValueError: naming it
    """
    if device.type == "cpu" or (device.type == "cuda" and th.cuda.is_bf16_supported(including_emulation=False)):
        return
    raise ValueError(f"precision: bf16 needs a CPU or a GPU with bfloat16, and {device} is neither; leave it out")
