"""A user's own videos: decoding, own_cache, and every mistake with its remedy."""

import struct
import sys

import numpy as np
import pytest
from video_inputs import Image, av, both, own_cache, shade, shown, two_folders, videos_folder, write_frames, write_video  # noqa: F401

from sb3_abisim.envs.backgrounds import video
from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.point_maze.distractors import DistractorPointMazeVectorEnv


class TestDecoding:
    def test_a_title_in_another_encoding_does_no_harm(self, folder):
        for seed in range(2):
            path = write_video(folder / f"{seed}.avi", seed, title="CafXX")
            assert b"CafXX" in path.read_bytes()
            path.write_bytes(path.read_bytes().replace(b"CafXX", b"Caf\xe9s"))
        assert [side.lengths.tolist() for side in both(folder)] == [[64], [64]]

    @pytest.mark.parametrize("on_error", ["raise", "skip"])
    def test_pictures_of_more_than_8_bits_are_refused(self, folder, on_error):
        for seed in range(4):
            write_frames(folder / f"clip{seed}", seed)
        deep = Image.fromarray(np.arange(4800, dtype=np.uint16).reshape(60, 80))
        for seed in range(4):
            deep.save(folder / f"clip{seed}" / "frame3.png")
        with pytest.raises(ValueError, match=r"frame3\.png has more than 8 bits per value \(I;16\)"):
            load_backgrounds(folder, "train", on_error=on_error)

    def test_video_frames_in_order_and_cropped_to_the_center(self, folder):
        for seed in range(3):
            write_video(folder / f"film{seed}.mp4", seed)
        for clips in both(folder):
            for index, name in enumerate(clips.names):
                frames = shown(clips, index).astype(int)
                assert frames.shape == (64, 3, 64, 64)
                expected = shade(int(name[4]), np.arange(64))
                assert np.abs(frames[:, :, 32, 32] - expected[:, None]).max() <= 8
                assert np.abs(frames[:, :, 32, 2] - expected[:, None]).max() <= 12  # the black margin is cut off

    def test_frames_in_natural_order_averaged_to_64(self, folder):
        two_folders(folder)
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
            shades = [np.asarray(image)[36, 48, 0] for image in video.decode_video(path)]
            expected = shade(0, 20 + np.arange(n_shown))
            assert len(shades) == n_shown and np.abs(np.array(shades, dtype=int) - expected).max() <= 8

    def test_in_the_environment(self, folder):
        two_folders(folder)
        env = DistractorPointMazeVectorEnv(2, videos=str(folder), split="eval", video_kwargs={"min_frames": 20})
        pictures, _ = env.reset(seed=0)
        name = load_backgrounds(folder, "eval").names[0]
        behind = (pictures[:, 1] == {"a": 1, "b": 2}[name]) & (pictures[:, 2] == 7)
        assert behind.mean() > 0.3
        assert (pictures[0, 0][behind[0]] == env.factors()["frame"][0]).all()


class TestCache:
    def test_decoded_once_and_found_again_under_another_name(self, folder, cache, monkeypatch):
        for seed in range(2):
            write_video(folder / f"film{seed}.mp4", seed)
        before = [clips.content_hash for clips in both(folder)]
        assert len(list(cache.glob("*.npy"))) == len(list(cache.iterdir())) // 2 == 2
        hashes = {clip.hash for clips in both(folder) for clip in clips.clips}
        video.load_split.cache_clear()
        monkeypatch.setattr(video, "decode_video", None)  # would raise if it were called
        assert [clips.content_hash for clips in both(folder)] == before
        folder.rename(folder.with_name("moved"))
        again = both(folder.with_name("moved"))
        assert {clip.hash for clips in again for clip in clips.clips} == hashes

    def test_a_cache_that_cannot_be_written_is_named(self, folder, tmp_path, monkeypatch):
        two_folders(folder)
        (tmp_path / "taken").touch()
        monkeypatch.setenv("SB3_ABISIM_CACHE", str(tmp_path / "taken"))
        with pytest.raises(OSError, match=r"cannot keep decoded clips in .*taken .*; set SB3_ABISIM_CACHE to a folder"):
            load_backgrounds(folder, "train")

    def test_a_damaged_entry_is_decoded_again(self, folder, cache):
        two_folders(folder)
        expected = shown(load_backgrounds(folder, "train"))
        path = next(cache.glob("*.npy"))
        raw = bytearray(path.read_bytes())
        raw[-100] ^= 1
        path.write_bytes(raw)
        video.load_split.cache_clear()
        assert np.array_equal(shown(load_backgrounds(folder, "train")), expected)
        raw[-100] ^= 1
        assert path.read_bytes() == bytes(raw)

    def test_a_changed_video_is_not_taken_from_the_cache(self, folder):
        write_video(folder / "a.mp4", 1), write_video(folder / "b.mp4", 2)
        before = [clips.content_hash for clips in both(folder)]
        write_video(folder / "a.mp4", 3), write_video(folder / "b.mp4", 4)
        after = [clips.content_hash for clips in both(folder)]
        assert not set(before) & set(after)

    def test_frames_are_mapped_not_copied(self, folder):
        two_folders(folder)
        array = load_backgrounds(folder, "train").clips[0].load()
        assert isinstance(array.base, np.memmap)

    def test_folder(self, monkeypatch, tmp_path):
        monkeypatch.delenv("SB3_ABISIM_CACHE")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert video.cache_folder() == tmp_path / "sb3_abisim"


