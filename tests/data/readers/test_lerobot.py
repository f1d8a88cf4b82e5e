"""LeRobot folders: frames are found by their timestamps, and what does not fit is refused."""

import importlib
import json
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from lerobot_inputs import (
    CAMERA,
    DATA_PATH,
    FPS,
    LENGTHS,
    OTHER,
    SIZE,
    VIDEO_PATH,
    action_of,
    feature,
    lists,
    make_episodes,
    make_info,
    make_rows,
    pa,
    shade,
    write_lerobot,
    write_table,
    write_video,
)

from sb3_abisim import TRUNCATED, TransitionDataset, import_dataset
from sb3_abisim.data.command import main
from sb3_abisim.data.format import INSIDE
from sb3_abisim.data.importing import import_report
from sb3_abisim.data.readers import lerobot as reader_module

EPISODES = "meta/episodes/chunk-000/file-000.parquet"
# Lossy compression moves flat gray by no more than this; frames are 10 apart.
CLOSE = 3


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lerobot(tmp_path_factory.mktemp("lerobot") / "arm")


@pytest.fixture
def source(written: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return shutil.copytree(written, tmp_path / "arm")


def read(source: Path, folder: Path, **options: Any) -> TransitionDataset:
    import_dataset("lerobot", source, folder, verbose=0, **({"image_key": CAMERA} | options))
    return TransitionDataset(folder, eval_fraction=0.0)


def shades(dataset: TransitionDataset) -> np.ndarray:
    frames = dataset.frames(np.arange(dataset.n_frames)).astype(int)
    assert frames.shape[1:] == (3, *SIZE)
    assert (np.ptp(frames, axis=(1, 2, 3)) <= CLOSE).all()
    return frames.mean(axis=(1, 2, 3))


EXPECTED = np.array([shade(e, i) for e, n in enumerate(LENGTHS) for i in range(n)])


def test_every_frame_is_that_of_its_row(written: Path, tmp_path: Path) -> None:
    dataset = read(written, tmp_path / "d")
    assert np.abs(shades(dataset) - EXPECTED).max() <= CLOSE
    # What the last action led to is not recorded.
    actions = dataset.actions(np.arange(dataset.n_frames))[dataset.ends == INSIDE]
    assert np.array_equal(actions, np.concatenate([action_of(e, n)[:-1] for e, n in enumerate(LENGTHS)]))
    assert np.flatnonzero(dataset.ends == TRUNCATED).tolist() == (np.cumsum(LENGTHS) - 1).tolist()
    factors = dataset.factors(np.arange(dataset.n_frames))
    whole = np.concatenate([action_of(e, n) for e, n in enumerate(LENGTHS)])
    assert np.array_equal(factors["observation_state"], whole + 0.5)
    assert factors["observation_gripper"].ravel().tolist() == [i for n in LENGTHS for i in range(n)]


def test_what_is_recorded_of_the_source(written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["import", "lerobot", str(written), "-o", str(tmp_path / "d"), "--image-key", CAMERA])
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.env_id == "arm"
    space = dataset.action_space
    assert (space.low.tolist(), space.high.tolist()) == ([0, -5], [205, 0])
    source = dataset.meta["source"]
    assert (source["codebase_version"], source["image_key"], source["fps"]) == ("v3.0", CAMERA, FPS)
    assert source["lossy"] == "h264 video" and source["action_space_from_data"]
    report = capsys.readouterr().out
    assert report == import_report(tmp_path / "d") + "\n"
    assert "lossy         yes, h264 video" in report and "channels first (last in the source)" in report
    assert (
        f"left out      the last action of each episode, whose outcome is not recorded; {OTHER}; next.reward" in report
    )


def test_the_camera_is_chosen(written: Path, tmp_path: Path) -> None:
    assert np.abs(shades(read(written, tmp_path / "d", image_key=OTHER)) - (EXPECTED - 10)).max() <= CLOSE
    for key, message in ((None, f"2 videos .{CAMERA}, {OTHER}., not None; choose one with --image-key"),
                         ("action", "not 'action'")):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            read(written, tmp_path / "other", image_key=key)


def test_a_registered_id_gives_the_action_space(written: Path, tmp_path: Path) -> None:
    class ArmEnv(gym.Env):
        observation_space = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)
        action_space = gym.spaces.Box(-1000, 1000, (2,), np.float32)

    gym.register("lerobot_arm-v0", entry_point=ArmEnv)
    try:
        dataset = read(written, tmp_path / "d", env_id="lerobot_arm-v0")
    finally:
        del gym.registry["lerobot_arm-v0"]
    assert dataset.action_space == ArmEnv.action_space and dataset.env_id == "lerobot_arm-v0"


