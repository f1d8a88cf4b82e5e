"""LeRobot folders of version 3: tables in Parquet, cameras in MP4, many episodes in each file.

    meta/info.json                 version, frames per second, features with dtype and shape, patterns of paths
    meta/episodes/*/*.parquet      per episode: its length, its files, from when to when it lasts in each video
    data/*/*.parquet               per frame: its episode, its timestamp within it, action, state
    videos/CAMERA/*/*.mp4          the frames

They are read with PyArrow and PyAV. An episode of L frames has L actions; what the last one led to is not recorded, so
that it has L - 1 transitions. Frames are found by their timestamps, never by their number. Videos are lossy.
"""

import importlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.files import find, is_of_system
from sb3_abisim.common.spaces import ActionSpace
from sb3_abisim.data.copies import ImageLayout, factor_name
from sb3_abisim.data.format import TRUNCATED, from_json_file
from sb3_abisim.data.importing import CHANNELS_KEY, LEFT_OUT_KEY, LOSSY_KEY
from sb3_abisim.data.recorded import find_action_space, recorded_actions, recorded_layout
from sb3_abisim.data.writer import Segment, check_folder, write_dataset
from sb3_abisim.envs.backgrounds.video_frames import open_container
from sb3_abisim.registry import register_reader

ACTION = "action"
# Columns that number the rows, and are no state.
# Of the columns of one table.
MAX_TABLE_BYTES = 1 << 29
_NUMBERING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_VERSION = re.compile(r"v3\.\d+")
_FIELD = re.compile(r"\{(\w+)(?::0(\d)d)?\}")


def import_lerobot(
    source: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    env_id: str | None = None,
    image_key: str | None = None,
) -> str:
    """Make a dataset folder of a LeRobot folder of version 3.

    :param source: the folder that holds ``meta/info.json``
    :param folder: new or empty
    :param env_id: recorded with the dataset; one of Gymnasium's registry gives the action space, too. Without one, the
        bounds of the action space are the smallest and the largest actions
    :param image_key: which camera, such as "observation.images.top"; None for the only one
    :return: the hash of the new dataset
    :raises ValueError: for another version, a missing file, or frames that are not where their timestamps say
    :raises ImportError: without PyArrow or PyAV, naming the command that installs them
    """
    _import("pyarrow.parquet"), _import("av")
    check_folder(Path(folder))
    recording = _Recording(Path(source), image_key)
    chunks = (recording.actions(episode) for episode in recording.episodes)
    action_space, from_actions = find_action_space(env_id, chunks, str(source))
    layout, codec = recording.video_layout()
    short = sum(episode.length < 2 for episode in recording.episodes)
    left_out = ["the last action of each episode, whose outcome is not recorded"]
    left_out += [f"{short} episodes of a single frame"] if short else []
    left_out += [key for key in recording.features if key not in recording.used()]
    return write_dataset(
        folder,
        (recording.segment(e, layout, action_space) for e in recording.episodes if e.length > 1),
        env_id=env_id or Path(source).resolve().name,
        observation_space=layout.space,
        action_space=action_space,
        source={
            "lerobot": Path(source).resolve().name,
            "codebase_version": recording.version,
            "image_key": recording.camera,
            "fps": recording.fps,
            CHANNELS_KEY: layout.channels,
            LOSSY_KEY: f"{codec} video",
            LEFT_OUT_KEY: left_out,
            "action_space_from_data": from_actions,
        },
    )


@dataclass(frozen=True)
class _Episode:
    """An episode, and where it is.

    :param index: its number
    :param length: its frames
    :param table: file of its rows
    :param video: file of its frames
    :param begin: when it begins in the video, in seconds
    :param end: when it ends there
    """

    index: int
    length: int
    table: Path
    video: Path
    begin: float
    end: float