class TestMistakes:
    def test_missing_folder_and_file_instead_of_folder(self, folder):
        with pytest.raises(ValueError, match=r"videos.nothing does not exist.*correct the path"):
            load_backgrounds(folder / "nothing")
        with pytest.raises(ValueError, match=r"a\.mp4 is a file; give the folder"):
            load_backgrounds(write_video(folder / "a.mp4"))

    def test_no_videos_says_what_was_found(self, folder):
        with pytest.raises(ValueError, match="found an empty folder"):
            load_backgrounds(folder)
        for name in ("a.txt", "b.txt", "c.zip", "d"):
            (folder / name).touch()
        with pytest.raises(ValueError, match=r"no videos in .*2 x \.txt, 1 x .*; put video files \(.*\.mp4"):
            load_backgrounds(folder)

    def test_undecodable_video(self, folder):
        for name in "abcd":
            (folder / f"{name}.mp4").write_bytes(name.encode() * 5000)
        with pytest.raises(video.ClipError, match=r"[a-d]\.mp4 cannot be decoded after 0 frames.*; replace the file"):
            load_backgrounds(folder)

    def test_undecodable_frame(self, folder):
        for path in two_folders(folder):
            (path / "frame7.png").write_bytes((path / "frame7.png").read_bytes()[:60])
        with pytest.raises(video.ClipError, match=r"frame7\.png cannot be decoded"):
            load_backgrounds(folder)

    @pytest.mark.parametrize("suffix", ["mkv", "avi"])
    def test_half_a_video(self, folder, suffix):
        for seed in range(2):
            path = write_video(folder / f"{seed}.{suffix}", seed, 200)
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(video.ClipError, match=rf"\.{suffix}"):
            load_backgrounds(folder)

    def test_half_a_matroska_file_says_how_many_frames_are_missing(self, folder):
        path = write_video(folder / "half.mkv", 0, 200)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(video.ClipError, match=r"decoded \d+ of 200 frames of .*half\.mkv: the file is cut off"):
            list(video.decode_video(path))

    @pytest.mark.parametrize(("name", "hidden", "left"), [("a.mp4", 20, 100), ("a.mp4", 20, 195), ("a.avi", 0, 150)])
    def test_cut_off_between_two_frames(self, folder, name, hidden, left):
        path = write_video(folder / name, 0, 200, n_hidden=hidden, options={"movflags": "faststart"})
        with av.open(str(path)) as container:
            starts = [packet.pos for packet in container.demux() if packet.size]
        assert len(list(video.decode_video(path))) == 200 - hidden
        path.write_bytes(path.read_bytes()[: starts[left - 200]])
        with pytest.raises(video.ClipError, match=rf"decoded {left - hidden} of 200 frames .*{name}: the file is cut"):
            list(video.decode_video(path))

    def test_a_matroska_file_whose_frames_are_not_evenly_timed_names_the_remedy(self, folder):
        path = write_video(folder / "uneven.mkv", pause=100)
        with pytest.raises(video.ClipError, match=r"64 of 164 .*: ffmpeg -i uneven\.mkv -fps_mode cfr even\.mp4"):
            list(video.decode_video(path))

    def test_damage_in_the_middle_that_the_decoder_conceals(self, folder):
        path = write_video(folder / "a.mp4", 0, 100)
        raw = bytearray(path.read_bytes())
        middle = len(raw) // 2
        raw[middle : middle + 300] = np.random.default_rng(0).bytes(300)
        path.write_bytes(raw)
        with pytest.raises(video.ClipError, match=r"frame \d+ of .*a\.mp4 is damaged; replace the file"):
            list(video.decode_video(path))

    def test_missing_frames_of_a_folder(self, folder):
        for name in "ab":
            write_frames(folder / name, ord(name), [n for n in range(10, 60, 2) if n != 34])
        with pytest.raises(video.ClipError, match=r"24 of 25 frames: there is none between frame32\.png and frame36"):
            load_backgrounds(folder)

    def test_too_short(self, folder):
        two_folders(folder)
        assert load_backgrounds(folder, min_frames=20).lengths.tolist() == [20]
        with pytest.raises(video.ClipError, match=r"[ab] has 20 frames, fewer than min_frames=21; give a longer"):
            load_backgrounds(folder, min_frames=21)

    def test_too_large_is_known_before_decoding(self, folder, monkeypatch):
        write_video(folder / "a.mp4", 1), write_video(folder / "b.mp4", 2)
        monkeypatch.setattr(video, "decode_video", None)
        with pytest.raises(ValueError, match=r"have 64 frames, but max_bytes allows 63 .*larger max_bytes"):
            load_backgrounds(folder, max_bytes=64 * 12288 - 1)

    def test_too_large_without_a_count_in_the_header(self, folder, cache, monkeypatch):
        write_video(folder / "a.mp4", 1), write_video(folder / "b.mp4", 2)
        monkeypatch.setattr(video, "_promise", lambda container, path: (None, 0.0))
        with pytest.raises(ValueError, match=r"more than 63 frames, but max_bytes allows 63"):
            load_backgrounds(folder, max_bytes=64 * 12288 - 1)
        # More on one side: the limit is that of all of them, in the message too, whether they are in the cache or not.
        write_video(folder / "c.mp4", 3), write_video(folder / "d.mp4", 4)
        for _ in range(2):
            with pytest.raises(ValueError, match=r"the clips before it have more than 100 frames, but .* allows 100 "):
                load_backgrounds(folder, max_bytes=100 * 12288)
        # The first anew, with a length that is not known yet, and the next from the cache.
        names = load_backgrounds(folder).names
        assert len(names) == 3
        video.load_split.cache_clear()
        (note,) = [path for path in cache.glob("*.json") if f"/{names[0]}" in path.read_text()]
        note.unlink()
        with pytest.raises(ValueError, match=r"the clips before it have more than 150 frames, but .* allows 150 "):
            load_backgrounds(folder, max_bytes=150 * 12288)
        for path in folder.glob("[cd].mp4"):
            path.unlink()
        assert load_backgrounds(folder, max_bytes=64 * 12288).lengths.tolist() == [64]

    @pytest.mark.parametrize("missing", ["av", "PIL.Image"])
    def test_decoder_not_installed(self, folder, monkeypatch, missing):
        write_video(folder / "a.mp4", 1), write_video(folder / "b.mp4", 2)
        monkeypatch.setitem(sys.modules, missing, None)
        with pytest.raises(ImportError, match=r"pip install 'sb3_abisim\[video\]'"):
            load_backgrounds(folder)

    def test_skip_leaves_clips_out_and_says_which(self, folder):
        for i in range(8):
            write_frames(folder / f"good{i}", i)
            (folder / f"bad{i}.mp4").write_bytes(f"{i}".encode() * 5000)
        sides = []
        for split in ("train", "eval"):
            with pytest.warns(UserWarning, match=r"skipped \d+ of \d+ .*\n.*bad\d\.mp4 cannot be decoded"):
                sides.append(load_backgrounds(folder, split, on_error="skip", eval_fraction=0.5))
        assert sorted(sides[0].names + sides[1].names) == [f"good{i}" for i in range(8)]

    def test_skipping_every_clip_is_an_error(self, folder):
        for name in "ab":
            (folder / f"{name}.mp4").write_bytes(name.encode() * 5000)
        with pytest.raises(ValueError, match=r"all 1 train clips .* were skipped"):
            load_backgrounds(folder, on_error="skip")

    @pytest.mark.parametrize(
        "kwargs", [{"eval_fraction": 0.0}, {"eval_fraction": 1.0}, {"min_frames": 1}, {"on_error": "ignore"}]
    )
    def test_unknown_settings(self, folder, kwargs):
        (name, value), *_ = kwargs.items()
        with pytest.raises(ValueError, match=f"{name} must .*{value}"):
            load_backgrounds(folder, **kwargs)
