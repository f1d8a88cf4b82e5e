"""How clips are fetched, selected, hashed and divided into sides."""

import dataclasses

import numpy as np
import pytest
from clip_inputs import numbered_clip, numbered_clips  # noqa: F401

from sb3_abisim.envs.backgrounds import clips as module
from sb3_abisim.envs.backgrounds.clips import Backgrounds, Clip, array_hash, split_groups


class TestFrames:
    def test_ping_pong_does_not_repeat_the_ends(self, numbered):
        played = numbered.frames(np.zeros(9, dtype=int), np.arange(9))[:, 0, 0, 0]
        assert played.tolist() == [10, 11, 12, 13, 12, 11, 10, 11, 12]

    def test_each_row_is_another_clip_and_frame(self, numbered):
        frames = numbered.frames(np.array([2, 0, 1, 2]), np.array([6, 1, 2, 13]))
        assert frames.shape == (4, 3, 64, 64) and frames.dtype == np.uint8
        assert frames.min(axis=(1, 2, 3)).tolist() == frames.max(axis=(1, 2, 3)).tolist() == [36, 11, 22, 31]

    def test_clips_are_loaded_when_first_shown(self):
        def fail():
            raise AssertionError("loaded")

        clips = Backgrounds("test", "train", [numbered_clip("a", 1, 4), Clip("b", "b", 4, "0" * 64, fail)])
        clips.frames(np.array([0]), np.array([1]))
        with pytest.raises(AssertionError, match="loaded"):
            clips.frames(np.array([1]), np.array([1]))

    def test_the_content_hash_changes_with_a_pixel_a_name_and_the_selection(self, numbered):
        clips = list(numbered.clips)
        frames = clips[1].load().copy()
        frames[2, 1, 63, 0] ^= 1
        pixel = dataclasses.replace(clips[1], hash=array_hash(frames))
        name = dataclasses.replace(clips[1], name="z")
        variants = [clips, [clips[0], pixel, clips[2]], [clips[0], name, clips[2]], clips[:2]]
        hashes = [Backgrounds("test", "train", variant).content_hash for variant in variants]
        assert len(set(hashes)) == 4
        assert Backgrounds("elsewhere", "eval", clips).content_hash == hashes[0] == numbered.content_hash

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


class TestSplitGroups:
    def test_disjoint_complete_and_independent_of_order(self):
        names = [f"movie{i}" for i in range(40)]
        train, eval_groups = split_groups(names, 0, 0.25)
        assert len(eval_groups) == 10 and train | eval_groups == set(names) and not train & eval_groups
        assert split_groups(reversed(names), 0, 0.25) == (train, eval_groups)
        assert split_groups(names, 1, 0.25) != (train, eval_groups)

    def test_both_sides_have_a_group(self):
        for fraction in (0.01, 0.99):
            train, eval_groups = split_groups(["a", "b"], 0, fraction)
            assert len(train) == len(eval_groups) == 1
