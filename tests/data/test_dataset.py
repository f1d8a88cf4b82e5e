"""Reading: which transitions there are, in which order, and from which frames."""

import functools
import json
import pickle
import shutil
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import index_env
import numpy as np
import pytest
from dataset_inputs import N, collect_index

import sb3_abisim.data.dataset as dataset_module
import sb3_abisim.data.shard_files as shard_files
from sb3_abisim.common.spaces import space_from_json, space_to_json
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CUT, INSIDE, TERMINATED, TRUNCATED, DatasetError, is_shard_file
from sb3_abisim.data.writer import Segment, open_writer, write_dataset


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return collect_index(tmp_path_factory.mktemp("data") / "index")


@pytest.fixture
def dataset(folder: Path) -> TransitionDataset:
    return TransitionDataset(folder)


def labels(frames: np.ndarray) -> np.ndarray:
    """(step, episode, action before) of each frame, which must be the same at every pixel."""
    assert frames.shape[1:] == index_env.SHAPE
    assert (frames == frames[:, :, :1, :1]).all()
    return frames[:, :, 0, 0].astype(np.int64)


def test_counts_and_description(dataset: TransitionDataset) -> None:
    assert dataset.n_transitions == N == len(dataset.valid_starts())
    assert len(dataset.meta["shards"]) == 9
    assert dataset.n_frames == N + np.count_nonzero(dataset.ends)
    assert dataset.env_id == "IndexEnv-v0"
    assert dataset.env_kwargs == {}
    assert dataset.observation_space == index_env.IndexVectorEnv(1).single_observation_space
    assert dataset.action_space == index_env.IndexVectorEnv(1).single_action_space
    assert set(np.unique(dataset.ends)) == {INSIDE, TERMINATED, TRUNCATED, CUT}


def test_frames_of_a_segment_are_one_episode_with_its_actions_and_factors(dataset: TransitionDataset) -> None:
    everything = np.arange(dataset.n_frames)
    seen, actions, factors = (
        labels(dataset.frames(everything)),
        dataset.actions(everything),
        dataset.factors(everything),
    )
    begins_episode = True
    for t in everything:
        step, episode, action_before = seen[t]
        assert factors["step"][t] == step
        assert tuple(factors["pair"][t]) == (step, episode)
        assert factors["even"][t] == (step % 2 == 0)
        if begins_episode:
            assert (step, action_before) == (0, index_env.NO_ACTION)
        end = dataset.ends[t]
        if end == INSIDE:
            assert tuple(seen[t + 1]) == (step + 1, episode, actions[t])
        else:
            assert actions[t] == 0
            assert step <= index_env.LIMIT
            if end == TRUNCATED:
                assert step == index_env.LIMIT
        begins_episode = end != INSIDE
    assert factors["even"].dtype == bool
    assert factors["step"].dtype == np.int32


@pytest.mark.parametrize("k", [1, 2, 5, 6])
def test_valid_starts_are_those_found_by_walking(dataset: TransitionDataset, k: int) -> None:
    ends = dataset.ends
    expected = [t for t in range(dataset.n_frames - k) if not ends[t : t + k].any()]
    assert dataset.valid_starts(k).tolist() == expected
    assert len(expected) > 0


@pytest.mark.parametrize("k", [1, 3])
def test_pairs_never_cross_an_episode(dataset: TransitionDataset, k: int) -> None:
    pairs = 0
    for batch in dataset.batches(7, k=k):
        obs, next_obs = labels(batch.obs), labels(batch.next_obs)
        assert (next_obs[:, 0] == obs[:, 0] + k).all()
        assert (next_obs[:, 1] == obs[:, 1]).all()
        if k == 1:
            assert (next_obs[:, 2] == batch.actions).all()
        assert batch.actions.dtype == np.int64
        assert batch.obs.dtype == np.uint8
        pairs += len(batch.actions)
    assert pairs == len(dataset.valid_starts(k)) // 7 * 7


