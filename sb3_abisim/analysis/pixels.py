"""Perturbations in pixel space: point mazes rendered again from changed simulator states.

One obstacle is moved by a meter. All else stays: the agent, the other obstacles and, in Distractor PointMaze, the frame
of the clip in the background. For comparison the agent is moved by as much, the state is replaced by another one, and
(in Distractor PointMaze) the clip is swapped under the same state. Train and eval clips are looked at apart.
"""

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_abisim.analysis.nav2d_exact import check_centered, embed
from sb3_abisim.analysis.scenes import Samples, eval_settings, render_point_mazes, sample_episodes
from sb3_abisim.envs.backgrounds.clips import Backgrounds
from sb3_abisim.envs.base import batch_class
from sb3_abisim.envs.point_maze.distractors import DistractorPointMazeVectorEnv
from sb3_abisim.envs.point_maze.env import PointMazeVectorEnv
from sb3_abisim.envs.point_maze.layout import GOAL_RADIUS, OBSTACLE_PIXELS, PIXELS_PER_METER, ROOM_SIZE
from sb3_abisim.envs.point_maze.top_down import AGENT_RADIUS, DIRECTIONS
from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.encoder_file import EncoderFile

STEP = 1.0  # m, how far an obstacle or the agent is moved
# Distances in meters from the agent's center to the nearest edge of the obstacle, before or after the move.
BINS = ((0.0, 0.6), (0.6, 1.2), (1.2, 2.0), (2.0, 3.0), (3.0, 5.0), (5.0, 15.0))
MAP_REACH = 8  # m
MIN_SAMPLES = 5

_HALF = OBSTACLE_PIXELS / PIXELS_PER_METER / 2


def backgrounds_of(samples: Samples) -> NDArray[np.uint8] | None:
    """The clip frames in the background, uint8 (n, 3, 64, 64); None for environments without clips.

    :param samples: of any environment
    """
    clips = clips_of(samples)
    return None if clips is None else clips.frames(samples.factors["clip"], samples.factors["frame"])


def clips_of(samples: Samples) -> Backgrounds | None:
    """The clips that an environment shows; None for environments without.

    :param samples: of any environment
    """
    return samples.env.backgrounds if isinstance(samples.env, DistractorPointMazeVectorEnv) else None


def swapped_backgrounds(samples: Samples, generator: np.random.Generator) -> NDArray[np.uint8]:
    """Frames of another clip of the same split for each sample, uint8 (n, 3, 64, 64).

    :param samples: of an environment with clips
    :param generator: samples clip and frame
    :raises ValueError: if the split has one clip only
    """
    clips = clips_of(samples)
    assert clips is not None
    if clips.n_clips < 2:
        raise ValueError(f"{clips.source} has one clip in the split {clips.split!r}; give a second one to swap it with")
    clip = (samples.factors["clip"] + generator.integers(1, clips.n_clips, size=len(samples))) % clips.n_clips
    return clips.frames(clip, generator.integers(0, clips.lengths[clip]))


def check_point_maze(env_id: str) -> None:
    """Refuse environments whose obstacles cannot be moved.

    :param env_id: an id of a point maze
    :raises ValueError: for any other, or one whose goal is not in the center
    """
    found = batch_class(env_id)
    if found is None or not issubclass(found, PointMazeVectorEnv):
        raise ValueError(
            f"obstacles can be moved in the point mazes alone, got {env_id!r}; give an id of one such as PointMaze-v0"
        )
    check_centered(env_id)


def pixel_maps(files: dict[str, EncoderFile], env_id: str, n_states: int, seed: int = 0) -> dict[str, Any]:
    """Mean change of the embedding by where the moved obstacle is, and what other changes do.

    :param files: encoders by name
    :param env_id: an id of a point maze
    :param n_states: agents, each in a separate layout
    :param seed: of the choices
    :return: per encoder and setting (:func:`eval_settings`), in units of the mean distance between two states on the
        same background: ``map`` by offset [dy, dx] in meters from agent to obstacle, ``profile`` by distance
        (:data:`BINS`), ``agent``, and ``clip`` (None without clips)
    :raises ValueError: for another environment, or too few states
    """
    check_point_maze(env_id)
    if n_states < 2:
        raise ValueError(f"distances between states need two states or more, got {n_states}")
    encoders: dict[str, Any] = {name: {"hash": file.hash, "settings": {}} for name, file in files.items()}
    for setting, env_kwargs in eval_settings(env_id).items():
        samples = sample_episodes(env_id, n_states, 1, seed, env_kwargs)
        scenes = _scenes(samples, np.random.default_rng(seed))
        for name, file in files.items():
            encoders[name]["settings"][setting] = _changes(file.encoder.eval(), scenes)
    return {"bins": BINS, "reach": MAP_REACH, "encoders": encoders}


