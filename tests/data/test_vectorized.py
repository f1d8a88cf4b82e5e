"""Collecting from environments that somebody else has vectorized."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import index_env
import numpy as np
import pytest
from dataset_inputs import tree
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_abisim.data import chains
from sb3_abisim.data.collect import collect, main
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import META_NAME
from sb3_abisim.data.vectorized import VectorizedCopies
from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.zoo.preprocessing import check_preprocessing

N_ENVS, PER_SHARD = 3, 12


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chains, "CHAINED_SHARD_TRANSITIONS", PER_SHARD)


def one_env() -> gym.Env:
    return gym.wrappers.TimeLimit(index_env.PlainEnv(), index_env.LIMIT)


class SameVectorEnv(SyncVectorEnv):
    """A vector environment that shows what single ones show."""

    n_steps = 0
    mode = AutoresetMode.SAME_STEP

    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        super().__init__([lambda: self.one(**kwargs)] * num_envs, autoreset_mode=self.mode)

    def one(self, max_episode_steps: int) -> gym.Env:
        return gym.wrappers.TimeLimit(index_env.PlainEnv(), max_episode_steps)

    def step(self, actions: Any) -> Any:
        type(self).n_steps += 1
        return super().step(actions)


class NextStepVectorEnv(SameVectorEnv):
    """It resets at the step after the last."""

    mode = AutoresetMode.NEXT_STEP


class OtherNumbersVectorEnv(SameVectorEnv):
    """It differs, and only once an episode was truncated."""

    def one(self, max_episode_steps: int) -> gym.Env:
        return super().one(max_episode_steps - 1)


class OtherShapeVectorEnv(SameVectorEnv):
    """It preprocesses observations."""

    def one(self, max_episode_steps: int) -> gym.Env:
        return gym.wrappers.ReshapeObservation(super().one(max_episode_steps), (6, 10))


class OtherEndVectorEnv(SameVectorEnv):
    """It differs in the last observations of episodes alone."""

    def step(self, actions: Any) -> Any:
        *outcome, infos = super().step(actions)
        for observation in infos.get("final_obs", []):
            if observation is not None:
                observation[:] = 0
        return (*outcome, infos)


class BrokenVectorEnv(SameVectorEnv):
    """It cannot be made."""

    def one(self, max_episode_steps: int) -> gym.Env:
        raise RuntimeError("no such file")


for cls in (SameVectorEnv, *SameVectorEnv.__subclasses__()):
    gym.register(
        f"{cls.__name__}-v0",
        entry_point=index_env.PlainEnv,
        vector_entry_point=cls,
        max_episode_steps=index_env.LIMIT,
    )


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("SameVectorEnv", ""),
        ("NextStepVectorEnv", ""),
        ("OtherNumbersVectorEnv", "its observations differ from those of single ones after"),
        ("OtherEndVectorEnv", "its observations differ from those of single ones after"),
        ("OtherShapeVectorEnv", r"its observation space is Box(0, 255, (1, 6, 10), uint8), that of a single one"),
        ("BrokenVectorEnv", "it cannot be made (no such file)"),
    ],
)
def test_a_vector_entry_point_is_stepped_where_it_shows_what_single_environments_show(
    tmp_path: Path, name: str, reason: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    collect("PlainEnv-v0", 100, tmp_path / "single", n_envs=N_ENVS, seed=2)
    monkeypatch.setattr(SameVectorEnv, "n_steps", 0)
    words = ["--env", f"{name}-v0", "-n", "100", "--n-envs", str(N_ENVS), "--seed", "2", "-o"]
    main([*words, str(tmp_path / "whole")])
    said = capsys.readouterr().err
    single, whole = (TransitionDataset(tmp_path / folder) for folder in ("single", "whole"))
    for array in ("frames", "actions"):
        everything = np.arange(single.n_frames)
        np.testing.assert_array_equal(getattr(single, array)(everything), getattr(whole, array)(everything))
    assert whole.ends.tolist() == single.ends.tolist() and whole.preprocessing == {}
    if reason:
        assert f"{name}-v0: copies are stepped one by one, without its faster vector environment: {reason}" in said
    else:
        assert "single environments" not in said
        cls = NextStepVectorEnv if name.startswith("Next") else SameVectorEnv
        assert cls.n_steps > 90


def test_workers_do_not_take_the_place_of_a_vector_environment(tmp_path: Path) -> None:
    for n_workers in (1, 2):
        collect("SameVectorEnv-v0", 50, tmp_path / str(n_workers), n_envs=N_ENVS, n_workers=n_workers)
    assert tree(tmp_path / "1") == tree(tmp_path / "2")


def make_vec_env() -> VecFrameStack:
    return VecFrameStack(DummyVecEnv([lambda: one_env()] * N_ENVS), 1)


def make_vector_env(offset: int = 0) -> SyncVectorEnv:
    return SyncVectorEnv([one_env] * N_ENVS, autoreset_mode=AutoresetMode.NEXT_STEP)


def assert_episodes(dataset: TransitionDataset) -> None:
    """Steps count up within episodes, and begin anew after ends."""
    seen = dataset.frames(np.arange(dataset.n_frames))[:, 0, 0, 0].astype(int)
    inside = np.flatnonzero(dataset.ends[:-1] == 0)
    assert (seen[inside + 1] == seen[inside] + 1).all()
    truncated = np.flatnonzero(dataset.ends == 2)
    assert len(truncated) and (seen[truncated] == index_env.LIMIT).all()


@pytest.mark.parametrize("make_fn", [make_vec_env, make_vector_env])
def test_a_function_that_makes_a_vectorized_environment_goes_on(tmp_path: Path, make_fn: Any) -> None:
    kwargs: dict[str, Any] = {"seed": 2}
    collect(make_fn, 100, tmp_path / "direct", **kwargs)
    collect(make_fn, 30, tmp_path / "d", **kwargs)
    collect(make_fn, 100, tmp_path / "d", **kwargs)
    assert tree(tmp_path / "d") == tree(tmp_path / "direct")
    collect(make_fn, 100, tmp_path / "other", seed=3)
    dataset, other = TransitionDataset(tmp_path / "d"), TransitionDataset(tmp_path / "other")
    assert not np.array_equal(dataset.frames(np.arange(50)), other.frames(np.arange(50)))
    assert_episodes(dataset)
    assert dataset.meta["n_envs"] == N_ENVS
    assert dataset.preprocessing["vec_env"][-1].rpartition(":")[2] in ("DummyVecEnv", "SyncVectorEnv")
    assert len(dataset.preprocessing["vec_env"]) == (2 if make_fn is make_vec_env else 1)


@pytest.mark.parametrize("make_fn", [make_vec_env, make_vector_env])
def test_a_ready_environment_is_collected_from_in_one_pass(
    tmp_path: Path, make_fn: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[Any] = []
    monkeypatch.setattr(index_env.PlainEnv, "close", lambda self: closed.append(self))
    collect(make_fn, 100, tmp_path / "made", seed=2)
    assert len(closed) == N_ENVS
    closed.clear()
    env = make_fn()
    collect(env, 100, tmp_path / "d", seed=2)
    assert not closed
    dataset = TransitionDataset(tmp_path / "d")
    assert_episodes(dataset)
    # One chain: all that goes on in the next shard is known to.
    assert dataset.meta["shards_per_chain"] == 9 == len(dataset.meta["shards"])
    assert dataset.meta["source"] == {"one_pass": dataset.preprocessing["vec_env"]}
    # What cannot be stepped to again is refused, whether finished or not.
    for _ in range(2):
        before = tree(tmp_path / "d")
        with pytest.raises(ValueError, match=r"was begun before, and .* cannot be made again .* name a new one"):
            collect(env, 100, tmp_path / "d", seed=2)
        with pytest.raises(ValueError, match=r"was begun with other arguments .*source"):
            collect(make_fn, 100, tmp_path / "d", seed=2)
        assert tree(tmp_path / "d") == before
        (tmp_path / "d" / META_NAME).unlink(missing_ok=True)
    again = make_fn()
    collect(again, 100, tmp_path / "again", seed=2)
    (tmp_path / "d" / "shard-00003.json").unlink()
    assert all(tree(tmp_path / "again")[name] == content for name, content in tree(tmp_path / "d").items())


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_envs": 4}, r"has 3 copies, not n_envs 4; leave n_envs out"),
        ({"env_kwargs": {"offset": 1}}, r"env_kwargs {'offset': 1} come too late"),
        (
            {"env_wrapper": "gymnasium.wrappers.Autoreset"},
            r"wraps single environments, and .* is vectorized",
        ),
    ],
)
def test_what_cannot_be_done_to_a_ready_environment_is_refused(tmp_path: Path, kwargs: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        collect(make_vector_env(), 50, tmp_path / "d", **kwargs)
    assert not (tmp_path / "d").exists()


def test_a_dict_of_observations_has_factors_and_last_ones() -> None:
    class DictEnv(index_env.PlainEnv):
        def __init__(self) -> None:
            super().__init__()
            vector = gym.spaces.Box(-1, 99, (2,))
            self.observation_space = gym.spaces.Dict({"camera": self.observation_space, "arm-pos": vector})

        def _observe(self) -> Any:
            return {"camera": super()._observe(), "arm-pos": np.array([self._step, -1], np.float32)}

    copies = VectorizedCopies(SyncVectorEnv([DictEnv] * 2, autoreset_mode=AutoresetMode.SAME_STEP))
    copies.reset(seed=[4, 9])
    n_ends = 0
    for _ in range(20):
        images, _, terminated, _, infos = copies.step(np.full((2, 2), [0, 3], np.float32))
        assert copies.factors()["arm_pos"].tolist() == [[step, -1] for step in images[:, 0, 0, 0]]
        for i in np.flatnonzero(terminated):
            assert images[i, 0, 0, 0] == 0 < infos["final_obs"][i][0, 0, 0]
            assert infos["final_info"]["factors"]["arm_pos"][i].tolist() == [infos["final_obs"][i][0, 0, 0], -1]
            n_ends += 1
    assert n_ends > 3


def test_an_episode_without_its_last_observation_is_refused(tmp_path: Path) -> None:
    class Silent(DummyVecEnv):
        def step_wait(self) -> Any:
            *outcome, infos = super().step_wait()
            for info in infos:
                info.pop("terminal_observation", None)
            return (*outcome, infos)

    with pytest.raises(ValueError, match=r"without infos\['terminal_observation'\]"):
        collect(Silent([one_env]), 50, tmp_path / "d")


def test_the_zoo_refuses_what_it_cannot_make() -> None:
    file = EncoderFile(Path("e"), "", None, {"preprocessing": {"vec_env": ["a:B", "c:D"]}})
    with pytest.raises(ValueError, match=r"e was pretrained on what a:B of c:D shows, which the zoo cannot make"):
        check_preprocessing(file, {})


def test_atari(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """ale-py's vector environment preprocesses by itself, other than the wrappers of single environments."""
    ale_py = pytest.importorskip("ale_py", reason="needs the extra [atari]")
    gym.register_envs(ale_py)
    main(["--env", "ALE/Pong-v5", "-n", "30", "--n-envs", "2", "-o", str(tmp_path / "single")])
    assert "without its faster vector environment: its observation space is" in capsys.readouterr().err
    assert TransitionDataset(tmp_path / "single").observation_space.shape == (3, 210, 160)

    def make() -> gym.vector.VectorEnv:
        return gym.make_vec("ALE/Pong-v5", 2, "vector_entry_point", stack_num=1)

    for name in ("a", "b"):
        collect(make, 30, tmp_path / name)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    dataset = TransitionDataset(tmp_path / "a")
    assert (dataset.env_id, dataset.observation_space.shape) == ("ALE/Pong-v5", (1, 84, 84))
    assert dataset.preprocessing == {"vec_env": ["ale_py.vector_env:AtariVectorEnv"]}
