"""Episodes as NumPy arrays: which layouts are read, and that what a file declares is not believed."""

import io
import pickle
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import index_env  # noqa: F401  (registers ids)
import numpy as np
import pytest

from sb3_abisim import CUT, TERMINATED, TRUNCATED, TransitionDataset, import_dataset
from sb3_abisim.data.command import main
from sb3_abisim.data.format import INSIDE
from sb3_abisim.data.readers import arrays as reader_module
from sb3_abisim.data.readers.arrays import import_arrays

SHAPE = (3, 4, 5)


def frames(n: int, seed: int = 0, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    return np.random.default_rng(seed).integers(256, size=(n, *shape), dtype=np.uint8)


def episode(n: int = 3, seed: int = 0, **changes: Any) -> dict[str, Any]:
    arrays = {"observations": frames(n + 1, seed), "actions": (np.arange(n) + seed) % 3, "terminations": True}
    return {name: array for name, array in (arrays | changes).items() if array is not None}


def read(source: Any, folder: Path, **options: Any) -> TransitionDataset:
    import_dataset("arrays", source, folder, verbose=0, **options)
    return TransitionDataset(folder, eval_fraction=0.0)


def everything(dataset: TransitionDataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    index = np.arange(dataset.n_frames)
    return dataset.frames(index), dataset.actions(index), dataset.ends


def save_folder(folder: Path, arrays: dict[str, Any]) -> Path:
    folder.mkdir()
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    return folder


def test_one_episode_from_every_kind_of_source(tmp_path: Path) -> None:
    one = episode()
    np.savez(tmp_path / "plain.npz", **one)
    np.savez_compressed(tmp_path / "packed.npz", **one)
    sources = [tmp_path / "plain.npz", str(tmp_path / "packed.npz"), one, [one]]
    sources.append(save_folder(tmp_path / "folder", one))
    for i, source in enumerate(sources):
        shown, actions, ends = everything(read(source, tmp_path / str(i)))
        assert np.array_equal(shown, one["observations"])
        assert actions.tolist() == [0, 1, 2, 0] and ends.tolist() == [INSIDE] * 3 + [TERMINATED]


def test_the_ids_and_the_source_are_recorded(tmp_path: Path) -> None:
    np.savez(tmp_path / "walks.npz", **episode(rewards=np.zeros(3)))
    dataset = read(tmp_path / "walks.npz", tmp_path / "d")
    assert dataset.env_id == "walks" and dataset.meta["source"]["left_out"] == ["rewards"]
    assert read(tmp_path / "walks.npz", tmp_path / "named", env_id="Else-v0").env_id == "Else-v0"


def test_several_episodes_in_one_file_by_flags(tmp_path: Path) -> None:
    """Steps 2 and 4 end by themselves, 5 by a time limit, and 7 does not end."""
    actions = np.arange(7) % 3
    terminations, truncations = np.zeros((2, 7), bool)
    terminations[[1, 3]], truncations[4] = True, True
    shown = frames(7 + 4)
    source = {"observations": shown, "actions": actions, "terminations": terminations, "truncations": truncations}
    dataset = read(source, tmp_path / "d")
    stored, kept, ends = everything(dataset)
    assert np.array_equal(stored, shown)
    assert ends.tolist() == [0, 0, TERMINATED, 0, 0, TERMINATED, 0, TRUNCATED, 0, 0, CUT]
    assert kept[ends == INSIDE].tolist() == actions.tolist()


def test_several_episodes_in_one_file_by_their_ends(tmp_path: Path) -> None:
    flags = np.array([0, 0, 1, 0, 0])
    source = {"observations": frames(8), "actions": np.arange(5) % 2, "episode_ends": [1, 3, 5], "terminations": flags}
    dataset = read(source, tmp_path / "d")
    assert dataset.ends.tolist() == [0, CUT, 0, 0, TERMINATED, 0, 0, CUT]


def test_a_folder_of_files_keeps_the_order_of_names(tmp_path: Path) -> None:
    (tmp_path / "many").mkdir()
    for seed, name in ((2, "b"), (1, "a"), (3, "c")):
        np.savez(
            tmp_path / "many" / f"{name}.npz", **episode(seed, seed, truncations=seed == 2, terminations=seed == 3)
        )
    shown, _, ends = everything(read(tmp_path / "many", tmp_path / "d"))
    assert np.array_equal(shown, np.concatenate([frames(seed + 1, seed) for seed in (1, 2, 3)]))
    assert ends[ends != INSIDE].tolist() == [CUT, TRUNCATED, TERMINATED]


@pytest.mark.parametrize(("shape", "channels"), [((4, 5, 3), "last"), ((4, 5), "none"), (SHAPE, "first")])
def test_where_the_channels_are(shape: tuple[int, ...], channels: str, tmp_path: Path) -> None:
    shown = frames(4, shape=shape)
    dataset = read(episode(observations=shown), tmp_path / "d")
    stored = dataset.frames([2])[0]
    n_channels = 1 if channels == "none" else 3
    assert dataset.observation_space.shape == stored.shape == (n_channels, 4, 5)
    assert dataset.meta["source"]["channels"] == channels
    for c, y, x in ((0, 1, 2), (n_channels - 1, 3, 4)):
        place = {"last": (2, y, x, c), "none": (2, y, x), "first": (2, c, y, x)}[channels]
        assert stored[c, y, x] == shown[place]


def test_a_dict_of_observations_gives_factors(tmp_path: Path) -> None:
    observations = {"camera": frames(4, 1), "arm.angle": np.arange(8.0).reshape(4, 2), "word": np.array(list("abcd"))}
    source = episode(observations=observations, factor_goal=np.arange(4, dtype=np.int32))
    dataset = read(source, tmp_path / "d")
    assert np.array_equal(dataset.frames(np.arange(4)), frames(4, 1))
    factors = dataset.factors(np.arange(4))
    assert np.array_equal(factors["arm_angle"], observations["arm.angle"])
    assert factors["goal"].tolist() == [0, 1, 2, 3] and factors["goal"].dtype == np.int32
    assert dataset.meta["source"]["left_out"] == ["observations 'word'"]
    two = episode(observations={"left": frames(4, 1), "right": frames(4, 2)})
    with pytest.raises(ValueError, match=r"2 images .left, right.*--image-key"):
        read(two, tmp_path / "two")
    dataset = read(two, tmp_path / "right", image_key="right")
    assert np.array_equal(dataset.frames(np.arange(4)), frames(4, 2))


@pytest.mark.parametrize(
    ("actions", "space"),
    [
        (np.array([0, 4, 1]), gym.spaces.Discrete(5)),
        (np.array([[0], [4], [1]], np.uint8), gym.spaces.Discrete(5)),
        (np.array([True, False, True]), gym.spaces.Discrete(2)),
        (np.array([[0, 2], [1, 0], [0, 0]]), gym.spaces.MultiDiscrete([2, 3])),
        (np.array([[0, 1], [1, 0], [0, 0]], bool), gym.spaces.MultiBinary((2,))),
        (np.array([[-1, 2], [3, 0], [0, 0.5]], np.float32), gym.spaces.Box(np.float32([-1, 0]), np.float32([3, 2]))),
        (np.array([[-1.0], [3.0], [0.5]]), gym.spaces.Box(-1.0, 3.0, (1,), np.float64)),
        (np.array([-1, 3, 0.5], np.float16), gym.spaces.Box(-1, 3, (), np.float32)),
        (np.array([[-1.0], [3.0], [0.5]], ">f4"), gym.spaces.Box(-1, 3, (1,), np.float32)),
    ],
)
def test_the_smallest_action_space(actions: np.ndarray, space: gym.Space, tmp_path: Path) -> None:
    dataset = read([episode(), episode(actions=actions)][1:], tmp_path / "d")
    assert dataset.action_space == space and dataset.action_space.dtype == space.dtype
    assert np.array_equal(dataset.actions([0, 1, 2]).reshape(-1), actions.reshape(-1))
    assert dataset.meta["source"]["action_space_from_data"] is True


def test_bounds_follow_from_all_episodes(tmp_path: Path) -> None:
    source = [episode(actions=np.float32([[0, 1]] * 3)), episode(actions=np.float32([[-2, 0.5]] * 3))]
    space = read(source, tmp_path / "d").action_space
    assert (space.low.tolist(), space.high.tolist()) == ([-2, 0.5], [0, 1])


def test_a_registered_id_or_a_space_gives_the_action_space(tmp_path: Path) -> None:
    actions = np.array([[0.0, 3.0], [1.0, 2.0], [-0.5, 2.5]])
    dataset = read(episode(actions=actions), tmp_path / "a", env_id="PlainEnv-v0")
    assert dataset.action_space == gym.make("PlainEnv-v0").action_space
    assert np.array_equal(dataset.actions([0, 1, 2]), actions) and dataset.actions([0]).dtype == np.float32
    assert dataset.meta["source"]["action_space_from_data"] is False
    space = gym.spaces.Discrete(9, start=-4)
    assert read(episode(actions=np.array([-1, 0, 2])), tmp_path / "b", action_space=space).action_space == space
    with pytest.raises(ValueError, match="not in the action space"):
        read(episode(actions=actions + 10), tmp_path / "c", env_id="PlainEnv-v0")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": frames(3)}, r"observations of shape \(3, 3, 4, 5\) for 3 actions in 1 episodes; it needs 4"),
        ({"observations": frames(5)}, "it needs 4, the last one of each episode included"),
        ({"observations": frames(4) / 255}, "only uint8 images"),
        ({"observations": frames(4, shape=(9, 3, 9))}, "neither channels first nor channels last"),
        ({"observations": None}, "has no observations, only actions, terminations"),
        ({"actions": None}, "has no actions"),
        ({"actions": np.zeros(0)}, "no actions"),
        ({"actions": np.array([0, -1, 1])}, "from -1, not from 0 on; name the environment"),
        ({"actions": np.array([0, np.nan, 1])}, "finite numbers"),
        ({"actions": np.array(["a", "b", "c"])}, "finite numbers"),
        ({"terminations": np.array([0, 1])}, "needs a 0 or 1 for each of 3"),
        ({"terminations": np.array([0, 1, 2])}, "needs a 0 or 1 for each of 3"),
        ({"terminations": np.array([0, 1, 0])}, "in 2 episodes; it needs 5"),
        ({"episode_ends": [2, 3], "terminations": [1, 0, 0]}, "name every step with a termination"),
        ({"episode_ends": [2, 2, 3]}, "must ascend up to that"),
        ({"episode_ends": [0, 3]}, "must ascend up to that"),
        ({"episode_ends": [2], "terminations": None}, "must ascend up to that"),
        ({"episode_ends": [2.0, 3.0]}, "give whole numbers"),
        ({"factor_x": np.zeros(3)}, r"factor|x of shape \(3,\) for 3 actions"),
        ({"factor_x": np.array(list("abcd"))}, "must hold numbers"),
    ],
)
def test_what_does_not_fit_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        read(episode(**changes), tmp_path / "d")
    assert not (tmp_path / "d" / "meta.json").exists()


