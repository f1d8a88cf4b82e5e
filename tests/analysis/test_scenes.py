"""Samples are what the environments show, and observations rendered from factors are those of the environments."""

import gymnasium as gym
import index_env  # noqa: F401  (registers the environments)
import numpy as np
import pytest

from sb3_abisim.analysis import scenes
from sb3_abisim.analysis.pixels import backgrounds_of, clips_of, swapped_backgrounds
from sb3_abisim.analysis.scenes import (
    agent_positions,
    eval_settings,
    local_obstacles,
    render_point_mazes,
    sample_episodes,
)
from sb3_abisim.envs.backgrounds.photo_pan import photo_pan
from sb3_abisim.envs.nav2d import MOVES, SIZE
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.layout import to_pixels
from sb3_abisim.registry import EnvTraits


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
    for obs, action, after, agent in zip(nav2d.obs, nav2d.actions, nav2d.next_obs, nav2d.factors["agent"], strict=True):
        np.testing.assert_array_equal(np.argwhere(obs[0])[0][::-1], agent)
        x, y = agent + np.array(MOVES[action])
        stays = not (0 <= x < SIZE and 0 <= y < SIZE) or obs[1, y, x]
        assert after[0, agent[1] if stays else y, agent[0] if stays else x] == 255
        np.testing.assert_array_equal(obs[1], after[1])


def test_seeds_give_other_samples_and_the_same_again(nav2d):
    np.testing.assert_array_equal(sample_episodes("Nav2D-v0", 60, 4, seed=1).obs, nav2d.obs)
    other = sample_episodes("Nav2D-v0", 60, 4, seed=2)
    assert not {a.tobytes() for a in other.obs[:, 1]} & {a.tobytes() for a in nav2d.obs[:, 1]}


def test_no_episodes_is_an_error():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        sample_episodes("Nav2D-v0", 0, 1)


def test_surroundings_in_nav2d(nav2d):
    blocked = local_obstacles(nav2d)
    for obs, (x, y), row in zip(nav2d.obs, nav2d.factors["agent"], blocked, strict=True):
        expected = []
        for dy in (-2, -1, 0, 1, 2):
            for dx in (-2, -1, 0, 1, 2):
                if (dx, dy) != (0, 0):
                    inside = 0 <= x + dx < SIZE and 0 <= y + dy < SIZE
                    expected.append(not inside or obs[1, y + dy, x + dx] == 255)
        np.testing.assert_array_equal(row, expected)


def test_surroundings_in_the_point_mazes_are_what_is_seen():
    samples = sample_episodes("PointMaze-v0", 10, 3)
    blocked = local_obstacles(samples)
    solid = [np.array(color)[:, None, None] for color in (top_down.WALL, top_down.OBSTACLE)]
    offsets = [(dx, dy) for dy in (-2, -1, 0, 1, 2) for dx in (-2, -1, 0, 1, 2) if (dx, dy) != (0, 0)]
    n_checked = 0
    for obs, agent, row in zip(samples.obs, samples.factors["agent"], blocked, strict=True):
        seen = np.any([(obs == color).all(axis=0) for color in solid], axis=0)
        for offset, value in zip(offsets, row, strict=True):
            column, line = np.floor(to_pixels(agent + np.array(offset))).astype(int)
            if 0 <= column < 64 and 0 <= line < 64:
                assert seen[line, column] == value
                n_checked += 1
    assert n_checked > 400 and 0.1 < blocked.mean() < 0.9


def test_surroundings_in_the_apartments_are_what_the_depth_shows():
    samples = sample_episodes("ScanNav-v0", 20, 5, env_kwargs={"stop": "auto"})
    blocked = local_obstacles(samples)
    offsets = [(dx, dy) for dy in (-2, -1, 0, 1, 2) for dx in (-2, -1, 0, 1, 2) if (dx, dy) != (0, 0)]
    free, solid = [], []
    for obs, agent, row in zip(samples.obs, agent_positions(samples), blocked, strict=True):
        for (dx, dy), value in zip(offsets, row, strict=True):
            column = int(np.floor(64 + (agent[0] + 0.25 * dx) * 128 / 6))
            line = int(np.floor(64 - (agent[1] + 0.25 * dy) * 128 / 6))
            if 0 <= column < 128 and 0 <= line < 128:
                (solid if value else free).append(obs[3, line, column])
    # One can stand on what is lower than 0.2 m; a wall's neighborhood is blocked, too, so floor is among the blocked.
    assert len(free) > 300 and np.mean(np.array(free) >= 255 * (1 - 0.2 / 3)) > 0.995
    assert len(solid) > 300 and np.mean(np.array(solid) < 200) > 0.4