def test_pairs_of_a_range_of_steps_are_all_of_them_once(dataset: TransitionDataset) -> None:
    ends = dataset.ends
    expected = [(t, k) for k in (2, 3, 4) for t in range(dataset.n_frames - k) if not ends[t : t + k].any()]
    starts, steps = dataset.pairs((2, 4))
    assert list(zip(starts.tolist(), steps.tolist(), strict=True)) == expected
    splits = [dataset.pairs([2, 4], split) for split in ("train", "eval")]
    assert sorted(zip(*np.concatenate(splits, axis=1).tolist(), strict=True)) == sorted(expected)
    visited = []
    for batch in dataset.batches(1, k=(2, 4)):
        (obs,), (next_obs,) = labels(batch.obs), labels(batch.next_obs)
        assert obs[1] == next_obs[1]
        visited.append((int(obs[0]), int(obs[1]), int(next_obs[0] - obs[0])))
    seen = labels(dataset.frames(starts))
    assert sorted(visited) == sorted((*pair, k) for pair, k in zip(seen[:, :2].tolist(), steps.tolist(), strict=True))


def test_a_range_may_reach_beyond_the_longest_episode(dataset: TransitionDataset) -> None:
    ends, longest = dataset.ends, index_env.LIMIT
    expected = {
        (t, k) for k in (longest - 1, longest) for t in range(dataset.n_frames - k) if not ends[t : t + k].any()
    }
    starts, steps = dataset.pairs((longest - 1, longest + 3))
    assert set(zip(starts.tolist(), steps.tolist(), strict=True)) == expected
    with pytest.raises(ValueError, match=rf"k = {longest + 1} .* longest has {longest}"):
        dataset.pairs((longest + 1, longest + 3))
    with pytest.raises(ValueError, match=r"k must be the fewest steps and the most, got \[4, 2\]"):
        dataset.pairs((4, 2))


def test_sequences_hold_every_action_in_between(dataset: TransitionDataset) -> None:
    n_batches = 0
    for batch in dataset.batches(5, k=3, sequences=True):
        assert batch.actions.shape == (5, 3)
        # The last action is the one that led to the later observation.
        assert (labels(batch.next_obs)[:, 2] == batch.actions[:, 2]).all()
        n_batches += 1
    assert n_batches == len(dataset.valid_starts(3)) // 5
    plain = next(dataset.batches(5, k=3))
    assert (next(dataset.batches(5, k=3, sequences=True)).actions[:, 0] == plain.actions).all()
    with pytest.raises(ValueError, match=r"one length, got k = \(1, 2\)"):
        dataset.batches(5, k=(1, 2), sequences=True)


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="reads Linux's account of mapped pages")
@pytest.mark.parametrize(("limit", "stays"), [(10**12, True), (0, False)], ids=["kept", "given back"])
def test_pages_that_were_read_are_given_back(
    dataset: TransitionDataset, monkeypatch: pytest.MonkeyPatch, limit: int, stays: bool
) -> None:
    monkeypatch.setattr(shard_files, "RELEASE_AFTER_BYTES", limit)
    frames = dataset.frames(np.arange(dataset.n_frames))
    lines = Path("/proc/self/smaps").read_text().splitlines()
    maps = [i for i, line in enumerate(lines) if "frames-00000.npy" in line and str(dataset.path) in line]
    resident = [int(line.split()[1]) for i in maps for line in lines[i : i + 6] if line.startswith("Rss:")]
    assert len(resident) > 0 and (sum(resident) > 0) == stays
    assert stays or dataset._files.bytes_read == 0
    np.testing.assert_array_equal(dataset.frames(np.arange(dataset.n_frames)), frames)