def test_episodes_that_differ_are_named(tmp_path: Path) -> None:
    other = episode(observations=frames(4, shape=(3, 5, 4)))
    with pytest.raises(ValueError, match=r"episode 1: observations are \(3, 5, 4\)"):
        read([episode(), other], tmp_path / "a")
    with pytest.raises(ValueError, match="episode 1 has observations of float64; convert them to uint8"):
        read([episode(), episode(observations=frames(4) / 255)], tmp_path / "floats")
    with pytest.raises(ValueError, match=r"episode 1: .* dict in some episodes"):
        read([episode(), episode(observations={"camera": frames(4)})], tmp_path / "b")
    with pytest.raises(ValueError, match=r"actions of int64 \(\) and of float64 \(2,\)"):
        read([episode(), episode(actions=np.zeros((3, 2)))], tmp_path / "c")


def npz(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def npy(array: np.ndarray, **changes: Any) -> bytes:
    """An .npy file, with another header where ``changes`` say so."""
    file = io.BytesIO()
    header = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape}
    np.lib.format.write_array_header_1_0(file, header | changes)
    return file.getvalue() + array.tobytes()


# NumPy reads headers as Python, whose tokenizer raises an error of its own.
UNENDING = b"\x93NUMPY\x01\x00\x40\x00" + b"(" * 60


