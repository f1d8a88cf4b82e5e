"""Frames whose colors are not known to be read right, and those that are."""

import io

import numpy as np
import pytest
from video_inputs import Image, av, empty_cache, two_folders, videos_folder, write_frames  # noqa: F401

from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.video_files import find_sources
from sb3_abisim.envs.backgrounds.video_frames import decode_clip, decode_video
from sb3_abisim.envs.backgrounds.video_whole import ClipError

COLOR = (200, 60, 30)


def write(path, codec="ffv1", pix_fmt="yuv444p", size=(96, 72), alpha=255, n_streams=1, options=None, **context):
    """Twenty frames of one color, of which the upper half has an alpha."""
    with av.open(str(path), "w") as container:
        streams = [container.add_stream(codec, rate=25, options=options or {}) for _ in range(n_streams)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = *size, pix_fmt
            for name, value in context.items():
                setattr(stream.codec_context, name, value)
        pixels = np.full((size[1], size[0], 4), (*COLOR, 255), np.uint8)
        pixels[: size[1] // 2, :, 3] = alpha
        for _ in range(20):
            for stream in streams:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgba")))
        for stream in streams:
            container.mux(stream.encode())
    return path


def count(path):
    return sum(1 for _ in decode_video(path))


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("odd sides", {"size": (95, 71)}),
        ("10 bits", {"pix_fmt": "yuv444p10le"}),
        ("12 bits", {"pix_fmt": "yuv444p12le"}),
        ("RGB", {"pix_fmt": "gbrp16le"}),
        ("full range", {"codec": "mjpeg", "pix_fmt": "yuvj444p", "options": {"qscale": "1"}}),
        ("alpha that hides nothing", {"pix_fmt": "bgra"}),
    ],
)
def test_the_colors_of_each_kind(folder, name, settings):
    path = write(folder / "a.mkv", **settings)
    frames = list(decode_clip(find_sources(folder)[0]))
    assert len(frames) == 20 and count(path) == 20
    assert abs(frames[7].reshape(3, -1).T - np.array(COLOR, float)).max() <= 3


@pytest.mark.parametrize(
    ("suffix", "settings"),
    [
        ("mov", {"codec": "qtrle", "pix_fmt": "argb"}),
        ("mov", {"codec": "png", "pix_fmt": "rgba"}),
        ("mkv", {"codec": "ffv1", "pix_fmt": "yuva444p"}),
        ("webm", {"codec": "libvpx-vp9", "pix_fmt": "yuva420p"}),  # its decoder drops the alpha
    ],
    ids=["qtrle", "png", "ffv1", "vp9"],
)
def test_videos_that_are_transparent_in_parts_are_refused(folder, suffix, settings):
    with pytest.raises(ClipError, match=rf"a\.{suffix} is transparent in parts; lay it over a color"):
        count(write(folder / f"a.{suffix}", alpha=90, **settings))


def test_hdr_and_stereo_and_several_videos_are_refused(folder):
    for transfer in (16, 18):
        with pytest.raises(ClipError, match="is in HDR, whose colors are not read; convert it: ffmpeg"):
            count(write(folder / "a.mkv", color_trc=transfer))
    stereo = {"codec": "libx264", "options": {"x264-params": "frame-packing=3"}}
    with pytest.raises(ClipError, match="holds two images or a sphere in each frame"):
        count(write(folder / "b.mkv", **stereo))
    with pytest.raises(ClipError, match=r"holds 2 videos, and which is meant is not known; take one: ffmpeg -i c\.mkv"):
        count(write(folder / "c.mkv", n_streams=2))


def animated(path, seed, **kwargs):
    images = [Image.new("RGBA", (64, 64), (COLOR[0], seed, 9 * i, 255)) for i in range(20)]
    for image in images[1:]:
        image.putpixel((40, 40), (0, 0, 0, 0))
    images[0].save(path, save_all=True, append_images=images[1:], **kwargs)


