"""Chains of shards: episodes run on over shards, and whatever is missing is collected by stepping again."""

import itertools
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import index_env
import numpy as np
import pytest
from dataset_inputs import rewrite_meta, tree
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecTransposeImage

from sb3_abisim.data import chains, environments
from sb3_abisim.data import collect as collect_module
from sb3_abisim.data.collect import collect
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CUT, INSIDE, META_NAME, DatasetError
from sb3_abisim.data.rollout import Policy, Rollout

N_ENVS, STEPS, SHARDS = 3, 4, 5
PER_SHARD, PER_CHAIN = N_ENVS * STEPS, N_ENVS * STEPS * SHARDS


class LongEnv(index_env.PlainEnv):
    """Episodes of 2 to about 30 steps, over several shards of a chain; what it did before shows after a reset."""

    n_made = n_steps = 0

    def __init__(self, channels_last: bool = False) -> None:
        super().__init__(channels_last)
        self.n_episodes = 0
        type(self).n_made += 1

    def reset(self, **kwargs: Any) -> Any:
        self.n_episodes += 1
        return super().reset(**kwargs)

    def step(self, action: Any) -> Any:
        observation, reward, _, truncated, info = super().step(action)
        type(self).n_steps += 1
        return observation, reward, bool(self.np_random.random() < 0.1), truncated, info

    def _observe(self) -> Any:
        self._number = self._number // 8 * 8 + self.n_episodes % 8
        return super()._observe()


class EndlessEnv(LongEnv):
    """Episodes never end."""

    def step(self, action: Any) -> Any:
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, False, truncated, info


gym.register("Endless-v0", entry_point=EndlessEnv)
gym.register("Long-v0", entry_point=LongEnv, max_episode_steps=STEPS * SHARDS)


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chains, "CHAINED_SHARD_TRANSITIONS", PER_SHARD)


def collect_long(folder: Path, n: int = 150, **kwargs: Any) -> TransitionDataset:
    collect("Long-v0", n, folder, n_envs=N_ENVS, seed=2, **kwargs)
    return TransitionDataset(folder, eval_fraction=0.2)


def test_episodes_run_on_over_shards(tmp_path: Path) -> None:
    dataset = collect_long(tmp_path / "d", frame_stack=1)
    assert [shard["n_transitions"] for shard in dataset.meta["shards"]] == [PER_SHARD] * 12 + [6]
    assert (dataset.meta["steps_per_shard"], dataset.meta["shards_per_chain"]) == (STEPS, SHARDS)
    seen = dataset.frames(np.arange(dataset.n_frames))[:, :2, 0, 0].astype(int)
    begins = np.concatenate([[0], np.flatnonzero(dataset.ends)[:-1] + 1])
    # The first segments of a chain begin episodes, and there are longer ones than a shard.
    shard = np.searchsorted(dataset._offsets, begins, side="right") - 1
    first_of_chain = shard % SHARDS == 0
    assert (seen[begins[first_of_chain], 0] == 0).all()
    goes_on = seen[begins, 0] > 0
    assert goes_on.sum() > 10 and seen[:, 0].max() > 2 * STEPS
    # What goes on shows the last frame of the segment that it goes on with.
    for segment in np.flatnonzero(goes_on):
        before = dataset._before[segment]
        assert dataset.ends[dataset._last[before]] == CUT
        assert tuple(seen[dataset._last[before]]) == tuple(seen[begins[segment]])
    assert (dataset._before[~goes_on] == -1).all()


@pytest.mark.parametrize("n", [5, PER_SHARD, PER_SHARD + 1, PER_CHAIN, 100])
def test_grown_repaired_and_direct_are_the_same_bytes(tmp_path: Path, n: int) -> None:
    collect_long(tmp_path / "direct")
    collect_long(tmp_path / "d", n)
    collect_long(tmp_path / "d")
    assert tree(tmp_path / "d") == tree(tmp_path / "direct")
    for names in (["frames-00003.npy"], ["shard-00001.json", "shard-00003.json", "frames-00007.npy"], [META_NAME]):
        for name in names:
            (tmp_path / "d" / name).unlink()
        collect_long(tmp_path / "d")
        assert tree(tmp_path / "d") == tree(tmp_path / "direct")


