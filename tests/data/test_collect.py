"""Collecting: what is written, stopped and gone on with at any moment, and refused."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from dataset_inputs import tree

from sb3_abisim.common import vocabulary
from sb3_abisim.common.files import folder_lock
from sb3_abisim.data import chains
from sb3_abisim.data import writer as dataset_writer
from sb3_abisim.data.collect import collect, main
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.environments import make_vector_env
from sb3_abisim.data.format import CONFIG_NAME, CUT, META_NAME, TERMINATED, TRUNCATED, DatasetError
from sb3_abisim.data.rollout import collect_shard

N_ENVS = 4
# 12 steps of 4 copies: two time limits.
PER_SHARD = 48
COMMAND = [sys.executable, "-m", "sb3_abisim", "collect", "--packages", "index_env", "--n-envs", str(N_ENVS)]
KILL_EVERYWHERE = str(Path(__file__).parents[1] / "kill_everywhere.py")
CHILD_ENV = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chains, "SHARD_TRANSITIONS", PER_SHARD)


def collect_index(folder: Path, n: int = 110, seed: int = 3, n_envs: int = N_ENVS, **kwargs: object) -> str:
    return collect("IndexEnv-v0", n, folder, seed=seed, n_envs=n_envs, env_kwargs=kwargs)


@pytest.mark.parametrize("n", [1, 3, 47, 48, 49, 110])
def test_exactly_n_transitions_in_shards_of_fixed_size(tmp_path: Path, n: int) -> None:
    collect_index(tmp_path / "d", n)
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.n_transitions == n == len(dataset.valid_starts())
    sizes = [shard["n_transitions"] for shard in dataset.meta["shards"]]
    assert sizes == [PER_SHARD] * (n // PER_SHARD) + [n % PER_SHARD] * (n % PER_SHARD > 0)
    assert set(dataset.ends[dataset.ends > 0]) <= {TERMINATED, TRUNCATED, CUT}


def test_same_arguments_same_bytes_other_seed_other_data(tmp_path: Path) -> None:
    hashes = [collect_index(tmp_path / name, seed=seed) for name, seed in (("a", 3), ("b", 3), ("c", 4))]
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    assert hashes[0] == hashes[1] != hashes[2]
    a, c = TransitionDataset(tmp_path / "a"), TransitionDataset(tmp_path / "c")
    assert not np.array_equal(a.actions(np.arange(50)), c.actions(np.arange(50)))


def test_killed_before_every_system_call_gives_the_same_bytes(tmp_path: Path) -> None:
    self_test = [sys.executable, KILL_EVERYWHERE, str(tmp_path), "0", "60", "1"]
    output = subprocess.run(self_test, env=CHILD_ENV, capture_output=True, text=True, check=True).stdout.split()
    assert output[:-1] == ["kills"], output
    assert int(output[1]) > 50


def test_extension_killed_before_every_other_system_call_gives_the_same_bytes(tmp_path: Path) -> None:
    self_test = [sys.executable, KILL_EVERYWHERE, str(tmp_path), "20", "60", "2"]
    output = subprocess.run(self_test, env=CHILD_ENV, capture_output=True, text=True, check=True).stdout.split()
    assert output[:-1] == ["kills"], output
    assert int(output[1]) > 25


def test_command_killed_at_random_moments_ends_with_the_same_bytes(tmp_path: Path) -> None:
    arguments = ["--env", "IndexEnv-v0", "-n", "60000", "-o"]
    subprocess.run([*COMMAND, *arguments, str(tmp_path / "whole")], env=CHILD_ENV, check=True, capture_output=True)
    rng, killed = np.random.default_rng(0), 0
    for _ in range(3):
        process = subprocess.Popen([*COMMAND, *arguments, str(tmp_path / "cut")], env=CHILD_ENV, stderr=subprocess.PIPE)
        while not (tmp_path / "cut").exists() and process.poll() is None:
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.3))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        killed += process.returncode == -signal.SIGKILL
    assert killed
    subprocess.run([*COMMAND, *arguments, str(tmp_path / "cut")], env=CHILD_ENV, check=True, capture_output=True)
    assert tree(tmp_path / "cut") == tree(tmp_path / "whole")


def test_ctrl_c_exits_130_with_a_message_and_resumes(tmp_path: Path) -> None:
    arguments = ["--env", "IndexEnv-v0", "-n", "1000000", "-o", str(tmp_path / "d")]
    # Where the tests run in the background of a shell, they and their children inherit that Ctrl-C is ignored.
    process = subprocess.Popen(
        [*COMMAND, *arguments],
        env=CHILD_ENV,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while not (tmp_path / "d" / "shard-00000.json").exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    assert stderr.splitlines()[-1].endswith("the same command goes on from there")
    assert "Traceback" not in stderr
    assert not [name for name in os.listdir(tmp_path / "d") if name.startswith(".")]


def test_extended_dataset_equals_one_collected_at_once(tmp_path: Path) -> None:
    for n in (1, 50, 110):
        collect_index(tmp_path / "grown", n)
        assert TransitionDataset(tmp_path / "grown").n_transitions == n
    collect_index(tmp_path / "direct", 110)
    assert tree(tmp_path / "grown") == tree(tmp_path / "direct")
    with pytest.raises(ValueError, match="already holds 110 transitions, more than 109"):
        collect_index(tmp_path / "grown", 109)
    assert tree(tmp_path / "grown") == tree(tmp_path / "direct")


def test_dataset_whose_extension_was_stopped_is_unfinished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not: the old manifest over shards of which one has just been replaced."""
    collect_index(tmp_path / "d", 50)
    with monkeypatch.context() as patch, pytest.raises(OSError, match="stopped"):
        patch.setattr(os, "posix_fallocate", stop)
        collect_index(tmp_path / "d", 110)
    with pytest.raises(DatasetError, match="unfinished"):
        TransitionDataset(tmp_path / "d")