@pytest.mark.parametrize("kind", ["npz", "folder"])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npy(frames(4), shape=(10**12, *SHAPE)), r"declares uint8 \(1000000000000, 3, 4, 5\), .* bytes, and has"),
        (npy(frames(4), shape=(3, *SHAPE)), "declares"),
        (npy(frames(4))[:-1], "declares"),
        (npy(np.zeros(3), descr="|O"), "holds Python objects"),
        (b"no array", "no array of NumPy's"),
        (pickle.dumps(frames(4)), "no array of NumPy's"),
        (UNENDING, "no array of NumPy's"),
    ],
    ids=["a terabyte", "too short", "cut off", "objects", "text", "pickle", "brackets"],
)
def test_what_a_header_declares_is_not_believed(kind: str, content: bytes, message: str, tmp_path: Path) -> None:
    members = {"observations": content, "actions": npy(np.arange(3))}
    if kind == "npz":
        source = npz(tmp_path / "forged.npz", members)
    else:
        source = tmp_path / "folder"
        source.mkdir()
        for name, part in members.items():
            (source / f"{name}.npy").write_bytes(part)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=message):
            import_arrays(source, tmp_path / "d")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2**24 and not (tmp_path / "d").exists()


def test_what_an_archive_declares_is_not_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez(tmp_path / "a.npz", **episode())
    content = (tmp_path / "a.npz").read_bytes()
    true = len(npy(frames(4)))
    # The size before packing stands in the local header and in the directory.
    forged = content.replace(true.to_bytes(4, "little"), (2**28).to_bytes(4, "little"))
    assert forged != content
    (tmp_path / "forged.npz").write_bytes(forged)
    with pytest.raises(ValueError, match=r"observations in .* declares 268435456 bytes in"):
        read(tmp_path / "forged.npz", tmp_path / "d")
    monkeypatch.setattr(reader_module, "MAX_UNPACKED_BYTES", 100)
    with pytest.raises(ValueError, match=r"more than 100; save it as observations\.npy in a folder"):
        read(tmp_path / "a.npz", tmp_path / "d")


