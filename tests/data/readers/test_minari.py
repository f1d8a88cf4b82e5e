"""Exchange with Minari: lossless both ways, and nothing that a stranger's file names is run."""

import builtins
import json
from pathlib import Path

import gymnasium as gym
import index_env  # noqa: F401  registers ids
import numpy as np
import pytest
from minari_inputs import episode, make_frames, make_minari

from sb3_abisim.data import writer as writer_module
from sb3_abisim.data.collect import collect
from sb3_abisim.data.command import main
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CUT, INSIDE, TERMINATED, TRUNCATED
from sb3_abisim.data.importing import import_report
from sb3_abisim.data.readers import minari as reader_module
from sb3_abisim.data.readers.minari import export_dataset, import_dataset

minari = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")


pytestmark = pytest.mark.usefixtures("store", "no_environment")


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    collect("IndexEnv-v0", 200, tmp_path / "ours", n_envs=4, seed=3)
    return tmp_path / "ours"


def assert_same_data(a: TransitionDataset, b: TransitionDataset) -> None:
    assert a.n_frames == b.n_frames
    everything = np.arange(a.n_frames)
    assert np.array_equal(a.frames(everything), b.frames(everything))
    assert np.array_equal(a.actions(everything), b.actions(everything))
    assert np.array_equal(a.ends, b.ends)
    for name, values in a.factors(everything).items():
        other = b.factors(everything)[name]
        assert other.dtype == values.dtype
        assert np.array_equal(other, values)
    assert a.meta["factors"] == b.meta["factors"]
    assert (a.observation_space, a.action_space) == (b.observation_space, b.action_space)


def test_round_trip_is_lossless(ours: Path, tmp_path: Path) -> None:
    before = TransitionDataset(ours)
    assert set(np.unique(before.ends)) == {INSIDE, TERMINATED, TRUNCATED, CUT}
    export_dataset(ours, "index/random-v0")
    hash = import_dataset("index/random-v0", tmp_path / "back")
    after = TransitionDataset(tmp_path / "back")
    assert_same_data(before, after)
    assert after.hash == hash != before.hash
    assert (after.env_id, after.env_kwargs) == ("IndexEnv-v0", {})
    assert (after.meta["seed"], after.meta["policy"]) == (3, "uniform")
    assert after.meta["source"]["minari"] == "index/random-v0"
    import_dataset("index/random-v0", tmp_path / "named", env_id="Else-v0")
    assert TransitionDataset(tmp_path / "named").env_id == "Else-v0"


def test_frames_large_enough_for_jpeg_stay_exact(tmp_path: Path) -> None:
    """Minari takes frames of 32 x 32 and more for images, and would store them as JPEG."""
    for name, shape in (("first", (3, 40, 48)), ("last", (40, 48, 3))):
        frames = make_frames(6, shape)
        space = gym.spaces.Box(0, 255, shape, np.uint8)
        make_minari(f"{name}-v0", [episode(frames, terminated=True)], space, jpeg_encoding=False)
        import_dataset(f"{name}-v0", tmp_path / name)
        export_dataset(tmp_path / name, f"{name}-v1")
        again = next(iter(minari.load_dataset(f"{name}-v1")))
        assert np.array_equal(again.observations, frames)
        assert minari.load_dataset(f"{name}-v1").observation_space == space


def test_what_minari_users_see(ours: Path) -> None:
    export_dataset(ours, "index/random-v0")
    dataset, stored = TransitionDataset(ours), minari.load_dataset("index/random-v0")
    assert stored.total_steps == 200
    assert stored.total_episodes == np.count_nonzero(dataset.ends)
    assert stored.action_space == dataset.action_space
    position = 0
    for one in stored:
        n = len(one.actions)
        index = np.arange(position, position + n + 1)
        assert np.array_equal(one.observations, dataset.frames(index))
        assert np.array_equal(one.actions, dataset.actions(index[:-1]))
        end = dataset.ends[position + n]
        assert one.terminations.tolist() == [False] * (n - 1) + [end == TERMINATED]
        assert one.truncations.tolist() == [False] * (n - 1) + [end in (TRUNCATED, CUT)]
        assert one.infos["cut_by_shard_end"].tolist() == [False] * n + [end == CUT]
        assert not one.rewards.any()
        position += n + 1
    metadata = stored.storage.metadata
    assert "Rewards were not recorded" in metadata["description"]
    assert metadata["sb3_abisim"]["rewards_recorded"] is False