def test_pages_are_given_back_within_a_large_read(dataset: TransitionDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    row = dataset.frames(np.array([0])).nbytes
    monkeypatch.setattr(shard_files, "RELEASE_AFTER_BYTES", 100 * row)
    times = []
    files = dataset._files
    monkeypatch.setattr(
        files, "release_pages", lambda: (times.append(files.bytes_read), setattr(files, "bytes_read", 0))
    )
    dataset.frames(np.arange(dataset.n_frames))
    largest = max(shard["n_frames"] for shard in dataset.meta["shards"])
    assert largest < 100, "several parts make up the limit"
    assert len(times) > 1 and all(100 * row < read <= (100 + largest) * row for read in times)
    times.clear()
    monkeypatch.setattr(files, "bytes_read", 0)
    dataset.frames(np.arange(100) % 50)
    assert times == [], "the limit itself is not beyond it"


def test_too_large_k_names_the_longest_segment(dataset: TransitionDataset) -> None:
    with pytest.raises(ValueError, match=rf"k = {index_env.LIMIT + 1} .* longest has {index_env.LIMIT}"):
        dataset.valid_starts(index_env.LIMIT + 1)
    with pytest.raises(ValueError, match="at least 1, got 0"):
        dataset.batches(4, k=0)
    for name, least in (("batch_size", 1), ("chunk_length", 1), ("start", 0)):
        with pytest.raises(ValueError, match=f"^{name} must be at least {least}, got {least - 1}$"):
            dataset.batches(**{"batch_size": 4, name: least - 1})


def as_rows(batches: Iterator[dataset_module.TransitionBatch]) -> np.ndarray:
    rows = [np.concatenate([b.obs, b.next_obs]).tobytes() + b.actions.tobytes() for b in batches]
    return np.array(rows, dtype=object)


def test_order_follows_from_seed_and_epoch_and_start_skips_batches(dataset: TransitionDataset) -> None:
    for chunk_length in (1, 4):
        batches = functools.partial(dataset.batches, 16, chunk_length=chunk_length)
        whole = as_rows(batches(seed=5, epoch=2))
        assert len(whole) == N // 16
        assert (as_rows(batches(seed=5, epoch=2)) == whole).all()
        assert (as_rows(batches(seed=5, epoch=2, start=10)) == whole[10:]).all()
        assert len(as_rows(batches(start=len(whole)))) == 0
        for other in (batches(seed=5, epoch=3), batches(seed=6, epoch=2)):
            assert (as_rows(other) != whole).all()


def test_a_pass_visits_every_transition_once(dataset: TransitionDataset) -> None:
    # The label of s_{t+1} and its first factor do not name a transition; the order of frames does.
    starts = dataset.valid_starts(2)
    visited = [label for b in dataset.batches(1, k=2) for label in map(tuple, labels(b.obs))]
    assert sorted(visited) == sorted(map(tuple, labels(dataset.frames(starts))))


@pytest.mark.parametrize(("k", "most_frames"), [(1, 25), (3, 32), ((2, 4), 25)])
def test_chunks_hold_every_pair_once_and_share_its_frames(dataset: TransitionDataset, k: Any, most_frames: int) -> None:
    starts, _ = dataset.pairs(k)
    whole = list(dataset.batches(len(starts), k=k, chunk_length=4))
    plain = list(dataset.batches(len(starts), k=k))
    assert len(whole) == len(plain) == 1
    assert sorted(as_transitions(whole[0])) == sorted(as_transitions(plain[0]))
    assert len(plain[0].frames) == 2 * len(starts)
    n_frames = [len(batch.frames) for batch in dataset.batches(16, k=k, chunk_length=4)]
    assert np.mean(n_frames) < most_frames and max(len(batch.frames) for batch in dataset.batches(16, k=k)) == 32


def as_transitions(batch: dataset_module.TransitionBatch) -> list[tuple[int, ...]]:
    both = np.concatenate([labels(batch.obs), labels(batch.next_obs)], axis=1)
    return [tuple(row) for row in both.tolist()]


def test_chunks_follow_an_episode(dataset: TransitionDataset) -> None:
    """Of the frames of a chunk of three, the index that is painted into each counts up by one."""
    lengths, seen = [], set()
    for epoch in range(4):
        (batch,) = dataset.batches(N, epoch=epoch, chunk_length=3)
        obs, next_obs = labels(batch.obs), labels(batch.next_obs)
        assert (next_obs[:, 1] == obs[:, 1]).all() and (next_obs[:, 0] == obs[:, 0] + 1).all()
        joined = (obs[1:, :2] == next_obs[:-1, :2]).all(axis=1)
        first = np.flatnonzero(np.r_[True, ~joined])
        lengths.append(np.diff(np.r_[first, N]))
        seen |= {tuple(row) for row in obs[first, :2].tolist()}
    # Two chunks of an episode that meet by chance count as one here.
    assert np.mean([(length <= 3).mean() for length in lengths]) > 0.9
    assert np.mean(np.concatenate(lengths)) > 2
    # Where chunks begin differs from pass to pass.
    assert len(seen) > 1.3 * len(lengths[0])


@pytest.mark.parametrize("chunk_length", [3, 50])
def test_chunks_end_with_their_episode(
    dataset: TransitionDataset, monkeypatch: pytest.MonkeyPatch, chunk_length: int
) -> None:
    """The first transition of an episode follows the last of the episode before it by chance only."""
    monkeypatch.setattr(dataset, "_frames", lambda index: index)  # frames are then their indices
    starts = dataset.valid_starts()
    (batch,) = dataset.batches(len(starts), chunk_length=chunk_length)
    last = dataset.ends[batch.obs[:-1] + 1] != INSIDE
    n_crossed = np.count_nonzero(last & (batch.obs[1:] == batch.obs[:-1] + 2))
    n_joined = np.count_nonzero(batch.obs[1:] == batch.obs[:-1] + 1)
    n_segments = np.count_nonzero(dataset.ends)
    assert n_joined > n_segments, "most transitions are joined to others of their episode"
    assert n_crossed < 0.1 * n_segments


def test_batch_larger_than_the_data_is_refused(dataset: TransitionDataset) -> None:
    with pytest.raises(ValueError, match=f"batch_size 421 exceeds the {N} transitions"):
        dataset.batches(N + 1)


def test_gather_keeps_the_asked_order_across_shards(dataset: TransitionDataset) -> None:
    everything = dataset.frames(np.arange(dataset.n_frames))
    index = np.random.default_rng(0).integers(dataset.n_frames, size=300)
    assert (dataset.frames(index) == everything[index]).all()
    assert dataset.frames(np.array([], dtype=np.int64)).shape == (0, *index_env.SHAPE)


@pytest.mark.parametrize("index", [[-1], [10**6], [0.5], 3])
def test_bad_indices_are_refused(dataset: TransitionDataset, index: object) -> None:
    with pytest.raises(IndexError):
        dataset.frames(index)
    with pytest.raises(IndexError):
        dataset.actions(index)


def test_more_shards_than_a_process_may_have_open(dataset: TransitionDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    everything = np.random.default_rng(0).permutation(np.arange(dataset.n_frames).repeat(2))
    before, factors = dataset.frames(everything), dataset.factors(everything)
    monkeypatch.setattr(shard_files, "MAX_OPEN_FILES", 3)
    few = TransitionDataset(dataset.path)
    opened: list[str] = []
    load = np.load
    monkeypatch.setattr(np, "load", lambda path, **kwargs: opened.append(Path(path).name) or load(path, **kwargs))
    for _ in range(2):
        assert np.array_equal(few.frames(everything), before)
        assert all(np.array_equal(array, factors[name]) for name, array in few.factors(everything).items())
        assert len(dataset.meta["shards"]) > len(few._files.maps) == 3
    # The header of each file was compared, and was so once.
    assert len(opened) == len(set(opened)) == len(dataset.meta["shards"]) * (1 + len(factors))


def test_a_file_cut_short_while_it_is_used_is_an_error(
    dataset: TransitionDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied = shutil.copytree(dataset.path, tmp_path / "copy")
    monkeypatch.setattr(shard_files, "MAX_OPEN_FILES", 0)
    reader = TransitionDataset(copied)
    everything = np.arange(reader.n_frames)
    reader.frames(everything)
    with open(copied / "frames-00001.npy", "r+b") as file:
        file.truncate(400)
    with pytest.raises(DatasetError, match=r"frames-00001.npy ends early; run the command that collected it again"):
        reader.frames(everything)


def test_splits_share_no_segment(folder: Path) -> None:
    dataset = TransitionDataset(folder, eval_fraction=0.2)
    segment = np.cumsum(np.concatenate([[0], dataset.ends[:-1] != INSIDE]))
    train, unseen = dataset.valid_starts(split="train"), dataset.valid_starts(split="eval")
    assert not set(segment[train]) & set(segment[unseen])
    assert sorted([*train, *unseen]) == dataset.valid_starts().tolist()
    assert len(set(segment[unseen])) == round(0.2 * (segment[-1] + 1))
    assert dataset.valid_starts(split="eval").tolist() == unseen.tolist()
    with pytest.raises(ValueError, match="split must be 'train', 'eval' or None, got 'test'"):
        dataset.valid_starts(split="test")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="eval_fraction 0"):
        TransitionDataset(folder, eval_fraction=0).valid_starts(split="eval")


def test_pickle_holds_no_data(dataset: TransitionDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = pickle.dumps(dataset)
    # Nor does unpickling hash the files again.
    monkeypatch.setattr(dataset_module, "file_hash", None)
    assert len(sent) < 1000
    again = pickle.loads(sent)
    assert (again.frames(np.arange(50)) == dataset.frames(np.arange(50))).all()


def test_reading_does_not_load_the_frames(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    length, n_segments, shape = 100, 40, (3, 64, 64)
    identity = {
        "format_version": 1,
        "env_id": "Large-v0",
        "env_kwargs": {},
        "observation_space": {"type": "Box", "low": 0, "high": 255, "shape": shape, "dtype": "uint8"},
        "action_space": {"type": "Discrete", "n": 4, "start": 0},
        "factors": {},
        **dict.fromkeys(["fingerprint", "policy", "seed", "n_envs", "steps_per_shard", "source"]),
    }
    frames = rng.integers(256, size=(length + 1, *shape), dtype=np.uint8)
    with open_writer(tmp_path / "large", identity) as writer:
        for k in range(4):
            writer.write_shard(k, [Segment(frames, np.ones(length, np.int64), CUT)] * (n_segments // 4))
        writer.finish(4)
    tracemalloc.start()
    try:
        dataset = TransitionDataset(tmp_path / "large")
        for batch, _ in zip(dataset.batches(32), range(5), strict=False):
            index = batch.obs
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert index.shape == (32, *shape)
    size = n_segments * (length + 1) * frames[0].size
    assert peak < size / 10


def test_spaces_survive_json() -> None:
    for space in (
        gym.spaces.Discrete(4, start=-2),
        gym.spaces.Box(0, 255, (3, 15, 15), np.uint8),
        gym.spaces.Box(np.float32([-0.1, -2]), np.float32([1e-7, 3])),
    ):
        document = json.loads(json.dumps(space_to_json(space)))
        again = space_from_json(document)
        assert again == space
        assert again.dtype == space.dtype
        assert space_to_json(again) == document
    with pytest.raises(ValueError, match="can be stored, got Text"):
        space_to_json(gym.spaces.Text(3))


def test_only_files_of_the_format_are_ever_cleaned_up() -> None:
    ours = ["frames-00000.npy", "factor_agent-00012.npy", "shard-00003.json", "ends-123456.npy"]
    others = ["frames.npy", "notes-00000.npy", "meta.json", "factor_-00001.npy", "shard-00003.json.bak"]
    assert [is_shard_file(name) for name in ours + others] == [True] * len(ours) + [False] * len(others)


# What a mutation found to be free.


def test_batches_are_of_their_split(folder: Path) -> None:
    dataset = TransitionDataset(folder, eval_fraction=0.2)
    for split in ("train", "eval"):
        starts = dataset.valid_starts(split=split)  # type: ignore[arg-type]
        seen = [row for batch in dataset.batches(1, split=split) for row in map(tuple, labels(batch.obs))]  # type: ignore[arg-type]
        assert sorted(seen) == sorted(map(tuple, labels(dataset.frames(starts))))
        others = set(map(tuple, labels(dataset.frames(dataset.valid_starts())))) - set(seen)
        assert others, "the other split has transitions of its own"


def test_the_first_pass_of_seed_0_is_the_default(dataset: TransitionDataset) -> None:
    plain = as_rows(dataset.batches(16))
    assert (as_rows(dataset.batches(16, seed=0, epoch=0)) == plain).all()
    assert len(dataset.pairs()[0]) == len(dataset.pairs(1)[0])


def test_single_transitions_are_permuted_as_ever(dataset: TransitionDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Encoders follow from this order: another one would make other weights of the same seed."""
    monkeypatch.setattr(dataset, "_frames", lambda index: index)
    starts = dataset.valid_starts()
    order = np.random.Generator(np.random.PCG64(np.random.SeedSequence([7, 3]))).permutation(len(starts))
    found = np.concatenate([batch.obs for batch in dataset.batches(1, seed=7, epoch=3)])
    assert np.array_equal(found, starts[order])


@pytest.mark.parametrize("chunk_length", [2, 5])
def test_all_chunks_but_those_at_the_ends_have_their_length(
    dataset: TransitionDataset, monkeypatch: pytest.MonkeyPatch, chunk_length: int
) -> None:
    monkeypatch.setattr(dataset, "_frames", lambda index: index)
    starts = dataset.valid_starts()
    last = np.flatnonzero(dataset.ends)
    segment_of = np.searchsorted(last, np.arange(dataset.n_frames))
    first_of = np.concatenate([[0], last[:-1] + 1])
    places = []
    for epoch in range(6):
        (batch,) = dataset.batches(len(starts), epoch=epoch, chunk_length=chunk_length)
        begins = batch.obs[np.r_[True, batch.obs[1:] != batch.obs[:-1] + 1]]
        # Within a segment, chunks begin at places that are equal modulo their length, but for the segment's own start.
        inner = begins[begins != first_of[segment_of[begins]]]
        for segment in np.unique(segment_of[inner]):
            offsets = (inner[segment_of[inner] == segment] - first_of[segment]) % chunk_length
            assert len(set(offsets.tolist())) == 1
            places.append((segment, int(offsets[0])))
    # Each pass cuts anew, and a segment's cut does not follow from its place in the dataset.
    assert len(set(places)) > len({segment for segment, _ in places})


@pytest.mark.parametrize("chunk_length", [2, 5])
def test_chunks_are_cut_and_permuted_as_ever(
    dataset: TransitionDataset, monkeypatch: pytest.MonkeyPatch, chunk_length: int
) -> None:
    """Encoders follow from this order, too."""
    monkeypatch.setattr(dataset, "_frames", lambda index: index)
    ends, starts = dataset.ends, dataset.valid_starts()
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([7, 3])))
    before = generator.integers(chunk_length, size=np.count_nonzero(ends))
    chunk_of, chunk, segment, step = [], 0, 0, 0
    for end in ends:
        chunk += step == 0 or (step + before[segment]) % chunk_length == 0
        chunk_of.append(chunk)
        step = step + 1 if end == INSIDE else 0
        segment += end != INSIDE
    rank = generator.permutation(max(chunk_of[t] for t in starts) + 1)
    expected = sorted(starts.tolist(), key=lambda t: (rank[chunk_of[t]], t))
    (batch,) = dataset.batches(len(starts), seed=7, epoch=3, chunk_length=chunk_length)
    assert batch.obs.tolist() == expected
    assert len(batch.frames) < 2 * len(starts), "frames are shared"


def write_episodes(folder: Path, lengths: list[int]) -> Path:
    """Episodes whose frames hold their number."""
    segments = [
        Segment(np.full((length + 1, 3, 4, 4), number, np.uint8), np.zeros(length, np.int64), TERMINATED)
        for number, length in enumerate(lengths)
    ]
    space = gym.spaces.Box(0, 255, (3, 4, 4), np.uint8)
    write_dataset(
        folder,
        segments,
        env_id="My-v0",
        observation_space=space,
        action_space=gym.spaces.Discrete(2),
        source="a test",
    )
    return folder


@pytest.mark.parametrize(
    ("n_episodes", "fraction", "n_eval"),
    [(1, 0.5, 0), (2, 0.9, 1), (2, 0.1, 1), (10, 0.0, 0), (10, 0.25, 2), (10, 0.26, 3), (10, 0.01, 1)],
)
def test_which_episodes_are_evaluated_on(tmp_path: Path, n_episodes: int, fraction: float, n_eval: int) -> None:
    """A share of them, but one at least, and not all; which ones does not depend on the run."""
    folder = write_episodes(tmp_path / "d", [2 + k % 3 for k in range(n_episodes)])
    dataset = TransitionDataset(folder, eval_fraction=fraction)
    chosen = np.random.Generator(np.random.PCG64(20240229)).permutation(n_episodes)[:n_eval].tolist()
    for split, expected in (("eval", chosen), ("train", set(range(n_episodes)) - set(chosen))):
        if expected:
            frames = dataset.frames(dataset.valid_starts(split=split))  # type: ignore[arg-type]
            assert set(frames[:, 0, 0, 0].tolist()) == set(expected)
        else:
            with pytest.raises(ValueError, match=f"no transition of 1 steps in split '{split}'"):
                dataset.valid_starts(split=split)  # type: ignore[arg-type]


def test_the_only_transition(tmp_path: Path) -> None:
    dataset = TransitionDataset(write_episodes(tmp_path / "d", [1]), eval_fraction=0)
    (batch,) = dataset.batches(1, sequences=True)
    assert batch.actions.shape == (1, 1)


def test_what_is_in_memory_per_frame(dataset: TransitionDataset) -> None:
    """Five bytes and an action, and something per segment; one more for a split, and four in a pass."""
    arrays = [value for value in vars(dataset).values() if isinstance(value, np.ndarray)]
    per_frame = [array for array in arrays if len(array) == dataset.n_frames]
    assert sum(array.nbytes for array in per_frame) == dataset.n_frames * (5 + dataset.actions([0]).nbytes)
    in_pass = dataset.batches(16, split="train").gi_frame.f_locals  # type: ignore[attr-defined]
    assert in_pass["starts"].nbytes == 4 * len(dataset.valid_starts(split="train"))
    assert in_pass["steps"].base.nbytes == 8
    assert dataset._in_eval is dataset._in_eval and dataset._in_eval.nbytes == dataset.n_frames


def test_what_is_out_of_range_is_named(dataset: TransitionDataset) -> None:
    with pytest.raises(IndexError, match=rf"frame index {dataset.n_frames} is out of range, the dataset has"):
        dataset.frames([dataset.n_frames])
    with pytest.raises(IndexError, match=r"one-dimensional integers, got float64 of shape \(1,\)"):
        dataset.frames([0.5])
    for wrong in (1.0, 1.5, -0.1):
        with pytest.raises(ValueError, match=r"eval_fraction must be in \[0, 1\)"):
            TransitionDataset(dataset.path, eval_fraction=wrong)


def test_a_split_without_a_pair_names_the_split(folder: Path) -> None:
    dataset = TransitionDataset(folder, eval_fraction=0)
    with pytest.raises(ValueError, match="no transition of 1 steps in split 'eval'"):
        dataset.pairs(1, "eval")
