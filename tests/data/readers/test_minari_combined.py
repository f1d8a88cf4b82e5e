"""What minari.combine_datasets makes of our exports keeps the id and the factors, or says what is lost."""

import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import index_env
import numpy as np
import pytest

from sb3_abisim.data.collect import collect
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CUT, TERMINATED
from sb3_abisim.data.importing import import_report
from sb3_abisim.data.readers.minari import export_dataset, import_dataset
from sb3_abisim.data.writer import Segment, write_dataset

minari = pytest.importorskip("minari")


pytestmark = pytest.mark.usefixtures("store", "no_environment")


# Its entry point is a text, which Minari can store.
gym.register(
    "SpelledIndexEnv-v0", "index_env:PlainEnv", vector_entry_point="index_env:IndexVectorEnv", max_episode_steps=6
)


def combine(names: list[str], name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        minari.combine_datasets([minari.load_dataset(one) for one in names], name)


def export(folder: Path, seed: int, env_id: str = "IndexEnv-v0", **kwargs: Any) -> TransitionDataset:
    collect(env_id, 40, folder / str(seed), seed=seed, n_envs=4, **kwargs)
    export_dataset(folder / str(seed), f"index/s{seed}-v0")
    return TransitionDataset(folder / str(seed))


def check_both(parts: list[TransitionDataset], both: TransitionDataset) -> None:
    """The combination holds what its parts do, one after the other."""
    everything = [np.arange(part.n_frames) for part in parts]
    frames = np.concatenate([part.frames(index) for part, index in zip(parts, everything, strict=True)])
    assert np.array_equal(both.frames(np.arange(both.n_frames)), frames)
    assert np.array_equal(both.ends, np.concatenate([part.ends for part in parts]))
    assert both.meta["factors"] == parts[0].meta["factors"] and CUT in both.ends
    for name, values in both.factors(np.arange(both.n_frames)).items():
        rows = np.concatenate([part.factors(index)[name] for part, index in zip(parts, everything, strict=True)])
        assert np.array_equal(values, rows) and values.dtype == rows.dtype


def test_the_id_comes_from_what_was_combined(tmp_path: Path) -> None:
    parts = [export(tmp_path, seed, env_kwargs={"offset": 3}) for seed in (0, 1)]
    combine(["index/s0-v0", "index/s1-v0"], "index/both-v0")
    import_dataset("index/both-v0", tmp_path / "both")
    both = TransitionDataset(tmp_path / "both")
    assert (both.env_id, both.env_kwargs, both.meta["policy"]) == ("IndexEnv-v0", {"offset": 3}, "uniform")
    assert both.meta["source"]["combined"] == ["index/s0-v0", "index/s1-v0"]
    check_both(parts, both)


def test_a_combination_of_combinations(tmp_path: Path) -> None:
    parts = [export(tmp_path, seed) for seed in (0, 1, 2)]
    combine(["index/s0-v0", "index/s1-v0"], "index/two-v0")
    combine(["index/two-v0", "index/s2-v0"], "index/three-v0")
    import_dataset("index/three-v0", tmp_path / "three")
    three = TransitionDataset(tmp_path / "three")
    assert three.env_id == "IndexEnv-v0"
    check_both(parts, three)


def test_without_the_parts_the_id_comes_from_minaris_own_record(tmp_path: Path) -> None:
    kwargs = {"env_kwargs": {"offset": 2}}
    parts = [export(tmp_path, seed, "SpelledIndexEnv-v0", **kwargs) for seed in (0, 1)]
    combine(["index/s0-v0", "index/s1-v0"], "index/both-v0")
    for name in ("index/s0-v0", "index/s1-v0"):
        minari.delete_dataset(name)
    import_dataset("index/both-v0", tmp_path / "both")
    both = TransitionDataset(tmp_path / "both")
    assert (both.env_id, both.env_kwargs) == ("SpelledIndexEnv-v0", {"offset": 2})
    check_both(parts, both)


def test_an_id_that_is_lost_is_said_to_be(tmp_path: Path, store: Path) -> None:
    parts = [export(tmp_path, seed) for seed in (0, 1)]
    combine(["index/s0-v0", "index/s1-v0"], "index/both-v0")
    shutil.rmtree(store / "index" / "s1-v0")
    with pytest.warns(UserWarning, match=r"id and arguments of the environment are lost: .*both-v0.*--env ID"):
        import_dataset("index/both-v0", tmp_path / "both")
    both = TransitionDataset(tmp_path / "both")
    assert both.env_id == "index/both-v0"
    check_both(parts, both)
    import_dataset("index/both-v0", tmp_path / "named", env_id="IndexEnv-v0")
    assert TransitionDataset(tmp_path / "named").env_id == "IndexEnv-v0"


def test_arguments_that_differ_are_said_to_be_lost(tmp_path: Path) -> None:
    for seed in (0, 1):
        export(tmp_path, seed, env_kwargs={"offset": seed})
    combine(["index/s0-v0", "index/s1-v0"], "index/both-v0")
    with pytest.warns(UserWarning, match="the arguments of the environment are lost"):
        import_dataset("index/both-v0", tmp_path / "both")
    both = TransitionDataset(tmp_path / "both")
    assert (both.env_id, both.env_kwargs) == ("IndexEnv-v0", {})


def test_factors_that_only_some_episodes_have(tmp_path: Path) -> None:
    space = gym.spaces.Box(0, 255, index_env.SHAPE, np.uint8)
    for i, factors in enumerate(({"step": np.arange(3.0), "goal": np.zeros(3)}, {"step": np.arange(3.0)})):
        segment = Segment(np.zeros((3, *index_env.SHAPE), np.uint8), np.ones(2, np.int64), TERMINATED, factors)
        write_dataset(
            tmp_path / f"d{i}", [segment], env_id="A-v0", observation_space=space,
            action_space=gym.spaces.Discrete(3), source="test",
        )  # fmt: skip
        export_dataset(tmp_path / f"d{i}", f"d{i}-v0")
    combine(["d0-v0", "d1-v0"], "both-v0")
    import_dataset("both-v0", tmp_path / "both")
    both = TransitionDataset(tmp_path / "both")
    assert (both.env_id, list(both.meta["factors"])) == ("A-v0", ["step"])
    assert "factor 'goal', not alike in all episodes" in import_report(tmp_path / "both")


def test_nothing_that_the_record_names_is_run(tmp_path: Path, store: Path) -> None:
    """gym.make fails the test; the entry point would leave a file behind."""
    for seed in (0, 1):
        export(tmp_path, seed, "SpelledIndexEnv-v0")
    combine(["index/s0-v0", "index/s1-v0"], "index/both-v0")
    path = store / "index" / "both-v0" / "data" / "metadata.json"
    spec = {"id": "Evil-v0", "entry_point": "os:mkdir", "kwargs": {"path": str(tmp_path / "evil")}}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"env_spec": json.dumps(spec)}))
    import_dataset("index/both-v0", tmp_path / "both")
    assert TransitionDataset(tmp_path / "both").env_id == "SpelledIndexEnv-v0" and not (tmp_path / "evil").exists()


@pytest.mark.parametrize("parts", [["index/both-v0"], ["../outside/s0-v0"]])
def test_forged_parts_lead_nowhere(parts: list[str], tmp_path: Path, store: Path) -> None:
    """Neither in a circle nor out of the store."""
    export(tmp_path, 0)
    combine(["index/s0-v0"], "index/both-v0")
    shutil.copytree(store / "index" / "s0-v0", store.parent / "outside" / "s0-v0")
    path = store / "index" / "both-v0" / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"combined_datasets": parts}))
    with pytest.warns(UserWarning, match="are lost"):
        import_dataset("index/both-v0", tmp_path / "both")
    assert TransitionDataset(tmp_path / "both").env_id == "index/both-v0"


def test_an_export_says_which_environment_it_is_of(tmp_path: Path) -> None:
    export(tmp_path, 0, "SpelledIndexEnv-v0", env_kwargs={"offset": 1})
    spec = minari.load_dataset("index/s0-v0").spec.env_spec
    assert (spec.id, spec.kwargs) == ("SpelledIndexEnv-v0", {"offset": 1})
    assert gym.registry["SpelledIndexEnv-v0"].kwargs == {}
