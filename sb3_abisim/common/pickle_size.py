"""How large the objects of a pickle are and what it calls, found out without opening it.

A few bytes of a pickle can stand for a tuple of two tuples of two tuples, and so on: whoever goes through all of it, or
takes it for a key of a dictionary, is at it for years. And a class that may be named can be called with any arguments,
such as the shape of a space that fills the memory, although nobody writes a pickle that does.
"""

import pickletools
from collections.abc import Container
from typing import Any

MAX_PARTS = 1_000_000
_MUTATES = frozenset(("APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD"))
_SILENT = frozenset(("PROTO", "FRAME", "STOP"))
# A mark on the stack; compared by identity.
_MARK: list[Any] = []


def check_pickle_size(data: bytes, may_call: Container[str] | None = None) -> None:
    """Refuse a pickle whose objects have too many parts, each counted as often as it is reached, or that calls others.

    :param data: the pickle, of which nothing is executed
    :param may_call: functions, as ``module.name``; None for any
    :raises ValueError: for more than ``MAX_PARTS``, objects that hold themselves, a call of something else, and what is
        no pickle
    """
    try:
        sizes: dict[int, int] = {}
        # They are kept, so that no two have the same id.
        nodes, called = _nodes(data)
        largest = max((_size(node, sizes) for node in nodes), default=0)
    except (ValueError, IndexError, KeyError, RecursionError) as error:
        raise ValueError(f"a pickle is damaged ({type(error).__name__}: {error})") from error
    if largest > MAX_PARTS:
        raise ValueError(f"a pickle holds more than {MAX_PARTS} parts, or itself")
    others = [name for name in called if may_call is not None and name not in may_call]
    if others:
        raise ValueError(f"a pickle calls {others[0]}, which is not among what is called here")


def _nodes(data: bytes) -> tuple[list[list[Any]], list[str]]:
    """All objects of a pickle, each the list of those that it is made of, and the names of what it calls."""
    stack: list[list[Any]] = []
    memo: dict[int, list[Any]] = {}
    nodes: list[list[Any]] = []
    texts: dict[int, str] = {}
    called: list[str] = []
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
            if name == "REDUCE":
                called.append(texts.get(id(below[1]), "what it has made"))
            elif name in ("INST", "OBJ"):
                called.append(str(argument).replace(" ", ".") if name == "INST" else "what it has named")
            if name in _MUTATES:
                below[-1].extend(taken + below[:-1])
                stack.append(below[-1])
            elif operation.stack_after:
                nodes.append(taken + below)
                stack.append(nodes[-1])
                if name == "STACK_GLOBAL":
                    texts[id(nodes[-1])] = ".".join(texts.get(id(part), "?") for part in reversed(below))
                elif isinstance(argument, str):
                    texts[id(nodes[-1])] = argument.replace(" ", ".") if name == "GLOBAL" else argument
    return nodes, called


def _size(node: list[Any], sizes: dict[int, int]) -> int:
    if id(node) not in sizes:
        sizes[id(node)] = MAX_PARTS + 1  # one that holds itself is without end
        sizes[id(node)] = min(1 + sum(_size(part, sizes) for part in node), MAX_PARTS + 1)
    return sizes[id(node)]
