"""Datasets made of what something else has recorded."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_abisim import CUT, TERMINATED, TRUNCATED, Segment, TransitionDataset, write_dataset
from sb3_abisim.data import writer as writer_module

SHAPE = (3, 5, 4)
SPACE = gym.spaces.Box(0, 255, SHAPE, np.uint8)
ACTIONS = gym.spaces.Discrete(3, start=1)


def segment(n: int, end: int = TERMINATED, **changes: Any) -> Segment:
    rng = np.random.default_rng(n)
    frames = rng.integers(256, size=(n + 1, *SHAPE), dtype=np.uint8)
    fields = {"frames": frames, "actions": rng.integers(1, 4, n), "end": end, "factors": {"step": np.arange(n + 1.0)}}
    return Segment(**(fields | changes))


def write(folder: Path, segments: Any, **changes: Any) -> str:
    arguments = {"env_id": "My-v0", "observation_space": SPACE, "action_space": ACTIONS, "source": ["disk", 3]}
    return write_dataset(folder, segments, **(arguments | changes))


def test_what_was_recorded_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module, "SHARD_TRANSITIONS", 6)
    recorded = [segment(4), segment(2, TRUNCATED), segment(5, CUT), segment(1)]
    waiting = iter(recorded)
    hash = write(tmp_path / "d", waiting, env_kwargs={"size": 5}, policy="expert")
    dataset = TransitionDataset(tmp_path / "d", eval_fraction=0.0)
    assert (dataset.hash, dataset.env_id, dataset.env_kwargs) == (hash, "My-v0", {"size": 5})
    assert (dataset.meta["policy"], dataset.meta["source"], dataset.meta["seed"]) == ("expert", ["disk", 3], None)
    assert (dataset.observation_space, dataset.action_space) == (SPACE, ACTIONS)
    assert [shard["n_transitions"] for shard in dataset.meta["shards"]] == [6, 6]
    everything = np.arange(dataset.n_frames)
    assert np.array_equal(dataset.frames(everything), np.concatenate([s.frames for s in recorded]))
    assert np.array_equal(dataset.actions(dataset.valid_starts()), np.concatenate([s.actions for s in recorded]))
    assert np.array_equal(dataset.factors(everything)["step"], np.concatenate([s.factors["step"] for s in recorded]))
    assert dataset.ends[dataset.ends > 0].tolist() == [TERMINATED, TRUNCATED, CUT, TERMINATED]


def test_segments_are_taken_one_shard_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module, "SHARD_TRANSITIONS", 4)
    n_written = []

    def segments() -> Any:
        for _ in range(3):
            yield segment(4)
            n_written.append(len(list((tmp_path / "d").glob("shard-*.json"))))

    write(tmp_path / "d", segments())
    assert n_written == [1, 2, 3]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"actions": np.array([1, 2, 3, 4])},
            r"segment 1 has actions .* not in the action space Discrete\(3, start=1\)",
        ),
        ({"actions": np.array([1.0, 2.0, 3.0, 1.5])}, "segment 1 has actions .float64"),
        ({"end": 0}, "segment 1 has 4 actions and end 0; .*TERMINATED"),
        ({"frames": np.zeros((4, *SHAPE), np.uint8)}, "frames must be uint8 .5, 3, 5, 4.*got uint8 .4, 3, 5, 4"),
        ({"frames": np.zeros((5, *SHAPE), np.float32)}, "frames must be uint8 .* got float32"),
        ({"factors": {"step": np.arange(5)}}, "factor_step must be float64 .* got int64"),
    ],
    ids=str,
)
def test_segments_that_do_not_fit_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "d", [segment(4), segment(4, **changes)])
    assert not (tmp_path / "d" / "meta.json").exists()


def test_continuous_actions_keep_their_bounds(tmp_path: Path) -> None:
    space = gym.spaces.Box(-1, 1, (2,), np.float32)
    actions = np.float32([[0.5, -1], [1, 0]])
    write(tmp_path / "d", [segment(2, actions=actions)], action_space=space)
    assert np.array_equal(TransitionDataset(tmp_path / "d").actions([0, 1]), actions)
    for wrong in (actions * 2, actions[:, :1], np.float32([[np.nan, 0], [0, 0]])):
        with pytest.raises(ValueError, match="not in the action space"):
            write(tmp_path / "e", [segment(2, actions=wrong)], action_space=space)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": None}, "source must say where the data comes from"),
        ({"source": Path("x")}, "must be what JSON can hold"),
        ({"observation_space": gym.spaces.Box(-1, 1, (3,))}, "uint8 images"),
        ({"action_space": gym.spaces.Text(3)}, "MultiBinary or a Box of floats"),
    ],
    ids=str,
)
def test_mistakes_are_refused_before_anything_is_written(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "d", [segment(4)], **changes)
    with pytest.raises(ValueError, match="no segments"):
        write(tmp_path / "d", [])
    assert not (tmp_path / "d").exists()


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    write(tmp_path / "d", [segment(4)])
    with pytest.raises(ValueError, match="already holds this dataset; name a new folder"):
        write(tmp_path / "d", [segment(4)])
    with pytest.raises(ValueError, match="begun with other arguments"):
        write(tmp_path / "d", [segment(4)], source="elsewhere")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    with pytest.raises(ValueError, match="holds something else"):
        write(tmp_path / "mine", [segment(4)])


def test_a_damaged_import_names_its_source(tmp_path: Path) -> None:
    write(tmp_path / "d", [segment(4)])
    (tmp_path / "d" / "frames-00000.npy").unlink()
    with pytest.raises(
        ValueError, match=r"frames-00000\.npy is missing; remove .* make it again from its source, \['disk', 3\]"
    ):
        TransitionDataset(tmp_path / "d")
