"""How large the objects of a pickle are, found out without opening it.

A few bytes of a pickle can stand for a tuple of two tuples of two tuples, and so on: whoever goes through all of it, or
takes it for a key of a dictionary, is at it for years.
"""

import pickletools
from typing import Any

MAX_PARTS = 1_000_000
_MUTATES = frozenset(("APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD"))
_SILENT = frozenset(("PROTO", "FRAME", "STOP"))
# A mark on the stack; compared by identity.
_MARK: list[Any] = []


def check_pickle_size(data: bytes) -> None:
    """Refuse a pickle whose objects have too many parts, each counted as often as it is reached.

    :param data: the pickle, of which nothing is executed
    :raises ValueError: for more than ``MAX_PARTS``, objects that hold themselves, and what is no pickle
    """
    try:
        sizes: dict[int, int] = {}
        # They are kept, so that no two have the same id.
        nodes = _nodes(data)
        largest = max((_size(node, sizes) for node in nodes), default=0)
    except (ValueError, IndexError, KeyError, RecursionError) as error:
        raise ValueError(f"a pickle is damaged ({type(error).__name__}: {error})") from error
    if largest > MAX_PARTS:
        raise ValueError(f"a pickle holds more than {MAX_PARTS} parts, or itself")


def _nodes(data: bytes) -> list[list[Any]]:
    """All objects of a pickle, each the list of those that it is made of."""
    stack: list[list[Any]] = []
    memo: dict[int, list[Any]] = {}
    nodes: list[list[Any]] = []
    for operation, argument, _ in pickletools.genops(data):
        name, before = operation.name, operation.stack_before
        if name in _SILENT:
            continue
        if name == "MARK":
            stack.append(_MARK)
        elif name == "MEMOIZE" or name.endswith("PUT"):
            memo[len(memo) if name == "MEMOIZE" else int(argument or 0)] = stack[-1]
        elif name.endswith("GET"):
            stack.append(memo[int(argument or 0)])
        elif name == "DUP":
            stack.append(stack[-1])
        else:
            taken: list[list[Any]] = []
            n_below = len(before)
            if pickletools.markobject in before:
                while (part := stack.pop()) is not _MARK:
                    taken.append(part)
                n_below = before.index(pickletools.markobject)
            below = [stack.pop() for _ in range(n_below)]
            if name in _MUTATES:
                below[-1].extend(taken + below[:-1])
                stack.append(below[-1])
            elif operation.stack_after:
                nodes.append(taken + below)
                stack.append(nodes[-1])
    return nodes


def _size(node: list[Any], sizes: dict[int, int]) -> int:
    if id(node) not in sizes:
        sizes[id(node)] = MAX_PARTS + 1  # one that holds itself is without end
        sizes[id(node)] = min(1 + sum(_size(part, sizes) for part in node), MAX_PARTS + 1)
    return sizes[id(node)]
