"""A learned distance on Nav2D beside the exact one.

A perturbation map shows by how much the distance between two states grows when one cell of the grid is toggled (an
obstacle added or removed) and the agent stays where it is. The learned distance is the L1 distance of the two
embeddings. The exact one is the fixed point of the action-bisimulation metric whose base distance is that of the base
encoder (:mod:`sb3_abisim.analysis.exact_metric`). Both are averaged over layouts and agents by the offset from agent to
cell.

The goal counts as any other cell here: the metric knows no reward, and random play passes over it.
"""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import preprocess_obs

from sb3_abisim.analysis.exact_metric import action_bisim_metric
from sb3_abisim.common.grids import fewest_steps, flood_fill, pack, unpack
from sb3_abisim.envs.base import batch_class
from sb3_abisim.envs.nav2d import CHANNELS, GOAL, SIZE, Nav2DVectorEnv, next_cells
from sb3_abisim.networks.base import Encoder
from sb3_abisim.registry import get_traits

N_CELLS = SIZE * SIZE
GOAL_CELL = GOAL[1] * SIZE + GOAL[0]
# Bins of the city-block distance from agent to cell, both ends included.
BINS = ((1, 1), (2, 2), (3, 3), (4, 4), (5, 6), (7, 9), (10, 2 * (SIZE - 1)))
# Steps of the shortest path between two states.
STEPS = tuple(range(1, 13))
# Far offsets that few agents see are noise.
MIN_SAMPLES = 20
# Far from the seeds that people type, and from those that a dataset's copies get of its seed.
EVAL_SEED = 1_000_000
TOLERANCE = 1e-3
EMBED_BATCH = 2048

_Y, _X = np.divmod(np.arange(N_CELLS), SIZE)
_DY, _DX = _Y[None] - _Y[:, None], _X[None] - _X[:, None]
# By [agent, cell]: indices into a map of offsets, (2 SIZE - 1) squared, and the city-block distance.
_OFFSET = (_DY + SIZE - 1) * (2 * SIZE - 1) + _DX + SIZE - 1
DISTANCE = np.abs(_DY) + np.abs(_DX)

Maps = NDArray[np.float64]


@dataclass(frozen=True)
class Comparison:
    """How a learned distance agrees with the exact one.

    :param map_correlation: Spearman's, of the two mean perturbation maps
    :param state_correlation: Spearman's, of distances between states of one layout, mean over layouts
    :param profile: learned sensitivity by distance (:data:`BINS`), relative to the nearest
    :param exact_profile: the exact one
    :param profile_error: largest difference of the two
    :param step_profile: learned distance between states so many steps apart (:data:`STEPS`), relative to the mean
        distance in their layout
    :param exact_step_profile: the exact one
    """

    map_correlation: float
    state_correlation: float
    profile: tuple[float, ...]
    exact_profile: tuple[float, ...]
    profile_error: float
    step_profile: tuple[float, ...]
    exact_step_profile: tuple[float, ...]


def check_nav2d(env_id: str) -> None:
    """Refuse environments whose cells cannot be toggled.

    :param env_id: an id of Nav2D, that is of :class:`~sb3_abisim.envs.nav2d.Nav2DVectorEnv` or a subclass
    :raises ValueError: for any other, or one whose goal is not in the center
    """
    found = batch_class(env_id)
    if found is None or not issubclass(found, Nav2DVectorEnv):
        raise ValueError(f"cells can be toggled in Nav2D alone, got {env_id!r}; give an id of it such as Nav2D-v0")
    check_centered(env_id)


def check_centered(env_id: str) -> None:
    """Refuse an environment with random goals, for what renders states with the goal in the center.

    :param env_id: a registered id
    :raises ValueError: naming one that has its goal there
    """
    if gym.spec(env_id).kwargs.get("goal", "center") != "center":
        other = get_traits(env_id).same_observations_as or "another id"
        raise ValueError(f"the goal of {env_id} is not in the center, where this figure shows it; give {other}")


def eval_layouts(env_id: str, n_layouts: int, seed: int = EVAL_SEED) -> NDArray[np.bool_]:
    """Obstacles of new episodes.

    :param env_id: an id of Nav2D
    :param n_layouts: how many
    :param seed: of the first episode; the next has the next seed
    :return: (n_layouts, SIZE * SIZE)
    :raises ValueError: for another environment
    """
    check_nav2d(env_id)
    env = gym.make(env_id)
    shown = np.array([env.reset(seed=seed + k)[0] for k in range(n_layouts)])
    obstacles: NDArray[np.bool_] = shown[:, CHANNELS.index("obstacles")].reshape(n_layouts, N_CELLS) > 0
    return obstacles


