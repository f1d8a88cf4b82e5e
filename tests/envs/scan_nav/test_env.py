"""ScanNav's task, against habitat-lab's definitions and an agent that knows the map."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from scan_inputs import empty_room, map_of_a_room, start_at  # noqa: F401
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

from sb3_abisim.envs.scan_nav.apartment import SEEDS
from sb3_abisim.envs.scan_nav.env import ScanNavEnv, ScanNavVectorEnv, load_scene


@pytest.mark.parametrize("obs_mode", ["rgb", "rgbd", "dict"])
def test_observation_modes_agree(obs_mode):
    reference, env = (ScanNavEnv(scenes=1, obs_mode=m, goals_per_scene=2, image_size=64) for m in ("rgbd", obs_mode))
    with warnings.catch_warnings():
        # Habitat's depth is float32, which Stable-Baselines3 takes as a plain vector.
        warnings.filterwarnings("ignore", message="It seems that your observation (space )?depth is an image")
        check_env(env)
    expected, seen = reference.reset(seed=1)[0], env.reset(seed=1)[0]
    assert env.observation_space.contains(seen)
    if obs_mode != "dict":
        assert np.array_equal(seen, expected[: len(seen)])
        return
    assert np.array_equal(np.moveaxis(seen["rgb"], -1, 0), expected[:3])
    # Habitat's depth is meters / 10; ours is 255 * meters / 3 (surfaces are all below the camera here).
    assert np.abs(seen["depth"][..., 0] * 10 / 3 * 255 - expected[3]).max() <= 0.5 + 1e-3


def test_reward_success_and_spl_are_habitats(room):
    """Straight north: 1.5 m, 6 steps of 0.25 m, with one detour of a step to the east and back."""
    env = ScanNavEnv(scenes=room)
    _, _ = start_at(env, (4.0, 1.5), (4.0, 3.0))
    goal = env.factors()["goal"]
    d0 = float(env.batch._distance[0])
    assert d0 == pytest.approx(np.hypot(*(goal - (4.0, 1.5))), abs=0.03)
    # To the right nine times, forward, turn round, forward, turn left... back to north.
    script = [3] * 9 + [1] + [2] * 18 + [1] + [3] * 9 + [1] * 6
    rewards, previous, path, position = [], d0, 0.0, env.factors()["agent"]
    for action in script:
        _, reward, terminated, _, info = env.step(action)
        assert reward == pytest.approx(-0.01 + previous - info["distance_to_goal"], abs=1e-12)
        assert not terminated and info["spl"] == 0 and not info["collided"]
        path += float(np.hypot(*(env.factors()["agent"] - position)))
        position, previous = env.factors()["agent"], info["distance_to_goal"]
        rewards.append(reward)
    assert previous < 0.2 and path == pytest.approx(8 * 0.25)
    _, reward, terminated, _, info = env.step(0)
    assert terminated and info["success"] == 1 and info["is_success"] is True
    assert reward == pytest.approx(2.5 - 0.01)
    assert info["spl"] == pytest.approx(d0 / path)
    assert sum(rewards) == pytest.approx(d0 - previous - 0.01 * len(script))


def test_stop_in_the_wrong_place_ends_without_success(room):
    env = ScanNavEnv(scenes=room)
    start_at(env, (4.0, 1.5), (4.0, 3.0))
    _, reward, terminated, truncated, info = env.step(0)
    assert terminated and not truncated and reward == pytest.approx(-0.01)
    assert not info["is_success"] and info["success"] == info["spl"] == 0


def test_automatic_stop(room):
    env = ScanNavEnv(scenes=room, stop="auto")
    assert env.action_space.n == 3
    start_at(env, (4.0, 2.5), (4.0, 3.0))
    _, reward, terminated, _, info = env.step(0)
    while not terminated:
        _, reward, terminated, _, info = env.step(0)
    assert info["is_success"] and info["distance_to_goal"] < 0.2 and reward > 2.5


def test_turns_are_ten_degrees(room):
    env = ScanNavEnv(scenes=room)
    start_at(env, (4.0, 1.5), (4.0, 3.0), heading=5)
    env.step(2)
    assert env.factors()["heading"] == pytest.approx(15)
    for _ in range(2):
        env.step(3)
    assert env.factors()["heading"] == pytest.approx(355)
    before = env.factors()["agent"]
    env.step(1)
    moved = env.factors()["agent"] - before
    assert moved == pytest.approx(0.25 * np.array([np.sin(np.deg2rad(5)), np.cos(np.deg2rad(5))]))


@pytest.mark.parametrize("allow_sliding", [True, False])
def test_walls_and_the_border_of_the_view_stop(allow_sliding):
    # A wall along x at y = 4 m to the north of the start; the view's border 3 m east of the goal.
    env = ScanNavEnv(scenes=empty_room(walls=[np.s_[30:40, :]]), allow_sliding=allow_sliding)
    start_at(env, (4.0, 3.9), (4.0, 2.5), heading=-45)
    *_, info = env.step(1)
    x, y = env.factors()["agent"]
    assert info["collided"] and 3.95 <= y <= 4.03
    assert (x > 4.15) == allow_sliding
    start_at(env, (6.0, 2.5), (4.0, 2.5), heading=-90)
    for _ in range(12):
        *_, info = env.step(1)
    assert info["collided"] and 6.5 < env.factors()["agent"][0] < 7.0


def test_who_starts_at_the_goal_took_the_shortest_path(room):
    env = ScanNavVectorEnv(scenes=room, stop="action", autoreset=False)
    env.reset(seed=0, options={"goal": (4.0, 3.0), "start": (4.0, 3.0)})
    goal = env.factors()["goal"][0].tolist()
    env.reset(seed=0, options={"goal": goal, "start": goal})
    *_, infos = env.step(np.zeros(1, dtype=np.int64))
    assert env._first_distance[0] == 0 and infos["is_success"][0] and infos["spl"][0] == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_an_agent_that_knows_the_map_succeeds(seed):
    env = ScanNavVectorEnv(16, 500, scenes=seed, goals_per_scene=25)
    env.reset(seed=0)
    successes, spls = [], []
    while len(successes) < 100:
        _, _, terminated, truncated, infos = env.step(env.oracle_actions())
        ended = terminated | truncated
        successes += infos["success"][ended].tolist()
        spls += infos["spl"][ended].tolist()
    assert np.mean(successes) >= 0.99 and np.mean(spls) >= 0.95


def test_final_info_has_the_metrics(room):
    env = ScanNavVectorEnv(3, scenes=room)
    start_at(env, (4.0, 2.9), (4.0, 3.0))
    *_, infos = env.step(np.array([0, 1, 0]))
    assert infos["_final_obs"].tolist() == [True, False, True]
    assert infos["final_info"]["spl"].tolist() == [1.0, 0.0, 1.0] and infos["final_info"]["success"][0] == 1
    assert np.abs(infos["final_info"]["factors"]["agent"][0] - (4.0, 2.9)).max() < 1e-9


def test_scenes_of_every_kind(room, tmp_path):
    room.save(tmp_path / "room.npz")
    assert load_scene(room) is room
    assert load_scene(str(tmp_path / "room.npz")).content_hash == room.content_hash
    env = ScanNavVectorEnv(8, scenes=[tmp_path / "room.npz", 1], goals_per_scene=1)
    env.reset(seed=0)
    assert set(env.factors()["scene"]) == {0, 1}
    assert env.content_hash != ScanNavVectorEnv(scenes=room).content_hash


def test_the_papers_preset():
    env = gym.make("ScanNavPaper-v0", scenes=0, goals_per_scene=1, render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (4, 256, 256) and env.spec.max_episode_steps == 500
    assert env.unwrapped.batch._world.rule.min_ratio == 1.1 and env.unwrapped.batch._pitch == 10 / 256
    assert env.render().shape == (512, 512, 3)


@pytest.mark.parametrize(("obs_mode", "policy"), [("dict", "MultiInputPolicy"), ("rgbd", "CnnPolicy")])
def test_ppo_learns_from_both_forms(room, obs_mode, policy):
    env = ScanNavEnv(scenes=room, image_size=64, obs_mode=obs_mode)
    model = PPO(policy, env, n_steps=32, batch_size=16, n_epochs=1, device="cpu")
    model.learn(32)
    assert model.predict(env.reset(seed=0)[0])[0] in range(4)