def stop(*args: object) -> None:
    raise OSError("stopped")


def test_finished_dataset_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--env", "IndexEnv-v0", "-n", "110", "-o", str(tmp_path / "d"), "--n-envs", "4"]
    main(arguments)
    assert "complete (hash" in capsys.readouterr().out
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "d").iterdir()}
    main(arguments)
    assert "already complete, nothing to do" in capsys.readouterr().out
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "d").iterdir()} == before


@pytest.mark.parametrize("name", ["frames-00001.npy", "ends-00002.npy", "shard-00001.json", META_NAME])
@pytest.mark.parametrize("harm", ["flip", "remove", "truncate"])
def test_damage_is_repaired_by_the_same_command(tmp_path: Path, name: str, harm: str) -> None:
    collect_index(tmp_path / "d")
    before, path = tree(tmp_path / "d"), tmp_path / "d" / name
    content = bytearray(path.read_bytes())
    if harm == "remove":
        path.unlink()
    else:
        content[len(content) // 2] ^= 4
        path.write_bytes(content if harm == "flip" else content[: len(content) // 2])
    collect_index(tmp_path / "d")
    assert tree(tmp_path / "d") == before


def test_other_arguments_are_refused_with_both_sides(tmp_path: Path) -> None:
    collect_index(tmp_path / "d")
    before = tree(tmp_path / "d")
    with pytest.raises(ValueError, match=r"seed: 3 in the folder, 5 now; n_envs: 4 in the folder, 2 now"):
        collect_index(tmp_path / "d", seed=5, n_envs=2)
    with pytest.raises(ValueError, match=r"env_kwargs: {} in the folder, {'offset': 7} now"):
        collect_index(tmp_path / "d", offset=7)
    (tmp_path / "d" / META_NAME).unlink()
    with pytest.raises(ValueError, match="seed: 3 in the folder, 5 now"):
        collect_index(tmp_path / "d", seed=5)
    collect_index(tmp_path / "d")
    assert tree(tmp_path / "d") == before


def test_a_dataset_with_the_names_of_another_version_is_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collect_index(tmp_path / "d", 50, offset=7)
    monkeypatch.setitem(vocabulary._ENV_KWARGS, "shift", "offset")
    config = json.loads((tmp_path / "d" / CONFIG_NAME).read_bytes())
    (tmp_path / "d" / CONFIG_NAME).write_text(json.dumps(config | {"env_kwargs": {"shift": 7}}))
    collect_index(tmp_path / "d", offset=7)
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.n_transitions == 110 and dataset.meta["env_kwargs"] == {"shift": 7}
    assert dataset.env_kwargs == {"offset": 7}
    with pytest.raises(ValueError, match=r"env_kwargs: {'offset': 7} in the folder, {'offset': 8} now"):
        collect_index(tmp_path / "d", offset=8)


def test_shards_of_other_package_versions_are_not_mixed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect_index(tmp_path / "d")
    monkeypatch.setattr(dataset_writer, "package_versions", lambda: {"numpy": "0.1"})
    collect_index(tmp_path / "d")  # nothing is collected, so nothing is mixed
    before = tree(tmp_path / "d")
    with pytest.raises(DatasetError, match=r"other package versions.*'numpy': '0.1'"):
        collect_index(tmp_path / "d", 200)
    assert tree(tmp_path / "d") == before


def test_something_else_is_refused_untouched(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "frames-00000.npy").write_bytes(b"mine")
    (tmp_path / "file").write_bytes(b"mine")
    before = tree(tmp_path)
    with pytest.raises(ValueError, match=r"photos holds something else \(frames-00000.npy\)"):
        collect_index(tmp_path / "photos")
    with pytest.raises(ValueError, match="file is a file"):
        collect_index(tmp_path / "file")
    assert tree(tmp_path) == before
    (tmp_path / "empty").mkdir()
    collect_index(tmp_path / "empty", 5)


def test_foreign_files_in_a_dataset_survive_but_debris_does_not(tmp_path: Path) -> None:
    collect_index(tmp_path / "d", 50)
    before = tree(tmp_path / "d")
    for name in ("notes.txt", "frames-00007.npy", f".frames-00001.npy.{'0a' * 8}.tmp", ".lock"):
        (tmp_path / "d" / name).write_bytes(b"x")
    collect_index(tmp_path / "d", 50)
    assert set(tree(tmp_path / "d")) == {*before, "notes.txt"}


def test_second_writer_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    collect_index(tmp_path / "d", 50)
    with folder_lock(tmp_path / "d"), pytest.raises(SystemExit) as exit_info:
        main(["--env", "IndexEnv-v0", "-n", "110", "-o", str(tmp_path / "d"), "--n-envs", "4", "--seed", "3"])
    assert exit_info.value.code == 2
    assert f"is being written by process {os.getpid()} on host" in capsys.readouterr().err


def test_full_disk_is_one_message_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real, calls = os.posix_fallocate, []

    def fills_up(descriptor: int, offset: int, size: int) -> None:
        calls.append(size)
        if len(calls) > 10:  # within the second shard
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor, offset, size)

    arguments = ["--env", "IndexEnv-v0", "-n", "110", "-o", str(tmp_path / "d"), "--n-envs", "4", "--seed", "3"]
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as exit_info:
        patch.setattr(os, "posix_fallocate", fills_up)
        main(arguments)
    assert exit_info.value.code == 1
    message = capsys.readouterr().err.splitlines()[-1]
    assert "no space left" in message
    assert "run the same command again" in message
    assert (tmp_path / "d" / "shard-00000.json").exists()
    assert not (tmp_path / "d" / "shard-00001.json").exists()
    main(arguments)
    collect_index(tmp_path / "direct")
    assert tree(tmp_path / "d") == tree(tmp_path / "direct")


def test_a_shard_does_not_depend_on_what_the_environment_did_before() -> None:
    def shard(env: gym.vector.VectorEnv, k: int) -> list[tuple[bytes, bytes, int]]:
        segments = collect_shard(env, 12, PER_SHARD, np.random.SeedSequence(0, spawn_key=(k,)))
        return [(np.stack(s.frames).tobytes(), s.actions.tobytes(), s.end) for s in segments]

    for env_id in ("IndexEnv-v0", "Nav2D-v0", "PlainEnv-v0"):
        used, fresh = make_vector_env(env_id, 4, {}), make_vector_env(env_id, 4, {})
        first = [shard(used, k) for k in (0, 1)]
        assert first[0] != first[1]
        assert shard(fresh, 1) == first[1]


def test_shorter_last_shard_is_the_beginning_of_the_full_one() -> None:
    env = make_vector_env("IndexEnv-v0", N_ENVS, {})
    seed = np.random.SeedSequence(1)
    full = collect_shard(env, 12, PER_SHARD, np.random.SeedSequence(1))
    part = collect_shard(env, 12, 14, seed)
    assert sum(len(s.actions) for s in part) == 14
    # Copies in order; the first two keep 4 transitions, the others 3.
    starts = np.cumsum([0, *(len(s.actions) for s in full)])
    actions = np.concatenate([s.actions for s in full])
    assert starts[-1] == PER_SHARD
    expected = np.concatenate([actions[12 * i : 12 * i + n] for i, n in enumerate([4, 4, 3, 3])])
    assert np.concatenate([s.actions for s in part]).tolist() == expected.tolist()
    assert {s.end for s in part} >= {CUT}
    assert all(len(s.frames) == len(s.actions) + 1 for s in part)


def test_nav2d_data_are_what_single_environments_show(tmp_path: Path) -> None:
    """Replay: the seeds of a shard's copies and the recorded actions, through gymnasium.make."""
    collect("Nav2D-v0", 300, tmp_path / "d", n_envs=3, seed=9)
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.meta["steps_per_shard"] == 50
    frames, actions = dataset.frames(np.arange(dataset.n_frames)), dataset.actions(np.arange(dataset.n_frames))
    t = 0
    for k in range(2):
        seeds = np.random.SeedSequence(9, spawn_key=(k,)).spawn(2)[0].generate_state(3)
        for seed in seeds.tolist():
            env = gym.make("Nav2D-v0")
            observation, _ = env.reset(seed=seed)
            for step in range(50):
                assert np.array_equal(frames[t], observation)
                observation, _, terminated, truncated, _ = env.step(actions[t])
                t += 1
                if terminated or truncated or step == 49:
                    assert np.array_equal(frames[t], observation)
                    assert dataset.ends[t] == (TERMINATED if terminated else TRUNCATED if truncated else CUT)
                    observation, _ = env.reset() if step < 49 else (None, None)
                    t += 1
                else:
                    assert dataset.ends[t] == 0
    assert t == dataset.n_frames


def test_discrete_actions_are_uniform_over_the_whole_range(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chains, "SHARD_TRANSITIONS", 3000)
    collect_index(tmp_path / "d", 3000)
    dataset = TransitionDataset(tmp_path / "d")
    counts = np.bincount(dataset.actions(dataset.valid_starts()), minlength=5)
    assert counts[0] == counts[4] == 0
    # Chi-square with two degrees of freedom; 18.4 has probability 1e-4.
    assert (((counts[1:4] - 1000) ** 2) / 1000).sum() < 18.4


def test_arguments_reach_the_environment_and_the_manifest(tmp_path: Path) -> None:
    arguments = ["--env", "IndexEnv-v0", "-n", "20", "-o", str(tmp_path / "d"), "--n-envs", "2", "--env-kwargs"]
    main([*arguments, "offset:7", "max_episode_steps:3"])
    dataset = TransitionDataset(tmp_path / "d")
    assert dataset.env_kwargs == {"offset": 7, "max_episode_steps": 3}
    frames = dataset.frames(np.arange(dataset.n_frames))
    assert sorted(set(frames[:, 0].ravel())) == [7, 8, 9, 10]
    assert json.loads((tmp_path / "d" / CONFIG_NAME).read_bytes())["policy"] == "uniform"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"--env": "Nav2D-v1"}, "did you mean Nav2D-v0"),
        ({"-n": "0"}, "n_transitions must be at least 1, got 0"),
        ({"--n-envs": "0"}, "n_envs must be at least 1, got 0"),
        ({"--seed": "-1"}, "seed must be at least 0, got -1"),
        ({"--env-kwargs": "offset=3"}, "--env-kwargs takes NAME:VALUE"),
        ({"--env-kwargs": "nonsense:3"}, "IndexVectorEnv takes no argument 'nonsense'"),
        ({"--packages": "no_such_module"}, "cannot import 'no_such_module'"),
        ({"--env": "CartPole-v1"}, "uint8 images"),
        ({"--env-kwargs": "offset:{1,2}"}, "env_kwargs and env_wrapper must be what JSON can hold"),
        (
            {"--env": "DistractorPointMaze-v0", "--env-kwargs": "color_jitter:maybe"},
            "color_jitter must be True or False, got 'maybe'",
        ),
    ],
)
def test_mistakes_exit_2_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, str], message: str
) -> None:
    arguments = {"--env": "IndexEnv-v0", "-n": "10", "-o": str(tmp_path / "d"), "--n-envs": "2"} | changes
    with pytest.raises(SystemExit) as exit_info:
        main([part for pair in arguments.items() for part in pair])
    assert exit_info.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("sb3-abisim collect: error: ")
    assert message in lines[0]
    assert not (tmp_path / "d").exists()


def test_shards_too_large_for_memory_become_chains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # An episode of 6 frames of 60 bytes takes 360 bytes.
    monkeypatch.setattr(chains, "MAX_SHARD_BYTES", 3 * 360 + 300)
    for n_envs, version in ((3, 1), (8, 3)):
        collect_index(tmp_path / str(n_envs), n_envs=n_envs)
        meta = TransitionDataset(tmp_path / str(n_envs)).meta
        assert meta["format_version"] == version
        assert meta["steps_per_shard"] * n_envs * 60 <= 3 * 360 + 300


def test_torch_is_not_imported() -> None:
    code = "import sys, sb3_abisim.data.collect, sb3_abisim.data.dataset; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], env=CHILD_ENV).returncode == 0
