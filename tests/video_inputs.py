"""What the tests of custom videos share: an empty cache, and small clips."""

import numpy as np
import pytest

from sb3_abisim.envs.backgrounds.load import load_backgrounds

av = pytest.importorskip("av")
Image = pytest.importorskip("PIL.Image")


@pytest.fixture(autouse=True, name="cache")
def empty_cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("SB3_ABISIM_CACHE", str(folder))
    return folder


@pytest.fixture(name="folder")
def videos_folder(tmp_path):
    (tmp_path / "videos").mkdir()
    return tmp_path / "videos"


def shade(seed, frame):
    return (40 * seed + 2 * frame) % 250


def write_video(path, seed=0, n_frames=64, size=(96, 72), codec="mpeg4", title=None, n_hidden=0, pause=0, options=None):
    """A video whose frames brighten one by one; black outside of the central square.

    The first ``n_hidden`` come before its beginning; its middle frame stands for ``pause`` frames more.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=options or {}) as container:
        if title:
            container.metadata["title"] = title
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = 4_000_000
        margin = (size[0] - size[1]) // 2
        for i in range(n_frames):
            pixels = np.zeros((size[1], size[0], 3), dtype=np.uint8)
            pixels[:, margin : size[0] - margin] = shade(seed, i)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts = i - n_hidden + (pause if i > n_frames // 2 else 0)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def write_frames(folder, seed=0, numbers=range(20), pattern="frame{}.png", size=(80, 60)):
    """Frame n is filled with its number (red) and the seed (green)."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        Image.new("RGB", size, (number, seed, 7)).save(folder / pattern.format(number))
    return folder


def two_folders(folder):
    return write_frames(folder / "a", 1), write_frames(folder / "b", 2)


def both(folder, **kwargs):
    return [load_backgrounds(folder, split, **kwargs) for split in ("train", "eval")]


def shown(clips, index=0):
    return clips.frames(np.full(clips.lengths[index], index), np.arange(clips.lengths[index]))
