"""Speed of collecting Atari, and the cost of stacks that are made while reading, measured in turns: ``make bench``.

ALE/Pong-v5 steps as single environments in Stable-Baselines3's ``AtariWrapper``, as rl-zoo3's entry has them, in one
process and in several, and as ale-py's own vector environment, whose observations differ in their bytes. All of them
show four frames of the emulator per transition (``frameskip``). A turn is measured by the clock, since work is done in
other processes and threads. The speed of each is that of its fastest turn, the one least disturbed by other load. What
bounds all of them is the emulator, whose share of the processor time is measured.

Stacks of four that a dataset makes while reading are compared with stacks that lie in the dataset, in pretraining by
SSI. Here speed is by processor time, on one core. Needs ``pip install 'sb3_abisim[atari]'``.
"""

import argparse
import os
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "collect.md"
# Frames of the emulator in a transition.
SKIP = 4
ATARI, ATARI_WRAPPER = "ALE/Pong-v5", "stable_baselines3.common.atari_wrappers.AtariWrapper"
N_ENVS, N_WORKERS = 8, (2, 4)
OWN = "ale-py's vector environment"
N_TRANSITIONS, STACK = 8_000, 4
# The most that stacks may cost in pretraining.
MOST = 0.10


class PatchEnv(gym.Env[np.ndarray, int]):
    """A patch on noise in gray, of Atari's size: as costly to read as Atari, and fast to collect."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(0, 255, (1, 84, 84), np.uint8)
        self.action_space = gym.spaces.Discrete(4)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._noise = self.np_random.integers(100, size=(1, 84, 84), dtype=np.uint8)
        self._place, self._elapsed = np.array([40, 40]), 0
        return self._observe(), {}

    def _observe(self) -> np.ndarray:
        observation = self._noise.copy()
        y, x = self._place
        observation[0, y : y + 8, x : x + 8] = 255
        return observation

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._place = np.clip(self._place + [(0, 4), (4, 0), (0, -4), (-4, 0)][action], 0, 76)
        self._elapsed += 1
        return self._observe(), 0.0, False, self._elapsed == 200, {}


def stacked_patches() -> gym.Env[np.ndarray, int]:
    """The same, whose observations are stacks."""
    stacks = gym.wrappers.FrameStackObservation(PatchEnv(), STACK, padding_type="zero")
    return gym.wrappers.ReshapeObservation(stacks, (STACK, 84, 84))


def contenders() -> dict[str, gym.vector.VectorEnv]:
    """What steps Pong, by name."""
    from sb3_abisim.data.environments import Preprocessing, make_vector_env, resolve_wrapper

    preprocessing = Preprocessing(env_wrapper=[ATARI_WRAPPER], wrapper=resolve_wrapper([ATARI_WRAPPER]))
    single = {"frameskip": 1}  # the wrapper skips
    envs = {
        f"single environments, {n} process{'es' * (n > 1)}": make_vector_env(ATARI, N_ENVS, single, preprocessing, n)
        for n in (1, *N_WORKERS)
    }

    def own() -> gym.vector.VectorEnv:
        return gym.make_vec(ATARI, N_ENVS, "vector_entry_point", stack_num=1)

    return envs | {OWN: make_vector_env(own, None, {})}


def measure_steps(rounds: int, seconds: float) -> list[str]:
    """Rows of the table of steps."""
    from sb3_abisim.data.rollout import Rollout

    envs = contenders()
    rollouts = {name: Rollout(env, np.random.SeedSequence(0)) for name, env in envs.items()}
    speeds = dict.fromkeys(envs, 0.0)
    for _ in range(rounds):
        for name, rollout in rollouts.items():
            n_steps, start = 0, time.perf_counter()
            while (elapsed := time.perf_counter() - start) < seconds:
                rollout.advance(10, 10 * N_ENVS, lambda n: None)
                n_steps += 10
            speeds[name] = max(speeds[name], n_steps * N_ENVS / elapsed)
    for env in envs.values():
        env.close()
    first, *_ = speeds.values()
    return [f"| {name} | {speed:,.0f} | {speed / first:.2f} |" for name, speed in speeds.items()]


def measure_emulator(rounds: int, n_steps: int = 200) -> tuple[float, float]:
    """Processor seconds of a transition in one process: of all that a wrapped environment does, and of the emulator."""
    from stable_baselines3.common.atari_wrappers import AtariWrapper

    env = AtariWrapper(gym.make(ATARI, frameskip=1))
    env.reset(seed=0)
    ale = gym.make(ATARI).unwrapped.ale  # type: ignore[attr-defined]
    ale.reset_game()
    generator, actions = np.random.default_rng(0), ale.getMinimalActionSet()

    def wrapped() -> None:
        _, _, terminated, truncated, _ = env.step(generator.integers(len(actions)))
        if terminated or truncated:
            env.reset()

    def emulated() -> None:
        action = actions[generator.integers(len(actions))]
        for _ in range(SKIP):
            ale.act(action)
        if ale.game_over():
            ale.reset_game()

    fastest = {wrapped: np.inf, emulated: np.inf}
    for _ in range(rounds):
        for step in fastest:
            start = time.process_time()
            for _ in range(n_steps):
                step()
            fastest[step] = min(fastest[step], (time.process_time() - start) / n_steps)
    env.close()
    return fastest[wrapped], fastest[emulated]


def measure_stacks(rounds: int, n_updates: int) -> dict[int, tuple[float, float]]:
    """Transitions per second of processor time, by ``chunk_length``: stacks that are made, stacks that are stored."""
    from benchmarks.bench_pretraining import BATCH_SIZE, make_run, ours
    from sb3_abisim.common.malloc import keep_freed_memory
    from sb3_abisim.data.collect import collect
    from sb3_abisim.data.dataset import TransitionDataset

    keep_freed_memory()
    speeds = {}
    with tempfile.TemporaryDirectory() as folder:
        made, stored = Path(folder) / "made", Path(folder) / "stored"
        collect(PatchEnv, N_TRANSITIONS, made, frame_stack=STACK)
        collect(stacked_patches, N_TRANSITIONS, stored)
        shown, expected = (TransitionDataset(data).frames(np.arange(0, 8_000, 7)) for data in (made, stored))
        assert np.array_equal(shown, expected)
        for chunk_length in (1, 8):
            loops = [ours(make_run("ssi", data, None, Path(folder), chunk_length)) for data in (made, stored)]
            fastest = [0.0, 0.0]
            for loop in loops:
                next(loop)
            for _ in range(rounds):
                for i, loop in enumerate(loops):
                    start = time.process_time()
                    for _ in range(n_updates):
                        next(loop)
                    fastest[i] = max(fastest[i], n_updates * BATCH_SIZE / (time.process_time() - start))
            speeds[chunk_length] = (fastest[0], fastest[1])
    return speeds


def _require_atari() -> None:
    try:
        import ale_py
        import cv2  # noqa: F401  (AtariWrapper needs it)
    except ImportError as error:
        sys.exit(f"Atari cannot be collected ({error}); pip install 'sb3_abisim[atari]'")
    gym.register_envs(ale_py)


def main(argv: list[str] | None = None) -> None:
    """Measure and write the tables; exits 1 where stacks cost too much."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_collect", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=12, help="turns of each contender (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="length of a turn (default: %(default)s)")
    parser.add_argument("--updates", type=int, default=4, help="updates per turn (default: %(default)s)")
    args = parser.parse_args(argv)
    # Read when torch and OpenCV are imported, here and in workers.
    os.environ["OMP_NUM_THREADS"] = "1"
    warnings.simplefilter("ignore")
    _require_atari()
    n_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    rows = measure_steps(args.rounds, args.seconds)
    use_one_core()
    whole, emulator = measure_emulator(args.rounds)
    stacks = measure_stacks(args.rounds, args.updates)
    tail = [
        f"What bounds it: of the {whole * 1e6:.0f} µs of processor time that a transition takes in one environment, "
        f"the {SKIP} frames of the emulator take {emulator * 1e6:.0f} µs. So {n_cores} cores that do nothing else give "
        f"at most {n_cores * whole / emulator:.1f} times the speed of one process, whatever steps the emulator.",
        "",
        f"Stacks of {STACK} gray observations of 84 x 84 in pretraining (`ssi`, `nature`, one core), transitions per "
        f"second of processor time in the fastest of {args.rounds} turns of {args.updates} updates; at most {MOST:.0%} "
        "less is the aim.",
        "",
        "| `chunk_length` | stacks made while reading | stored stacks | difference |",
        "|---:|---:|---:|---:|",
        *(f"| {k} | {made:,.0f} | {stored:,.0f} | {made / stored - 1:+.1%} |" for k, (made, stored) in stacks.items()),
        "",
    ]
    text = (
        f"`python -m benchmarks.bench_collect` on {n_cores} cores, {machine().removeprefix('one core of ')}: {ATARI}, "
        f"{N_ENVS} copies, transitions per second in the fastest of {args.rounds} turns of {args.seconds:g} s."
    )
    header = ["| stepped as | transitions/s | ratio |", "|---|---:|---:|"]
    write_page(args.output, "Speed of collecting", text, header, rows, tuple(tail))
    slow = [str(k) for k, (made, stored) in stacks.items() if made < (1 - MOST) * stored]
    if slow:
        sys.exit(f"stacks cost more than {MOST:.0%} with chunk_length {', '.join(slow)}")


if __name__ == "__main__":
    main()
