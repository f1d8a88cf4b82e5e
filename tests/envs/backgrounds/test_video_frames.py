"""Decoding custom videos, and every damage with its remedy."""

import struct
import sys

import numpy as np
import pytest
from video_inputs import (  # noqa: F401
    Image,
    av,
    both,
    empty_cache,
    shade,
    shown,
    two_folders,
    videos_folder,
    write_frames,
    write_video,
)

from sb3_abisim.envs.backgrounds import video_frames
from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.video_whole import ClipError
from sb3_abisim.envs.point_maze.distractors import DistractorPointMazeVectorEnv


class TestDecoding:
    def test_a_title_in_another_encoding_does_no_harm(self, folder):
        for seed in range(2):
            path = write_video(folder / f"{seed}.avi", seed, title="CafXX")
            assert b"CafXX" in path.read_bytes()
            path.write_bytes(path.read_bytes().replace(b"CafXX", b"Caf\xe9s"))
        assert [side.lengths.tolist() for side in both(folder)] == [[64], [64]]

    @pytest.mark.parametrize("on_error", ["raise", "skip"])
    def test_images_of_more_than_8_bits_are_refused(self, folder, on_error):
        for seed in range(4):
            write_frames(folder / f"clip{seed}", seed)
        deep = Image.fromarray(np.arange(4800, dtype=np.uint16).reshape(60, 80))
        for seed in range(4):
            deep.save(folder / f"clip{seed}" / "frame3.png")
        with pytest.raises(ValueError, match=r"frame3\.png has more than 8 bits per value \(I;16\)"):
            load_backgrounds(folder, "train", on_error=on_error)

    def test_video_frames_in_order_and_cropped_to_the_center(self, folder):
        for seed in range(3):
            write_video(folder / f"movie{seed}.mp4", seed)
        for clips in both(folder):
            for index, name in enumerate(clips.names):
                frames = shown(clips, index).astype(int)
                assert frames.shape == (64, 3, 64, 64)
                expected = shade(int(name[5]), np.arange(64))
                assert np.abs(frames[:, :, 32, 32] - expected[:, None]).max() <= 8
                assert np.abs(frames[:, :, 32, 2] - expected[:, None]).max() <= 12  # the black margin is cut off

    def test_frames_in_natural_order_averaged_to_64(self, folder):
        write_frames(folder / "a", 1), write_frames(folder / "b", 2, size=(192, 128))
        Image.fromarray(np.arange(128 * 192 * 3, dtype=np.uint8).reshape(128, 192, 3)).save(folder / "b" / "frame5.png")
        clips = {name: (side, i) for side in both(folder) for i, name in enumerate(side.names)}
        assert sorted(clips) == ["a", "b"]
        a, b = (shown(*clips[name]) for name in "ab")
        assert a[:, 0, 9, 9].tolist() == list(range(20))  # not 0, 1, 10, 11, ...
        assert (a[:, 1] == 1).all() and (a[:, 2] == 7).all()
        original = np.arange(128 * 192 * 3, dtype=np.uint8).reshape(128, 192, 3)[:, 32:160].astype(float)
        means = original.reshape(64, 2, 64, 2, 3).mean(axis=(1, 3)).transpose(2, 0, 1)
        assert np.abs(b[5] - means).max() <= 1

    def test_matroska_without_a_frame_count(self, folder):
        for seed in range(2):
            write_video(folder / f"{seed}.mkv", seed)
        assert [clips.lengths.tolist() for clips in both(folder)] == [[64], [64]]

    def test_a_trimmed_mp4_file_shows_a_part_of_its_frames(self, folder):
        path = write_video(folder / "trimmed.mp4", n_hidden=20)
        raw = path.read_bytes()
        entry = raw.index(b"elst") + 12  # what an editor writes: length in ms and beginning
        assert struct.unpack(">I", raw[entry : entry + 4])[0] == 40 * 44
        for n_shown in (44, 30):
            path.write_bytes(raw[:entry] + struct.pack(">I", 40 * n_shown) + raw[entry + 4 :])
            with av.open(str(path)) as container:
                assert container.streams.video[0].frames == 64
            shades = [np.asarray(image)[36, 48, 0] for image, _ in video_frames.decode_video(path)]
            expected = shade(0, 20 + np.arange(n_shown))
            assert len(shades) == n_shown and np.abs(np.array(shades, dtype=int) - expected).max() <= 8

    def test_in_the_environment(self, folder):
        two_folders(folder)
        env = DistractorPointMazeVectorEnv(2, videos=str(folder), split="eval", video_kwargs={"min_frames": 20})
        observations, _ = env.reset(seed=0)
        name = load_backgrounds(folder, "eval").names[0]
        shown = (observations[:, 1] == {"a": 1, "b": 2}[name]) & (observations[:, 2] == 7)
        assert shown.mean() > 0.3
        assert (observations[0, 0][shown[0]] == env.factors()["frame"][0]).all()


