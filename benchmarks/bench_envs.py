"""Speed of the environments beside the alternatives, measured in turns within one run: ``make bench``.

The alternatives are gymnasium-robotics' PointMaze rendered by MuJoCo at 64 x 64 (its step is 0.01 s, ours is 30 of
these), and Nav2D written the plain way: one environment, one cell at a time. Every contender takes random
actions and starts its episodes anew where they end, all on one core. The speed of each is that of its fastest turn,
the one least disturbed by other load on the machine. MuJoCo's renderer needs ``apt-get install libegl1 libgl1``.
"""

import argparse
import heapq
import os
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "envs.md"
PLAIN_MAZE = "gymnasium-robotics PointMaze_UMaze-v3, rendered by MuJoCo"
PLAIN_NAV2D = "Nav2D, plain NumPy per cell"
# (environment, copies, what it is compared with, least ratio)
TARGETS = (
    ("PointMaze-v0", 1, PLAIN_MAZE, 30),
    ("PointMaze-v0", 64, PLAIN_MAZE, 60),
    ("DistractorPointMaze-v0", 1, PLAIN_MAZE, 25),
    ("DistractorPointMaze-v0", 64, PLAIN_MAZE, 50),
    ("Nav2D-v0", 1, PLAIN_NAV2D, 3),
    ("Nav2D-v0", 256, PLAIN_NAV2D, 15),
)


class PlainNav2D(gym.Env[np.ndarray, int]):
    """Nav2D as one would first write it, like the released one: a grid of floats, and A* over cells for each layout."""

    size = 15
    moves = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)])

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(0, 255, (3, self.size, self.size), np.uint8)
        self.action_space = gym.spaces.Discrete(4)
        self.goal = np.array([7, 7])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.elapsed = 0
        while True:
            self.grid = np.zeros((3, self.size, self.size), dtype=np.float32)
            for _ in range(20):
                x, y = self.np_random.integers(0, self.size - 1, 2)
                self.grid[1, y : y + 2, x : x + 2] = 1.0
            self.grid[1, 7, 7] = 0.0
            free = np.argwhere(self.grid[1] == 0)
            self.agent = free[self.np_random.integers(len(free))][::-1].copy()
            self.grid[0, self.agent[1], self.agent[0]] = 1.0
            self.grid[2, 7, 7] = 1.0
            if not np.array_equal(self.agent, self.goal) and self._path_exists():
                return self._observe(), {}

    def _is_free(self, cell: np.ndarray) -> bool:
        return bool(np.all(cell >= 0) and np.all(cell < self.size) and not self.grid[1, cell[1], cell[0]])

    def _distance(self, cell: np.ndarray) -> float:
        return float(np.linalg.norm(cell - self.goal, ord=1))

    def _path_exists(self) -> bool:
        queue, visited = [(self._distance(self.agent), 0, tuple(self.agent))], set()
        while queue:
            _, cost, cell = heapq.heappop(queue)
            if cell in visited:
                continue
            if np.all(np.array(cell) == self.goal):
                return True
            visited.add(cell)
            for move in self.moves:
                neighbor = np.array(cell) + move
                if self._is_free(neighbor):
                    heapq.heappush(queue, (self._distance(neighbor) + cost + 1, cost + 1, tuple(neighbor)))
        return False

    def _observe(self) -> np.ndarray:
        return (self.grid * 255).astype(np.uint8)

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.elapsed += 1
        target = self.agent + self.moves[action]
        if self._is_free(target):
            self.grid[0, self.agent[1], self.agent[0]] = 0.0
            self.grid[0, target[1], target[0]] = 1.0
            self.agent = target
        reached = bool(np.all(self.agent == self.goal))
        info = {
            "agent": self.agent.copy(),
            "distance": self._distance(self.agent),
            "grid": self.grid.copy(),
            "is_success": reached,
        }
        return self._observe(), 0.0 if reached else -1.0, reached, self.elapsed >= 50, info


