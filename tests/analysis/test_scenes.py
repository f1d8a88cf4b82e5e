"""Samples are what the environments show, and pictures drawn from factors are the environments' own."""

import gymnasium as gym
import numpy as np
import pytest

from sb3_abisim.analysis.pixels import backgrounds_of, clips_of, swapped_backgrounds
from sb3_abisim.analysis.scenes import draw_point_mazes, local_obstacles, position_in_picture, sample_episodes
from sb3_abisim.envs.nav2d import MOVES, SIZE
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.layout import to_pixels


@pytest.fixture(scope="module")
def nav2d():
    return sample_episodes("Nav2D-v0", 60, 4, seed=1)


@pytest.fixture(scope="module")
def distractor():
    return sample_episodes("DistractorPointMaze-v0", 6, 2, seed=1, env_kwargs={"split": "eval"})


def test_samples_are_transitions_of_different_layouts(nav2d):
    assert set(nav2d.episodes) == set(range(60))
    layouts = {nav2d.factors["obstacles"][nav2d.episodes == k][0].tobytes() for k in range(60)}
    assert len(layouts) == 60
    for frame, action, after, agent in zip(
        nav2d.frames, nav2d.actions, nav2d.next_frames, nav2d.factors["agent"], strict=True
    ):
        np.testing.assert_array_equal(np.argwhere(frame[0])[0][::-1], agent)
        x, y = agent + np.array(MOVES[action])
        stays = not (0 <= x < SIZE and 0 <= y < SIZE) or frame[1, y, x]
        assert after[0, agent[1] if stays else y, agent[0] if stays else x] == 255
        np.testing.assert_array_equal(frame[1], after[1])


def test_seeds_give_other_samples_and_the_same_again(nav2d):
    np.testing.assert_array_equal(sample_episodes("Nav2D-v0", 60, 4, seed=1).frames, nav2d.frames)
    other = sample_episodes("Nav2D-v0", 60, 4, seed=2)
    assert not {a.tobytes() for a in other.frames[:, 1]} & {a.tobytes() for a in nav2d.frames[:, 1]}


def test_no_episodes_is_an_error():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        sample_episodes("Nav2D-v0", 0, 1)


def test_surroundings_in_nav2d(nav2d):
    blocked = local_obstacles(nav2d.factors)
    for frame, (x, y), row in zip(nav2d.frames, nav2d.factors["agent"], blocked, strict=True):
        expected = []
        for dy in (-2, -1, 0, 1, 2):
            for dx in (-2, -1, 0, 1, 2):
                if (dx, dy) != (0, 0):
                    inside = 0 <= x + dx < SIZE and 0 <= y + dy < SIZE
                    expected.append(not inside or frame[1, y + dy, x + dx] == 255)
        np.testing.assert_array_equal(row, expected)


def test_surroundings_in_the_point_mazes_are_what_is_seen():
    samples = sample_episodes("PointMaze-v0", 10, 3)
    blocked = local_obstacles(samples.factors)
    solid = [np.array(color)[:, None, None] for color in (top_down.WALL, top_down.OBSTACLE)]
    offsets = [(dx, dy) for dy in (-2, -1, 0, 1, 2) for dx in (-2, -1, 0, 1, 2) if (dx, dy) != (0, 0)]
    n_checked = 0
    for frame, agent, row in zip(samples.frames, samples.factors["agent"], blocked, strict=True):
        seen = np.any([(frame == color).all(axis=0) for color in solid], axis=0)
        for offset, value in zip(offsets, row, strict=True):
            column, line = np.floor(to_pixels(agent + np.array(offset))).astype(int)
            if 0 <= column < 64 and 0 <= line < 64:
                assert seen[line, column] == value
                n_checked += 1
    assert n_checked > 400 and 0.1 < blocked.mean() < 0.9


def test_surroundings_in_the_flats_are_what_the_depth_shows():
    samples = sample_episodes("ScanNav-v0", 20, 5, env_kwargs={"stop": "auto"})
    blocked = local_obstacles(samples.factors)
    offsets = [(dx, dy) for dy in (-2, -1, 0, 1, 2) for dx in (-2, -1, 0, 1, 2) if (dx, dy) != (0, 0)]
    free, solid = [], []
    for frame, agent, row in zip(samples.frames, position_in_picture(samples.factors), blocked, strict=True):
        for (dx, dy), value in zip(offsets, row, strict=True):
            column = int(np.floor(64 + (agent[0] + 0.25 * dx) * 128 / 6))
            line = int(np.floor(64 - (agent[1] + 0.25 * dy) * 128 / 6))
            if 0 <= column < 128 and 0 <= line < 128:
                (solid if value else free).append(frame[3, line, column])
    # One can stand on what is lower than 0.2 m; a wall's neighborhood is blocked, too, so floor is among the blocked.
    assert len(free) > 300 and np.mean(np.array(free) >= 255 * (1 - 0.2 / 3)) > 0.995
    assert len(solid) > 300 and np.mean(np.array(solid) < 200) > 0.4


@pytest.mark.parametrize("env_id", ["PointMaze-v0", "ContinuousPointMaze-v0"])
def test_drawn_mazes_are_those_of_the_environment(env_id):
    samples = sample_episodes(env_id, 8, 3)
    drawn = draw_point_mazes(samples.factors["agent"], samples.factors["obstacles"])
    # Factors are float32.
    assert np.abs(drawn.astype(int) - samples.frames).max() <= 2
    assert (drawn == samples.frames).mean() > 0.999


def test_drawn_mazes_over_clips(distractor):
    drawn = draw_point_mazes(distractor.factors["agent"], distractor.factors["obstacles"], backgrounds_of(distractor))
    assert np.abs(drawn.astype(int) - distractor.frames).max() <= 2
    env = gym.make("DistractorPointMaze-v0", split="clean")
    assert clips_of(distractor).split == "eval"
    assert clips_of(sample_episodes("PointMaze-v0", 1, 1)) is None
    assert env.observation_space.shape == drawn.shape[1:]


def test_swapped_backgrounds_are_of_other_clips(distractor):
    swapped = swapped_backgrounds(distractor, np.random.default_rng(0))
    clips = clips_of(distractor)
    for picture, own in zip(swapped[:4], distractor.factors["clip"], strict=False):
        sources = set()
        for k, length in enumerate(clips.lengths.tolist()):
            frames = clips.frames(np.full(length, k), np.arange(length))
            if (frames == picture).all(axis=(1, 2, 3)).any():
                sources.add(k)
        assert sources and own not in sources