def test_channels_last_is_transposed_and_back(tmp_path: Path) -> None:
    shape = (4, 5, 3)
    frames = make_frames(4, shape)
    space = gym.spaces.Box(0, 255, shape, np.uint8)
    make_minari("hwc-v0", [episode(frames, terminated=True)], space, jpeg_encoding=False)
    import_dataset("hwc-v0", tmp_path / "d")
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.observation_space.shape == (3, 4, 5)
    stored = dataset.frames(np.arange(4))
    for t, row, column, channel in ((0, 1, 2, 0), (3, 3, 4, 2), (2, 0, 1, 1)):
        assert stored[t, channel, row, column] == frames[t, row, column, channel]
    export_dataset(tmp_path / "d", "hwc-v1")
    assert np.array_equal(next(iter(minari.load_dataset("hwc-v1"))).observations, frames)
    import_dataset("hwc-v1", tmp_path / "again")
    assert_same_data(dataset, TransitionDataset(tmp_path / "again"))


def test_gray_without_channels(tmp_path: Path) -> None:
    frames = make_frames(4, (6, 5))
    make_minari("gray-v0", [episode(frames, terminated=True)], gym.spaces.Box(0, 255, (6, 5), np.uint8))
    import_dataset("gray-v0", tmp_path / "d")
    dataset = TransitionDataset(tmp_path / "d")
    assert np.array_equal(dataset.frames(np.arange(4)), frames[:, None])
    assert "gray without channels in the source" in import_report(tmp_path / "d")


def test_images_that_lie_in_no_known_way_are_refused(tmp_path: Path) -> None:
    make_minari("odd-v0", [episode(make_frames(4, (6, 3, 5)))], gym.spaces.Box(0, 255, (6, 3, 5), np.uint8))
    with pytest.raises(ValueError, match="neither channels first nor channels last"):
        import_dataset("odd-v0", tmp_path / "d")


@pytest.fixture
def of_dicts(tmp_path: Path) -> list[dict]:
    """A dataset of two cameras, a vector, a number and a word."""
    shape = (40, 48, 3)
    space = gym.spaces.Dict(
        front=gym.spaces.Box(0, 255, shape, np.uint8),
        wrist=gym.spaces.Box(0, 255, (3, 6, 5), np.uint8),
        **{"arm.state": gym.spaces.Box(-9, 9, (2,), np.float32)},
        gear=gym.spaces.Discrete(5),
        task=gym.spaces.Text(9),
    )
    episodes = [
        {
            "front": make_frames(4, shape, i),
            "wrist": make_frames(4, (3, 6, 5), i),
            "arm.state": np.float32([[t, i] for t in range(4)]),
            "gear": np.arange(4) + i,
            "task": ["lift"] * 4,
        }
        for i in (0, 1)
    ]
    made = [episode(np.zeros(4), terminated=True, observations=observations) for observations in episodes]
    make_minari("dict-v0", made, space, jpeg_encoding=False)
    make_minari("lossy-v0", made, space)
    return episodes


def test_a_dict_of_observations_gives_one_image_and_factors(of_dicts: list[dict], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"Minari dataset dict-v0: .*2 images \(front, wrist\).*--image-key"):
        import_dataset("dict-v0", tmp_path / "none")
    for key in ("front", "wrist"):
        main(["import", "minari", "dict-v0", "-o", str(tmp_path / key), "--image-key", key])
        dataset = TransitionDataset(tmp_path / key, eval_fraction=0.0)
        shown = np.concatenate([one[key] for one in of_dicts])
        everything = np.arange(8)
        assert np.array_equal(dataset.frames(everything), np.moveaxis(shown, -1, 1) if key == "front" else shown)
        factors = dataset.factors(everything)
        assert np.array_equal(factors["arm_state"], np.concatenate([one["arm.state"] for one in of_dicts]))
        assert factors["gear"].tolist() == [0, 1, 2, 3, 1, 2, 3, 4]
        assert dataset.meta["source"]["left_out"] == ["rewards", "observations 'task'"]
    assert set(factors) == {"arm_state", "gear", "front"}
    # What is exported is what the dataset holds: the image and the factors.
    export_dataset(tmp_path / "front", "front-v0")
    import_dataset("front-v0", tmp_path / "again")
    assert_same_data(TransitionDataset(tmp_path / "front"), TransitionDataset(tmp_path / "again"))


def test_jpeg_counts_for_the_image_that_is_chosen(of_dicts: list[dict], tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="lossy-v0 holds JPEG images"):
        import_dataset("lossy-v0", tmp_path / "front", image_key="front")
    assert "lossy         yes, JPEG images" in import_report(tmp_path / "front")
    import_dataset("lossy-v0", tmp_path / "wrist", image_key="wrist")
    assert "lossy         no" in import_report(tmp_path / "wrist")


