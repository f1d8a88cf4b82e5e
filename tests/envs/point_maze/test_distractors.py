"""DistractorPointMaze: PointMaze over a moving background, foreground untouched."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sb3_abisim  # noqa: F401
from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.point_maze.distractors import DistractorPointMazeEnv, DistractorPointMazeVectorEnv
from sb3_abisim.envs.point_maze.env import PointMazeVectorEnv
from sb3_abisim.envs.point_maze.layout import to_pixels

PUSHES = np.random.default_rng(9).integers(0, 4, (40, 3))


def rollout(env, seed=7, steps=40):
    observations = [env.reset(seed=seed)[0]]
    factors = [env.factors()]
    for actions in PUSHES[:steps]:
        observations.append(env.step(actions)[0])
        factors.append(env.factors())
    return np.stack(observations), {name: np.stack([f[name] for f in factors]) for name in factors[0]}


def foreground(env):
    """Which pixels show something other than floor, shape (n, 64, 64): static things, and the agent at any coverage."""
    masks = env._floor[:, 0] == 0
    env._agent.mark(masks, to_pixels(env._position))
    return masks


def make(**kwargs):
    return DistractorPointMazeVectorEnv(num_envs=3, max_episode_steps=15, **kwargs)


@pytest.mark.parametrize("split", ["train", "eval"])
def test_foreground_is_byte_equal_to_the_clean_observation_and_the_rest_to_the_clip(split):
    # The clean copies see the same mazes and the same pushes, over several episodes.
    clean, shown = make(split="clean"), make(split=split, color_jitter=False)
    frames = [clip.load() for clip in load_backgrounds(split=split).clips]
    clean.reset(seed=7), shown.reset(seed=7)
    for actions in PUSHES:
        plain, observation = clean.step(actions)[0], shown.step(actions)[0]
        masks = foreground(clean)
        factors = shown.factors()
        backgrounds = np.stack([frames[c][f] for c, f in zip(factors["clip"], factors["frame"], strict=True)])
        assert 0.15 < masks.mean() < 0.8
        assert np.array_equal(observation, np.where(masks[:, None], plain, backgrounds))
        floor = np.array([226, 226, 220])[:, None, None]
        assert (plain == floor).all(axis=1)[~masks].all()  # nothing of the foreground outside of the mask


def test_each_train_episode_has_another_color_jitter():
    clean, shown = make(split="clean"), make()
    frames = [clip.load() for clip in load_backgrounds().clips]
    clean.reset(seed=7), shown.reset(seed=7)
    seen = set()
    for step, actions in enumerate(PUSHES):
        plain, observation = clean.step(actions)[0], shown.step(actions)[0]
        factors, jitter = shown.factors(), shown._player._color_jitter
        backgrounds = np.stack([frames[c][f] for c, f in zip(factors["clip"], factors["frame"], strict=True)])
        floor = jitter.apply(backgrounds, np.arange(3))
        assert np.array_equal(observation, np.where(foreground(clean)[:, None], plain, floor))
        assert not np.array_equal(floor, backgrounds)
        if step == 3:
            first = jitter._channels.tobytes() + jitter._first.tobytes() + jitter._flips.tobytes()
        if 3 <= step < 14:  # within the first episode
            assert jitter._channels.tobytes() + jitter._first.tobytes() + jitter._flips.tobytes() == first
        seen |= {
            row.tobytes() for row in np.concatenate([jitter._channels, jitter._flips, jitter._first[..., 0, 0]], 1)
        }
    assert len(seen) >= 6
    assert len({env.content_hash for env in (shown, make(color_jitter=False), make(split="eval"), clean)}) == 4
    assert make(split="eval").content_hash == make(split="eval", color_jitter=False).content_hash


def test_clean_has_the_observations_of_point_maze_in_the_first_episode():
    plain = PointMazeVectorEnv(num_envs=3, max_episode_steps=15)
    assert np.array_equal(make(split="clean").reset(seed=3)[0], plain.reset(seed=3)[0])
    factors = make(split="clean")
    factors.reset(seed=3)
    assert factors.factors()["clip"].tolist() == [-1, -1, -1] and factors.content_hash == "clean"


def test_the_next_frame_every_step_and_a_new_clip_every_episode():
    env = DistractorPointMazeVectorEnv(num_envs=3, max_episode_steps=15)
    _, factors = rollout(env, steps=14)
    assert (factors["clip"] == factors["clip"][0]).all()
    lengths = load_backgrounds().lengths[factors["clip"][0]]
    steps = np.diff(factors["frame"], axis=0)
    turns = (factors["frame"][1:-1] == 0) | (factors["frame"][1:-1] == lengths - 1)
    assert (np.abs(steps) == 1).all()
    assert ((steps[1:] == steps[:-1]) | turns).all()
    seen = set()
    for seed in range(30):
        env.reset(seed=100 * seed)
        seen |= set(env.factors()["clip"].tolist())
    assert seen == set(range(14))


def test_clip_id_names_the_content_in_any_selection():
    name = load_backgrounds(split="eval").names[3]
    alone = make(split="eval", clips=[name])
    alone.reset(seed=0)
    assert alone.factors()["clip"].tolist() == [0, 0, 0]
    assert set(alone.factors()["clip_id"].tolist()) == {int(load_backgrounds(split="eval").clip_ids[3])}
    assert (
        len({make(split="eval", clips=[name]).content_hash, make(split="eval").content_hash, make().content_hash}) == 3
    )


@pytest.mark.parametrize("order", ["video", "shuffled"])
def test_the_seed_determines_everything(order):
    first, second, other = (rollout(make(order=order), seed)[0] for seed in (7, 7, 8))
    assert np.array_equal(first, second)
    assert not np.array_equal(first[0], other[0])
    assert np.array_equal(first[0, 1:], other[0, :2])  # copy i has seed + i


@pytest.mark.parametrize("order", ["video", "shuffled"])
def test_a_single_environment_is_a_batch_of_one(order):
    batch, _ = rollout(DistractorPointMazeVectorEnv(num_envs=3, order=order), steps=12)
    for i in range(3):
        env = DistractorPointMazeEnv(order=order)
        single = [env.reset(seed=7 + i)[0]] + [env.step(actions[i])[0] for actions in PUSHES[:12]]
        assert np.array_equal(np.stack(single), batch[:, i])


def test_shuffled_frames_are_less_alike():
    def similarity(order):
        observations, _ = rollout(make(order=order, clips=["fig"], color_jitter=False), steps=14)
        return np.abs(np.diff(observations.astype(int), axis=0)).mean()

    assert similarity("shuffled") > 3 * similarity("video")


def test_final_factors_are_those_of_the_ended_episode():
    env = make()
    _, factors = rollout(env, steps=14)
    info = env.step(PUSHES[14])[4]
    ended = info["_final_obs"]
    assert ended.all()
    assert np.array_equal(info["final_info"]["factors"]["clip"], factors["clip"][-1])
    assert (np.abs(info["final_info"]["factors"]["frame"] - factors["frame"][-1]) == 1).all()


def test_render_shows_the_background_enlarged_and_the_agent():
    env = gym.make("DistractorPointMaze-v0", render_mode="rgb_array")
    observation, _ = env.reset(seed=1)
    image = env.render()
    assert image.shape == (512, 512, 3) and image.dtype == np.uint8
    same = (image[4::8, 4::8].transpose(2, 0, 1) == observation).all(axis=0)
    assert same.mean() > 0.99
    assert (image == (220, 40, 40)).all(axis=2).sum() > 200


@pytest.mark.parametrize("env_id", ["DistractorPointMaze-v0", "ContinuousDistractorPointMaze-v0"])
def test_registered_ids(env_id):
    check_env(gym.make(env_id).unwrapped, skip_render_check=True)
    env = gym.make_vec(env_id, num_envs=2, vectorization_mode="vector_entry_point")
    observations, _ = env.reset(seed=0)
    assert env.observation_space.contains(observations) and env.spec.max_episode_steps == 128
    assert gym.make(env_id, color_jitter=False).unwrapped.content_hash == load_backgrounds().content_hash


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"split": "test"}, "'train', 'eval' or 'clean', got 'test'"),
        ({"order": "random"}, "'random'"),
        ({"clips": ["bee"]}, "'bee'"),  # an eval clip
        ({"split": "clean", "clips": ["bee"]}, "leave out"),
        ({"video_kwargs": {"seed": 1}}, "give videos="),
        ({"videos": "/nowhere/at all"}, "/nowhere/at all does not exist"),
    ],
)
def test_mistakes(kwargs, words):
    with pytest.raises(ValueError, match=words):
        DistractorPointMazeEnv(**kwargs)
