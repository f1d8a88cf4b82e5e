"""Let torch reuse memory on Linux, instead of asking the system for it again in every step."""

import ctypes
import sys

# From glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
_INT_MAX = 2**31 - 1


def keep_freed_memory() -> bool:
    """Make glibc keep what the process has freed; costs some resident memory, changes no result.

    A minibatch of observations takes tens of megabytes at every layer. By default, glibc gives blocks of that size back
    to the system when they are freed, and every new one is mapped and zeroed page by page when it is first written
    to, which can take longer than the arithmetic on it. The effect is that of the environment variables
    ``MALLOC_MMAP_MAX_=0`` and ``MALLOC_TRIM_THRESHOLD_=2147483647``.

    :return: whether it was possible; False without glibc
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # another C library
        return False
    return bool(mallopt(_M_MMAP_MAX, 0)) and bool(mallopt(_M_TRIM_THRESHOLD, _INT_MAX))