def test_files_of_a_folder_are_not_read_at_once(tmp_path: Path) -> None:
    n, shape = 400, (3, 64, 64)
    arrays = {"observations": frames(n + 20, shape=shape), "actions": np.arange(n) % 4}
    source = save_folder(tmp_path / "large", {**arrays, "episode_ends": np.arange(20, n + 1, 20)})
    tracemalloc.start()
    try:
        import_arrays(source, tmp_path / "d")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < arrays["observations"].nbytes


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nothing.npz", "neither a file nor a folder"),
        ("one.npy", "is one array; name the folder"),
        ("text.npz", "is no .npz file"),
        ("empty", "holds neither .npz files nor observations.npy"),
        ("both", "holds .npz and .npy files"),
    ],
)
def test_sources_that_are_none(name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "one.npy", frames(2))
    (tmp_path / "text.npz").write_text("text")
    (tmp_path / "empty").mkdir()
    np.savez(save_folder(tmp_path / "both", episode()) / "other.npz", **episode())
    with pytest.raises(SystemExit) as exit_info:
        main(["import", "arrays", str(tmp_path / name), "-o", str(tmp_path / "d")])
    assert exit_info.value.code == 2 and message in capsys.readouterr().err


def test_lists_that_are_none(tmp_path: Path) -> None:
    for source in ([], [frames(3)], [episode(), None]):
        with pytest.raises(ValueError, match="list of dicts of arrays"):
            read(source, tmp_path / "d")
