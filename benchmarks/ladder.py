"""Does a read-out predict what RL gains with an encoder? ``python -m benchmarks.ladder READOUTS RUNS ... -o FILE``.

READOUTS is a file of ``sb3-abisim analyze readouts -o``; RUNS are folders of finished, frozen zoo runs with final
evaluations. Each encoder is one point: its read-outs, and its mean return over RL seeds (stochastic policy) on each
split. Intervals are of a bootstrap over encoders.
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

RETURNS = "stochastic/{}/results"
N_RESAMPLES = 2000
# Of fewer encoders, the better half is not looked at by itself.
MIN_HALF = 10


def returns_by_encoder(folders: list[Path], split: str = "standard") -> dict[str, float]:
    """Mean final return of each encoder.

    :param folders: searched for runs at any depth
    :param split: of the final evaluations
    :return: hash of the encoder file to the mean over its runs
    :raises ValueError: if there are no runs
    """
    returns = defaultdict(list)
    for folder in folders:
        for path in sorted(folder.rglob("final_evaluations.npz")):
            run = read_run(path.parent)
            final = run.final()
            if run.record is not None and run.record.encoder_hash is not None and final is not None:
                key = RETURNS.format(split)
                if key not in final:
                    raise ValueError(f"{path} has no split {split!r} but {', '.join(sorted(final))}; give --splits")
                returns[run.record.encoder_hash].append(float(final[key].mean()))
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


def rows_of(points: list[dict], returns: list[dict[str, float]], half: bool = False) -> list[str]:
    """A line of the table for each setting and read-out.

    :param points: encoders of ``analyze readouts``
    :param returns: by hash, for each split
    :param half: of the half of the encoders with the highest read-out alone
    """
    rows, everyone = [], points
    for setting, targets in points[0]["scores"].items():
        for target in targets:
            if half:
                best_first = sorted(everyone, key=lambda point: -point["scores"][setting][target])
                points = best_first[: len(everyone) // 2]
            x = np.array([point["scores"][setting][target] for point in points])
            cells = [target if len(points[0]["scores"]) == 1 else f"{target}, {setting}"]
            for by_hash in returns:
                rho, low, high = correlation(x, np.array([by_hash[point["hash"]] for point in points]))
                cells += [f"{rho:.2f}", f"{low:.2f} to {high:.2f}"]
            rows.append(f"| {' | '.join(cells)} |")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("readouts", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--splits", nargs="+", default=["standard"], help="of the final evaluations")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a page of Markdown")
    args = parser.parse_args()
    results = json.loads(args.readouts.read_text())
    returns = [returns_by_encoder(args.runs, split) for split in args.splits]
    points = [encoder for encoder in results["encoders"].values() if encoder["hash"] in returns[0]]
    heads = ["correlation"] if len(args.splits) == 1 else [f"return, {split}" for split in args.splits]
    half = len(points) // 2
    columns = ["read-out", *(cell for head in heads for cell in (head, "95 % interval"))]
    header = [f"| {' | '.join(columns)} |", f"|---|{'---:|' * (len(columns) - 1)}"]
    few = " They are few here, and where both orders agree in full an interval has no width." if half < MIN_HALF else ""
    tail: tuple[str, ...] = ()
    if not few:
        words = f"The same over the {half} encoders with the highest read-out each:"
        tail = (words, "", *header, *rows_of(points, returns, half=True), "")
    write_page(
        args.output,
        "Read-outs and RL return",
        f"Spearman's correlation over {len(points)} encoders of {results['env_id']} between what a ridge regression "
        "reads from the frozen embedding and the final return of PPO on it, mean over RL seeds. Intervals are of a "
        f"bootstrap over encoders.{few}",
        header,
        rows_of(points, returns),
        tail,
    )


if __name__ == "__main__":
    main()
