"""The built-in clips, how they are fetched, played and composited. Users' videos: test_video.py."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest

from sb3_abisim.envs.backgrounds import backgrounds as module
from sb3_abisim.envs.backgrounds.clips import Backgrounds, Clip, array_hash, split_groups
from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.photo_pan import MEDIA_FOLDER, render_pan
from sb3_abisim.envs.backgrounds.player import BackgroundPlayer, composite

MANIFEST = json.loads((MEDIA_FOLDER / "photo_pan.json").read_text(encoding="utf-8"))


def numbered_clip(name, number, length):
    """A clip whose frame f is filled with 10 * number + f."""
    frames = np.empty((length, 3, 64, 64), dtype=np.uint8)
    frames[:] = (10 * number + np.arange(length))[:, None, None, None]
    return Clip(name, name, length, array_hash(frames), lambda: frames)


@pytest.fixture
def numbered():
    return Backgrounds("test", "train", [numbered_clip("a", 1, 4), numbered_clip("b", 2, 3), numbered_clip("c", 3, 7)])


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
        moved = [[entry["path"][0][0] + 1, *entry["path"][0][1:]], *entry["path"][1:]]
        with pytest.raises(ValueError, match=r"'rocket'.*damaged.*reinstall"):
            module._load_entry({**entry, "path": moved})

    def test_loaded_once_per_process(self):
        assert load_backgrounds(split="eval") is load_backgrounds(None, "eval")

    def test_unknown_split(self):
        with pytest.raises(ValueError, match="'test'"):
            load_backgrounds(split="test")


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


class TestFrames:
    def test_ping_pong_does_not_repeat_the_ends(self, numbered):
        played = numbered.frames(np.zeros(9, dtype=int), np.arange(9))[:, 0, 0, 0]
        assert played.tolist() == [10, 11, 12, 13, 12, 11, 10, 11, 12]

    def test_each_row_is_its_own_clip_and_frame(self, numbered):
        pictures = numbered.frames(np.array([2, 0, 1, 2]), np.array([6, 1, 2, 13]))
        assert pictures.shape == (4, 3, 64, 64) and pictures.dtype == np.uint8
        assert pictures.min(axis=(1, 2, 3)).tolist() == pictures.max(axis=(1, 2, 3)).tolist() == [36, 11, 22, 31]

    def test_clips_are_loaded_when_first_shown(self):
        def fail():
            raise AssertionError("loaded")

        clips = Backgrounds("test", "train", [numbered_clip("a", 1, 4), Clip("b", "b", 4, "0" * 64, fail)])
        clips.frames(np.array([0]), np.array([1]))
        with pytest.raises(AssertionError, match="loaded"):
            clips.frames(np.array([1]), np.array([1]))

    def test_fingerprint_changes_with_a_pixel_a_name_and_the_selection(self, numbered):
        clips = list(numbered.clips)
        frames = clips[1].load().copy()
        frames[2, 1, 63, 0] ^= 1
        pixel = dataclasses.replace(clips[1], hash=array_hash(frames))
        name = dataclasses.replace(clips[1], name="z")
        variants = [clips, [clips[0], pixel, clips[2]], [clips[0], name, clips[2]], clips[:2]]
        prints = [Backgrounds("test", "train", variant).content_hash for variant in variants]
        assert len(set(prints)) == 4
        assert Backgrounds("elsewhere", "eval", clips).content_hash == prints[0] == numbered.content_hash

    def test_selections_are_shared_and_few_clips_are_open(self, numbered, monkeypatch):
        assert numbered.select(["b", "a"]) is numbered.select(["b", "a"]) is not numbered.select(["a", "b"])
        monkeypatch.setattr(module, "MAX_OPEN_CLIPS", 2)
        before = [numbered.frames(np.array([clip]), np.array([1])) for clip in range(3)]
        for clip in (0, 1, 2, 0, 2, 1):
            fresh = numbered.frames(np.array([clip]), np.array([1]))
            assert np.array_equal(fresh, before[clip])
        assert list(numbered._arrays) == [2, 1]

    def test_select(self, numbered):
        chosen = numbered.select(["c", "a"])
        assert chosen.names == ("c", "a") and chosen.lengths.tolist() == [7, 4]
        assert chosen.clip_ids[0] == numbered.clip_ids[2] != numbered.clip_ids[0]
        for wrong in (["c", "x"], [], ["a", "a"]):
            with pytest.raises(ValueError, match=r"there are a, b, c"):
                numbered.select(wrong)


class TestPlayer:
    def test_one_frame_a_step_from_a_random_start(self, numbered):
        player = BackgroundPlayer(numbered, 2)
        starts = set()
        for seed in range(60):
            player.start(1, np.random.default_rng(seed))
            starts.add((int(player.clip[1]), int(player.frame[1])))
        assert starts == {(clip, frame) for clip, length in enumerate((4, 3, 7)) for frame in range(length)}
        player._position[1], player.clip[1] = 2, 2
        shown = []
        for _ in range(8):
            assert (player.pictures(np.array([1]))[0] == 30 + player.frame[1]).all()
            shown.append(int(player.frame[1]))
            player.advance()
        assert shown == [2, 3, 4, 5, 6, 5, 4, 3]

    def test_shuffled_shows_every_frame_once_in_an_order_of_the_episode(self):
        clips = Backgrounds("test", "train", [numbered_clip("a", 0, 40)])
        player, orders = BackgroundPlayer(clips, 1, "shuffled"), []
        for seed in (0, 0, 1):
            player.start(0, np.random.default_rng(seed))
            player._position[0] = 0
            shown = []
            for _ in range(40):
                assert (player.pictures(np.array([0])) == player.frame[0]).all()
                shown.append(int(player.frame[0]))
                player.advance()
            orders.append(shown)
        assert sorted(orders[0]) == list(range(40)) != orders[0]
        assert orders[0] == orders[1] != orders[2]

    def test_the_draws_that_follow_do_not_depend_on_the_clips(self, numbered):
        following = set()
        for clips in (numbered, numbered.select(["b"])):
            for order in ("video", "shuffled"):
                generator = np.random.default_rng(5)
                BackgroundPlayer(clips, 1, order).start(0, generator)
                following.add(generator.integers(2**60))
        assert len(following) == 1

    def test_unknown_order(self, numbered):
        with pytest.raises(ValueError, match="'random'"):
            BackgroundPlayer(numbered, 1, "random")


def test_composite_chooses_by_the_mask_alone():
    generator = np.random.default_rng(0)
    pictures, behind = generator.integers(0, 256, (2, 5, 3, 64, 64), dtype=np.uint8)
    masks = generator.random((5, 64, 64)) < 0.3
    expected = np.where(masks[:, None], pictures, behind)
    before = pictures.copy()
    assert np.array_equal(composite(pictures, masks, behind), expected)
    assert np.array_equal(pictures, before)


class TestSplitGroups:
    def test_disjoint_complete_and_independent_of_order(self):
        names = [f"film{i}" for i in range(40)]
        train, unseen = split_groups(names, 0, 0.25)
        assert len(unseen) == 10 and train | unseen == set(names) and not train & unseen
        assert split_groups(reversed(names), 0, 0.25) == (train, unseen)
        assert split_groups(names, 1, 0.25) != (train, unseen)

    def test_both_sides_have_a_group(self):
        for fraction in (0.01, 0.99):
            train, unseen = split_groups(["a", "b"], 0, fraction)
            assert len(train) == len(unseen) == 1
