"""Speed of ScanNav on one core, and of turning a house into a map: ``python -m benchmarks.bench_scan_nav``.

Times are of the process (CPU seconds), which other load on the machine disturbs least; the speed is that of the
fastest turn. The house has at least 150,000 triangles.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "scan_nav.json"
# (copies, actions): least steps/s; the bound holds for walking, where no time goes into goals seen for the first time.
TARGETS = {(1, "walking"): 0, (6, "walking"): 8000, (64, "walking"): 8000, (64, "random"): 0}
LONGEST, LARGEST = 5.0, 1024.0  # s and MB of preprocessing

_PREPROCESS = """
import resource, sys, time
from sb3_abisim.envs.scan_nav.map import ScanMap
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for cached in (False, True, True):
    start = time.process_time()
    ScanMap.from_mesh(sys.argv[1], cache=cached)
    seconds = time.process_time() - start
    print(seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def house(path: Path) -> int:
    """Write a house of at least 150,000 triangles; return their number."""
    import trimesh

    ground = trimesh.creation.box(bounds=[(0, 0, -0.1), (12, 10, 0)])
    parts = [ground]
    for x in np.arange(1.0, 12, 2.2):
        parts += [trimesh.creation.box(bounds=[(x, 0.5 + y, 0), (x + 0.12, 2.5 + y, 2.5)]) for y in (0, 3.2, 6.4)]
    mesh = trimesh.util.concatenate(parts).subdivide_to_size(0.08, max_iter=12)
    mesh.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (len(mesh.vertices), 4)).astype(np.uint8)
    mesh.export(path)
    return len(mesh.faces)


def preprocessing() -> dict[str, Any]:
    """Seconds and peak memory of making a map, in another process, and seconds of reading it from the cache."""
    with tempfile.TemporaryDirectory() as folder:
        n_faces = house(Path(folder) / "house.ply")
        environment = {**os.environ, "SB3_ABISIM_CACHE": folder}
        command = [sys.executable, "-c", _PREPROCESS, f"{folder}/house.ply"]
        output = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
    rows = [[float(k) for k in line.split()] for line in output.splitlines()]
    return {"triangles": n_faces, "seconds": rows[0][0], "peak_mb": rows[0][1], "cached_seconds": rows[2][0]}


def stepping(n: int, actions: str, rounds: int, calls: int) -> float:
    """Steps per CPU second of a batch: 128 x 128 RGB-D of the five apartments."""
    import gymnasium as gym

    import sb3_abisim  # noqa: F401

    kwargs = {"goals_per_scene": 16, "stop": "auto" if actions == "walking" else "action"}
    env = gym.make_vec("ScanNav-v0", num_envs=n, vectorization_mode="vector_entry_point", **kwargs)
    env.reset(seed=0)
    env.action_space.seed(0)
    chosen = [env.action_space.sample() for _ in range(calls)]
    best = 0.0
    for _ in range(rounds):
        start = time.process_time()
        for action in chosen:
            env.step(action)
        best = max(best, calls * n / (time.process_time() - start))
    return best


def main(argv: list[str] | None = None) -> None:
    """Measure and write the results; exits 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_scan_nav", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="JSON file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    made = preprocessing()
    speeds = {key: stepping(*key, rounds=args.rounds, calls=max(20, 2000 // key[0])) for key in TARGETS}
    result = {
        "machine": platform.machine(),
        "python": platform.python_version(),
        "preprocessing": {name: round(value, 3) for name, value in made.items()},
        "steps_per_second": [{"copies": n, "actions": a, "speed": round(s)} for (n, a), s in speeds.items()],
    }
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(json.dumps(result, indent=1) + "\n")
    rows = [f"| {a} | {n} | {s:,.0f} | {TARGETS[n, a] or '':} |" for (n, a), s in speeds.items()]
    text = (
        f"`python -m benchmarks.bench_scan_nav` on {machine()}; CPU seconds. 128 x 128 RGB-D, five apartments. "
        "Walking: random moves without stop; random: with stop, "
        "so that episodes last four steps and most of the time goes into "
        "resets."
    )
    tail = (
        f"A map of {made['triangles']:,} triangles takes {made['seconds']:.1f} s (at most {LONGEST:g}) and "
        f"{made['peak_mb']:.0f} MB (at most {LARGEST:g}); read from the cache, {made['cached_seconds']:.2f} s.",
        "",
    )
    header = ["| actions | copies | steps/s | at least |", "|---|---:|---:|---:|"]
    write_page(args.output.with_suffix(".md"), "Speed of ScanNav", text, header, rows, tail)
    missed = [str(key) for key, speed in speeds.items() if speed < TARGETS[key]]
    missed += ["preprocessing"] if made["seconds"] > LONGEST or made["peak_mb"] > LARGEST else []
    if missed:
        sys.exit(f"below the target: {', '.join(missed)}")


if __name__ == "__main__":
    main()
