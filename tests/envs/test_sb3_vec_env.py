"""The batched VecEnv against ``DummyVecEnv``: nothing differs but the speed."""

import importlib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import PassiveEnvChecker
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_abisim.envs import ENV_IDS
from sb3_abisim.envs.plain_wrappers import PlainWrappers
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


def _count_calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Of the outermost wrapper of Gymnasium's, from now on."""
    calls = [0]
    step = gym.wrappers.TimeLimit.step

    def counted(self: Any, action: Any) -> Any:
        calls[0] += 1
        return step(self, action)

    monkeypatch.setattr(gym.wrappers.TimeLimit, "step", counted)
    return calls


@pytest.mark.parametrize("module", ["gymnasium", "rl_zoo3.gym_patches"])
def test_wrappers_are_called_at_the_ends_of_episodes_alone(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And hold afterwards what they would hold if they had been called; also with the time limit of rl-zoo3."""
    importlib.import_module(module)
    ours, theirs = (make("Nav2D-v0", cls) for cls in (BatchedVecEnv, DummyVecEnv))
    actions = np.random.default_rng(0).integers(0, 4, (170, 3))
    for env in (ours, theirs):
        env.reset()
    for action in actions[:3]:  # in which Gymnasium's checker looks at the environment
        ours.step(action)
    calls = _count_calls(monkeypatch)
    ended = sum(ours.step(action)[2].sum() for action in actions[3:])
    assert calls[0] == ended > 5
    for action in actions:
        theirs.step(action)
    assert calls[0] == ended + actions.size
    for one, other in zip(ours.envs, theirs.envs, strict=True):
        for name in ("rewards", "total_steps", "needs_reset", "episode_returns", "episode_lengths"):
            assert getattr(one, name) == getattr(other, name)
        assert one.get_wrapper_attr("_elapsed_steps") == other.get_wrapper_attr("_elapsed_steps")


def test_the_checker_of_gymnasium_before_1_4_has_less_to_check() -> None:
    env = gym.make("Nav2D-v0")
    env.reset(seed=0)
    wrappers = PlainWrappers(env)
    assert not wrappers.are_plain()
    for _ in range(3):
        env.step(0)
    assert wrappers.are_plain()
    checker: Any = env
    while not isinstance(checker, PassiveEnvChecker):
        checker = checker.env
    vars(checker).pop("checked_data_reuse", None)
    assert wrappers.are_plain()


class Doubled(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> Any:
        return 2 * reward


@pytest.mark.parametrize("how", ["another wrapper", "another method", "another environment"])
def test_anything_but_plain_wrappers_is_called(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make("Nav2D-v0", BatchedVecEnv, wrapper_class=Doubled if how == "another wrapper" else None)
    env.reset()
    if how == "another method":
        monitor = env.envs[1]
        monkeypatch.setattr(monitor, "step", monitor.step)
    elif how == "another environment":
        env.envs[1] = gym.Wrapper(env.envs[1])
    for _ in range(3):
        env.step(np.zeros(3, int))
    calls = _count_calls(monkeypatch)
    rewards = env.step(np.zeros(3, int))[1]
    assert calls[0] == 3
    assert set(rewards.tolist()) <= ({-2.0, 0.0} if how == "another wrapper" else {-1.0, 0.0})


def test_what_is_returned_stays_as_it_is() -> None:
    env = make("Nav2D-v0", BatchedVecEnv)
    env.reset()
    rng, kept = np.random.default_rng(0), []
    for _ in range(60):
        observations, _, _, infos = env.step(rng.integers(0, 4, 3))
        terminal = [info["terminal_observation"] for info in infos if "terminal_observation" in info]
        kept += [(array, array.copy()) for array in (observations, *terminal)]
    assert len(kept) > 60
    assert all(np.array_equal(array, copied) for array, copied in kept)