def _scenes(samples: Samples, generator: np.random.Generator) -> dict[str, Any]:
    """Observations of the samples and of what was changed in them."""
    agents, obstacles = samples.factors["agent"].astype(np.float64), samples.factors["obstacles"].astype(np.float64)
    backgrounds = backgrounds_of(samples)
    moves = _moves(agents, obstacles, generator)
    index = moves["state"]
    others = np.roll(np.arange(len(samples)), 1)
    nudged, who = _nudged(agents, obstacles, backgrounds, generator)
    swapped = None
    if backgrounds is not None:
        swapped = render_point_mazes(agents, obstacles, swapped_backgrounds(samples, generator))
    of_moves = None if backgrounds is None else backgrounds[index]
    return {
        "here": render_point_mazes(agents, obstacles, backgrounds),
        "others": render_point_mazes(agents[others], obstacles[others], backgrounds),
        "moved": render_point_mazes(agents[index], moves["obstacles"], of_moves),
        "nudged": nudged,
        "swapped": swapped,
        "moves": moves,
        "who": who,
    }


def _changes(encoder: Encoder, scenes: dict[str, Any]) -> dict[str, Any]:
    """The numbers of one encoder in one setting."""
    here, others, moved, nudged = (embed(encoder, scenes[key]) for key in ("here", "others", "moved", "nudged"))
    moves = scenes["moves"]
    unit = float(_l1(here, others).mean())
    change = (_l1(here[th.as_tensor(moves["state"])], moved) / unit).numpy()
    within = [(low <= moves["gap"]) & (moves["gap"] < high) for low, high in BINS]
    swapped = scenes["swapped"]
    return {
        "map": _offset_map(moves["offset"], change).tolist(),
        "profile": [float(change[chosen].mean()) if chosen.any() else None for chosen in within],
        "agent": float(_l1(here[th.as_tensor(scenes["who"])], nudged).mean()) / unit,
        "clip": None if swapped is None else float(_l1(here, embed(encoder, swapped)).mean()) / unit,
    }


def _l1(x: th.Tensor, y: th.Tensor) -> th.Tensor:
    return (x - y).abs().sum(dim=1)


def _edge_distance(agents: NDArray[np.float64], centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """From a point to the nearest point of a square obstacle, 0 inside; shapes (n, 2) to (n,)."""
    outside = np.maximum(np.abs(centers - agents) - _HALF, 0.0)
    return np.hypot(outside[:, 0], outside[:, 1])


def _moves(
    agents: NDArray[np.float64], obstacles: NDArray[np.float64], generator: np.random.Generator
) -> dict[str, NDArray[Any]]:
    """Every obstacle of every state moved in a random direction, where that is a possible state.

    An obstacle may touch neither the agent's disc nor the goal, nor leave the room.
    """
    n_states, n_obstacles = obstacles.shape[:2]
    state, which = (array.ravel() for array in np.indices((n_states, n_obstacles)))
    old = obstacles[state, which]
    new = old + STEP * DIRECTIONS[generator.integers(len(DIRECTIONS), size=len(old))]
    agent = agents[state]
    gap = np.minimum(_edge_distance(agent, old), _edge_distance(agent, new))
    possible = (_edge_distance(agent, new) > AGENT_RADIUS) & (np.abs(new).max(axis=1) <= ROOM_SIZE / 2 - _HALF)
    possible &= np.abs(new).max(axis=1) >= GOAL_RADIUS + _HALF
    if not possible.any():
        raise ValueError(f"no obstacle of {n_states} states has room to move; take more states")
    layouts = obstacles[state]
    layouts[np.arange(len(state)), which] = new
    result = {"state": state, "obstacles": layouts, "gap": gap, "offset": (old + new) / 2 - agent}
    return {name: array[possible] for name, array in result.items()}


def _nudged(
    agents: NDArray[np.float64],
    obstacles: NDArray[np.float64],
    backgrounds: NDArray[np.uint8] | None,
    generator: np.random.Generator,
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Observations with the agent moved by a step over free floor, and the states that they belong to."""
    new = agents + STEP * DIRECTIONS[generator.integers(len(DIRECTIONS), size=len(agents))]
    free = np.abs(new).max(axis=1) <= ROOM_SIZE / 2 - AGENT_RADIUS
    for k in range(obstacles.shape[1]):
        free &= _edge_distance(new, obstacles[:, k]) > AGENT_RADIUS
    if not free.any():
        raise ValueError(f"no agent of {len(agents)} states has room to move; take more states")
    who = np.flatnonzero(free)
    return render_point_mazes(new[who], obstacles[who], None if backgrounds is None else backgrounds[who]), who


def _offset_map(offsets: NDArray[np.float64], values: NDArray[Any]) -> NDArray[np.float64]:
    """Mean by offset in bins of a meter, [dy, dx] from -MAP_REACH to MAP_REACH; NaN for rare offsets."""
    bins = np.rint(offsets).astype(np.int64) + MAP_REACH
    side = 2 * MAP_REACH + 1
    inside = ((bins >= 0) & (bins < side)).all(axis=1)
    flat = bins[inside, 1] * side + bins[inside, 0]
    counts = np.bincount(flat, minlength=side**2)
    sums = np.bincount(flat, weights=values[inside], minlength=side**2)
    means: NDArray[np.float64] = np.divide(sums, counts, out=np.full(side**2, np.nan), where=counts >= MIN_SAMPLES)
    return means.reshape(side, side)
