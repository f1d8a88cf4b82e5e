"""Run by test_collect.py as a child process: ``kill_everywhere.py WORK FIRST THEN STRIDE``.

Collects FIRST transitions (none for 0), then THEN, and kills that second collection right before a system call that
changes the folder: the first such call, the one STRIDE later, and so on, each time in a new folder. After each kill it
collects again and compares every byte with a collection that was left alone. Prints what went wrong and the number of
kills. It forks, which needs a process with one thread.
"""

import os
import shutil
import signal
import sys
from collections.abc import Callable
from typing import Any

import tqdm  # noqa: F401  here once instead of in every child
from dataset_inputs import tree

from sb3_abisim.data import chains
from sb3_abisim.data.collect import collect

CALLS = ("fsync", "replace", "unlink", "posix_fallocate", "mkdir", "ftruncate")


def run(folder: str, n: int, kill_at: int | None = None) -> int:
    """Collect in a child that is killed before its ``kill_at``-th call; its exit code."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    n_calls = 0

    def counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            nonlocal n_calls
            n_calls += 1
            if n_calls == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
            # A kill does not lose what the kernel has; leaving fsync out makes this ten times faster.
            return None if name == "fsync" else function(*args, **kwargs)

        return wrapper

    for name in CALLS:
        setattr(os, name, counted(name, getattr(os, name)))
    try:
        collect("IndexEnv-v0", n, folder, n_envs=4, seed=3)
    except BaseException as error:
        print(f"raised {error!r} after {n_calls} calls", flush=True)
        os._exit(1)
    os._exit(0)


def main(work: str, first: int, then: int, stride: int) -> None:
    chains.SHARD_TRANSITIONS = 48
    reference, folder = os.path.join(work, "reference"), os.path.join(work, "killed")
    assert run(reference, then) == 0
    expected = tree(reference)
    kills = 0
    while True:
        shutil.rmtree(folder, ignore_errors=True)
        if first and run(folder, first) != 0:
            sys.exit("the first collection failed")
        status = run(folder, then, kills * stride + 1)
        if status == 0:
            break
        if status != -signal.SIGKILL:
            sys.exit(f"status {status}")
        kills += 1
        if kills % 5 == 0:
            run(folder, then, 7)
        if run(folder, then) != 0 or tree(folder) != expected:
            print("differs after a kill before call", (kills - 1) * stride + 1)
    print("kills", kills)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
