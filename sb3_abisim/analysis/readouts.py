"""A ladder for encoders that needs no RL: what an agent needs to find a goal, read from frozen embeddings by ridge.

On Nav2D every state of a layout and every shortest path in it are known. From the embedding of a state is read:

* ``optimal_action``: whether each move lies on a shortest path to the goal, the area under the ROC curve;
* ``geodesic_excess``: how many steps the shortest path is longer than without obstacles, R^2;
* ``blocked_1`` to ``blocked_4``: which of the cells so many moves away are blocked, the area under the ROC curve.

The ridge regression learns on some layouts and is scored on others.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.analysis.nav2d_exact import (
    DISTANCE,
    EVAL_SEED,
    GOAL_CELL,
    embed,
    eval_layouts,
    observations,
    reachable,
)
from sb3_abisim.analysis.probes import Target, read
from sb3_abisim.common.grids import fewest_steps
from sb3_abisim.envs.nav2d import SIZE, next_cells
from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.encoder_file import EncoderFile

N_LAYOUTS = 200
PER_LAYOUT = 20
DISTANCES = (1, 2, 3, 4)


def sample_states(env_id: str, n_layouts: int, seed: int = EVAL_SEED) -> tuple[NDArray[np.uint8], dict[str, Target]]:
    """Observations of states anywhere in some layouts, and what is to be read from them.

    :param env_id: an id of Nav2D
    :param n_layouts: at least 1; each gives :data:`PER_LAYOUT` states, or all that it has
    :param seed: of the first layout, see :func:`~sb3_abisim.analysis.nav2d_exact.eval_layouts`
    :return: uint8 (n, 3, SIZE, SIZE), and the targets by name
    :raises ValueError: for another environment, or ``n_layouts`` below 1
    """
    if n_layouts < 1:
        raise ValueError(f"the number of layouts must be at least 1, got {n_layouts}")
    generator = np.random.default_rng(seed)
    shown, optimal, excess, blocked = [], [], [], []
    for obstacles in eval_layouts(env_id, n_layouts, seed):
        cells = reachable(obstacles)
        cells = generator.permutation(cells[cells != GOAL_CELL])[:PER_LAYOUT]
        nexts = next_cells(obstacles)
        steps = fewest_steps(nexts, np.array([GOAL_CELL]))[:, 0]
        shown.append(observations(obstacles, cells))
        optimal.append(steps[nexts[cells]] < steps[cells, None])
        excess.append(steps[cells] - DISTANCE[cells, GOAL_CELL])
        blocked.append(_blocked_around(obstacles, cells))
    targets = {
        "optimal_action": Target(np.concatenate(optimal).astype(np.float64), "binary"),
        "geodesic_excess": Target(np.concatenate(excess)[:, None].astype(np.float64), "continuous"),
    }
    around, apart = np.concatenate(blocked), np.abs(_OFFSETS).sum(axis=1)
    for n in DISTANCES:
        targets[f"blocked_{n}"] = Target(around[:, apart == n].astype(np.float64), "binary")
    return np.concatenate(shown), targets


def _offsets() -> NDArray[np.int64]:
    """(dx, dy) of all cells up to the last of :data:`DISTANCES` moves away."""
    reach = np.arange(-DISTANCES[-1], DISTANCES[-1] + 1)
    offsets = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    apart = np.abs(offsets).sum(axis=1)
    near: NDArray[np.int64] = offsets[(apart >= DISTANCES[0]) & (apart <= DISTANCES[-1])]
    return near


_OFFSETS = _offsets()


def _blocked_around(obstacles: NDArray[np.bool_], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether the cells at :data:`_OFFSETS` are obstacles or off the grid, (n, n_offsets)."""
    margin = DISTANCES[-1]
    padded = np.pad(obstacles.reshape(SIZE, SIZE), margin, constant_values=True)
    y, x = np.divmod(cells[:, None], SIZE)
    blocked: NDArray[np.bool_] = padded[y + margin + _OFFSETS[:, 1], x + margin + _OFFSETS[:, 0]]
    return blocked


def readouts(encoder: Encoder, env_id: str, n_layouts: int = N_LAYOUTS, seed: int = EVAL_SEED) -> dict[str, float]:
    """The ladder of one encoder.

    :param encoder: of Nav2D, in evaluation mode
    :param env_id: an id of Nav2D
    :param n_layouts: to learn from, and as many others to score
    :param seed: of the first layout
    :return: score by target
    """
    learn, learned = sample_states(env_id, n_layouts, seed)
    test, tested = sample_states(env_id, n_layouts, seed + n_layouts)
    features, test_features = embed(encoder, learn).numpy(), embed(encoder, test).numpy()
    scores = {name: read("linear", features, learned[name], test_features, tested[name]) for name in learned}
    return {name: score for name, score in scores.items() if score is not None}


def compare(files: dict[str, EncoderFile], env_id: str, n_layouts: int, seed: int = EVAL_SEED) -> dict[str, Any]:
    """The ladder of several encoders.

    :param files: by name
    :param env_id: an id of Nav2D
    :param n_layouts: see :func:`readouts`
    :param seed: of the first layout
    :return: JSON types: the settings, and per encoder its hash, objective, seed and scores
    """
    encoders = {
        name: {
            "hash": file.hash,
            "objective": file.metadata["objective"],
            "seed": file.metadata["settings"].get("seed"),
            "scores": readouts(file.encoder.eval(), env_id, n_layouts, seed),
        }
        for name, file in files.items()
    }
    return {"env_id": env_id, "n_layouts": n_layouts, "seed": seed, "encoders": encoders}


def table(results: dict[str, Any]) -> str:
    """The results of :func:`compare` as a Markdown table.

    :param results: what it returned
    """
    names = list(next(iter(results["encoders"].values()))["scores"])
    lines = [["encoder", *names], ["---", *["---:"] * len(names)]]
    for name, result in results["encoders"].items():
        lines.append([name, *(f"{result['scores'][target]:.3f}" for target in names)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
