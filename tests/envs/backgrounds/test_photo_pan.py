"""The built-in clips, and the camera that pans over photographs."""

import hashlib
import json

import numpy as np
import pytest

from sb3_abisim.envs.backgrounds import photo_pan
from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.photo_pan import MEDIA_FOLDER, render_pan

MANIFEST = json.loads((MEDIA_FOLDER / "photo_pan.json").read_text(encoding="utf-8"))


class TestPhotoPan:
    def test_fourteen_train_and_five_eval_clips(self):
        assert [load_backgrounds(split=split).n_clips for split in ("train", "eval")] == [14, 5]
        assert load_backgrounds().source == "photo_pan"

    @pytest.mark.parametrize("entry", MANIFEST["clips"], ids=lambda entry: entry["name"])
    def test_frames_have_the_bytes_of_the_manifest_and_move(self, entry):
        clips = load_backgrounds(split=entry["split"])
        index = clips.names.index(entry["name"])
        length = int(clips.lengths[index])
        frames = clips.frames(np.full(length, index), np.arange(length))
        assert hashlib.sha256(frames.tobytes()).hexdigest() == entry["sha256"]
        change = np.abs(np.diff(frames.astype(int), axis=0)).mean(axis=(1, 2, 3))
        assert change.min() > 0.1 and change.max() < 25  # always moving, never cutting
        assert frames.std() > 20

    def test_no_group_and_no_frame_on_both_sides(self):
        groups, hashes = {}, {}
        for split in ("train", "eval"):
            clips = load_backgrounds(split=split)
            groups[split] = {clip.group for clip in clips.clips}
            hashes[split] = {hashlib.sha256(frame).digest() for clip in clips.clips for frame in clip.load()}
        assert not groups["train"] & groups["eval"]
        assert not hashes["train"] & hashes["eval"]
        assert len(hashes["train"]) > 3000 and len(hashes["eval"]) > 1000
        city = {entry["split"] for entry in MANIFEST["clips"] if entry["group"] == "city"}
        assert len(city) == 1

    def test_every_clip_has_a_license_that_the_license_file_repeats(self):
        text = (MEDIA_FOLDER / "LICENSES-media.md").read_text(encoding="utf-8")
        for entry in MANIFEST["clips"]:
            assert entry["license"] in ("CC0-1.0", "CC-BY-4.0", "public domain")
            assert f"| {entry['name']} | {entry['license']} | {entry['author']} | {entry['source']} |" in text

    def test_a_damaged_pack_is_refused(self):
        entry = next(entry for entry in MANIFEST["clips"] if entry["name"] == "rocket")
        path = [[entry["path"][0][0] + 1, *entry["path"][0][1:]], *entry["path"][1:]]
        with pytest.raises(ValueError, match=r"'rocket'.*damaged.*reinstall"):
            photo_pan._load_entry({**entry, "path": path})

    def test_loaded_once_per_process(self):
        assert load_backgrounds(split="eval") is load_backgrounds(None, "eval")


class TestRenderPan:
    def test_a_window_of_64_pixels_is_the_photograph_itself(self):
        photo = np.random.default_rng(0).integers(0, 256, (3, 70, 90), dtype=np.uint8)
        frames = render_pan(photo, [[5, 17, 64]] * 4, 32)
        assert all(np.array_equal(frame, photo[:, 5:69, 17:81]) for frame in frames)

    def test_a_window_of_128_pixels_is_the_mean_of_blocks(self):
        photo = np.random.default_rng(0).integers(0, 256, (3, 128, 131), dtype=np.uint8)
        frames = render_pan(photo, [[0, 3, 128]] * 4, 32)
        blocks = photo[:, :, 3:].astype(float).reshape(3, 64, 2, 64, 2).mean(axis=(2, 4))
        assert np.array_equal(frames[0], np.floor(blocks + 0.5))

    def test_a_moving_window_against_sampling_by_hand(self):
        photo = np.random.default_rng(1).integers(0, 256, (3, 100, 120), dtype=np.uint8)
        path = [[0, 0, 64], [30, 50, 70], [10, 20, 90], [0, 30, 80], [36, 10, 64]]
        frame = render_pan(photo, path, 64)[40].astype(float)
        t = (40 - 32) / 32  # within the second segment
        weights = np.array([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6
        top, left, side = weights @ np.array(path[1:], dtype=float)
        fine = 40
        centers = (np.arange(64 * fine) + 0.5) / fine * side / 64
        sampled = photo[:, (top + centers).astype(int)][:, :, (left + centers).astype(int)]
        expected = sampled.reshape(3, 64, fine, 64, fine).mean(axis=(2, 4))
        # The photograph is noise, and the window's side is a multiple of 1/16 pixel.
        assert np.abs(frame - expected).max() < 8 and np.abs(frame - expected).mean() < 0.8