def reachable(obstacles: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Cells joined to the goal: those where the agent of an episode can be.

    :param obstacles: (SIZE * SIZE,)
    """
    # One column more, which is never free.
    free = np.pad(~obstacles.reshape(SIZE, SIZE), ((0, 0), (0, 1)))
    goal = 1 << (GOAL[1] * (SIZE + 1) + GOAL[0])
    reached = flood_fill(goal, pack(free), SIZE + 1)
    return np.flatnonzero(unpack(reached, SIZE, SIZE + 1)[:, :SIZE])


def observations(obstacles: NDArray[np.bool_], agents: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Observations of a layout with the agent in each of some cells.

    :param obstacles: (SIZE * SIZE,)
    :param agents: cell indices, (n,)
    :return: (n, 3, SIZE, SIZE)
    """
    shown = np.zeros((len(agents), len(CHANNELS), N_CELLS), dtype=np.uint8)
    shown[:, CHANNELS.index("obstacles")] = np.where(obstacles, 255, 0)
    shown[:, CHANNELS.index("goal"), GOAL_CELL] = 255
    shown[np.arange(len(agents)), CHANNELS.index("agent"), agents] = 255
    return shown.reshape(len(agents), len(CHANNELS), SIZE, SIZE)


@th.no_grad()
def embed(encoder: Encoder, observations: NDArray[np.uint8]) -> th.Tensor:
    """Embeddings through SB3's preprocessing, (n, features_dim).

    :param encoder: in evaluation mode
    :param observations: (n, channels, height, width)
    """
    space = gym.spaces.Box(0, 255, observations.shape[1:], np.uint8)
    parts = []
    # Floats of a 64 x 64 observation take 49 kB.
    for part in th.split(th.as_tensor(observations), EMBED_BATCH):
        inputs = preprocess_obs(part, space)
        assert isinstance(inputs, th.Tensor)
        parts.append(encoder(inputs))
    return th.cat(parts)


def states(base: Encoder, obstacles: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64], th.Tensor]:
    """All states of a layout.

    :param base: the base encoder
    :param obstacles: (SIZE * SIZE,)
    :return: free cells (n,), where each move leads from them as indices into them (n, 4), and the base embedding with
        the agent there (n, features_dim)
    """
    free = np.flatnonzero(~obstacles)
    nexts = np.searchsorted(free, next_cells(obstacles)[free])
    return free, nexts, embed(base, observations(obstacles, free))


def learned_maps(encoder: Encoder, layouts: NDArray[np.bool_]) -> Maps:
    """L1 distances of embeddings with one cell toggled.

    :param encoder: any encoder of Nav2D
    :param layouts: (n_layouts, SIZE * SIZE)
    :return: (n_layouts, agent's cell, toggled cell), NaN where there is no such pair
    """
    maps = np.full((len(layouts), N_CELLS, N_CELLS), np.nan)
    for k, obstacles in enumerate(layouts):
        agents = reachable(obstacles)
        features = embed(encoder, observations(obstacles, agents))
        for cell in _togglable():
            stay = agents != cell
            other = embed(encoder, observations(_toggled(obstacles, cell), agents[stay]))
            maps[k, agents[stay], cell] = (features[th.as_tensor(stay)] - other).abs().sum(dim=1).numpy()
    return maps


def exact_maps(base: Encoder, layouts: NDArray[np.bool_], c: float) -> Maps:
    """The same for the exact metric over a base encoder's distance.

    :param base: the base encoder
    :param layouts: (n_layouts, SIZE * SIZE)
    :param c: weight of the recursive term
    """
    maps = np.full((len(layouts), N_CELLS, N_CELLS), np.nan)
    for k, obstacles in enumerate(layouts):
        agents = reachable(obstacles)
        free, nexts, features = states(base, obstacles)
        for cell in _togglable():
            other_free, other_nexts, other_features = states(base, _toggled(obstacles, cell))
            base_distance = th.cdist(features, other_features, p=1.0).numpy()
            metric = action_bisim_metric(base_distance, nexts, other_nexts, c, tol=TOLERANCE)
            stay = agents[agents != cell]
            rows, columns = np.searchsorted(free, stay), np.searchsorted(other_free, stay)
            maps[k, stay, cell] = metric[rows, columns]
    return maps


def exact_distances(base: Encoder, obstacles: NDArray[np.bool_], c: float) -> NDArray[np.float32]:
    """Exact distances between the reachable states of a layout, (n, n) in the order of :func:`reachable`.

    :param base: the base encoder
    :param obstacles: (SIZE * SIZE,)
    :param c: weight of the recursive term
    """
    free, nexts, features = states(base, obstacles)
    rows = np.searchsorted(free, reachable(obstacles))
    base_distance = th.cdist(features, features, p=1.0).numpy()
    metric: NDArray[np.float32] = action_bisim_metric(base_distance, nexts, c=c, tol=TOLERANCE)[np.ix_(rows, rows)]
    return metric


def mean_map(maps: Maps) -> NDArray[np.float64]:
    """Mean by offset from agent to cell, (2 SIZE - 1, 2 SIZE - 1) by [dy, dx]; NaN for rare offsets.

    :param maps: (n_layouts, agent's cell, toggled cell)
    """
    offsets = np.broadcast_to(_OFFSET, maps.shape)
    seen = ~np.isnan(maps)
    n_offsets = (2 * SIZE - 1) ** 2
    counts = np.bincount(offsets[seen], minlength=n_offsets)
    sums = np.bincount(offsets[seen], weights=maps[seen], minlength=n_offsets)
    means: NDArray[np.float64] = np.divide(sums, counts, out=np.full(n_offsets, np.nan), where=counts >= MIN_SAMPLES)
    return means.reshape(2 * SIZE - 1, 2 * SIZE - 1)


