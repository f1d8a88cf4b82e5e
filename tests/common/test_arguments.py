"""Arguments against annotations: what fits, and the message where something does not."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from sb3_abisim.common.arguments import checked_arguments


class Thing:
    @checked_arguments
    def __init__(
        self,
        count: int = 1,
        share: float = 0.5,
        path: str | os.PathLike[str] | None = None,
        names: Sequence[str] | None = None,
        more: dict[str, Any] | None = None,
        flag: bool = False,
        way: Literal["a", "b"] = "a",
        anything: Any = None,
    ) -> None:
        self.given = (count, share, path, names, more, flag, way, anything)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"count": np.int8(3)}, {"share": 2}, {"share": np.float32(2)}, {"path": Path("x")}, {"names": ("a", "b")},
        {"names": []}, {"more": {"a": object()}}, {"flag": np.True_}, {"way": "b"}, {"anything": object()},
    ],
    ids=lambda kwargs: "-".join(kwargs) if isinstance(kwargs, dict) else None,
)  # fmt: skip
def test_takes_what_fits(kwargs):
    (value,) = kwargs.values()
    assert any(each is value for each in Thing(**kwargs).given)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"count": True}, "count must be a whole number, got True"),
        ({"count": 2.0}, r"count must be a whole number, got 2\.0"),
        ({"share": "0.5"}, "share must be a number, got '0.5'"),
        ({"share": np.array([1.0, 2.0])}, "share must be a number, got array"),
        ({"path": 3}, "path must be a text, a path or None, got 3"),
        ({"names": "ab"}, r"names must be a list \(a text each\) or None, got 'ab'"),
        ({"names": ["a", 1]}, "names must be a list"),
        ({"more": {1: 2}}, "more must be a mapping or None"),
        ({"flag": "no"}, "flag must be True or False, got 'no'"),
        ({"way": "c"}, "way must be 'a' or 'b', got 'c'"),
        ({"color": 1}, "Thing takes no argument 'color'; it takes count, share, path"),
        ({"path": ["x" * 999]}, r"got \['x{10,200}\.\.\."),
    ],
    ids=lambda kwargs: "-".join(kwargs) if isinstance(kwargs, dict) else None,
)
def test_names_what_does_not_fit(kwargs, message):
    with pytest.raises(ValueError, match=message):
        Thing(**kwargs)


def test_functions_and_missing_arguments():
    @checked_arguments
    def area(width: float, height: float, **rest: Any) -> float:
        return width * height

    assert area(2, height=3, other="x") == 6
    with pytest.raises(ValueError, match="area: missing a required argument: 'height'"):
        area(2)
    with pytest.raises(ValueError, match="width must be a number, got '2'"):
        area("2", 3)
    assert area.__name__ == "area" and area.__annotations__["width"] is float