@pytest.mark.parametrize("env_id", ["PointMaze-v0", "ContinuousPointMaze-v0"])
def test_rendered_mazes_are_those_of_the_environment(env_id):
    samples = sample_episodes(env_id, 8, 3)
    rendered = render_point_mazes(samples.factors["agent"], samples.factors["obstacles"])
    # Factors are float32.
    assert np.abs(rendered.astype(int) - samples.obs).max() <= 2
    assert (rendered == samples.obs).mean() > 0.999


def test_rendered_mazes_over_clips(distractor):
    rendered = render_point_mazes(
        distractor.factors["agent"], distractor.factors["obstacles"], backgrounds_of(distractor)
    )
    assert np.abs(rendered.astype(int) - distractor.obs).max() <= 2
    env = gym.make("DistractorPointMaze-v0", split="clean")
    assert clips_of(distractor).split == "eval"
    assert clips_of(sample_episodes("PointMaze-v0", 1, 1)) is None
    assert env.observation_space.shape == rendered.shape[1:]


def test_swapped_backgrounds_are_of_other_clips(distractor):
    swapped = swapped_backgrounds(distractor, np.random.default_rng(0))
    clips = clips_of(distractor)
    for background, shown in zip(swapped[:4], distractor.factors["clip"], strict=False):
        sources = set()
        for k, length in enumerate(clips.lengths.tolist()):
            frames = clips.frames(np.full(length, k), np.arange(length))
            if (frames == background).all(axis=(1, 2, 3)).any():
                sources.add(k)
        assert sources and shown not in sources


def test_settings_follow_from_traits_and_classes(monkeypatch):
    assert eval_settings("Nav2DMaze-v0") == {"eval layouts": {}}
    assert eval_settings("ContinuousDistractorPointMaze-v0") == {
        "train clips": {"split": "train", "color_jitter": False}, "eval clips": {"split": "eval"},
    }  # fmt: skip
    assert eval_settings("ScanNavPaper-v0") == {"eval episodes": {"stop": "auto"}}
    assert eval_settings("IndexEnv-v0") == {"eval episodes": {}}
    traits = EnvTraits(splits=("eval", "train"), collect_kwargs={"offset": 3})
    monkeypatch.setattr(scenes, "get_traits", lambda env_id: traits)
    assert eval_settings("IndexEnv-v0") == {
        "train split": {"offset": 3, "split": "train"}, "eval split": {"offset": 3, "split": "eval"},
    }  # fmt: skip


def test_any_image_environment_has_samples():
    samples = sample_episodes("PlainEnv-v0", 12, 3)
    assert samples.factors == {} and agent_positions(samples) is None and local_obstacles(samples) is None
    assert clips_of(samples) is None and set(samples.episodes) == set(range(12))
    # The first two channels are step and episode.
    assert (samples.next_obs[:, 0, 0, 0] == samples.obs[:, 0, 0, 0] + 1).all()
    assert (samples.next_obs[:, 1] == samples.obs[:, 1]).all()


def test_clips_are_those_that_the_environment_shows():
    (name,) = photo_pan("eval").names[:1]
    samples = sample_episodes("DistractorPointMaze-v0", 3, 2, env_kwargs={"split": "eval", "clips": [name]})
    assert clips_of(samples).names == (name,)
    assert (samples.factors["clip_id"] == clips_of(samples).clip_ids[0]).all()
    with pytest.raises(ValueError, match="one clip in the split 'eval'; give a second one"):
        swapped_backgrounds(samples, np.random.default_rng(0))


def test_long_episodes_are_left_where_memory_ends(monkeypatch):
    monkeypatch.setattr(scenes, "MAX_BYTES", 3 * 5 * 3 * SIZE * SIZE)
    # Five copies, three steps.
    assert np.bincount(sample_episodes("Nav2D-v0", 5, 50).episodes).tolist() == [3] * 5


def test_observations_must_be_images():
    with pytest.raises(ValueError, match="observations must be uint8 images"):
        sample_episodes("CartPole-v1", 2, 2)
    with pytest.raises(ValueError, match="unknown environment 'Nav3D-v0'"):
        sample_episodes("Nav3D-v0", 2, 2)
