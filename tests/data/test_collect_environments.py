"""Collecting in environments of other people."""

from pathlib import Path

import gymnasium as gym
import index_env
import numpy as np
import pytest

from sb3_abisim.data import chains
from sb3_abisim.data.collect import collect, main
from sb3_abisim.data.copies import EnvCopies
from sb3_abisim.data.dataset import TransitionDataset


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chains, "SHARD_TRANSITIONS", 48)


def test_an_environment_made_without_a_limit(tmp_path: Path) -> None:
    """-1 is Gymnasium's word for none."""
    collect("PlainEnv-v0", 50, tmp_path / "d", n_envs=2, env_kwargs={"max_episode_steps": -1})
    dataset = TransitionDataset(tmp_path / "d")
    assert len(dataset.valid_starts()) == 50
    assert dataset.meta["steps_per_shard"] * dataset.meta["shards_per_chain"] >= 8192


def test_environment_of_somebody_else(tmp_path: Path) -> None:
    collect("PlainEnv-v0", 200, tmp_path / "d", n_envs=2)
    dataset = TransitionDataset(tmp_path / "d")
    everything = np.arange(dataset.n_frames)
    seen = dataset.frames(everything)[:, :2, 0, 0].astype(int)
    for t in everything[:-1]:
        step, episode = seen[t]
        expected = (step + 1, episode) if not dataset.ends[t] else (0, seen[t + 1][1])
        assert tuple(seen[t + 1]) == expected
    actions = dataset.actions(dataset.valid_starts())
    assert actions.dtype == np.float32
    # Uniform over Box([-1, 2], [1, 5]): mean and variance within five standard errors.
    assert np.abs(actions.mean(axis=0) - [0, 3.5]).max() < 5 * 3 / np.sqrt(12 * 200)
    assert actions[:, 0].min() < -0.9 and actions[:, 0].max() > 0.9
    assert actions[:, 1].min() < 2.2 and actions[:, 1].max() > 4.8


def test_an_environment_that_draws_into_what_it_returned(tmp_path: Path) -> None:
    """The last frame of an episode would else be the first of the next."""

    class BufferEnv(index_env.PlainEnv):
        def _observe(self) -> np.ndarray:
            self.buffer = getattr(self, "buffer", np.empty(index_env.SHAPE, np.uint8))
            self.buffer[:] = super()._observe()
            return self.buffer

    limit = index_env.LIMIT
    gym.register("BufferEnv-v0", entry_point=BufferEnv, max_episode_steps=limit, disable_env_checker=True)
    frames = []
    for name in ("BufferEnv-v0", "PlainEnv-v0"):
        collect(name, 60, tmp_path / name, n_envs=2)
        dataset = TransitionDataset(tmp_path / name)
        frames.append(dataset.frames(np.arange(dataset.n_frames)))
    assert (dataset.ends > 0).sum() > 8
    np.testing.assert_array_equal(*frames)


def test_a_batch_without_a_time_limit_is_a_warning(tmp_path: Path) -> None:
    gym.register("EndlessBatch-v0", vector_entry_point=index_env.IndexVectorEnv)
    with pytest.warns(UserWarning, match="EndlessBatch-v0 has no time limit, so that each episode is left after 24"):
        collect("EndlessBatch-v0", 60, tmp_path / "d", n_envs=2)


def test_what_an_environment_cannot_open_is_not_blamed_on_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Bare(index_env.PlainEnv):
        def __init__(self) -> None:
            (tmp_path / "asset.bin").read_bytes()

    gym.register("Bare-v0", entry_point=Bare)
    with pytest.raises(SystemExit) as stopped:
        main(["--env", "Bare-v0", "-n", "10", "-o", str(tmp_path / "d")])
    assert stopped.value.code == 2
    assert "cannot make Bare-v0 with {}: " in capsys.readouterr().err and not (tmp_path / "d").exists()


def test_env_kwargs_may_be_given_one_by_one(tmp_path: Path) -> None:
    words = ["--env", "IndexEnv-v0", "-n", "10", "-o", str(tmp_path / "d"), "--n-envs", "2"]
    main([*words, "--env-kwargs", "offset:1", "--env-kwargs", "max_episode_steps:3"])
    assert TransitionDataset(tmp_path / "d").env_kwargs == {"offset": 1, "max_episode_steps": 3}


def test_environments_are_closed_once_and_not_when_never_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gymnasium 1.2 closes a vector environment again, and one whose making failed, when it is collected."""
    closed: list[object] = []
    monkeypatch.setattr(index_env.PlainEnv, "close", lambda self: closed.append(self))
    copies = EnvCopies([index_env.PlainEnv] * 3)
    copies.close()
    copies.close()
    assert closed == copies.envs and len(closed) == 3
    EnvCopies.__new__(EnvCopies).close()
    assert len(closed) == 3


def test_a_wrapper_that_asserts_without_a_word(tmp_path: Path) -> None:
    """As those of Gymnasium 1.2 that render do."""
    with pytest.raises(ValueError, match=r"where a wrapper renders, add --env-kwargs render_mode:rgb_array"):
        collect("PlainEnv-v0", 50, tmp_path / "d", env_wrapper="index_env.SilentWrapper")
