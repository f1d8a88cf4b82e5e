"""Does a read-out predict what RL gains with an encoder? ``python -m benchmarks.ladder READOUTS RUNS ... -o FILE``.

READOUTS is a file of ``sb3-abisim analyze readouts -o``; RUNS are folders of finished, frozen zoo runs with final
evaluations. Each encoder is one point: its read-outs, and its mean return over RL seeds (stochastic policy). Intervals
are of a bootstrap over encoders.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import write_page
from sb3_abisim.analysis.nav2d_exact import spearman
from sb3_abisim.zoo.runs import read_run

RETURNS = "stochastic/standard/results"
N_RESAMPLES = 2000


def returns_by_encoder(folders: list[Path]) -> dict[str, float]:
    """Mean final return of each encoder.

    :param folders: searched for runs at any depth
    :return: hash of the encoder file to the mean over its runs
    :raises ValueError: if there are no runs
    """
    returns = defaultdict(list)
    for folder in folders:
        for path in sorted(folder.rglob("final_evaluations.npz")):
            run = read_run(path.parent)
            final = run.final()
            if run.record is not None and run.record.encoder_hash is not None and final is not None:
                returns[run.record.encoder_hash].append(float(final[RETURNS].mean()))
    if not returns:
        raise ValueError(f"no finished runs with an encoder in {', '.join(map(str, folders))}")
    return {hash: float(np.mean(values)) for hash, values in returns.items()}


def correlation(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float, float]:
    """Spearman's, and the ends of its 95 % bootstrap interval.

    :param x: (n,)
    :param y: (n,)
    """
    generator = np.random.default_rng(0)
    samples = generator.integers(len(x), size=(N_RESAMPLES, len(x)))
    resampled = [spearman(x[rows], y[rows]) for rows in samples]
    low, high = np.nanpercentile(resampled, (2.5, 97.5))
    return spearman(x, y), float(low), float(high)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("readouts", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a page of Markdown")
    args = parser.parse_args()
    encoders = json.loads(args.readouts.read_text())["encoders"]
    returns = returns_by_encoder(args.runs)
    points = [encoder for encoder in encoders.values() if encoder["hash"] in returns]
    y = np.array([returns[point["hash"]] for point in points])
    rows = []
    for target in points[0]["scores"]:
        rho, low, high = correlation(np.array([point["scores"][target] for point in points]), y)
        rows.append(f"| {target} | {rho:.2f} | {low:.2f} to {high:.2f} |")
    write_page(
        args.output,
        "Read-outs and RL return",
        f"Spearman's correlation over {len(points)} encoders of Nav2D between what a ridge regression reads from the "
        "frozen embedding and the final return of PPO on it, mean over RL seeds. Intervals are of a bootstrap over "
        "encoders.",
        ["| read-out | correlation | 95 % interval |", "|---|---:|---:|"],
        rows,
    )


if __name__ == "__main__":
    main()
