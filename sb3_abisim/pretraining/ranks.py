"""Several processes that pretrain one encoder together, as ``torchrun`` starts them (docs/pretraining.md).

Every process has the whole batch, the same weights and the same random numbers, and computes the same loss. What is
divided are the networks on images, which take nearly all of the time: each process puts a share of a batch's rows
through them, and the rows are put together again, with their gradients. So whatever an objective compares, chooses or
samples is the whole batch's, in every process, and it need not know of the others.
"""

import contextlib
import copy
import os
import signal
import threading
from collections.abc import Iterable, Iterator
from datetime import timedelta
from typing import Any

import torch as th
import torch.distributed as dist
from torch import nn

from sb3_abisim.networks.base import Encoder
from sb3_abisim.pretraining.image_networks import Forward

# What one process does alone is far shorter: it writes a checkpoint, or the encoder file.
TIMEOUT = timedelta(minutes=30)
# Embeddings of halves of a batch may differ from those of the whole by rounding.
_TOLERANCE = 1e-3


class Ranks:
    """The processes of a run, seen from one of them. With one process, all of this does nothing.

    :param rank: this process, from 0; the first is the only one that writes
    :param size: how many there are
    """

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that writes and prints."""
        return self.rank == 0

    def divide(self, forward: Forward) -> Forward:
        """A network's ``forward`` that puts a share of the rows through it in each process, and gives all of them.

        All processes must call it equally often, with the same rows.

        :param forward: from rows (n, ...) to rows (n, ...), each by itself
        """
        if self.size == 1:
            return forward

        def call(rows: th.Tensor) -> th.Tensor:
            n = len(rows)
            share = -(-n // self.size)
            if n < share * self.size:
                # Shares must be equally long; what is repeated is cut off again.
                rows = th.cat([rows, rows[-1:].expand(share * self.size - n, *rows.shape[1:])])
            whole: th.Tensor = _Gather.apply(forward(_Take.apply(rows, self)), self)  # type: ignore[no-untyped-call]
            return whole[:n]

        return call

    def gather(self, rows: th.Tensor) -> th.Tensor:
        """Rows of all processes, in their order; no gradient.

        :param rows: as many in each process
        """
        parts = [th.empty_like(rows, memory_format=th.contiguous_format) for _ in range(self.size)]
        with _together():
            dist.all_gather(parts, rows.contiguous())
        return th.cat(parts)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace gradients by their mean over the processes, in place.

        :param parameters: those without a gradient here must have none elsewhere
        """
        if self.size == 1:
            return
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        flat = th.cat([gradient.flatten() for gradient in gradients])
        with _together():
            dist.all_reduce(flat)
        flat /= self.size
        start = 0
        for gradient in gradients:
            gradient.copy_(flat[start : start + gradient.numel()].view(gradient.shape))
            start += gradient.numel()

    def wait(self) -> None:
        """Go on when all processes are here."""
        if self.size > 1:
            self.gather(th.zeros(1, device=_device_of_backend()))

    def require_equal(self, n_updates: int) -> None:
        """Refuse to go on from different positions.

        :param n_updates: of this process
        :raises ValueError: if another process is elsewhere
        """
        if self.size == 1:
            return
        positions = self.gather(th.tensor([n_updates], device=_device_of_backend())).tolist()
        if len(set(positions)) > 1:
            raise ValueError(
                f"the processes would go on from different checkpoints, of {positions} updates; put the output where "
                "all of them see the same files"
            )

    def require_independent_rows(self, module: nn.Module, observations: th.Tensor) -> None:
        """Refuse an encoder that cannot be divided: one row's embedding depends on the other rows, or on chance.

        :param module: an objective
        :param observations: some, float (n, channels, height, width) in 0..1, n at least 4
        :raises ValueError: naming the network
        """
        # Of each brightness, since statistics of observations may all be the same.
        observations = observations * th.linspace(0.1, 1.0, len(observations))[:, None, None, None].to(observations)
        for part in module.modules() if self.size > 1 else ():
            if not isinstance(part, Encoder):
                continue
            # A copy, since some networks count what they have seen.
            encoder = copy.deepcopy(part).train()
            with th.no_grad(), th.random.fork_rng():
                whole = encoder(observations)
                halves = th.cat([encoder(half) for half in observations.chunk(2)])
            scale = float(whole.abs().max())
            if not th.allclose(whole, halves, rtol=_TOLERANCE, atol=_TOLERANCE * scale):
                raise ValueError(
                    f"{self.size} processes cannot share the network {encoder.spec()['name']}: what it makes of an "
                    "observation while it learns depends on the rest of the batch, or on chance (batch normalization, "
                    "dropout); pretrain it in one process, or take another network"
                )


# The loss is the same in each process, so the gradients of what is whole are, too. Those of shares are `size` times as
# large, since the gradients of weights are averaged, of which each process then has its share's alone.


class _Take(th.autograd.Function):
    """This process's share of rows that all have."""

    @staticmethod
    def forward(ctx: Any, rows: th.Tensor, ranks: Ranks) -> th.Tensor:
        ctx.ranks = ranks
        return rows.chunk(ranks.size)[ranks.rank]

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, None]:
        return ctx.ranks.gather(gradient) / ctx.ranks.size, None


class _Gather(th.autograd.Function):
    """All rows, from each process's share."""

    @staticmethod
    def forward(ctx: Any, rows: th.Tensor, ranks: Ranks) -> th.Tensor:
        ctx.ranks = ranks
        return ranks.gather(rows)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, None]:
        return ctx.ranks.size * gradient.chunk(ctx.ranks.size)[ctx.ranks.rank], None


@contextlib.contextmanager
def processes(device: str) -> Iterator[Ranks]:
    """This process among those of ``torchrun``, for the duration of a ``with`` block; else the only one.

    :param device: as in Stable-Baselines3
    :raises ValueError: for more processes than GPUs, or a GPU by number
    """
    if not dist.is_available() or not (dist.is_initialized() or dist.is_torchelastic_launched()):
        yield Ranks()
        return
    if dist.is_initialized():
        yield Ranks(dist.get_rank(), dist.get_world_size())
        return
    on_gpu = device != "cpu" and th.cuda.is_available()
    if on_gpu:
        th.cuda.set_device(_own_gpu(device))
    with _stops_at_sigterm():
        dist.init_process_group("nccl" if on_gpu else "gloo", timeout=TIMEOUT)
        try:
            yield Ranks(dist.get_rank(), dist.get_world_size())
        finally:
            dist.destroy_process_group()


def _own_gpu(device: str) -> int:
    if ":" in device:
        raise ValueError(f"each process takes a GPU of its own, got --device {device}; give cuda or auto")
    number, there = int(os.environ["LOCAL_RANK"]), th.cuda.device_count()
    if number >= there:
        raise ValueError(f"process {number} has no GPU of its own among {there}; start fewer, or give --device cpu")
    return number


def _device_of_backend() -> str:
    return "cuda" if dist.get_backend() == "nccl" else "cpu"


@contextlib.contextmanager
def _together() -> Iterator[None]:
    """What the processes do together, which fails if one of them has ended."""
    try:
        yield
    except RuntimeError as error:
        raise ConnectionError(
            f"the processes of this run have lost each other ({str(error).splitlines()[0][:200]}); start the same "
            "command again, and it goes on from the last checkpoint"
        ) from error


@contextlib.contextmanager
def _stops_at_sigterm() -> Iterator[None]:
    """``torchrun`` ends the other processes so when one has died: as Ctrl-C, which says what to do."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
