"""What pickles hold is counted without opening them."""

import base64
import collections
import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_abisim.common.pickle_size import check_pickle_size
from sb3_abisim.zoo.models import read_weights
from sb3_abisim.zoo.saved_spaces import read_space, read_vec_normalize


def key_of_tuples(depth: int) -> bytes:
    """A dictionary whose key is a tuple of two tuples of two tuples, and so on; hashing it takes 2**depth steps."""
    doubled = b"".join(b"h" + bytes([k]) + b"\x86q" + bytes([k + 1]) for k in range(depth))
    return b"\x80\x02}Nq\x00" + doubled + b"K\x01s."


def lists_of_lists(depth: int) -> Any:
    value: list[Any] = []
    for _ in range(depth):
        value = [value, value]
    return value


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_what_is_saved_usually_passes(protocol: int) -> None:
    space = gym.spaces.Dict(a=gym.spaces.Box(0, 255, (3, 64, 64), np.uint8), b=gym.spaces.Discrete(3))
    space.seed(0)
    state = collections.OrderedDict((f"w{k}", np.zeros((k, 3))) for k in range(200))
    for value in (space, state, [(1, 2.5, "text", None, True, b"x")] * 3, {1, frozenset((2,))}, 10**30, {}):
        check_pickle_size(pickle.dumps(value, protocol))
    file = io.BytesIO()
    th.save({"policy": {f"w{k}": th.zeros(3) for k in range(100)}, "optimizer": {"state": {0: {"step": 1}}}}, file)
    with zipfile.ZipFile(file) as archive:
        check_pickle_size(archive.read(next(name for name in archive.namelist() if name.endswith("data.pkl"))))


def test_few_bytes_that_stand_for_much_are_refused() -> None:
    check_pickle_size(key_of_tuples(15))
    itself: list[Any] = []
    itself.append(itself)
    dictionary: dict[int, Any] = {}
    for _ in range(40):
        dictionary = {0: dictionary, 1: dictionary}
    for data in (key_of_tuples(60), *(pickle.dumps(v) for v in (lists_of_lists(40), itself, dictionary))):
        assert len(data) < 2000
        with pytest.raises(ValueError, match="holds more than 1000000 parts, or itself"):
            check_pickle_size(data)


@pytest.mark.parametrize("data", [b"", b"\x80\x02", b"\x80\x02}s.", b"h\x05.", b"\x80\x02\x86.", b"nonsense", b"t."])
def test_damaged_ones_are_one_sentence(data: bytes) -> None:
    with pytest.raises(ValueError, match="a pickle is damaged"):
        check_pickle_size(data)


def test_readers_of_saved_models_count_first(tmp_path: Path) -> None:
    """Each would hash the key for years."""
    hanging = key_of_tuples(60)
    with pytest.raises(ValueError, match="holds more than 1000000 parts"):
        read_space({":serialized:": base64.b64encode(hanging).decode()})
    (tmp_path / "vecnormalize.pkl").write_bytes(hanging)
    with pytest.raises(ValueError, match=r"vecnormalize\.pkl .*holds more than 1000000 parts"):
        read_vec_normalize(tmp_path / "vecnormalize.pkl")
    weights = io.BytesIO()
    with zipfile.ZipFile(weights, "w") as inner:
        inner.writestr("policy/data.pkl", hanging)
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
        archive.writestr("data", "{}")
        archive.writestr("policy.pth", weights.getvalue())
    with pytest.raises(ValueError, match=r"model\.zip .*holds more than 1000000 parts"):
        read_weights(tmp_path / "model.zip")


class Calls:
    """What its pickle does instead of being filled."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize("protocol", (2, 4))
@pytest.mark.parametrize(
    "what",
    [
        Calls(gym.spaces.Box, 0, 1, (2, 2)),
        Calls(gym.spaces.MultiBinary, 3),
        Calls(np.random.SeedSequence, 1),
    ],
)
def test_classes_of_spaces_are_never_called(what: Calls, protocol: int) -> None:
    """With the shape of a whole memory it would be filled."""
    with pytest.raises(ValueError, match=r"a pickle calls (gymnasium|numpy)\..*(Box|MultiBinary|SeedSequence)"):
        read_space({":serialized:": base64.b64encode(pickle.dumps(what, protocol)).decode()})


def test_calls_of_old_protocols_are_refused_where_calls_are_listed() -> None:
    for data in (b"(I1\nicollections\nOrderedDict\n.", b"(ccollections\nOrderedDict\no."):
        check_pickle_size(data)
        with pytest.raises(ValueError, match="a pickle calls"):
            check_pickle_size(data, {"numpy.dtype"})


@pytest.mark.parametrize("seeded", [False, True])
def test_spaces_that_are_whole_are_read(seeded: bool) -> None:
    parts = {
        "box": gym.spaces.Box(-1, 1, (2,)),
        "n": gym.spaces.Discrete(3, start=2),
        "m": gym.spaces.MultiDiscrete([2, 3]),
    }
    space = gym.spaces.Dict({**parts, "b": gym.spaces.MultiBinary(4)})
    if seeded:
        space.seed(3)
        space.sample()
    for protocol in (3, 4, 5):
        found = read_space({":serialized:": base64.b64encode(pickle.dumps(space, protocol)).decode()})
        assert found == space