class TestDamage:
    def test_undecodable_video(self, folder):
        for name in "abcd":
            (folder / f"{name}.mp4").write_bytes(name.encode() * 5000)
        with pytest.raises(ClipError, match=r"[a-d]\.mp4 cannot be decoded after 0 frames.*; replace the file"):
            load_backgrounds(folder)

    def test_undecodable_frame(self, folder):
        for path in two_folders(folder):
            (path / "frame7.png").write_bytes((path / "frame7.png").read_bytes()[:60])
        with pytest.raises(ClipError, match=r"frame7\.png cannot be decoded"):
            load_backgrounds(folder)

    @pytest.mark.parametrize("suffix", ["mkv", "avi"])
    def test_half_a_video(self, folder, suffix):
        for seed in range(2):
            path = write_video(folder / f"{seed}.{suffix}", seed, 200)
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(ClipError, match=rf"\.{suffix}"):
            load_backgrounds(folder)

    def test_half_a_matroska_file_says_how_many_frames_are_missing(self, folder):
        path = write_video(folder / "half.mkv", 0, 200)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(ClipError, match=r"half\.mkv is cut off or damaged \(\d+ of \d+ bytes\)"):
            list(video_frames.decode_video(path))

    @pytest.mark.parametrize(("name", "hidden", "left"), [("a.mp4", 20, 100), ("a.mp4", 20, 195), ("a.avi", 0, 150)])
    def test_cut_off_between_two_frames(self, folder, name, hidden, left):
        path = write_video(folder / name, 0, 200, n_hidden=hidden, options={"movflags": "faststart"})
        with av.open(str(path)) as container:
            starts = [packet.pos for packet in container.demux() if packet.size]
        assert len(list(video_frames.decode_video(path))) == 200 - hidden
        path.write_bytes(path.read_bytes()[: starts[left - 200]])
        with pytest.raises(
            ClipError, match=rf"decoded {left - hidden} of 200 frames .*{name}: the file is cut|avi is cut off"
        ):
            list(video_frames.decode_video(path))

    def test_a_matroska_file_whose_frames_are_not_evenly_timed_names_the_remedy(self, folder):
        path = write_video(folder / "uneven.mkv", pause=100)
        with pytest.raises(ClipError, match=r"64 of 164 .*: ffmpeg -i uneven\.mkv -fps_mode cfr even\.mp4"):
            list(video_frames.decode_video(path))

    def test_damage_in_the_middle_that_the_decoder_conceals(self, folder):
        path = write_video(folder / "a.mp4", 0, 100)
        raw = bytearray(path.read_bytes())
        middle = len(raw) // 2
        raw[middle : middle + 300] = np.random.default_rng(0).bytes(300)
        path.write_bytes(raw)
        with pytest.raises(ClipError, match=r"frame \d+ of .*a\.mp4 is damaged; replace the file"):
            list(video_frames.decode_video(path))

    def test_missing_frames_of_a_folder(self, folder):
        for name in "ab":
            write_frames(folder / name, ord(name), [n for n in range(10, 60, 2) if n != 34])
        with pytest.raises(ClipError, match=r"24 of 25 frames: there is none between frame32\.png and frame36"):
            load_backgrounds(folder)

    def test_frames_that_are_too_large_are_refused_before_they_are_decoded(self, folder, monkeypatch):
        assert video_frames._OPTIONS["max_pixels"] == str(video_frames.MAX_VIDEO_PIXELS)
        monkeypatch.setattr(video_frames, "MAX_VIDEO_PIXELS", 96 * 72 - 1)
        monkeypatch.setattr(video_frames, "MAX_FRAME_PIXELS", 96 * 72 - 1)
        monkeypatch.setitem(video_frames._OPTIONS, "max_pixels", str(96 * 72 - 1))
        path = write_video(folder / "a.mp4", 1)
        write_video(folder / "b.mp4", 2)
        with pytest.raises(ClipError, match=r"\.mp4 has frames of over 6911 pixels, .*; scale it down: ffmpeg -i"):
            list(video_frames.decode_video(path))
        write_frames(folder / "c", size=(96, 72))
        write_frames(folder / "d", 1, size=(96, 72))
        path.unlink(), (folder / "b.mp4").unlink()
        with pytest.raises(ClipError, match=r"frame0\.png has 96 x 72 pixels, more than 6911; scale it down"):
            load_backgrounds(folder)

    def test_more_pixels_than_so_small_a_file_can_hold(self, folder, monkeypatch):
        path = write_video(folder / "a.mp4", 1)
        monkeypatch.setattr(video_frames, "_MAX_PIXELS_PER_BYTE", 0)
        monkeypatch.setattr(video_frames, "_MAX_PIXELS", 63 * 128 * 72)
        with pytest.raises(ClipError, match="holds more than 580608 pixels in so small a file"):
            list(video_frames.decode_video(path))
        monkeypatch.setattr(video_frames, "_MAX_PIXELS", 64 * 128 * 72)
        assert len(list(video_frames.decode_video(path))) == 64

    def test_decoded_frames_do_not_pile_up(self, folder, monkeypatch):
        collected = []
        monkeypatch.setattr(video_frames.gc, "collect", lambda: collected.append(1))
        monkeypatch.setattr(video_frames, "_PIXELS_BEFORE_COLLECTION", 8 * 128 * 72)
        assert len(list(video_frames.decode_video(write_video(folder / "a.mp4", 1)))) == 64
        assert len(collected) == 8

    @pytest.mark.parametrize("missing", ["av", "PIL"])
    def test_decoder_not_installed(self, folder, monkeypatch, missing):
        write_video(folder / "a.mp4", 1), write_video(folder / "b.mp4", 2)
        monkeypatch.setitem(sys.modules, missing, None)
        with pytest.raises(ImportError, match=r"pip install 'sb3_abisim\[video\]'"):
            load_backgrounds(folder)