@pytest.mark.parametrize(
    ("missing", "n_shards"),
    [
        ([1, 3], 4),  # one pass through the chain for both, which ends after the last
        ([0, 4], 5),
        ([6, 8, 12], 4 + 3),  # chains of shards 5 to 9 and 10 to 12
    ],
)
def test_missing_shards_of_a_chain_take_one_pass(
    tmp_path: Path, missing: list[int], n_shards: int, capsys: pytest.CaptureFixture[str]
) -> None:
    n = 13 * PER_SHARD
    collect_long(tmp_path / "d", n)
    before = tree(tmp_path / "d")
    for k in missing:
        (tmp_path / "d" / f"shard-{k:05d}.json").unlink()
    LongEnv.n_steps = 0
    collect_long(tmp_path / "d", n, progress=True)
    assert LongEnv.n_steps == n_shards * PER_SHARD
    assert tree(tmp_path / "d") == before
    again = [k - before - 1 for before, k in itertools.pairwise([missing[0] // SHARDS * SHARDS - 1, *missing])]
    assert f"stepping through {again[0] * PER_SHARD} before" in capsys.readouterr().err or not again[0]


def test_what_is_stepped_through_again_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect_long(tmp_path / "d", 4 * PER_SHARD)
    before = tree(tmp_path / "d")
    (tmp_path / "d" / "shard-00003.json").unlink()
    kept = []
    real = Rollout.advance
    monkeypatch.setattr(Rollout, "advance", lambda self, *args: kept.append(args[1]) or real(self, *args))
    collect_long(tmp_path / "d", 4 * PER_SHARD)
    assert kept == [PER_SHARD] and tree(tmp_path / "d") == before


@pytest.mark.parametrize("n_workers", [2, 7])
def test_workers_give_the_same_bytes(tmp_path: Path, n_workers: int) -> None:
    collect_long(tmp_path / "one")
    collect_long(tmp_path / "many", n_workers=n_workers)
    assert tree(tmp_path / "many") == tree(tmp_path / "one")


def test_each_chain_has_environments_of_its_own(tmp_path: Path) -> None:
    LongEnv.n_made = 0
    collect_long(tmp_path / "d")
    assert LongEnv.n_made == 3 * N_ENVS


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize("n_stack", [2, 3])
def test_stacks_are_those_of_vec_frame_stack(
    tmp_path: Path, channels_last: bool, n_stack: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Replay: the recorded actions of the first chain, from the same seeds, through SB3's wrappers."""
    monkeypatch.setattr(chains, "CHAINED_SHARD_TRANSITIONS", N_ENVS)  # shards of one step
    monkeypatch.setattr(index_env, "SHAPE", (3, 10, 11))
    kwargs = {"channels_last": channels_last}
    dataset = collect_long(tmp_path / "d", 60, env_kwargs=kwargs, frame_stack=n_stack)
    assert dataset.observation_space.shape == (3 * n_stack, 10, 11)
    seeds = np.random.SeedSequence(2, spawn_key=(0,)).spawn(2)[0].generate_state(N_ENVS).tolist()
    copies = [gym.make("Long-v0", **kwargs) for _ in range(N_ENVS)]
    venv = DummyVecEnv([lambda env=env: env for env in copies])
    venv._seeds = seeds
    venv = VecFrameStack(venv, n_stack)
    venv = VecTransposeImage(venv) if channels_last else venv
    shown = venv.reset()
    position = iter(range(dataset.n_frames))
    ended = 0
    for _ in range(20):
        actions, starts = [], []
        for _copy in range(N_ENVS):
            starts.append(next(position))
            next(position)  # the segment's last frame
            actions.append(dataset.actions(starts[-1:])[0])
        np.testing.assert_array_equal(stacks := dataset.frames(starts), shown)
        assert stacks.dtype == np.uint8
        shown, _, dones, infos = venv.step(np.stack(actions))
        for i in range(N_ENVS):
            expected = infos[i]["terminal_observation"] if dones[i] else shown[i]
            np.testing.assert_array_equal(dataset.frames([starts[i] + 1])[0], expected)
            assert (dataset.ends[starts[i] + 1] == CUT) != dones[i]
            ended += dones[i]
    assert ended > 3


def test_batches_are_of_stacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_env, "SHAPE", (3, 10, 11))
    dataset = collect_long(tmp_path / "d", frame_stack=3)
    n = 0
    for chunk_length in (1, 4):
        for batch in dataset.batches(4, k=2, chunk_length=chunk_length):
            steps = batch.obs[:, [0, 3, 6], 0, 0].astype(int)
            newest = steps[:, 2:]
            assert (steps == np.maximum(newest - [2, 1, 0], 0)).all()
            assert (batch.next_obs[:, 6, 0, 0] == newest[:, 0] + 2).all()
            # The episode's number, or zero before its first frame.
            number = batch.obs[:, [1, 4, 7], 0, 0].astype(int)
            there = newest - [2, 1, 0] >= 0
            assert (number == there * number[:, 2:]).all()
            n += 1
    assert n > 10


def test_an_episode_is_in_one_split(tmp_path: Path) -> None:
    collect_long(tmp_path / "d")
    for fraction in (0.1, 0.3, 0.5, 0.7, 0.9):
        dataset = TransitionDataset(tmp_path / "d", eval_fraction=fraction)
        train, held_out = (dataset.valid_starts(split=split) for split in ("train", "eval"))
        assert sorted([*train, *held_out]) == dataset.valid_starts().tolist()
        segment = {name: set(np.searchsorted(dataset._last, s)) for name, s in (("train", train), ("eval", held_out))}
        assert not segment["train"] & segment["eval"]
        for s, before in enumerate(dataset._before):
            assert before < 0 or (s in segment["eval"]) == (before in segment["eval"])
        n_episodes = np.count_nonzero(dataset._before < 0)
        assert np.count_nonzero([dataset._before[s] < 0 for s in segment["eval"]]) == round(fraction * n_episodes)
    assert any(dataset._before[s] >= 0 for s in segment["eval"])


def test_forged_numbers_of_copies_are_refused(tmp_path: Path) -> None:
    collect_long(tmp_path / "d")
    meta = json.loads((tmp_path / "d" / META_NAME).read_bytes())
    for forged in ({"n_envs": 5}, {"shards_per_chain": 0}, {"n_envs": "3"}, {"preprocessing": {"frame_stack": -1}}):
        rewrite_meta(tmp_path / "d", meta | forged)
        with pytest.raises(DatasetError):
            TransitionDataset(tmp_path / "d")


def test_a_stack_that_sb3_would_misread_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a stack of 2 observations of shape \(3, 4, 5\) .*ResizeObservation"):
        collect_long(tmp_path / "d", frame_stack=2)
    assert not (tmp_path / "d").exists()


def test_a_dataset_of_whole_limits_is_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that was begun before there were chains."""
    with monkeypatch.context() as patch:
        patch.setattr(collect_module, "_identity_of", lambda folder: {"format_version": 1})
        for name, n in (("d", 50), ("direct", 150)):
            assert collect_long(tmp_path / name, n).meta["format_version"] == 1
    dataset = collect_long(tmp_path / "d")
    assert dataset.meta["format_version"] == 1 and "preprocessing" not in dataset.meta
    assert tree(tmp_path / "d") == tree(tmp_path / "direct")


def test_no_end_of_an_episode_is_a_warning(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"no episode ends among the 5 transitions .* only the first 2 steps"):
        collect("Endless-v0", 5, tmp_path / "d", n_envs=N_ENVS)


def test_the_default_number_of_copies_is_that_of_the_folder(tmp_path: Path) -> None:
    collect_long(tmp_path / "d", 20)
    collect("Long-v0", 40, tmp_path / "d", seed=2)
    assert TransitionDataset(tmp_path / "d").meta["n_envs"] == N_ENVS
    collect("Long-v0", 40, tmp_path / "e", seed=2)
    assert TransitionDataset(tmp_path / "e").meta["n_envs"] == environments.N_COPIES


def test_a_function_makes_the_environment(tmp_path: Path) -> None:
    LongEnv.n_made = 0
    collect(LongEnv, 60, tmp_path / "d", n_envs=2)
    assert LongEnv.n_made == 2
    collect(LongEnv, 60, tmp_path / "workers", n_envs=2, n_workers=2)
    assert tree(tmp_path / "workers") == tree(tmp_path / "d")
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.env_id == f"{__name__}:LongEnv" and dataset.n_transitions == 60
    assert set(itertools.chain(dataset.ends.tolist())) >= {INSIDE, CUT}


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 1.0])
def test_a_policy_sees_the_stacks_of_the_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, epsilon: float
) -> None:
    monkeypatch.setattr(index_env, "SHAPE", (3, 10, 11))

    def act(observations: np.ndarray) -> np.ndarray:
        """The two newest step numbers, of stacks of three."""
        return np.stack([observations[:, 3, 0, 0] / 100, 3 + observations[:, 6, 0, 0] / 100], 1).astype(np.float32)

    policy = Policy(act, "steps", epsilon)
    for name in ("direct", "grown"):
        dataset = collect_long(tmp_path / name, 40 if name == "grown" else 150, frame_stack=3, policy=policy)
    collect_long(tmp_path / "grown", frame_stack=3, policy=policy)
    assert tree(tmp_path / "grown") == tree(tmp_path / "direct")
    dataset = TransitionDataset(tmp_path / "direct")
    assert dataset.meta["policy"] == f"steps, epsilon {epsilon:g}"
    starts = dataset.valid_starts()
    same = np.isclose(dataset.actions(starts), act(dataset.frames(starts))).all(axis=1)
    assert abs(same.mean() - (1 - epsilon)) < 0.15
    assert epsilon or same.all()


def test_a_probability_is_one() -> None:
    with pytest.raises(ValueError, match=r"epsilon must be in 0..1, got 2"):
        Policy(lambda observations: observations, "x", 2)