@pytest.mark.parametrize(("suffix", "kwargs"), [("gif", {"disposal": 2}), ("webp", {"lossless": True})])
def test_animated_images_that_are_transparent_are_refused(folder, suffix, kwargs):
    for seed in range(2):
        animated(folder / f"{seed}.{suffix}", seed, **kwargs)
    with pytest.raises(ClipError, match=rf"\d\.{suffix} is transparent in parts"):
        load_backgrounds(folder)


def frame5(folder, image, **kwargs):
    image.save(folder / "b" / "frame5.png", **kwargs)


@pytest.mark.parametrize(
    ("image", "kwargs", "message"),
    [
        (Image.new("RGBA", (80, 60), (9, 9, 9, 254)), {}, "is transparent in parts"),
        (Image.new("P", (80, 60)), {"transparency": 0}, "is transparent in parts"),
        (Image.new("CMYK", (80, 60)), {"format": "JPEG"}, "has colors of the kind CMYK, which are not read; convert"),
        (Image.new("RGB", (60, 80)), {}, "has 60 x 80 pixels, and frames before it have others"),
        # Pillow would start Ghostscript.
        (Image.new("RGB", (80, 60)), {"format": "EPS"}, "cannot be decoded .*cannot identify"),
        (Image.new("RGB", (80, 60)), {"format": "TIFF"}, "cannot be decoded .*cannot identify"),
    ],
    ids=["alpha", "palette", "CMYK", "size", "EPS", "TIFF"],
)
def test_frames_that_are_not_known_to_be_read_right_are_refused(folder, image, kwargs, message):
    two_folders(folder)
    frame5(folder, image, **kwargs)
    with pytest.raises(ClipError, match=rf"frame5\.png {message}"):
        load_backgrounds(folder)


def test_frames_with_an_alpha_that_hides_nothing(folder):
    two_folders(folder)
    frame5(folder, Image.new("RGBA", (80, 60), (*COLOR, 255)))
    frame = list(decode_clip(find_sources(folder)[1]))[5]
    assert frame[:, 9, 9].tolist() == list(COLOR)


@pytest.mark.parametrize("error", [ValueError("x"), RuntimeError("x"), KeyError("x"), IndexError("x")])
def test_whatever_pillow_raises_is_one_sentence(folder, error, monkeypatch):
    def fail(*_):
        raise error

    two_folders(folder)
    monkeypatch.setattr("PIL.PngImagePlugin.PngImageFile.load", fail)
    with pytest.raises(ClipError, match=r"frame0\.png cannot be decoded \(.*x.*\); replace the file or remove"):
        load_backgrounds(folder)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["1.png", "01.png"], r"several images of one number, N\.png and N\.png"),
        (["1.png", "1.PNG"], r"several images of one number, N\.png and N\.png"),
        (["sun.jpg", "sea.jpg"], r"no numbers of one series \(sea, sun\): photographs, or frames of several clips"),
        (["bear_1.jpg", "camel_2.jpg"], r"no numbers of one series \(bear_N, camel_N\)"),
    ],
)
def test_images_that_are_no_series_are_refused(folder, names, message):
    for name in names:
        write_frames(folder / "a", 1, [3], name)
    with pytest.raises(ValueError, match=message):
        find_sources(folder)


def test_a_gap_before_a_suffix_is_found(folder):
    for seed in range(2):
        write_frames(folder / str(seed), seed, [*range(10), *range(15, 25)], "{:03}_left.png")
    with pytest.raises(ClipError, match=r"20 of 25 frames: there is none between 009_left\.png and 015_left\.png"):
        load_backgrounds(folder)


def test_a_jpeg_of_countless_scans_is_not_decoded(folder):
    two_folders(folder)
    file = io.BytesIO()
    Image.new("L", (80, 60)).save(file, "JPEG", progressive=True)
    data = file.getvalue()
    (folder / "b" / "frame5.png").write_bytes(data[:-2] + data[data.rindex(b"\xff\xda") : -2] * 420_000 + data[-2:])
    with pytest.raises(ClipError, match=r"frame5\.png has more scans than programs write"):
        load_backgrounds(folder)