@pytest.mark.parametrize("codec", ["libsvtav1", "mpeg4"])
def test_other_codecs(codec: str, tmp_path: Path) -> None:
    dataset = read(write_lerobot(tmp_path / "arm", codec), tmp_path / "d")
    assert np.abs(shades(dataset) - EXPECTED).max() <= 2 * CLOSE
    assert dataset.meta["source"]["lossy"] == {"libsvtav1": "av1 video", "mpeg4": "mpeg4 video"}[codec]


def video_of(source: Path, file: int = 1) -> Path:
    return source / VIDEO_PATH.format(video_key=CAMERA, chunk_index=0, file_index=file)


TWO = [shade(e, i) for e in (1, 2) for i in range(LENGTHS[e])]


@pytest.mark.parametrize("offset", [0.4, -0.4, 0.6])
def test_the_nearest_frame_within_half_a_frame(offset: float, source: Path, tmp_path: Path) -> None:
    """Frame i of the file comes at i + 1 + offset, and one of other gray before it."""
    video_of(source).unlink()
    times = [0.0, *(i + 1 + offset for i in range(len(TWO)))]
    write_video(video_of(source), [250, *TWO], times)
    columns = make_episodes()
    for side in ("from", "to"):
        column = columns[f"videos/{CAMERA}/{side}_timestamp"]
        columns[f"videos/{CAMERA}/{side}_timestamp"] = [column[0], column[1] + 1 / FPS, column[2] + 1 / FPS]
    write_table(source / EPISODES, columns)
    if abs(offset) < 0.5:
        assert np.abs(shades(read(source, tmp_path / "d")) - EXPECTED).max() <= CLOSE
    else:
        with pytest.raises(ValueError, match=r"no frame within 0\.0500 s of 0\.1000 s"):
            read(source, tmp_path / "d")


def test_frames_are_found_by_time_not_by_number(source: Path, tmp_path: Path) -> None:
    """A video of twice the rate, and one in which a frame is lost."""
    video_of(source).unlink()
    doubled = [value for shown in TWO for value in (shown, 255)]
    write_video(video_of(source), doubled, [i / 2 for i in range(len(doubled))])
    assert np.abs(shades(read(source, tmp_path / "d")) - EXPECTED).max() <= CLOSE
    video_of(source).unlink()
    kept = [i for i in range(len(TWO)) if i != 5]
    write_video(video_of(source), [TWO[i] for i in kept], [float(i) for i in kept])
    with pytest.raises(ValueError, match=r"no frame within .* of 0\.5000 s, nor at 0 other times"):
        read(source, tmp_path / "lost")


