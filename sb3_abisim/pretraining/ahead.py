"""The next batch is made while the present one is learned from, where that is faster."""

import os
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch as th

T = TypeVar("T")


def make_ahead(items: Iterator[T]) -> Generator[T, None, None]:
    """The same items in the same order, each made by a thread while the one before it is worked on.

    NumPy and PyTorch let other threads run while they copy and compute. Close what comes back, or the thread stays.

    :param items: none of them None; what it reads must bear a second thread
    """
    with ThreadPoolExecutor(1, "batches") as pool:
        coming = pool.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = pool.submit(next, items, None)
            yield item


def gains_from_ahead(device: th.device, n_processes: int) -> bool:
    """Whether batches made ahead make training faster: there is a core that the networks leave free.

    With networks on one thread of two cores, updates on point mazes were 1.1 to 1.2 times as fast; with networks on
    both, they were slower (benchmarks/bench_ahead.py). On a GPU nobody has measured it; there, networks leave all free.

    :param device: of the networks
    :param n_processes: that pretrain together
    """
    n_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return device.type != "cpu" or (th.get_num_threads() == 1 and n_cores > n_processes)