def test_ends_and_continuous_actions_of_a_foreign_dataset(tmp_path: Path) -> None:
    space = gym.spaces.Box(-1, 1, (2,), np.float32)
    actions = np.random.default_rng(0).uniform(-1, 1, size=(3, 2)).astype(np.float32)
    shape = (3, 4, 5)
    endings = [{"terminated": True}, {"truncated": True}, {}, {"terminated": True, "truncated": True}]
    episodes = [episode(make_frames(4, shape, i), actions=actions, **ends) for i, ends in enumerate(endings)]
    make_minari("box-v0", episodes, gym.spaces.Box(0, 255, shape, np.uint8), action_space=space, jpeg_encoding=False)
    import_dataset("box-v0", tmp_path / "d")
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.ends[[3, 7, 11, 15]].tolist() == [TERMINATED, TRUNCATED, CUT, TERMINATED]
    assert np.array_equal(dataset.actions(np.array([8, 9, 10])), actions)
    assert dataset.actions(np.array([0])).dtype == np.float32
    assert dataset.action_space == space
    assert (dataset.env_id, dataset.meta["policy"], dataset.meta["seed"]) == ("box-v0", "unknown", None)


def test_large_imports_are_cut_into_shards(ours: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export_dataset(ours, "index-v0")
    monkeypatch.setattr(writer_module, "SHARD_TRANSITIONS", 60)
    import_dataset("index-v0", tmp_path / "back")
    after = TransitionDataset(tmp_path / "back")
    assert len(after.meta["shards"]) == 4
    assert_same_data(TransitionDataset(ours), after)


def test_jpeg_images_are_announced(tmp_path: Path) -> None:
    shape = (40, 48, 3)
    space = gym.spaces.Box(0, 255, shape, np.uint8)
    make_minari("jpeg-v0", [episode(make_frames(4, shape), terminated=True)], space)
    with pytest.warns(UserWarning, match="jpeg-v0 holds JPEG images"):
        import_dataset("jpeg-v0", tmp_path / "d")


def test_damage_in_the_minari_file_is_noticed(ours: Path, tmp_path: Path, store: Path) -> None:
    export_dataset(ours, "index-v0")
    with h5py.File(store / "index-v0" / "data" / "main_data.hdf5", "a") as file:
        file["episode_3/observations"][1, 0, 2, 2] ^= 1
    with pytest.raises(ValueError, match=r"index-v0 is damaged, was changed .* `minari delete index-v0`"):
        import_dataset("index-v0", tmp_path / "back")
    assert not (tmp_path / "back" / "meta.json").exists()


def test_an_export_that_is_stopped_leaves_nothing_or_nothing_that_is_taken_for_whole(
    ours: Path, tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, kept = reader_module._to_episode, []

    def stopped(*args: object) -> object:
        kept.append(args)
        if len(kept) == 5:
            raise KeyboardInterrupt
        return plain(*args)

    monkeypatch.setattr(reader_module, "_to_episode", stopped)
    with pytest.raises(KeyboardInterrupt):
        export_dataset(ours, "index-v0")
    assert not (store / "index-v0").exists()
    # As a kill leaves it.
    monkeypatch.setattr(reader_module.shutil, "rmtree", lambda *args, **kwargs: None)
    kept.clear()
    with pytest.raises(KeyboardInterrupt):
        export_dataset(ours, "index-v0")
    with pytest.raises(ValueError, match="`minari delete index-v0` and export it again"):
        import_dataset("index-v0", tmp_path / "back")
    assert not (tmp_path / "back" / "meta.json").exists()
    # After the last episode, before the sum over all of them.
    storage = type(minari.load_dataset("index-v0").storage)
    original = storage.update_metadata

    def update_metadata(self: object, metadata: dict) -> None:
        if metadata.get(reader_module.METADATA_KEY, {}).get("content_sha256"):
            raise KeyboardInterrupt
        original(self, metadata)

    monkeypatch.setattr(storage, "update_metadata", update_metadata)
    monkeypatch.setattr(reader_module, "_to_episode", plain)
    with pytest.raises(KeyboardInterrupt):
        export_dataset(ours, "whole-v0")
    with pytest.raises(ValueError, match=r"was not exported to its end; .*`minari delete whole-v0`"):
        import_dataset("whole-v0", tmp_path / "other")


def change_metadata(store: Path, dataset_id: str, **changes: object) -> None:
    path = store / dataset_id / "data" / "metadata.json"
    document = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in document.items() if value is not None}))