def test_where_seeking_leads_too_far_the_file_is_read_from_its_start(
    written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = reader_module._decoded
    begins = []

    def late(path: Path, begin: float | None, end: float) -> Any:
        begins.append(begin)
        return (pair for pair in plain(path, begin, end) if begin is None or pair[0] > begin + 2 / FPS)

    monkeypatch.setattr(reader_module, "_decoded", late)
    assert np.abs(shades(read(written, tmp_path / "d")) - EXPECTED).max() <= CLOSE
    assert begins[0] is not None and None in begins


def test_seeking_spares_the_episodes_before(written: Path) -> None:
    begin = LENGTHS[1] / FPS
    first, _ = next(iter(reader_module._decoded(video_of(written), begin, 10.0)))
    assert 0 < first <= begin
    assert len(list(reader_module._decoded(video_of(written), None, 2.5 / FPS))) == 3, "and those after"


def change_info(source: Path, **changes: Any) -> None:
    (source / "meta" / "info.json").write_text(json.dumps(make_info(**changes)))


def features(**changes: Any) -> dict[str, Any]:
    known = make_info()["features"] | {name.replace("__", "."): value for name, value in changes.items()}
    return {name: value for name, value in known.items() if value is not None}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"codebase_version": "v2.1"}, "version v2.1, and v3.0 is read; convert it"),
        ({"codebase_version": "v4.0"}, "version v4.0"),
        ({"codebase_version": "v3.0/.."}, "version v3.0/.."),
        ({"fps": 0}, "0.0 frames per second"),
        ({"fps": "fast"}, "lacks what LeRobot writes"),
        ({"features": None}, "lacks what LeRobot writes"),
        ({"features": features(action=None)}, "must be an action"),
        ({"features": features(action=feature("float32", (2, 2)))}, "must be an action of one dimension"),
        ({"features": features(action=feature("float32", (3,)))}, "action in .* has rows of shape"),
        ({"features": features(observation__state=feature("float32", (3,)))}, "observation.state in .* has rows"),
        ({"features": features(observation_state=feature("float32", (2,)), observation__images__top=feature(
            "video", (*SIZE, 3), info={"video.is_depth_map": True}))}, "map of depths"),
        ({"features": features(observation__images__top=feature("video", (64, 48, 3)))}, "info.json says"),
        ({"features": features(observation__images__top=feature("image", (*SIZE, 3)))}, "has 1 videos"),
        ({"features": {"action": feature("float32", (2,))}}, "has no videos; images in its tables are not read"),
        ({"total_episodes": 4}, "announces 4 episodes and describes 3"),
        ({"total_episodes": 0}, "announces 0 episodes"),
        ({"data_path": "../{chunk_index}/{file_index}"}, "lead out of the folder"),
        ({"data_path": "/etc/{chunk_index}/{file_index}"}, "lead out of the folder"),
        ({"data_path": "{chunk_index.real}/{file_index}"}, "lead out of the folder"),
        ({"data_path": "{episode_index}.parquet"}, "only chunk_index, file_index can stand in it"),
        ({"video_path": "videos/{video_key}/{file_index}.mp4"}, "0.mp4 is missing; download the whole folder"),
    ],
)  # fmt: skip
def test_an_info_that_does_not_fit(changes: dict[str, Any], message: str, source: Path, tmp_path: Path) -> None:
    change_info(source, **changes)
    with pytest.raises(ValueError, match=message):
        read(source, tmp_path / "d")
    assert not (tmp_path / "d" / "meta.json").exists()


def test_axes_whose_names_are_not_true(source: Path, tmp_path: Path) -> None:
    change_info(source, features=features(observation__images__top=feature("video", (3, *SIZE))))
    assert read(source, tmp_path / "d").observation_space.shape == (3, *SIZE)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("frame_index", lambda a: a[::-1], "has 5 rows of episode 0, in place of 5 in order"),
        ("episode_index", lambda a: a * 0, "has 9 rows of episode 0, in place of 5"),
        ("timestamp", lambda a: a * 0, "which must ascend"),
        ("timestamp", lambda a: a + np.float32(1 / FPS), r"lasts from 0\.1000 to 0\.5000 s by its rows"),
        ("timestamp", lambda a: a - np.float32(1 / FPS), r"lasts from -0\.1000"),
        ("action", lambda a: None, "there is no column 'action'"),
        ("action", lambda a: [[1.0, 2.0]] * 8 + [[1.0]], "lists of .1, 2. numbers"),
        ("action", lambda a: [[1.0, 2.0]] * 8 + [None], "'action' has gaps"),
        ("action", lambda a: [["a", "b"]] * 9, "in place of numbers"),
        ("action", lambda a: [[1.0, 2.0]] * 8 + [[1.0, None]], "or gaps, in place of numbers"),
        ("action", lambda a: lists(np.full((9, 2), np.nan, np.float32)), "finite numbers"),
        ("timestamp", lambda a: [*a[:-1].tolist(), None], "'timestamp' has gaps"),
    ],
)
def test_rows_that_do_not_fit(name: str, change: Any, message: str, source: Path, tmp_path: Path) -> None:
    columns = make_rows([0, 1])
    columns[name] = change(columns[name])
    path = source / DATA_PATH.format(chunk_index=0, file_index=0)
    write_table(path, {key: column for key, column in columns.items() if column is not None})
    with pytest.raises(ValueError, match=message):
        read(source, tmp_path / "d")
    assert not (tmp_path / "d" / "meta.json").exists()


