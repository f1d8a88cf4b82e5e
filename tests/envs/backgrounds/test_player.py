"""Clips as environments play them, and the foreground over them."""

import numpy as np
import pytest
from clip_inputs import numbered_clip, numbered_clips  # noqa: F401

from sb3_abisim.envs.backgrounds.clips import Backgrounds
from sb3_abisim.envs.backgrounds.player import BackgroundPlayer, composite


class TestPlayer:
    def test_one_frame_a_step_from_a_random_start(self, numbered):
        player = BackgroundPlayer(numbered, 2)
        starts = set()
        for seed in range(60):
            player.start(1, np.random.default_rng(seed))
            starts.add((int(player.clip[1]), int(player.frame_index[1])))
        assert starts == {(clip, frame) for clip, length in enumerate((4, 3, 7)) for frame in range(length)}
        player._position[1], player.clip[1] = 2, 2
        shown = []
        for _ in range(8):
            assert (player.frames(np.array([1]))[0] == 30 + player.frame_index[1]).all()
            shown.append(int(player.frame_index[1]))
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
                assert (player.frames(np.array([0])) == player.frame_index[0]).all()
                shown.append(int(player.frame_index[0]))
                player.advance()
            orders.append(shown)
        assert sorted(orders[0]) == list(range(40)) != orders[0]
        assert orders[0] == orders[1] != orders[2]

    def test_the_samples_that_follow_do_not_depend_on_the_clips(self, numbered):
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
    observations, backgrounds = generator.integers(0, 256, (2, 5, 3, 64, 64), dtype=np.uint8)
    masks = generator.random((5, 64, 64)) < 0.3
    expected = np.where(masks[:, None], observations, backgrounds)
    before = observations.copy()
    assert np.array_equal(composite(observations, masks, backgrounds), expected)
    assert np.array_equal(observations, before)
