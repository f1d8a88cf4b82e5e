"""How much an embedding changes with the observation, on Nav2D: perturbation maps, near and far, fixed structures.

Maps toggle single cells, as in :mod:`sb3_abisim.analysis.nav2d_exact`. The violins add whole 2 x 2 blocks, the
obstacles that the environment has. All changes of an embedding are L1 distances.
"""

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_abisim.analysis.nav2d_exact import (
    BINS,
    DISTANCE,
    GOAL_CELL,
    N_CELLS,
    Maps,
    embed,
    eval_layouts,
    exact_maps,
    learned_maps,
    mean_map,
    observations,
    profile,
    reachable,
)
from sb3_abisim.data.environments import make_vector_env
from sb3_abisim.envs.nav2d import LAYOUTS, OBSTACLE_SIZE, SIZE
from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.encoder_file import EncoderFile

# Regions of the violins by the larger of the two coordinate distances from the agent, in cells. The paper shows a
# figure of its regions and no numbers.
NEAR = 2
FAR = 5
KINDS = {".": "reachable", "#": "walls", "?": "out of reach"}
# Bins with fewer toggled cells of a kind than this say nothing.
MIN_PAIRS = 100

_Y, _X = np.divmod(np.arange(N_CELLS), SIZE)
# The cells of every block inside the grid, (n_blocks, OBSTACLE_SIZE squared).
_BLOCKS = np.array(
    [
        [(y + j) * SIZE + x + i for j in range(OBSTACLE_SIZE) for i in range(OBSTACLE_SIZE)]
        for y in range(SIZE - OBSTACLE_SIZE + 1)
        for x in range(SIZE - OBSTACLE_SIZE + 1)
    ]
)


def nav2d_maps(files: dict[str, EncoderFile], env_id: str, n_layouts: int) -> dict[str, Any]:
    """Mean perturbation maps and their profiles by distance.

    :param files: encoders by name
    :param env_id: an id of Nav2D
    :param n_layouts: eval layouts to average over
    """
    layouts = eval_layouts(env_id, n_layouts)
    return {"bins": BINS, "encoders": {name: _map(file, layouts) for name, file in files.items()}}


def sweep_maps(files: dict[float, EncoderFile], base: Encoder, env_id: str, n_layouts: int) -> dict[str, Any]:
    """The maps of encoders trained with several c beside those of the exact metric with the same c.

    :param files: encoders by c
    :param base: the single-step encoder of all of them
    :param env_id: an id of Nav2D
    :param n_layouts: eval layouts to average over
    """
    layouts = eval_layouts(env_id, n_layouts)
    encoders = {}
    for c, file in files.items():
        exact = exact_maps(base, layouts, c)
        there = {"exact_map": mean_map(exact).tolist(), "exact_profile": profile(exact).tolist()}
        encoders[f"c = {c:g}"] = {**_map(file, layouts), **there}
    return {"bins": BINS, "encoders": encoders}


def _map(file: EncoderFile, layouts: NDArray[np.bool_]) -> dict[str, Any]:
    maps = learned_maps(file.encoder.eval(), layouts)
    return {"hash": file.hash, "map": mean_map(maps).tolist(), "profile": profile(maps).tolist()}


def structure_maps(files: dict[str, EncoderFile], env_id: str, n_layouts: int) -> dict[str, Any]:
    """Sensitivity to each cell of a fixed structure, mean over layouts and all places that the agent can be in.

    Distance from the agent is separated from reach: ``profiles`` compare cells of each kind at like distances.

    :param files: encoders by name
    :param env_id: an id of Nav2D with a fixed layout
    :param n_layouts: eval layouts to average over
    :return: per encoder ``cells``, (15, 15), ``kinds`` (mean by kind of cell, relative to reachable cells) and
        ``profiles`` (mean by kind and distance, relative to reachable neighbors)
    :raises ValueError: for an environment without fixed structure
    """
    layouts = eval_layouts(env_id, n_layouts)
    layout = make_vector_env(env_id, 1, {}).unwrapped.layout  # type: ignore[attr-defined]
    if layout not in LAYOUTS:
        raise ValueError(f"{env_id} has no fixed structure; give an id of Nav2D with layout={' or '.join(LAYOUTS)}")
    structure = np.array([list(row) for row in LAYOUTS[layout]]).ravel()
    encoders = {}
    for name, file in files.items():
        maps = learned_maps(file.encoder.eval(), layouts)
        profiles = {label: _kind_profile(maps, structure == kind) for kind, label in KINDS.items()}
        nearest = profiles[KINDS["."]][0]
        seen = ~np.isnan(maps)
        counts = seen.sum(axis=(0, 1))
        sums = np.where(seen, maps, 0).sum(axis=(0, 1))
        # The goal is never toggled.
        means = np.divide(sums, counts, out=np.full(N_CELLS, np.nan), where=counts > 0)
        reference = np.nanmean(means[structure == "."])
        encoders[name] = {
            "hash": file.hash,
            "cells": means.reshape(SIZE, SIZE).tolist(),
            "kinds": {label: float(np.nanmean(means[structure == kind]) / reference) for kind, label in KINDS.items()},
            "profiles": {label: (values / nearest).tolist() for label, values in profiles.items()},
        }
    return {"bins": BINS, "structure": list(LAYOUTS[layout]), "encoders": encoders}