def test_a_video_of_another_size(source: Path, tmp_path: Path) -> None:
    video_of(source).unlink()
    write_video(video_of(source), TWO, size=(48, 32))
    with pytest.raises(ValueError, match=r"a frame of 48 x 32 pixels at 0\.0000 s .* in place of 32 x 48"):
        read(source, tmp_path / "d")


def test_files_that_are_damaged_or_missing(source: Path, tmp_path: Path) -> None:
    video = video_of(source, 0)
    content = video.read_bytes()
    video.write_bytes(content[:200])
    with pytest.raises(ValueError, match=r"file-000\.mp4 cannot be decoded"):
        read(source, tmp_path / "a")
    video.write_bytes(content)
    table = source / DATA_PATH.format(chunk_index=0, file_index=1)
    table.write_bytes(b"no table")
    with pytest.raises(ValueError, match=r"file-001\.parquet cannot be read as LeRobot writes it"):
        read(source, tmp_path / "b")
    table.unlink()
    with pytest.raises(ValueError, match=r"file-001\.parquet is missing"):
        read(source, tmp_path / "c")
    (source / "meta" / "info.json").unlink()
    with pytest.raises(ValueError, match="is no LeRobot folder"):
        read(source, tmp_path / "d")


def test_an_episode_of_one_frame_is_left_out(source: Path, tmp_path: Path) -> None:
    columns = make_rows([0, 1])
    cut = {name: column[:6] for name, column in columns.items()}
    write_table(source / DATA_PATH.format(chunk_index=0, file_index=0), cut)
    episodes = make_episodes()
    episodes["length"] = [LENGTHS[0], 1, LENGTHS[2]]
    write_table(source / EPISODES, episodes)
    dataset = read(source, tmp_path / "d")
    assert dataset.n_frames == LENGTHS[0] + LENGTHS[2]
    assert "1 episodes of a single frame" in dataset.meta["source"]["left_out"]


@pytest.mark.parametrize("package", ["pyarrow", "av"])
def test_a_missing_package_names_the_command(
    package: str, written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = importlib.import_module

    def without(name: str, *args: Any) -> Any:
        if name.split(".")[0] == package:
            raise ImportError(f"No module named {package!r}")
        return real(name, *args)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(SystemExit) as exit_info:
        main(["import", "lerobot", str(written), "-o", str(tmp_path / "d")])
    assert exit_info.value.code == 2 and "pip install 'sb3_abisim[lerobot]'" in capsys.readouterr().err


def test_a_folder_with_the_name_of_an_address_is_a_folder(
    written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(written, tmp_path / "http:set")
    monkeypatch.chdir(tmp_path)
    first, second = read(Path("http:set"), tmp_path / "a"), read(written, tmp_path / "b")
    assert first.frames(np.arange(3)).tolist() == second.frames(np.arange(3)).tolist()


def test_a_list_of_files_in_place_of_a_video_is_refused(source: Path, tmp_path: Path) -> None:
    for path in source.rglob("*.mp4"):
        other = path.rename(path.with_suffix(".other"))
        path.write_text(f"ffconcat version 1.0\nfile {other.name}\n")
    with pytest.raises(ValueError, match=r"file-000\.mp4 cannot be decoded"):
        read(source, tmp_path / "a")


def test_columns_that_declare_more_than_they_take_are_refused(source: Path, tmp_path: Path) -> None:
    """Equal values take no room in Parquet."""
    path = source / DATA_PATH.format(chunk_index=0, file_index=0)
    zeros = pa.array(np.zeros(12_000_000, np.int8)).dictionary_encode()
    names = ["episode_index", "frame_index", "timestamp", "action", "observation.state", "observation.gripper"]
    pa.parquet.write_table(pa.table(dict.fromkeys(names, zeros)), path)
    assert path.stat().st_size < 1_000_000
    with pytest.raises(ValueError, match=r"its columns declare 576000000 bytes, more than 536870912"):
        read(source, tmp_path / "out")


@pytest.mark.parametrize("total", [10**12, float("inf"), -1])
def test_any_number_of_episodes_takes_no_memory(source: Path, tmp_path: Path, total: float) -> None:
    (source / "meta" / "info.json").write_text(json.dumps(make_info(total_episodes=total)))
    with pytest.raises(ValueError, match=r"announces -?\d+ episodes and describes 3|lacks what LeRobot writes there"):
        read(source, tmp_path / "out")
