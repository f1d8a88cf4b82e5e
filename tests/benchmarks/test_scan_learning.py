"""The agents beside which a trained one is judged on ScanNav."""

import numpy as np
import pytest
from scan_inputs import empty_room

from benchmarks.scan_learning import oracle_player, play, random_player, straight_player


@pytest.mark.parametrize("stop", ["action", "auto"])
def test_straight_lines_do_in_an_empty_room_and_not_behind_walls(stop):
    kwargs = {"scenes": empty_room(), "stop": stop, "max_episode_steps": 80, "image_size": 32, "goals_per_scene": 4}
    free = play(straight_player, kwargs, 24, seed=0)
    assert free["success"] > 0.95 and free["spl"] > 0.9
    walls = {**kwargs, "scenes": empty_room(walls=[np.s_[50:54, :70], np.s_[50:54, 82:]]), "min_ratio": 1.2}
    blind, knowing = (play(player, walls, 24, seed=0) for player in (straight_player, oracle_player))
    assert blind["success"] < 0.6 and knowing["success"] == 1 and knowing["spl"] > 0.9
    if stop == "action":
        assert play(random_player(0), kwargs, 24, seed=0)["success"] < 0.2
