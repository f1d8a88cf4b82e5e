"""Any VectorEnv as a VecEnv, against ``DummyVecEnv`` over the same environments in ``Monitor``."""

from typing import Any

import gymnasium as gym
import index_env
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorWrapper
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_abisim import BatchedVecEnv
from sb3_abisim.envs.sb3_vec_env import VectorEnvAdapter

MODES = list(AutoresetMode)


class DictEnv(index_env.PlainEnv):
    """Observations in a Dict, infos of each step, and attributes of each copy."""

    def __init__(self, number: int = 0) -> None:
        super().__init__()
        self.number = number
        vector = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = gym.spaces.Dict({"image": self.observation_space, "vector": vector})

    def reset(self, **kwargs: Any) -> Any:
        image, _ = super().reset(**kwargs)
        return self._both(image), {"number": self._number}

    def step(self, action: Any) -> Any:
        image, _, *ended, _ = super().step(action)
        info = {"steps": self._step, "more": {"half": self._step / 2}}
        if self._step % 2:
            info["odd"] = "yes"
        return self._both(image), 0.1 * self._step, *ended, info

    def _both(self, image: Any) -> dict[str, Any]:
        return {"image": image, "vector": self.np_random.uniform(-1, 1, 2).astype(np.float32)}

    def multiply(self, factor: int, plus: int = 0) -> int:
        return self.number * factor + plus


def functions(n: int = 3) -> list[Any]:
    def one(i: int) -> Any:
        return lambda: gym.wrappers.TimeLimit(DictEnv(i), index_env.LIMIT)

    return [one(i) for i in range(n)]


def same(ours: Any, theirs: Any) -> bool:
    if isinstance(theirs, dict):
        return ours.keys() == theirs.keys() and all(same(ours[key], theirs[key]) for key in theirs if key != "t")
    return np.array_equal(ours, theirs)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("cls", [SyncVectorEnv, AsyncVectorEnv])
def test_equals_dummy(cls: Any, mode: AutoresetMode) -> None:
    ours = BatchedVecEnv(cls(functions(), autoreset_mode=mode))
    theirs = DummyVecEnv([lambda make=make: Monitor(make()) for make in functions()])
    assert isinstance(ours, VectorEnvAdapter)
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    for env in (ours, theirs):
        env.seed(3)
    assert same(ours.reset(), theirs.reset())
    assert same(ours.reset_infos, theirs.reset_infos)
    theirs.action_space.seed(0)
    ends = {"terminated": 0, "truncated": 0}
    kept: list[Any] = []
    for _ in range(60):
        actions = np.array([theirs.action_space.sample() for _ in range(3)])
        (obs, rewards, dones, infos), expected = ours.step(actions), theirs.step(actions)
        kept.append((obs, {name: part.copy() for name, part in obs.items()}))
        assert same(obs, expected[0]) and same(dones, expected[2])
        assert rewards.dtype == np.float32 and np.allclose(rewards, expected[1])
        assert all(same(info, other) for info, other in zip(infos, expected[3], strict=True)), (infos, expected[3])
        assert all(same(*pair) for pair in zip(ours.reset_infos, theirs.reset_infos, strict=True))
        for info, done in zip(infos, dones, strict=True):
            ends["truncated" if info["TimeLimit.truncated"] else "terminated"] += bool(done)
    assert min(ends.values()) > 2
    assert all(same(*pair) for pair in kept), "an observation was written to after it was returned"
    ours.close()


@pytest.mark.parametrize("mode", MODES)
def test_the_same_seed_gives_the_same_episodes(mode: AutoresetMode) -> None:
    env = BatchedVecEnv(SyncVectorEnv(functions(), autoreset_mode=mode))
    firsts = []
    for seed in (5, 5, 6):
        env.seed(seed)
        firsts.append(env.reset()["image"])
    assert same(firsts[0], firsts[1]) and not same(firsts[0], firsts[2])


def test_our_own_vector_environments() -> None:
    ours = BatchedVecEnv(gym.make_vec("IndexEnv-v0", 3, "vector_entry_point"))
    ours.seed(0)
    first = ours.reset()
    assert (first[:, 0] == 0).all() and (first[:, 2] == index_env.NO_ACTION).all()
    lengths = np.zeros(3, int)
    for _ in range(30):
        obs, _, dones, infos = ours.step(np.full(3, 2))
        lengths += 1
        for i, info in enumerate(infos):
            assert obs[i, 0, 0, 0] == (0 if dones[i] else lengths[i])
            if dones[i]:
                assert info["terminal_observation"][0, 0, 0] == lengths[i] == info["episode"]["l"]
                assert info["is_success"] == (not info["TimeLimit.truncated"])
                lengths[i] = 0


