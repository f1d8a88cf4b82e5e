"""Half a file of any container is refused, what is shown is upright, and nothing but the file is opened."""

import socket
import struct

import numpy as np
import pytest
from video_inputs import Image, av, empty_cache, videos_folder, write_frames, write_video  # noqa: F401

from sb3_abisim.envs.backgrounds import video_frames
from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.video_files import find_sources
from sb3_abisim.envs.backgrounds.video_frames import decode_clip, decode_video
from sb3_abisim.envs.backgrounds.video_whole import ClipError, require_whole

FRAGMENTED = {"movflags": "frag_keyframe+empty_moov", "g": "8"}


def count(path):
    return sum(1 for _ in decode_video(path))


def write_gif(path, n=20):
    frames = [Image.fromarray(np.full((40, 60), 10 * i, np.uint8)) for i in range(n)]
    frames[0].save(path, save_all=True, append_images=frames[1:])
    return path


def write_webp(path, n=20):
    frames = [Image.new("RGB", (40, 40), (10 * i, 7, 7)) for i in range(n)]
    frames[0].save(path, save_all=True, append_images=frames[1:])
    return path


def ogg_page(number, flags, n=200, serial=7):
    return b"OggS" + struct.pack("<BBqIIIB", 0, flags, 0, serial, number, 0, 1) + bytes([n]) + bytes(n)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 0.99])
@pytest.mark.parametrize("kind", ["gif", "fragmented.mp4", "webp", "webm", "mov", "avi"])
def test_half_a_file_is_refused(folder, kind, share):
    path = folder / f"a.{kind}"
    if kind in ("gif", "webp"):
        (write_gif if kind == "gif" else write_webp)(path)
    else:
        options = FRAGMENTED if kind.startswith("frag") else {"movflags": "faststart"} if kind == "mov" else None
        write_video(path, codec="libvpx" if kind == "webm" else "mpeg4", n_frames=200, options=options)
    (source,) = find_sources(folder)
    whole = sum(1 for _ in decode_clip(source))
    assert whole == (20 if kind in ("gif", "webp") else 200)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(ClipError):
        for _ in decode_clip(source):
            pass


def test_fragments_that_end_between_two_are_refused(folder):
    raw = write_video(folder / "a.mp4", n_frames=60, options=FRAGMENTED).read_bytes()
    last = raw.rindex(b"moof") - 4
    (folder / "a.mp4").write_bytes(raw[:last])
    with pytest.raises(ClipError, match="fragments are not listed at the end: ffmpeg -i"):
        count(folder / "a.mp4")


def test_pages_of_ogg(folder):
    path = folder / "a.ogv"
    pages = [ogg_page(0, 2), ogg_page(1, 0), ogg_page(2, 0), ogg_page(3, 4)]
    path.write_bytes(b"".join(pages))
    assert require_whole(path)
    for damaged in (pages[:3], pages[:1] + pages[2:], [*pages[:3], pages[3][:-1]]):
        path.write_bytes(b"".join(damaged))
        with pytest.raises(ClipError, match="cut off or damaged"):
            require_whole(path)


def test_a_program_stream_without_an_end_is_refused(folder):
    raw = write_video(folder / "a.mpg", codec="mpeg1video").read_bytes()
    with pytest.raises(ClipError, match="no end code"):
        count(folder / "a.mpg")
    (folder / "a.mpg").write_bytes(raw.rstrip(b"\xff\x00") + b"\x00\x00\x01\xb9")
    assert count(folder / "a.mpg") >= 63


def test_a_file_that_does_not_say_how_long_it_is_is_refused(folder):
    write_video(folder / "a.mkv", options={"live": "1"})
    with pytest.raises(ClipError, match="does not say how long it is"):
        count(folder / "a.mkv")


def test_a_cover_is_no_clip(folder):
    with av.open(str(folder / "a.mp4"), "w") as container:
        sound = container.add_stream("aac", rate=8000)
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 32, 32, "yuvj420p"
        cover.disposition = av.stream.Disposition.attached_pic
        for i in range(8):
            samples = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            samples.sample_rate, samples.pts = 8000, 1024 * i
            container.mux(sound.encode(samples))
        container.mux(cover.encode(av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), "rgb24")))
        container.mux(cover.encode()), container.mux(sound.encode())
    with pytest.raises(ClipError, match="holds no video but a cover"):
        count(folder / "a.mp4")


