"""Datasets without frames: what is rendered from the factors is what was seen, or it is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from dataset_inputs import rewrite_meta, tree
from scan_inputs import empty_room

from sb3_abisim.common import files as atomic
from sb3_abisim.data import chains
from sb3_abisim.data.collect import collect
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.environments import make_vector_env
from sb3_abisim.data.format import META_NAME, DatasetError
from sb3_abisim.data.rollout import collect_shard
from sb3_abisim.envs.scan_nav.env import ScanNavEnv, ScanNavVectorEnv

N = 500
SMALL = {"stop": "auto", "image_size": 32, "goals_per_scene": 3, "max_episode_steps": 40}


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chains, "SHARD_TRANSITIONS", 160)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "room.npz"
    empty_room().save(path)
    return path


@pytest.fixture(scope="module")
def folder(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "scan"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chains, "SHARD_TRANSITIONS", 160)
        collect("ScanNav-v0", N, path, n_envs=4, seed=3, env_kwargs={**SMALL, "scenes": str(scene)})
    return path


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def test_frames_are_those_seen_at_collection(folder: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the same collection with the frames kept."""
    dataset = TransitionDataset(folder)
    assert dataset.meta["format_version"] == 2 and len(dataset.meta["shards"]) == 4
    assert not list(folder.glob("frames-*")) and (np.bincount(dataset.ends, minlength=4) > 0).all()
    monkeypatch.setattr(ScanNavVectorEnv, "renders_factors", False)
    env = make_vector_env("ScanNav-v0", 4, {**SMALL, "scenes": str(scene)})
    seen = []
    for k, shard in enumerate(dataset.meta["shards"]):
        seed = np.random.SeedSequence(3, spawn_key=(k,))
        for segment in collect_shard(env, 40, shard["n_transitions"], seed):
            seen += list(segment.frames)
    everything = np.arange(dataset.n_frames)
    assert np.array_equal(dataset.frames(everything), np.array(seen))
    batch = next(dataset.batches(64))
    # A frame may come twice (left and right again), a transition is known by both and its action.
    known = {(seen[t].tobytes(), int(dataset.actions([t])[0]), seen[t + 1].tobytes()) for t in dataset.valid_starts()}
    for obs, action, next_obs in zip(batch.obs, batch.actions, batch.next_obs, strict=True):
        assert (obs.tobytes(), int(action), next_obs.tobytes()) in known


@pytest.mark.parametrize("kwargs", [{}, {"obs_mode": "rgb", "marker": "box", "image_size": 64, "view_size": 5.0}])
def test_frames_of_the_apartments_are_those_seen(kwargs: dict) -> None:
    env, other = (ScanNavVectorEnv(8, goals_per_scene=2, **kwargs) for _ in range(2))
    frames, _ = env.reset(seed=0)
    for _ in range(30):
        assert np.array_equal(other.render_factors(env.factors()), frames)
        frames, *_ = env.step(env.action_space.sample())


def test_a_hundred_thousand_transitions_take_less_than_10_mb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    collect("ScanNav-v0", 2_000, tmp_path / "data", n_envs=4, env_kwargs={"stop": "auto", "scenes": 0})
    size = sum(path.stat().st_size for path in (tmp_path / "data").glob("*.npy"))
    assert size * 50 < 10_000_000


def test_shards_of_many_copies_fit_into_memory(tmp_path: Path) -> None:
    """64 copies of 500 steps would be 2 GiB of frames."""
    env = make_vector_env("ScanNav-v0", 64, {"scenes": 0, "goals_per_scene": 1})
    env.reset(seed=0)
    assert chains._steps_of_whole_limits(env, "ScanNav-v0", 500) == 500


def test_stopped_anywhere_the_same_command_ends_with_the_same_bytes(
    folder: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run() -> None:
        collect("ScanNav-v0", N, tmp_path / "data", n_envs=4, seed=3, env_kwargs={**SMALL, "scenes": str(scene)})

    replace, stops = atomic.os.replace, 0
    for stop_at in range(0, 100, 3):
        calls = 0

        def counted(*args: object) -> None:
            nonlocal calls
            calls += 1
            if calls > stop_at:  # noqa: B023
                raise KeyboardInterrupt
            replace(*args)

        monkeypatch.setattr(atomic.os, "replace", counted)
        try:
            run()
        except KeyboardInterrupt:
            stops += 1
            with pytest.raises(DatasetError, match=r"unfinished|not a dataset"):
                TransitionDataset(tmp_path / "data")
            monkeypatch.setattr(atomic.os, "replace", replace)
            run()
            assert tree(tmp_path / "data") == tree(folder)
            shutil.rmtree(tmp_path / "data")
        else:
            break
    assert stops >= 8 and tree(tmp_path / "data") == tree(folder)


def test_a_changed_or_missing_scene_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.npz"
    empty_room().save(path)
    collect("ScanNav-v0", 50, tmp_path / "data", n_envs=2, env_kwargs={**SMALL, "scenes": [str(path)]})
    TransitionDataset(tmp_path / "data")
    # Twelve pixels of the floor less.
    empty_room(walls=[np.s_[3:6, 3:7]]).save(path)
    with pytest.raises(DatasetError, match=r"scenes that .*data was collected in have changed.*scene\.npz.*bring"):
        TransitionDataset(tmp_path / "data")
    path.unlink()
    with pytest.raises(DatasetError, match=r"cannot be made: there is no scan map .*scene\.npz.*at collection"):
        TransitionDataset(tmp_path / "data")


def test_damaged_factors_are_refused(copy: Path) -> None:
    path = copy / "factor_agent-00001.npy"
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"factor_agent-00001.npy is damaged"):
        TransitionDataset(copy)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env_id": "CartPole-v1"}, "'CartPole-v1', which would render them, is not registered here or is no BatchEnv"),
        ({"env_id": "Nav2D-v0", "env_kwargs": {}}, "Nav2D-v0 does not render any"),
        ({"env_kwargs": {"num_envs": 3}}, "cannot be made: .*multiple values"),
        ({"env_kwargs": {"entry_point": "os:system"}}, "cannot be made: .*takes no argument 'entry_point'"),
        ({"env_kwargs": {"scenes": "/etc/passwd"}}, "cannot be made: .*suffix"),
        ({"env_kwargs": {**SMALL, "stop": "action"}}, "action_space"),
        ({"env_kwargs": {**SMALL, "image_size": 64}}, "observation_space"),
    ],
    ids=str,
)
def test_forged_descriptions_are_refused(copy: Path, scene: Path, changes: dict, message: str) -> None:
    meta = json.loads((copy / META_NAME).read_bytes())
    if "image_size" in changes.get("env_kwargs", {}):
        changes = {"env_kwargs": {**changes["env_kwargs"], "scenes": str(scene)}}
    rewrite_meta(copy, {**meta, **changes})
    with pytest.raises(DatasetError, match=message):
        TransitionDataset(copy)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("scene", 1, "scene that is not there"),
        ("agent", 90.0, "agent outside the view"),
        ("agent", np.nan, "agent outside the view"),
        ("goal", 90.0, "outside the view|goal outside"),
    ],
)
def test_factors_of_another_setting_are_refused(name: str, value: float, message: str) -> None:
    env = ScanNavEnv(scenes=empty_room())
    env.reset(seed=0)
    factors = env.batch.factors()
    if name == "goal":
        factors["agent"] += value
    factors[name] = np.full_like(factors[name], value) + (factors["goal"] if name == "goal" else 0)
    with pytest.raises(ValueError, match=message):
        env.batch.render_factors(factors)