def test_attributes_and_methods_of_copies() -> None:
    env = BatchedVecEnv(SyncVectorEnv(functions()))
    assert env.get_attr("number") == [0, 1, 2] and env.get_attr("number", 1) == [1]
    assert env.env_method("multiply", 3, plus=1, indices=[2, 1]) == [7, 4]
    env.set_attr("mark", 5, indices=[1])
    assert env.get_attr("mark", [1]) == [5] and not env.has_attr("mark")
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [True] * 3
    assert env.env_is_wrapped(gym.wrappers.TransformReward) == [False] * 3
    assert env.env_is_wrapped(Monitor, indices=[0]) == [True]
    env = BatchedVecEnv(RecordEpisodeStatistics(SyncVectorEnv(functions())))
    assert env.env_is_wrapped(RecordEpisodeStatistics) == [True] * 3


def test_attributes_of_processes_and_batches() -> None:
    env = BatchedVecEnv(AsyncVectorEnv(functions(2)))
    assert env.get_attr("number") == [0, 1] and env.env_method("multiply", 3) == [0, 3]
    with pytest.raises(ValueError, match="call multiply in all copies alone"):
        env.env_method("multiply", 3, indices=[1])
    env.close()
    batch = BatchedVecEnv(gym.make_vec("IndexEnv-v0", 2, "vector_entry_point"))
    assert batch.get_attr("offset") == [0, 0] and not batch.has_attr("nothing")
    batch.set_attr("offset", 7)
    assert batch.reset()[0, 0, 0, 0] == 7
    with pytest.raises(ValueError, match="set offset in all copies alone"):
        batch.set_attr("offset", 1, indices=[0])
    with pytest.raises(AttributeError, match="no multiply of one copy"):
        batch.env_method("multiply")


class Forgetful(index_env.IndexVectorEnv):
    """Resets everything, whatever the options are."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def _take_options(self, options: dict[str, Any]) -> None:
        pass


def test_refusals() -> None:
    env = BatchedVecEnv(Forgetful(3, autoreset=False))
    env.reset()
    with pytest.raises(ValueError, match=r"other copies were reset, too; make it with autoreset_mode=.*SAME_STEP"):
        for _ in range(20):
            env.step(np.ones(3, int))
    unsaid = SyncVectorEnv(functions())
    unsaid.metadata = {}
    with pytest.raises(ValueError, match=r"metadata\['autoreset_mode'\] must be one of .*, got None"):
        BatchedVecEnv(unsaid)
    env = BatchedVecEnv(SyncVectorEnv(functions()))
    env.set_options([{"a": 1}, {}, {}])
    with pytest.raises(ValueError, match="equal options"):
        env.reset()
    with pytest.raises(ValueError, match="infos\\['final_obs'\\] is missing"):
        env = BatchedVecEnv(InfoLess(SyncVectorEnv(functions(), autoreset_mode=AutoresetMode.SAME_STEP)))
        env.reset()
        for _ in range(20):
            env.step(np.float32([[0, 3]] * 3))


class InfoLess(VectorWrapper):
    """A wrapper that drops infos."""

    def step(self, actions: Any) -> Any:
        return *self.env.step(actions)[:4], {}


def test_ppo_logs_returns() -> None:
    env = BatchedVecEnv(SyncVectorEnv([lambda: gym.make("CartPole-v1", max_episode_steps=9)] * 3))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, device="cpu")
    model.learn(96)
    assert len(model.ep_info_buffer) > 5
    assert {info["r"] for info in model.ep_info_buffer} <= {8.0, 9.0}
    returns, lengths = evaluate_policy(model, env, 5, return_episode_rewards=True)
    assert returns == lengths and len(returns) == 5


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_real_atari(mode: AutoresetMode) -> None:
    ale_py = pytest.importorskip("ale_py")
    gym.register_envs(ale_py)
    vector = gym.make_vec("ALE/Pong-v5", 4, "vector_entry_point", autoreset_mode=mode, max_num_frames_per_episode=400)
    env = BatchedVecEnv(vector)
    model = PPO("CnnPolicy", env, n_steps=64, batch_size=128, n_epochs=1, device="cpu", seed=0)
    model.learn(1024)
    assert len(model.ep_info_buffer) >= 4
    assert {info["l"] for info in model.ep_info_buffer} <= set(range(80, 101))
    env.close()
