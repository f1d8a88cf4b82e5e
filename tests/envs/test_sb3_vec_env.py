"""The batched VecEnv against ``DummyVecEnv``: nothing differs but the speed."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_abisim.envs import ENV_IDS
from sb3_abisim.envs.sb3_vec_env import BatchedVecEnv


def make(env_id: str, cls: Any, n_envs: int = 3, **kwargs: Any) -> Any:
    return make_vec_env(env_id, n_envs, seed=7, vec_env_cls=cls, **kwargs)


def same(ours: Any, theirs: Any) -> bool:
    """Equal infos, observations included; clocks are not compared."""
    if isinstance(theirs, dict):
        return ours.keys() == theirs.keys() and all(same(ours[key], theirs[key]) for key in theirs if key != "t")
    return type(ours) is type(theirs) and np.array_equal(ours, theirs)


@pytest.mark.parametrize("env_id", ["ScanNav-v0", "DistractorPointMaze-v0"])
def test_content_hashes_are_passed_on(env_id: str) -> None:
    ours, theirs = (make(env_id, cls, n_envs=2) for cls in (BatchedVecEnv, DummyVecEnv))
    assert (
        ours.get_attr("content_hash") == theirs.get_attr("content_hash") and len(ours.get_attr("content_hash")[0]) == 64
    )


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_equals_dummy(env_id: str, tmp_path: Path) -> None:
    kwargs = {"monitor_kwargs": {"info_keywords": ("is_success",)}}
    ours, theirs = (
        make(env_id, cls, monitor_dir=str(tmp_path / cls.__name__), **kwargs) for cls in (BatchedVecEnv, DummyVecEnv)
    )
    assert np.array_equal(ours.reset(), theirs.reset())
    ours.action_space.seed(0)
    ended = 0
    for step in range(170):
        if step == 120:
            assert np.array_equal(ours.reset(), theirs.reset())
        if step == 140:
            for env in (ours, theirs):
                env.seed(99)
            assert np.array_equal(ours.reset(), theirs.reset())
        actions = np.array([ours.action_space.sample() for _ in range(3)])
        (*arrays, infos), (*their_arrays, their_infos) = ours.step(actions), theirs.step(actions)
        for array, other in zip(arrays, their_arrays, strict=True):
            assert array.dtype == other.dtype and np.array_equal(array, other)
        assert all(same(info, other) for info, other in zip(infos, their_infos, strict=True))
        ended += sum(arrays[2])
    if env_id.startswith("Nav2D"):
        assert ended > 3
    factors, their_factors = ours.env_method("factors"), theirs.env_method("factors")
    assert all(same(one, other) for one, other in zip(factors, their_factors, strict=True))
    assert len({one["agent"].tobytes() for one in factors}) > 1
    if "Distractor" in env_id:
        assert ours.get_attr("content_hash") == theirs.get_attr("content_hash")
    for env in (ours, theirs):
        env.close()
    if ended:
        files = [sorted((tmp_path / name).glob("*")) for name in ("BatchedVecEnv", "DummyVecEnv")]
        assert [file.name for file in files[0]] == [file.name for file in files[1]]
        for file, other in zip(*files, strict=True):
            episodes = [[line.split(",")[::3] for line in f.read_text().splitlines()[2:]] for f in (file, other)]
            assert episodes[0] == episodes[1]


def test_reset_options_of_one_copy_leave_the_others_alone() -> None:
    """ScanNav's goals: each copy walks to another, and knows its way."""
    ours, theirs = (make("ScanNav-v0", cls, n_envs=2) for cls in (BatchedVecEnv, DummyVecEnv))
    theirs.reset()
    goals = [factors["goal"].tolist() for factors in theirs.env_method("factors")]
    scenes = [int(factors["scene"]) for factors in theirs.env_method("factors")]
    for env in (ours, theirs):
        env.seed(3)
        env.set_options([{"goal": goal, "scene": scene} for goal, scene in zip(goals, scenes, strict=True)])
    assert np.array_equal(ours.reset(), theirs.reset())
    for _ in range(5):
        assert ours.env_method("oracle_action") == theirs.env_method("oracle_action")
        actions = np.array(theirs.env_method("oracle_action"))
        (*arrays, _), (*their_arrays, _) = ours.step(actions), theirs.step(actions)
        for array, other in zip(arrays, their_arrays, strict=True):
            assert np.isfinite(array).all() and np.array_equal(array, other)


def test_the_generator_is_that_of_each_copy() -> None:
    """As with ``DummyVecEnv``: what samples from a copy's ``np_random`` moves its episodes."""
    ours, theirs = (make("Nav2D-v0", cls, n_envs=2) for cls in (BatchedVecEnv, DummyVecEnv))
    for env in (ours, theirs):
        env.seed(5)
        env.reset()
        env.envs[1].unwrapped.np_random.random(7)
    assert np.array_equal(ours.reset(), theirs.reset())


def test_arguments_and_observations_reach_the_batch() -> None:
    kwargs = {"env_kwargs": {"layout": "corridor", "render_mode": "rgb_array"}}
    ours, theirs = (make("Nav2D-v0", cls, **kwargs) for cls in (BatchedVecEnv, DummyVecEnv))
    assert np.array_equal(ours.reset(), theirs.reset())
    assert np.array_equal(ours.render(), theirs.render())
    assert ours.env_is_wrapped(Monitor) == [True] * 3


def test_refusals() -> None:
    with pytest.raises(ValueError, match=r"not made by gymnasium\.make of an id of sb3_abisim; use DummyVecEnv"):
        make("CartPole-v1", BatchedVecEnv)
    with pytest.raises(ValueError, match="must be made alike"):
        BatchedVecEnv([lambda: gym.make("Nav2D-v0"), lambda: gym.make("PointMaze-v0")])
    env = make("Nav2D-v0", BatchedVecEnv)
    with pytest.raises(RuntimeError, match=r"call reset\(\) before step"):
        env.step(np.zeros(3, int))
    env.reset()
    with pytest.raises(ValueError, match="outside"):
        env.step(np.full(3, 9))
    with pytest.raises(ValueError, match="knows no reset options"):
        env.set_options({"maze": 3})
        env.reset()


class Mirrored(gym.ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return 3 - action


def test_wrappers_that_change_actions_are_noticed() -> None:
    env = make("Nav2D-v0", BatchedVecEnv, wrapper_class=Mirrored)
    env.reset()
    with pytest.raises(ValueError, match="use DummyVecEnv with wrappers that change actions"):
        env.step(np.zeros(3, int))
