"""What a perfect learner of the metric would bring: ``python -m benchmarks.exact_teacher -o FILE [-c 0.9] [--seed 0]``.

Action-bisimulation approaches its metric from recorded transitions. Here the same network, from the same base encoder,
is fitted to distances that :mod:`sb3_abisim.analysis.exact_metric` has solved, between states of 8,000 layouts of
Nav2D. How near it comes on other layouts (``sb3-abisim analyze exact FILE``) is what the network can hold. What RL
gains with it is what the metric itself is worth.
"""

import argparse
import sys

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from tqdm import tqdm

from sb3_abisim.analysis import nav2d_exact as nav
from sb3_abisim.analysis.exact_metric import action_bisim_metric
from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.encoder_file import load_encoder, save_encoder

ENV_ID = "Nav2D-v0"
# Far from the eval layouts of `analyze exact`.
FIRST_LAYOUT = 2_000_000
N_AGENTS = 48
# Pairs of layouts in a batch.
N_PAIRS = 4
# Errors are those of square roots, so that small distances count; this keeps their slope at zero finite.
EPSILON = 0.1

Pair = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]  # observations of two layouts, exact distances


def solve(
    base: Encoder, layouts: NDArray[np.bool_], c: float, generator: np.random.Generator, toggle: bool = True
) -> list[Pair]:
    """Exact distances between states of each layout and, in turns, itself, it with one cell toggled, or another one.

    :param base: the base encoder
    :param layouts: (n_layouts, SIZE * SIZE)
    :param c: weight of the recursive term
    :param generator: samples cells and agents
    :param toggle: False leaves out the toggled cells, which no dataset of layouts of 2x2 blocks shows
    :return: N_AGENTS states on either side; with toggled cells, every second pair is the same agents
    """
    pairs = []
    for k in tqdm(range(len(layouts)), desc="solve", file=sys.stderr):
        here, there = layouts[k], layouts[k].copy()
        cell = int(generator.choice(np.delete(np.arange(nav.N_CELLS), nav.GOAL_CELL)))
        if k % 2 and toggle:
            there[cell] ^= True
        elif k % 4:
            there = layouts[k - 1]
        free, nexts, features = nav.states(base, here)
        other_free, other_nexts, other_features = nav.states(base, there)
        base_distance = th.cdist(features, other_features, p=1.0).numpy()
        metric = action_bisim_metric(base_distance, nexts, other_nexts, c, tol=nav.TOLERANCE)
        agents, others = nav.reachable(here), nav.reachable(there)
        if k % 2 and toggle:
            # Half of them nearest to the cell.
            agents = np.intersect1d(agents, others)
            nearest = agents[np.argsort(nav.DISTANCE[agents, cell], kind="stable")[: N_AGENTS // 2]]
            rest = generator.choice(np.setdiff1d(agents, nearest), N_AGENTS // 2)
            agents = others = np.concatenate([nearest, rest])
        else:
            agents, others = generator.choice(agents, N_AGENTS), generator.choice(others, N_AGENTS)
        rows, columns = np.searchsorted(free, agents), np.searchsorted(other_free, others)
        pairs.append((nav.observations(here, agents), nav.observations(there, others), metric[np.ix_(rows, columns)]))
    return pairs


def fit(
    encoder: Encoder, pairs: list[Pair], n_updates: int, generator: np.random.Generator, toggle: bool = True
) -> None:
    """Make L1 distances of embeddings equal the exact ones; the same agents beside a toggled cell count double.

    :param encoder: trained in place
    :param pairs: from :func:`solve`
    :param n_updates: steps of Adam, its learning rate falling from 1e-3 to 2e-5
    :param generator: samples batches
    :param toggle: as for :func:`solve`
    """
    optimizer = th.optim.Adam(encoder.parameters(), lr=1e-3)
    scheduler = th.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.02, n_updates)
    bar = tqdm(range(n_updates), desc="fit", file=sys.stderr)
    for update in bar:
        chosen = N_PAIRS * generator.integers(len(pairs) // N_PAIRS) + np.arange(N_PAIRS)
        observations = np.concatenate([pairs[k][side] for k in chosen for side in (0, 1)])
        features = encoder(th.as_tensor(observations).float() / 255).view(N_PAIRS, 2, N_AGENTS, -1)
        learned = th.cdist(features[:, 0], features[:, 1], p=1.0)
        exact = th.as_tensor(np.stack([pairs[k][2] for k in chosen]), dtype=th.float32)
        error = ((learned + EPSILON).sqrt() - (exact + EPSILON).sqrt()) ** 2
        loss = error.mean() / exact.mean()
        if toggle:
            same_error, same = (x[1::2].diagonal(dim1=1, dim2=2) for x in (error, exact))
            loss = loss + same_error.mean() / same.mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
        if update % 100 == 0:
            bar.set_postfix(loss=f"{loss.item():.4f}")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser("python -m benchmarks.exact_teacher", description=__doc__)
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="encoder file to write")
    parser.add_argument("--base", default=f"{ENV_ID}/ssi", help="encoder whose distance is the base of the metric")
    parser.add_argument("-c", type=float, default=0.9)
    parser.add_argument("--n-layouts", type=int, default=8000)
    parser.add_argument("--n-updates", type=int, default=8000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-toggle", dest="toggle", action="store_false", help="only layouts as in a dataset")
    args = parser.parse_args()

    th.manual_seed(args.seed)
    generator = np.random.default_rng(args.seed)
    env = gym.make(ENV_ID)
    layouts = nav.eval_layouts(ENV_ID, args.n_layouts, FIRST_LAYOUT + args.seed * args.n_layouts)
    base = load_encoder(args.base)
    pairs = solve(base.encoder.eval(), layouts, args.c, generator, args.toggle)
    encoder = load_encoder(args.base).encoder.train().requires_grad_(True)
    fit(encoder, pairs, args.n_updates, generator, args.toggle)
    encoder.eval()
    observations = np.concatenate([here[:8] for here, _, _ in pairs[:512]])
    encoder.standardize(th.as_tensor(observations).float() / 255)
    save_encoder(
        args.output,
        encoder,
        observation_space=env.observation_space,
        action_space=env.action_space,
        env_id=ENV_ID,
        env_kwargs={},
        # So that ActionBisimExtractor takes it.
        objective="abisim",
        settings={
            "teacher": "exact metric",
            "base": args.base,
            "c": args.c,
            "seed": args.seed,
            "n_updates": args.n_updates,
            **({} if args.toggle else {"toggle": False}),
        },
        dataset_hash="exact",
        reference_observations=observations[:4],
    )


if __name__ == "__main__":
    main()