def profile(maps: Maps) -> NDArray[np.float64]:
    """Mean sensitivity by distance from the agent (:data:`BINS`), relative to the nearest.

    :param maps: (n_layouts, agent's cell, toggled cell)
    """
    means = np.array([np.nanmean(maps[:, (low <= DISTANCE) & (high >= DISTANCE)]) for low, high in BINS])
    relative: NDArray[np.float64] = means / means[0]
    return relative


def step_profile(distances: list[NDArray[Any]], steps: list[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Mean distance between states so many steps apart (:data:`STEPS`), relative to the mean in their layout.

    A distance that saturates is 1 from a few steps on.

    :param distances: between the reachable states of each layout, (n, n)
    :param steps: of the shortest paths between them, (n, n)
    :return: mean over layouts, NaN where no layout has such states
    """
    sums, counts = np.zeros(len(STEPS)), np.zeros(len(STEPS))
    for distance, apart in zip(distances, steps, strict=True):
        mean = distance[apart > 0].mean()
        for i, n in enumerate(STEPS):
            if (apart == n).any():
                sums[i] += distance[apart == n].mean() / mean
                counts[i] += 1
    profile: NDArray[np.float64] = np.divide(sums, counts, out=np.full(len(STEPS), np.nan), where=counts > 0)
    return profile


class ExactReference:
    """The exact side of the comparison, computed once for a base encoder and c; then any encoder is compared with it.

    :param base: the base encoder, in evaluation mode
    :param c: weight of the recursive term
    :param env_id: an id of Nav2D
    :param n_layouts: layouts to average over, about six seconds each
    :param seed: see :func:`eval_layouts`
    """

    def __init__(
        self, base: Encoder, c: float, env_id: str = "Nav2D-v0", n_layouts: int = 10, seed: int = EVAL_SEED
    ) -> None:
        self.layouts = eval_layouts(env_id, n_layouts, seed)
        self.maps = exact_maps(base, self.layouts, c)
        self._distances = [exact_distances(base, obstacles, c) for obstacles in self.layouts]
        cells = [reachable(obstacles) for obstacles in self.layouts]
        self._steps = [
            fewest_steps(next_cells(obstacles), states)[states]
            for obstacles, states in zip(self.layouts, cells, strict=True)
        ]

    def compare(self, encoder: Encoder) -> Comparison:
        """Compare an encoder with the exact metric.

        :param encoder: any encoder of Nav2D, in evaluation mode
        """
        maps = learned_maps(encoder, self.layouts)
        learned, exact = mean_map(maps).ravel(), mean_map(self.maps).ravel()
        # Not where the agent stands, nor where too few agents have looked.
        seen = ~np.isnan(learned) & ~np.isnan(exact)
        states, distances = [], []
        for obstacles, exact_distance in zip(self.layouts, self._distances, strict=True):
            features = embed(encoder, observations(obstacles, reachable(obstacles)))
            distances.append(th.cdist(features, features, p=1.0).numpy())
            pairs = np.triu_indices(len(exact_distance), k=1)
            states.append(spearman(distances[-1][pairs], exact_distance[pairs]))
        here, there = profile(maps), profile(self.maps)
        return Comparison(
            map_correlation=spearman(learned[seen], exact[seen]),
            state_correlation=float(np.mean(states)),
            profile=tuple(here.tolist()),
            exact_profile=tuple(there.tolist()),
            profile_error=float(np.abs(here - there).max()),
            step_profile=tuple(step_profile(distances, self._steps).tolist()),
            exact_step_profile=tuple(step_profile(self._distances, self._steps).tolist()),
        )

    def terms(self, encoder: Encoder) -> dict[str, float]:
        """The comparison as numbers for a log: the ``callback`` of :func:`sb3_abisim.pretraining.pretrain.pretrain`.

        :param encoder: any encoder of Nav2D, in evaluation mode
        """
        comparison = self.compare(encoder)
        names = ("map_correlation", "state_correlation", "profile_error")
        return {f"exact/{name}": getattr(comparison, name) for name in names}


def spearman(x: NDArray[Any], y: NDArray[Any]) -> float:
    """Spearman's rank correlation; NaN if either is constant.

    :param x: (n,)
    :param y: (n,)
    """
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan")
    # Through ranks, since pandas needs SciPy for its own Spearman.
    return float(pd.Series(x).rank().corr(pd.Series(y).rank()))


def _togglable() -> NDArray[np.int64]:
    """All cells but the goal's, which never holds an obstacle."""
    return np.delete(np.arange(N_CELLS), GOAL_CELL)


def _toggled(obstacles: NDArray[np.bool_], cell: int) -> NDArray[np.bool_]:
    other = obstacles.copy()
    other[cell] ^= True
    return other
