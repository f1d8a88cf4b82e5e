"""Memory of pretraining: the most that a command of a few updates, from opening its dataset to its encoder file, has
resident, mapped pages of the dataset included. Linux and macOS only. ``make bench``.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "memory.md"
AIM_GB = 2.0
DATASETS = (("Nav2D-v0", 1_000_000), ("PointMaze-v0", 250_000))
OBJECTIVES = ("ssi", "abisim", "curl")
UPDATES = ["-params", "n_updates:100", "log_interval:50", "checkpoint_interval:50"]


def peak_gigabytes(words: list[str]) -> float:
    """The largest resident size of a command.

    :param words: after ``python -m``
    :raises subprocess.CalledProcessError: if it fails
    """
    process = subprocess.Popen([sys.executable, "-m", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise subprocess.CalledProcessError(os.waitstatus_to_exitcode(status), words)
    return usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_memory", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--scale", type=float, default=1.0, help="share of the datasets' size (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    rows = []
    for env_id, n_transitions in DATASETS:
        with tempfile.TemporaryDirectory() as folder:
            data = f"{folder}/data"
            n = round(args.scale * n_transitions)
            collected = peak_gigabytes(["sb3_abisim", "collect", "--env", env_id, "-n", str(n), "-o", data])
            size = sum(path.stat().st_size for path in Path(data).iterdir()) / 1e9
            for objective in OBJECTIVES:
                words = ["sb3_abisim", "pretrain", "--objective", objective, "--env", env_id, "--data", data]
                words += ["-o", f"{folder}/{objective}.safetensors", "--device", "cpu", *UPDATES]
                words += ["--base", f"{env_id}/ssi"] if objective == "abisim" else []
                peak = peak_gigabytes(words)
                rows.append(
                    f"| {env_id} | {n:,} | {size:.2f} | {collected:.2f} | `{objective}` | {peak:.2f} | {AIM_GB:.0f} |"
                )
                print(rows[-1], flush=True)
    text = f"`python -m benchmarks.bench_memory` on {machine()}: GB, the most that each command had resident."
    header = [
        "| environment | transitions | dataset | collecting | objective | pretraining | aim, below |",
        "|---|---:|---:|---:|---|---:|---:|",
    ]
    write_page(args.output, "Memory of pretraining", text, header, rows)


if __name__ == "__main__":
    main()