@pytest.mark.parametrize("name", ["http:a.mp4", "part1:intro.mp4", "concat:a|b.mp4", "http:127.0.0.1:9.gif"])
def test_a_name_like_an_address_is_a_file(folder, name, monkeypatch):
    monkeypatch.chdir(folder)
    path = type(folder)(name)
    n = 20 if name.endswith("gif") else 64
    (write_gif if name.endswith("gif") else write_video)(folder / name)
    assert count(path) == n
    assert video_frames.expected_frames(find_sources(type(folder)("."))[0]) in (n, 0)


def test_a_playlist_reaches_for_nothing(folder):
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0)), server.listen(1), server.settimeout(0.3)
        address = f"http://127.0.0.1:{server.getsockname()[1]}/a.ts"
        text = f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{address}\n#EXT-X-ENDLIST\n"
        for name in ("a.mp4", "b.mkv"):
            (folder / name).write_text(text)
            with pytest.raises(ClipError, match="cannot be decoded after 0 frames"):
                count(folder / name)
        with pytest.raises(TimeoutError):
            server.accept()


def write_quadrants(path, matrix=None, size=(64, 64)):
    """Gray values 40, 90, 140 and 190 at the upper left, upper right, lower left and lower right."""
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    for i, (rows, columns) in enumerate((r, c) for r in (0, 1) for c in (0, 1)):
        h, w = size[1] // 2, size[0] // 2
        pixels[rows * h : rows * h + h, columns * w : columns * w + w] = 40 + 50 * i
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = *size, "yuv420p", 4_000_000
        for _ in range(16):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        container.mux(stream.encode())
    if matrix is not None:
        raw = bytearray(path.read_bytes())
        begin = raw.index(b"tkhd") + 4 + 40
        a, b, c, d = matrix
        raw[begin : begin + 36] = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
        path.write_bytes(raw)
    return path


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((1, 0, 0, 1), [40, 90, 140, 190]),
        ((0, 1, -1, 0), [140, 40, 190, 90]),  # a quarter to the right, as a telephone writes it
        ((-1, 0, 0, -1), [190, 140, 90, 40]),
        ((0, -1, 1, 0), [90, 190, 40, 140]),
        ((-1, 0, 0, 1), [90, 40, 190, 140]),  # mirrored
        ((1, 0, 0, -1), [140, 190, 40, 90]),
        ((0, 1, 1, 0), [40, 140, 90, 190]),
        ((0, -1, -1, 0), [190, 90, 140, 40]),
    ],
)
def test_frames_are_turned_and_mirrored(folder, matrix, shown):
    write_quadrants(folder / "a.mp4", matrix)
    frame = next(iter(decode_clip(find_sources(folder)[0])))[0].astype(int)
    assert np.abs(frame[[16, 16, 48, 48], [16, 48, 16, 48]] - shown).max() <= 6


def test_images_are_turned_as_their_header_says(folder):
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32] = 200
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter to the right
    (folder / "a").mkdir()
    Image.fromarray(pixels).save(folder / "a" / "0.png", exif=exif)
    frame = next(iter(decode_clip(find_sources(folder)[0])))
    assert frame[0, 32, 60] == 200 and frame[0, 32, 4] == 0


def test_the_aspect_of_pixels():
    # 40 x 60 pixels that are three times as wide as high are shown as 120 x 60: its middle 60 are 20 columns.
    pixels = np.zeros((60, 40, 3), np.uint8)
    pixels[:, 10:30] = 200
    assert (video_frames.shrink(Image.fromarray(pixels), 3.0) == 200).all()
    assert not (video_frames.shrink(Image.fromarray(pixels), 1.0) == 200).all()


def test_the_aspect_of_pixels_comes_from_the_header(folder):
    with av.open(str(folder / "a.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        stream.codec_context.sample_aspect_ratio = 2
        for _ in range(4):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), "rgb24")))
        container.mux(stream.encode())
    assert {aspect for _, aspect in decode_video(folder / "a.mp4")} == {2.0}


def test_an_image_of_several_images_is_refused(folder):
    for seed in range(2):
        write_frames(folder / str(seed), seed)
        images = [Image.new("RGB", (80, 60), (i, seed, 9)) for i in range(3)]
        images[0].save(folder / str(seed) / "frame4.png", save_all=True, append_images=images[1:])
    with pytest.raises(ClipError, match=r"frame4\.png holds several frames"):
        load_backgrounds(folder)