def single(env: gym.Env[Any, Any], render: bool = False) -> Callable[[float], float]:
    """A function that steps ``env`` for some seconds and returns the steps per second."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(1000)]

    def run(seconds: float) -> float:
        steps, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < seconds:
            for _ in range(5):
                _, _, terminated, truncated, _ = env.step(actions[steps % len(actions)])
                if render:
                    env.render()
                if terminated or truncated:
                    env.reset()
                steps += 1
        return steps / elapsed

    return run


def vectorized(env: gym.vector.VectorEnv) -> Callable[[float], float]:
    """The same for a batch, counting the steps of all copies."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(100)]

    def run(seconds: float) -> float:
        calls, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < seconds:
            env.step(actions[calls % len(actions)])
            calls += 1
        return calls * env.num_envs / elapsed

    return run


def contenders() -> dict[tuple[str, int], Callable[[float], float]]:
    """Every environment of the table, made the way a user makes it."""
    import gymnasium_robotics

    import sb3_abisim  # noqa: F401

    gym.register_envs(gymnasium_robotics)
    rendered = gym.make("PointMaze_UMaze-v3", render_mode="rgb_array", width=64, height=64)
    runs = {
        (PLAIN_MAZE, 1): single(rendered, render=True),
        (PLAIN_NAV2D, 1): single(PlainNav2D()),
    }
    for env_id, n, _, _ in TARGETS:
        if n == 1:
            runs[env_id, n] = single(gym.make(env_id))
        else:
            runs[env_id, n] = vectorized(gym.make_vec(env_id, num_envs=n, vectorization_mode="vector_entry_point"))
    return runs


def measure(rounds: int, seconds: float) -> list[str]:
    """Rows of the table, each a line of Markdown."""
    runs = contenders()
    speeds = dict.fromkeys(runs, 0.0)
    for _ in range(rounds):
        for key, run in runs.items():
            speeds[key] = max(speeds[key], run(seconds))
    rows = [f"| {name} | 1 | {speeds[name, 1]:,.0f} | | |" for name in (PLAIN_MAZE, PLAIN_NAV2D)]
    for env_id, n, plain, least in TARGETS:
        speed = speeds[env_id, n]
        rows.append(f"| {env_id} | {n} | {speed:,.0f} | {speed / speeds[plain, 1]:.1f} | {least} |")
    return rows


def _require_renderer(gl: str) -> None:
    try:
        import mujoco

        mujoco.GLContext(64, 64).free()
    except Exception as error:  # what a missing library raises depends on the library
        sys.exit(f"MuJoCo cannot render with {gl} ({error!r}); apt-get install libegl1 libgl1")


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table; exits 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_envs", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=15, help="turns of each contender (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=0.5, help="length of a turn (default: %(default)s)")
    parser.add_argument("--gl", choices=("egl", "osmesa"), default="egl", help="MuJoCo's renderer (default: egl)")
    args = parser.parse_args(argv)
    # Read by MuJoCo and OpenMP when they are imported.
    os.environ["MUJOCO_GL"] = args.gl
    use_one_core()
    warnings.simplefilter("ignore")
    _require_renderer(args.gl)
    rows = measure(args.rounds, args.seconds)
    text = (
        f"`make bench` on {machine()}: the fastest of {args.rounds} turns of {args.seconds} s. The ratio is to the "
        f"plain implementation of the same kind (MuJoCo's renderer: {args.gl}, on the CPU)."
    )
    header = ["| environment | copies | steps/s | ratio | at least |", "|---|---:|---:|---:|---:|"]
    write_page(args.output, "Speed of the environments", text, header, rows)
    cells = [[cell.strip() for cell in row.split("|")] for row in rows]
    missed = [row[1] for row in cells if row[5] and float(row[4]) < float(row[5])]
    if missed:
        sys.exit(f"below the target: {', '.join(missed)}")


if __name__ == "__main__":
    main()