def test_no_code_named_by_the_file_is_run(ours: Path, tmp_path: Path, store: Path) -> None:
    """Minari makes the environment of a dataset whose spaces are missing; ours refuses it (gym.make fails the test)."""
    export_dataset(ours, "index-v0")
    spec = {"id": "Evil-v0", "entry_point": "os:system", "kwargs": {"command": "true"}, "additional_wrappers": []}
    change_metadata(store, "index-v0", env_spec=json.dumps(spec))
    import_dataset("index-v0", tmp_path / "with_spaces")
    assert TransitionDataset(tmp_path / "with_spaces").env_id == "IndexEnv-v0"
    change_metadata(store, "index-v0", observation_space=None)
    with pytest.raises(ValueError, match="does not record its observation_space"):
        import_dataset("index-v0", tmp_path / "without")
    assert not (tmp_path / "without").exists()


def test_forged_factor_names_do_not_lead_out_of_the_folder(ours: Path, tmp_path: Path, store: Path) -> None:
    export_dataset(ours, "index-v0")
    block = json.loads((store / "index-v0" / "data" / "metadata.json").read_text())["sb3_abisim"]
    block["factors"]["/../../../escaped"] = {"dtype": "<f4", "shape": []}
    change_metadata(store, "index-v0", sb3_abisim=block)
    with pytest.raises(ValueError, match="factor names"):
        import_dataset("index-v0", tmp_path / "back")


SHAPE = (3, 4, 5)
SPACE = gym.spaces.Box(0, 255, SHAPE, np.uint8)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": np.array([0, 1, 7])}, "not in the action space"),
        ({"terminations": np.array([False, True, False])}, "goes on after an end"),
        ({"observations": make_frames(3, SHAPE)}, "n transitions need n \\+ 1 observations"),
    ],
)
def test_episodes_that_do_not_fit_are_named(tmp_path: Path, changes: dict, message: str) -> None:
    episodes = [episode(make_frames(4, SHAPE)), episode(make_frames(4, SHAPE)) | changes]
    make_minari("bad-v0", episodes, SPACE, jpeg_encoding=False)
    with pytest.raises(ValueError, match=f"episode 1 of Minari dataset bad-v0 .*{message}"):
        import_dataset("bad-v0", tmp_path / "d")


def test_spaces_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    vectors = gym.spaces.Box(-1, 1, (5,), np.float32)
    make_minari("vector-v0", [episode(np.zeros((4, 5), np.float32))], vectors)
    with pytest.raises(ValueError, match="only uint8 images"):
        import_dataset("vector-v0", tmp_path / "d")
    unbounded = gym.spaces.Box(-np.inf, 1, (2,), np.float64)
    make_minari("f64-v0", [episode(make_frames(4, SHAPE), actions=np.zeros((3, 2)))], SPACE, action_space=unbounded)
    with pytest.raises(ValueError, match="need bounds"):
        import_dataset("f64-v0", tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_commands(ours: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["export", str(ours), "index/random-v0"])
    assert "rewards were not recorded" in capsys.readouterr().out
    main(["import", "minari", "index/random-v0", "-o", str(tmp_path / "back")])
    assert "rewards were dropped" in capsys.readouterr().out
    for arguments, message in (
        (["export", str(ours), "index/random-v0"], "already exists"),
        (["export", str(tmp_path / "nothing"), "other-v0"], "nothing is not a folder"),
        (["import", "minari", "index/random-v0", "-o", str(tmp_path / "back")], "already holds"),
        (["import", "minari", "absent-v0", "-o", str(tmp_path / "d")], "minari download absent-v0"),
        (["import", "minari", "index/random-v0", "-o", str(ours)], "begun with other arguments"),
        (["import", "hdf4", "index/random-v0", "-o", str(tmp_path / "d")], "unknown reader 'hdf4'; known are arrays"),
    ):
        with pytest.raises(SystemExit) as exit_info:
            main(arguments)
        assert exit_info.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"sb3-abisim data {arguments[0]}: error: ") and message in line


@pytest.mark.parametrize("name", ["nav2d", "bad id", "-v0", "a-v"])
def test_a_name_that_minari_cannot_have_leaves_nothing_behind(ours: Path, store: Path, name: str) -> None:
    with pytest.raises(ValueError, match="is not a name of a Minari dataset"):
        export_dataset(ours, name)
    assert not store.exists() or not list(store.iterdir())
    assert minari.list_local_datasets() == {}


def test_missing_minari_names_the_command_that_installs_it(
    ours: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = builtins.__import__

    def without_minari(name: str, *args: object, **kwargs: object) -> object:
        if name == "minari":
            raise ImportError("No module named 'minari'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_minari)
    with pytest.raises(SystemExit) as exit_info:
        main(["export", str(ours), "index-v0"])
    assert exit_info.value.code == 2
    assert "pip install 'sb3_abisim[minari]'" in capsys.readouterr().err