class _Recording:
    """A LeRobot folder, one camera of it.

    :param path: the folder
    :param camera: a feature that is a video; None for the only one
    """

    def __init__(self, path: Path, camera: str | None) -> None:
        self.path = path
        info_path = path / "meta" / "info.json"
        if not info_path.is_file():
            raise ValueError(f"{path} is no LeRobot folder (no meta/info.json); name the folder that holds meta/")
        info = from_json_file(info_path)
        self.version = str(info.get("codebase_version"))
        if not _VERSION.fullmatch(self.version):
            raise ValueError(
                f"{path} is of LeRobot's version {self.version}, and v3.0 is read; convert it with the script "
                "convert_dataset_v21_to_v30 of the package lerobot"
            )
        try:
            self.fps = float(info["fps"])
            self.features: dict[str, dict[str, Any]] = dict(info["features"])
            patterns = str(info["data_path"]), str(info.get("video_path"))
            total, shapes = int(info["total_episodes"]), {k: tuple(f["shape"]) for k, f in self.features.items()}
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{info_path} lacks what LeRobot writes there ({error!r}); download it again") from None
        if not 0 < self.fps < 1e6:
            raise ValueError(f"{info_path} says {self.fps} frames per second; correct it")
        self.camera = self._choose(camera)
        self.shape = shapes[self.camera]
        self.state = {
            key: shape
            for key, shape in shapes.items()
            if key.startswith("observation.") and len(shape) < 2 and _is_number(self.features[key])
        }
        names = [factor_name(key) for key in self.state]
        if len(set(names)) != len(names) or ACTION not in self.features or len(shapes[ACTION]) != 1:
            raise ValueError(
                f"{info_path} has features {list(shapes)}; there must be an {ACTION} of one dimension, and names must "
                "differ in letters, digits and underscores"
            )
        self.action_shape = shapes[ACTION]
        self.episodes = self._read_episodes(total, *patterns)
        self._table: tuple[Path, dict[str, NDArray[Any]]] | None = None

    def _choose(self, camera: str | None) -> str:
        cameras = [key for key, feature in self.features.items() if feature.get("dtype") == "video"]
        if camera is None and len(cameras) == 1:
            camera = cameras[0]
        if not cameras:
            raise ValueError(f"{self.path} has no videos; images in its tables are not read, record them as videos")
        if camera not in cameras:
            raise ValueError(
                f"{self.path} has {len(cameras)} videos ({', '.join(cameras)}), not {camera!r}; choose one with "
                "--image-key"
            )
        if any(value for key, value in (self.features[camera].get("info") or {}).items() if "depth" in key):
            raise ValueError(f"{camera} of {self.path} is a map of depths, which is no image; choose another camera")
        return camera

    def used(self) -> set[str]:
        """The features that the dataset holds."""
        return {self.camera, ACTION, *self.state, *_NUMBERING}

    def _read_episodes(self, total: int, data_path: str, video_path: str) -> list[_Episode]:
        files = find(self.path / "meta" / "episodes", "**/*.parquet")
        video = f"videos/{self.camera}"
        names = ["episode_index", "length", "data/chunk_index", "data/file_index"]
        names += [f"{video}/{name}" for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp")]
        columns = [_read_table(file, names) for file in files]
        rows = list(zip(*(np.concatenate([c[name] for c in columns]).tolist() for name in names))) if files else []  # noqa: B905
        if len(rows) != total or sorted(row[0] for row in rows) != list(range(total)) or not total:
            raise ValueError(
                f"{self.path} announces {total} episodes and describes {len(rows)} in meta/episodes; download the "
                "whole folder"
            )
        return [
            _Episode(
                int(index),
                int(length),
                self._file(data_path, chunk_index=int(chunk), file_index=int(file)),
                self._file(video_path, chunk_index=int(video_chunk), file_index=int(video_file), video_key=self.camera),
                begin,
                end,
            )
            for index, length, chunk, file, video_chunk, video_file, begin, end in sorted(rows)
        ]

    def _file(self, pattern: str, **values: Any) -> Path:
        """A file of the folder: the pattern may hold nothing but names of the values, and lead nowhere else."""

        def fill(match: re.Match[str]) -> str:
            name, width = match.groups()
            if name not in values:
                raise ValueError(f"{self.path} has the path {pattern!r}; only {', '.join(values)} can stand in it")
            return str(values[name]).rjust(int(width or 0), "0")

        name = PurePosixPath(_FIELD.sub(fill, pattern))
        if name.is_absolute() or ".." in name.parts or {"{", "}", "\\"} & set(str(name)):
            raise ValueError(
                f"{self.path} has the path {pattern!r}, which may lead out of the folder; correct info.json"
            )
        path = self.path / name
        if not path.is_file():
            raise ValueError(f"{path} is missing; download the whole folder")
        return path

    def _rows(self, episode: _Episode) -> dict[str, NDArray[Any]]:
        """The rows of an episode: column to array."""
        if self._table is None or self._table[0] != episode.table:
            names = ["episode_index", "frame_index", "timestamp", ACTION, *self.state]
            self._table = episode.table, _read_table(episode.table, names)
        here = np.flatnonzero(self._table[1]["episode_index"] == episode.index)
        rows = {name: array[here] for name, array in self._table[1].items()}
        if not np.array_equal(rows["frame_index"], np.arange(episode.length)):
            raise ValueError(
                f"{episode.table} has {len(here)} rows of episode {episode.index}, in place of {episode.length} in "
                "order; damaged or forged, download it again"
            )
        return rows

    def actions(self, episode: _Episode) -> NDArray[Any]:
        """All actions of an episode, [L, ...]."""
        return self._shaped(self._rows(episode)[ACTION], self.action_shape, ACTION)

    def _shaped(self, array: NDArray[Any], shape: tuple[int, ...], name: str) -> NDArray[Any]:
        if array.size != len(array) * int(np.prod(shape)):
            raise ValueError(f"{name} in {self.path} has rows of shape {array.shape[1:]}, in place of {shape}")
        return array.reshape(len(array), *shape)

    def video_layout(self) -> tuple[ImageLayout, str]:
        """The layout of decoded frames, and the name of the codec."""
        import av

        video = self.episodes[0].video
        try:
            with open_container(video) as container:
                context = container.streams.video[0].codec_context
                shape, codec = (context.height, context.width, 3), context.codec.canonical_name
        except (av.FFmpegError, IndexError, AttributeError) as error:
            raise ValueError(f"{video} cannot be decoded ({error}); download it again") from None
        # What the axes are called is not always true.
        if self.shape not in (shape, (shape[2], *shape[:2])):
            raise ValueError(f"{video} has frames of shape {shape}, and info.json says {self.shape}; correct it")
        return recorded_layout(spaces.Box(0, 255, shape, np.uint8), None, self.camera), codec

    def segment(self, episode: _Episode, layout: ImageLayout, action_space: ActionSpace) -> Segment:
        """An episode without its last action.

        :param episode: of two frames at least
        :param layout: of :meth:`video_layout`
        :param action_space: of one action
        """
        rows = self._rows(episode)
        times = episode.begin + rows["timestamp"].astype(np.float64)
        half = 0.5 / self.fps
        # A frame at the end would be the next episode's first.
        if not (np.diff(times) > 0).all() or times[0] < episode.begin - half or times[-1] > episode.end - half / 2:
            raise ValueError(
                f"episode {episode.index} of {self.path} lasts from {times[0]:.4f} to {times[-1]:.4f} s by its rows, "
                f"which must ascend, and from {episode.begin:.4f} to {episode.end:.4f} s by meta/episodes; record it "
                "again"
            )
        _, height, width = layout.space.shape
        frames = _decode(episode.video, times, half, (height, width))
        factors = {factor_name(key): self._shaped(rows[key], shape, key) for key, shape in self.state.items()}
        actions = recorded_actions(self.actions(episode)[:-1], action_space)
        return Segment(layout.images(frames), actions, TRUNCATED, factors)


def _is_number(feature: dict[str, Any]) -> bool:
    try:
        return np.dtype(str(feature.get("dtype"))).kind in "biuf"
    except TypeError:
        return False


def _import(name: str) -> Any:
    with needs_extra("lerobot", "LeRobot's format"):
        return importlib.import_module(name)


def _read_table(path: Path, names: list[str]) -> dict[str, NDArray[Any]]:
    """Columns of a Parquet file: [n], or of lists [n, m].

    :param path: the file
    :param names: of the columns
    :raises ValueError: for a damaged file, a missing column, a gap, or lists of different lengths
    """
    import pyarrow
    import pyarrow.parquet

    try:
        # An open file: a name such as http:a would be taken for an address.
        with path.open("rb") as file:
            table = pyarrow.parquet.ParquetFile(file)
            _check_size(table.metadata, names)
            missing = [name for name in names if name not in table.schema_arrow.names]
            if missing:
                raise ValueError(f"there is no column {missing[0]!r}")
            # Column by column: names with dots are otherwise taken for nested ones.
            return {name: _to_numpy(pyarrow, name, table.read(columns=[name]).column(name)) for name in names}
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        if is_of_system(error):
            raise
        raise ValueError(f"{path} cannot be read as LeRobot writes it ({error}); download it again") from None


def _check_size(metadata: Any, names: list[str]) -> None:
    """Before they are unpacked: equal values take no room in a file."""
    groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
    columns = [group.column(k) for group in groups for k in range(group.num_columns)]
    # Those of lists lie below their names.
    wanted = [c for c in columns if any(f"{c.path_in_schema}.".startswith(f"{name}.") for name in names)]
    n_bytes = 8 * sum(max(column.num_values, 0) for column in wanted)
    if n_bytes > MAX_TABLE_BYTES:
        raise ValueError(f"its columns declare {n_bytes} bytes, more than {MAX_TABLE_BYTES}")


def _to_numpy(pyarrow: Any, name: str, column: Any) -> NDArray[Any]:
    if column.null_count:
        raise ValueError(f"column {name!r} has gaps")
    width = None
    if pyarrow.types.is_list(column.type) or pyarrow.types.is_fixed_size_list(column.type):
        lengths = np.unique(pyarrow.compute.list_value_length(column).to_numpy())
        if len(lengths) > 1:
            raise ValueError(f"column {name!r} has lists of {lengths.tolist()} numbers")
        width = int(lengths[0]) if len(lengths) else 0
        column = pyarrow.compute.list_flatten(column)
    array = column.to_numpy()
    if array.dtype.kind not in "biuf" or column.null_count:
        raise ValueError(f"column {name!r} holds {column.type}, or gaps, in place of numbers")
    return array if width is None else array.reshape(-1, width)  # type: ignore[no-any-return]


def _decode(path: Path, times: NDArray[np.float64], half: float, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The frames at given times.

    :param path: of a video
    :param times: ascending, in seconds
    :param half: a frame must be nearer than this
    :param size: height and width of every frame
    :return: [n, height, width, 3]
    :raises ValueError: if there is none at a time, or frames are of another size
    """
    frames = np.empty((len(times), *size, 3), np.uint8)
    # Seeking is a shortcut, whose end the container decides; the whole file is the way to be sure.
    for begin in (times[0] - half, None):
        distances = np.full(len(times), half)
        for time, frame in _decoded(path, begin, times[-1] + half):
            i = int(np.abs(times - time).argmin())
            if abs(times[i] - time) < distances[i]:
                if (frame.height, frame.width) != size or frame.rotation:
                    raise ValueError(
                        f"{path} has a frame of {frame.height} x {frame.width} pixels at {time:.4f} s (rotated by "
                        f"{frame.rotation}), in place of {size[0]} x {size[1]}; encode it again"
                    )
                frames[i], distances[i] = frame.to_ndarray(format="rgb24"), abs(times[i] - time)
        missing = np.flatnonzero(distances == half)
        if not len(missing):
            return frames
    raise ValueError(
        f"{path} has no frame within {half:.4f} s of {times[missing[0]]:.4f} s, nor at {len(missing) - 1} other times "
        "of the episode; its timestamps do not fit to the video, record or convert it again"
    )


def _decoded(path: Path, begin: float | None, end: float) -> Iterator[tuple[float, Any]]:
    """Frames of a video with their times, from a frame before ``begin`` on."""
    import av

    try:
        with open_container(path) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            if begin is not None and begin > 0 and stream.time_base:
                container.seek(int(begin / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                if frame.time is None:
                    raise ValueError(f"{path} has frames without a time; encode it again")
                if frame.time > end:
                    return
                yield frame.time, frame
    except (av.FFmpegError, IndexError, AttributeError) as error:
        raise ValueError(f"{path} cannot be decoded ({error}); download it again") from None


register_reader("lerobot", import_lerobot, help="a LeRobot folder of version 3; --image-key chooses the camera")
