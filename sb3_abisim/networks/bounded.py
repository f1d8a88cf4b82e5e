"""Networks that a file describes are built only if the file can fill them."""

import math
from typing import Any

import torch as th
from torch.overrides import TorchFunctionMode

# Networks are built more than once (the encoder's, then with the file's weights), and have buffers of their own.
_N_COPIES, _ROOM_BYTES, _LEAST_BYTES = 16, 64 << 20, 1024
_FACTORIES = {th.empty, th.zeros, th.ones, th.rand, th.randn, th.full}


class BoundedTensors(TorchFunctionMode):
    """A ``with`` block in which more tensors than a file has weights for are refused before they are made.

    :param n_bytes: size of the file
    """

    def __init__(self, n_bytes: int) -> None:
        super().__init__()
        self._left = _N_COPIES * n_bytes + _ROOM_BYTES

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Count, then call.

        :raises ValueError: for a tensor that is too large
        """
        if func in _FACTORIES:
            sizes = args[0] if args and isinstance(args[0], list | tuple) else args
            sizes = (kwargs or {}).get("size", sizes)
            self._left -= max(4 * math.prod(int(size) for size in sizes), _LEAST_BYTES)
            if self._left < 0:
                raise ValueError("it asks for larger networks than the file has weights for")
        return func(*args, **(kwargs or {}))
