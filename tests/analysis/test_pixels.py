"""Changed states of the point mazes are possible ones, and differ from the original in one thing."""

import numpy as np
import pytest
from analysis_inputs import identity

from sb3_abisim.analysis import pixels
from sb3_abisim.analysis.pixels import BINS, pixel_maps
from sb3_abisim.analysis.scenes import eval_settings, sample_episodes

SHAPE = (3, 64, 64)


@pytest.fixture(scope="module")
def samples():
    return sample_episodes("PointMaze-v0", 30, 1)


def test_one_obstacle_moves_by_a_meter_to_where_it_may_be(samples):
    agents, obstacles = (samples.factors[key].astype(np.float64) for key in ("agent", "obstacles"))
    moves = pixels._moves(agents, obstacles, np.random.default_rng(0))
    assert len(moves["state"]) > 300
    for state, layout, gap, offset in zip(*moves.values(), strict=True):
        (which,) = np.flatnonzero((layout != obstacles[state]).any(axis=1))
        old, new, agent = obstacles[state, which], layout[which], agents[state]
        assert np.abs(new - old).sum() == pytest.approx(1.0)
        assert np.abs(new).max() <= 6.5, "within the room"
        assert np.abs(new).max() >= 2.0, "beside the goal's square"
        np.testing.assert_allclose(offset, (old + new) / 2 - agent)
        # The distance to the nearest of many points of both squares.
        grid = np.stack(np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-1, 1, 81)), axis=-1).reshape(-1, 2)
        distances = [np.linalg.norm(center + grid - agent, axis=1).min() for center in (old, new)]
        assert gap == pytest.approx(min(distances), abs=0.02)
        assert distances[1] > 0.29


def test_offset_map_sorts_by_rows_and_columns():
    offsets = np.array([(2.2, -1.4)] * 5 + [(0.0, 0.0)] * 4 + [(20.0, 0.0)] * 9)
    means = pixels._offset_map(offsets, np.array([3.0] * 5 + [1.0] * 4 + [9.0] * 9))
    assert means[pixels.MAP_REACH - 1, pixels.MAP_REACH + 2] == 3.0
    assert np.isnan(np.delete(means.ravel(), (pixels.MAP_REACH - 1) * 17 + pixels.MAP_REACH + 2)).all()


def test_pixels_as_embedding_feel_every_obstacle_alike():
    (result,) = pixel_maps({"identity": identity(SHAPE)}, "PointMaze-v0", 40)["encoders"].values()
    one = result["settings"]["eval layouts"]
    assert one["clip"] is None and len(one["profile"]) == len(BINS)
    # Two strips of 8 x 4 pixels, unless they lie on others; hardly any of the disc's three dozen pixels' change.
    assert one["profile"][-1] == pytest.approx(one["profile"][-2], rel=0.2)
    assert 0 < one["agent"] < 0.2


def test_a_new_clip_changes_most_pixels():
    (result,) = pixel_maps({"identity": identity(SHAPE)}, "DistractorPointMaze-v0", 12)["encoders"].values()
    assert list(result["settings"]) == list(eval_settings("DistractorPointMaze-v0"))
    for one in result["settings"].values():
        assert one["clip"] > 0.3 > one["agent"]


def test_no_pixels_in_nav2d():
    with pytest.raises(ValueError, match="Nav2D-v0"):
        pixel_maps({}, "Nav2D-v0", 1)


def test_one_state_has_no_other_to_be_compared_with():
    with pytest.raises(ValueError, match="two states or more, got 1"):
        pixel_maps({"identity": identity(SHAPE)}, "PointMaze-v0", 1)


@pytest.mark.parametrize(("name", "value", "who"), [("GOAL_RADIUS", 100.0, "obstacle"), ("AGENT_RADIUS", 6.0, "agent")])
def test_states_without_room_to_move_are_too_few(monkeypatch, name, value, who):
    # A goal as wide as the room leaves no place for obstacles; an agent of six meters overlaps one everywhere.
    monkeypatch.setattr(pixels, name, value)
    with pytest.raises(ValueError, match=f"no {who} of 2 states has room to move"):
        pixel_maps({"identity": identity(SHAPE)}, "PointMaze-v0", 2)
