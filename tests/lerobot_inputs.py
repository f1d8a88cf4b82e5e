"""LeRobot folders of version 3, written by PyArrow and PyAV, whose frames show their number."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pa = pytest.importorskip("pyarrow", reason="the tests of LeRobot folders write Parquet with pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
av = pytest.importorskip("av", reason="the tests of LeRobot folders write videos with av")

CAMERA, OTHER = "observation.images.top", "observation.images.wrist"
FPS = 10
SIZE = (32, 48)
# Episodes share files: the first two one table, the last two one video.
LENGTHS = (5, 4, 6)
TABLES, VIDEOS = (0, 0, 1), (0, 1, 1)
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


def shade(episode: int, frame: int) -> int:
    """What every pixel of a frame is."""
    return 20 + 60 * episode + 10 * frame


def write_video(
    path: Path,
    shades: list[int],
    times: list[float] | None = None,
    codec: str = "libx264",
    size: tuple[int, int] = SIZE,
) -> None:
    """A video of gray frames.

    :param shades: of the frames
    :param times: of the frames, in frames; None for 0, 1, 2 and so on
    :param codec: as PyAV calls it
    :param size: height and width
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        # The encoder counts in twentieths of a frame.
        stream = container.add_stream(codec, rate=20 * FPS)
        stream.width, stream.height = size[::-1]
        stream.pix_fmt = "yuv420p"
        # Seeking lands before what is looked for.
        stream.codec_context.gop_size = 4
        if codec == "libx264":
            stream.options = {"qp": "4"}
        for i, value in enumerate(shades):
            frame = av.VideoFrame.from_ndarray(np.full((*size, 3), value, np.uint8), format="rgb24")
            frame.pts = round(20 * (i if times is None else times[i]))
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def lists(array: np.ndarray) -> Any:
    """Rows as a column of lists, as LeRobot writes them."""
    return pa.FixedSizeListArray.from_arrays(pa.array(array.ravel()), array.shape[1])


def action_of(episode: int, n: int) -> np.ndarray:
    return np.stack([np.arange(n) + 100.0 * episode, -np.arange(n)], axis=1).astype(np.float32)


def feature(dtype: str, shape: tuple[int, ...], **more: Any) -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "names": None, **more}


def make_info(**changes: Any) -> dict[str, Any]:
    numbering = {name: feature("int64", (1,)) for name in ("frame_index", "episode_index", "index", "task_index")}
    return {
        "codebase_version": "v3.0",
        "fps": FPS,
        "total_episodes": len(LENGTHS),
        "total_frames": sum(LENGTHS),
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": {
            CAMERA: feature("video", (*SIZE, 3)),
            OTHER: feature("video", (*SIZE, 3)),
            "observation.state": feature("float32", (2,)),
            "observation.gripper": feature("float32", (1,)),
            "action": feature("float32", (2,)),
            "next.reward": feature("float32", (1,)),
            "timestamp": feature("float32", (1,)),
            **numbering,
        },
        **changes,
    }


def make_rows(episodes: list[int]) -> dict[str, Any]:
    """The columns of a table with some episodes."""
    lengths = [LENGTHS[e] for e in episodes]
    frame = np.concatenate([np.arange(n) for n in lengths])
    actions = np.concatenate([action_of(e, n) for e, n in zip(episodes, lengths, strict=True)])
    return {
        "timestamp": (frame / FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat(episodes, lengths),
        "index": np.arange(len(frame)),
        "task_index": np.zeros(len(frame), np.int64),
        "action": lists(actions),
        "observation.state": lists(actions + 0.5),
        "observation.gripper": frame.astype(np.float32),
        "next.reward": np.zeros(len(frame), np.float32),
    }


def make_episodes() -> dict[str, list[Any]]:
    """The columns of meta/episodes."""
    columns: dict[str, list[Any]] = {
        "episode_index": [*range(len(LENGTHS))],
        "length": [*LENGTHS],
        "data/chunk_index": [0] * len(LENGTHS),
        "data/file_index": [*TABLES],
    }
    for camera in (CAMERA, OTHER):
        begins = [sum(LENGTHS[f] for f in range(e) if VIDEOS[f] == VIDEOS[e]) / FPS for e in range(len(LENGTHS))]
        columns[f"videos/{camera}/chunk_index"] = [0] * len(LENGTHS)
        columns[f"videos/{camera}/file_index"] = [*VIDEOS]
        columns[f"videos/{camera}/from_timestamp"] = begins
        columns[f"videos/{camera}/to_timestamp"] = [b + n / FPS for b, n in zip(begins, LENGTHS, strict=True)]
    return columns


def write_table(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


def write_lerobot(folder: Path, codec: str = "libx264") -> Path:
    """A whole folder; its second camera is darker by 10."""
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(make_info()))
    write_table(folder / "meta/episodes/chunk-000/file-000.parquet", make_episodes())
    for file in sorted(set(TABLES)):
        rows = make_rows([e for e in range(len(LENGTHS)) if TABLES[e] == file])
        write_table(folder / DATA_PATH.format(chunk_index=0, file_index=file), rows)
    for file in sorted(set(VIDEOS)):
        shades = [shade(e, i) for e in range(len(LENGTHS)) if VIDEOS[e] == file for i in range(LENGTHS[e])]
        for camera, darker in ((CAMERA, 0), (OTHER, 10)):
            path = folder / VIDEO_PATH.format(video_key=camera, chunk_index=0, file_index=file)
            write_video(path, [value - darker for value in shades], codec=codec)
    return folder