def _kind_profile(maps: Maps, cells: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean sensitivity to the ``cells`` by distance from the agent (:data:`BINS`), NaN where there are too few."""
    means = []
    for low, high in BINS:
        chosen = maps[:, (low <= DISTANCE) & (high >= DISTANCE) & cells]
        values = chosen[~np.isnan(chosen)]
        means.append(values.mean() if len(values) >= MIN_PAIRS else np.nan)
    return np.array(means)


def near_and_far(files: dict[str, EncoderFile], env_id: str, n_samples: int, seed: int = 0) -> dict[str, Any]:
    """Changes of the embedding when a 2 x 2 obstacle appears near the agent, or far from it.

    :param files: encoders by name
    :param env_id: an id of Nav2D
    :param n_samples: agents, each in a separate layout; every one sees one near and one far obstacle
    :param seed: of the choices
    :return: per encoder ``near`` and ``far``, (n_samples,), in units of the mean distance between two states that
        differ in where the agent is; ``near_share``, how often the near change is the larger; and the regions
        around one agent as ``example``
    """
    generator = np.random.default_rng(seed)
    example = None
    before: list[NDArray[np.uint8]] = []
    elsewhere: list[NDArray[np.uint8]] = []
    near: list[NDArray[np.uint8]] = []
    far: list[NDArray[np.uint8]] = []
    for obstacles in eval_layouts(env_id, n_samples):
        agents = reachable(obstacles)
        agent, other = generator.choice(agents, size=2, replace=False)
        choices = [_new_blocks(obstacles, agent, inside) for inside in (True, False)]
        if not all(len(blocks) for blocks in choices):
            continue
        changed = [_with_block(obstacles, generator.choice(blocks)) for blocks in choices]
        before.append(observations(obstacles, np.array([agent]))[0])
        elsewhere.append(observations(obstacles, np.array([other]))[0])
        for pile, layout in zip((near, far), changed, strict=True):
            pile.append(observations(layout, np.array([agent]))[0])
        if example is None:
            example = {"obstacles": obstacles.reshape(SIZE, SIZE).tolist(), "agent": [int(_X[agent]), int(_Y[agent])]}
    encoders = {}
    for name, file in files.items():
        features = [embed(file.encoder.eval(), np.array(shown)) for shown in (before, elsewhere, near, far)]
        moved, here, there = ((x - features[0]).abs().sum(dim=1).double() for x in features[1:])
        encoders[name] = {
            "hash": file.hash,
            "near": _rounded(here / moved.mean()),
            "far": _rounded(there / moved.mean()),
            "near_share": float((here > there).double().mean()),
        }
    return {"near_reach": NEAR, "far_reach": FAR, "n": len(before), "example": example, "encoders": encoders}


def _rounded(values: th.Tensor) -> list[float]:
    return [round(value, 5) for value in values.tolist()]


def _chebyshev(agent: int) -> NDArray[np.int64]:
    """The larger coordinate distance of each cell from the agent, (SIZE * SIZE,)."""
    distances: NDArray[np.int64] = np.maximum(np.abs(_X - _X[agent]), np.abs(_Y - _Y[agent]))
    return distances


def _new_blocks(obstacles: NDArray[np.bool_], agent: int, near: bool) -> NDArray[np.int64]:
    """Indices of the blocks on free cells of the near or far region, not on agent or goal."""
    distances = _chebyshev(agent)
    allowed = (distances <= NEAR) if near else (distances >= FAR)
    allowed = allowed & ~obstacles
    allowed[[agent, GOAL_CELL]] = False
    return np.flatnonzero(allowed[_BLOCKS].all(axis=1))


def _with_block(obstacles: NDArray[np.bool_], block: int) -> NDArray[np.bool_]:
    other = obstacles.copy()
    other[_BLOCKS[block]] = True
    return other
