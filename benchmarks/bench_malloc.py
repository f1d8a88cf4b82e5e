"""Speed of PPO on image observations with and without ``sb3_abisim.common.malloc.keep_freed_memory``.

An untrained network with the hyperparameters of ``hyperparams/`` (on Distractor PointMaze with shorter rollouts). The
two settings run in turns, each turn in a new process, since the allocator's setting holds for a process. Speed is steps
per second of processor time on one thread; the speed of each is that of its fastest turn. Linux with glibc.
``make bench``.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "malloc.md"
# Environment to (environments, arguments of PPO).
SETTINGS: dict[str, tuple[int, dict[str, Any]]] = {
    "DistractorPointMaze-v0": (16, {"n_steps": 256, "batch_size": 256}),
    "ScanNav-v0": (6, {"n_steps": 128, "batch_size": 384, "n_epochs": 4}),
}
N_ROLLOUTS = 4


def turn(env_id: str, keep: bool) -> dict[str, float]:
    """One turn, in this process: steps per second and the most memory that was resident, in GB."""
    use_one_core()
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    from sb3_abisim.common.malloc import keep_freed_memory
    from sb3_abisim.rl.extractors import VanillaExtractor

    if keep and not keep_freed_memory():
        raise SystemExit("this C library is not glibc; there is nothing to compare")
    n_envs, arguments = SETTINGS[env_id]
    policy_kwargs = {"features_extractor_class": VanillaExtractor, "net_arch": [256]}
    model = PPO("CnnPolicy", make_vec_env(env_id, n_envs), policy_kwargs=policy_kwargs, device="cpu", **arguments)
    n_steps = n_envs * int(arguments["n_steps"])
    model.learn(n_steps)
    start = time.process_time()
    model.learn(N_ROLLOUTS * n_steps)
    speed = N_ROLLOUTS * n_steps / (time.process_time() - start)
    return {"speed": speed, "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6}


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_malloc", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each setting (default: %(default)s)")
    parser.add_argument("--turn", nargs=2, metavar=("ID", "KEEP"), help="one turn, as JSON (what the others call)")
    args = parser.parse_args(argv)
    if args.turn:
        print(json.dumps(turn(args.turn[0], args.turn[1] == "True")))
        return
    rows = []
    for env_id in SETTINGS:
        best = {keep: {"speed": 0.0, "memory": 0.0} for keep in (False, True)}
        for _ in range(args.rounds):
            for keep, there in best.items():
                command = [sys.executable, "-m", "benchmarks.bench_malloc", "--turn", env_id, str(keep)]
                output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
                result = json.loads(output.splitlines()[-1])
                best[keep] = {name: max(value, result[name]) for name, value in there.items()}
        plain, kept = best[False], best[True]
        speeds = f"{plain['speed']:,.0f} | {kept['speed']:,.0f} | {kept['speed'] / plain['speed']:.1f}"
        rows.append(f"| {env_id} | {speeds} | {plain['memory']:.2f} | {kept['memory']:.2f} |")
        print(rows[-1], flush=True)
    text = (
        f"`python -m benchmarks.bench_malloc` on {machine()}: PPO on image observations, steps per second of "
        f"processor time, fastest of {args.rounds} turns, and the most memory that was resident, in GB."
    )
    header = [
        "| environment | glibc's default | `keep_freed_memory` | ratio | memory, default | memory, kept |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    write_page(args.output, "Speed with freed memory kept", text, header, rows, ())


if __name__ == "__main__":
    main()
