"""Freed memory is kept: large tensors reuse it."""

import platform
import subprocess
import sys

import pytest

from sb3_abisim.common.malloc import keep_freed_memory

COUNT_FAULTS = """
import resource
import torch as th
from sb3_abisim.common.malloc import keep_freed_memory
if {keep}:
    assert keep_freed_memory()
def fill():
    # 80 MB each, more than glibc keeps by itself; freed together, the end of the heap among them.
    a = th.ones(20_000_000)
    b = a + 1
    c = b * 2
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(15):
    fill()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(keep: bool) -> int:
    command = [sys.executable, "-c", COUNT_FAULTS.format(keep=keep)]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_large_tensors_reuse_memory() -> None:
    # Not none: at first, small blocks come to lie in the hole that a large one has left, which is then too small.
    assert 0 < faults(keep=True) < 0.5 * faults(keep=False)


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_other_systems_are_left_alone(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", system)
    assert not keep_freed_memory()


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr("ctypes.CDLL", lambda name: object())
    assert not keep_freed_memory()
