"""The cache of decoded videos, limits of length and memory, and clips that are left out."""

import numpy as np
import pytest
from video_inputs import both, empty_cache, shown, two_folders, videos_folder, write_frames, write_video  # noqa: F401

from sb3_abisim.envs.backgrounds import video_cache, video_frames
from sb3_abisim.envs.backgrounds.load import load_backgrounds


class TestCache:
    def test_decoded_once_and_found_again_under_another_name(self, folder, cache, monkeypatch):
        for seed in range(2):
            write_video(folder / f"movie{seed}.mp4", seed)
        before = [clips.content_hash for clips in both(folder)]
        assert len(list(cache.glob("*.npy"))) == len(list(cache.iterdir())) // 2 == 2
        hashes = {clip.hash for clips in both(folder) for clip in clips.clips}
        video_cache.load_split.cache_clear()
        monkeypatch.setattr(video_frames, "decode_video", None)  # would raise if it were called
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
        video_cache.load_split.cache_clear()
        assert np.array_equal(shown(load_backgrounds(folder, "train")), expected)
        raw[-100] ^= 1
        assert path.read_bytes() == bytes(raw)

    @pytest.mark.parametrize("harm", [(10, bytes(60)), (10, b"(" * 60), (11, b"-"), (20, b"9" * 20)])
    def test_an_entry_with_any_header_is_decoded_again(self, folder, cache, harm):
        two_folders(folder)
        expected = shown(load_backgrounds(folder, "train"))
        path = next(cache.glob("*.npy"))
        raw, (start, content) = path.read_bytes(), harm
        path.write_bytes(raw[:start] + content + raw[start + len(content) :])
        video_cache.load_split.cache_clear()
        assert np.array_equal(shown(load_backgrounds(folder, "train")), expected)
        assert path.read_bytes() == raw

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
        assert video_cache.cache_folder() == tmp_path / "sb3_abisim"


class TestLimits:
    def test_too_short(self, folder):
        two_folders(folder)
        assert load_backgrounds(folder, min_frames=20).lengths.tolist() == [20]
        with pytest.raises(
            video_frames.ClipError, match=r"[ab] has 20 frames, fewer than min_frames=21; give a longer"
        ):
            load_backgrounds(folder, min_frames=21)

    def test_too_large_is_known_before_decoding(self, folder, monkeypatch):
        write_video(folder / "a.mp4", 1), write_video(folder / "b.mp4", 2)
        monkeypatch.setattr(video_frames, "decode_video", None)
        with pytest.raises(ValueError, match=r"have 64 frames, but max_bytes allows 63 .*larger max_bytes"):
            load_backgrounds(folder, max_bytes=64 * 12288 - 1)

    def test_too_large_without_a_count_in_the_header(self, folder, cache, monkeypatch):
        write_video(folder / "a.mp4", 1), write_video(folder / "b.mp4", 2)
        monkeypatch.setattr(video_frames, "_promise", lambda container, path: (None, 0.0))
        # As of a container whose structure shows that it is whole.
        monkeypatch.setattr(video_frames, "require_whole", lambda path: True)
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
        video_cache.load_split.cache_clear()
        (note,) = [path for path in cache.glob("*.json") if f"/{names[0]}" in path.read_text()]
        note.unlink()
        with pytest.raises(ValueError, match=r"the clips before it have more than 150 frames, but .* allows 150 "):
            load_backgrounds(folder, max_bytes=150 * 12288)
        for path in folder.glob("[cd].mp4"):
            path.unlink()
        assert load_backgrounds(folder, max_bytes=64 * 12288).lengths.tolist() == [64]


class TestSkipping:
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
