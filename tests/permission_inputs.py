"""Permission bits that hold for root as well, as they do for everybody else."""

import contextlib
import ctypes
import functools
import os
from collections.abc import Iterator

import pytest

# linux/capability.h: CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH of the effective set.
_VERSION, _PASSES = 0x20080522, 0b110


@contextlib.contextmanager
def permission_bits_hold() -> Iterator[None]:
    """Within it, what may not be read or written by its bits cannot be."""
    with pytest.MonkeyPatch.context() as patch:
        if os.geteuid() == 0:
            # Otherwise it asks for the real user, who keeps the right to take everything back.
            patch.setattr(os, "access", functools.partial(os.access, effective_ids=True))
        system, header, sets = ctypes.CDLL(None), (ctypes.c_uint32 * 2)(_VERSION, 0), (ctypes.c_uint32 * 6)()
        if system.capget(header, sets):
            pytest.skip("the system has no capabilities")
        before = sets[0]
        sets[0] = before & ~_PASSES
        system.capset(header, sets)
        try:
            yield
        finally:
            sets[0] = before
            system.capset(header, sets)
