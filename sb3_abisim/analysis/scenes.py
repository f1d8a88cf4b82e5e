"""States of fresh episodes, what surrounds the agent in them, and pictures of states that no episode has been in."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.analysis.nav2d_exact import HELD_OUT_SEED
from sb3_abisim.data.collect import collect_shard, make_vector_env
from sb3_abisim.envs.backgrounds.player import composite
from sb3_abisim.envs.base import BatchEnv
from sb3_abisim.envs.nav2d import SIZE
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.env import ROOM_SIZE
from sb3_abisim.envs.point_maze.layout import (
    GOAL_MASK,
    OBSTACLE_PIXELS,
    PIXELS_PER_METER,
    WALL_MASK,
    static_layer,
    to_pixels,
)
from sb3_abisim.envs.scan_nav.apartment import SEEDS
from sb3_abisim.envs.scan_nav.map import ScanMap

# Copies collected at once; 64 x 64 pictures of a whole episode take 1.6 MB.
N_COPIES = 50
# Points around the agent, this many cells, meters or steps in each direction.
LOCAL_REACH = 2
SCAN_STEP = 0.25  # m, ScanNav's step forward
_HALF_OBSTACLE = OBSTACLE_PIXELS / PIXELS_PER_METER / 2


@dataclass(frozen=True)
class Samples:
    """Transitions of random play with the simulator's state at their beginning.

    :param frames: s_t, uint8 (n, channels, height, width)
    :param actions: a_t, (n,) or (n, action_dim)
    :param next_frames: s_{t+1}, as ``frames``
    :param factors: name to (n, ...)
    :param episodes: which episode, (n,); another episode is another layout, except where the environment has one only
    """

    frames: NDArray[np.uint8]
    actions: NDArray[Any]
    next_frames: NDArray[np.uint8]
    factors: dict[str, NDArray[Any]]
    episodes: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.frames)


def sample_episodes(
    env_id: str, n_episodes: int, per_episode: int, seed: int = 0, env_kwargs: dict[str, Any] | None = None
) -> Samples:
    """Play fresh episodes at random and keep a few transitions of each.

    :param env_id: a registered id of ours
    :param n_episodes: at least 1
    :param per_episode: transitions drawn from each; shorter episodes give all they have
    :param seed: other seeds give other episodes; none are those of a dataset
    :param env_kwargs: passed to the environment
    :raises ValueError: for ``n_episodes`` below 1, or an unknown environment
    """
    if n_episodes < 1:
        raise ValueError(f"the number of episodes must be at least 1, got {n_episodes}")
    env = make_vector_env(env_id, min(N_COPIES, n_episodes), env_kwargs or {})
    batch = env.unwrapped
    # Segments of such environments come without frames.
    draw = batch.draw if isinstance(batch, BatchEnv) and batch.draws_factors else None
    limit = env.spec.max_episode_steps if env.spec is not None else None
    assert limit is not None, "ours have a time limit"
    sequence = np.random.SeedSequence([HELD_OUT_SEED, seed])
    generator = np.random.default_rng(sequence.spawn(1)[0])
    rows: list[tuple[Any, ...]] = []
    n = 0
    while n < n_episodes:
        segments = collect_shard(env, limit, limit * env.num_envs, sequence.spawn(1)[0])
        for segment in segments[: n_episodes - n]:
            length = len(segment.actions)
            for t in np.sort(generator.permutation(length)[:per_episode]).tolist():
                state = {name: array[t] for name, array in segment.factors.items()}
                if draw is None:
                    assert segment.frames is not None
                    now, later = segment.frames[t], segment.frames[t + 1]
                else:
                    now, later = draw({name: array[t : t + 2] for name, array in segment.factors.items()})
                rows.append((now, segment.actions[t], later, state, n))
            n += 1
    env.close()
    frames, actions, next_frames, states, episodes = zip(*rows, strict=True)
    factors = {name: np.array([state[name] for state in states]) for name in states[0]}
    return Samples(np.array(frames), np.array(actions), np.array(next_frames), factors, np.array(episodes))


def position_in_picture(factors: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Where the agent is, (n, 2) in cells or meters; in ScanNav, whose camera hangs above the goal, from the goal.

    :param factors: of :class:`Samples`
    """
    agents = factors["agent"] - factors["goal"] if "scene" in factors else factors["agent"]
    return np.asarray(agents, dtype=np.float64)


def local_obstacles(factors: dict[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Whether the points around the agent are blocked, by an obstacle or because they lie outside.

    Points are a cell (Nav2D), a meter (the point mazes) or a step (the built-in flats of ScanNav) apart, up to
    :data:`LOCAL_REACH` in each direction.

    :param factors: of :class:`Samples`
    :return: (n, (2 LOCAL_REACH + 1)^2 - 1), row by row
    """
    steps = np.arange(-LOCAL_REACH, LOCAL_REACH + 1)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    offsets = offsets[(offsets != 0).any(axis=1)]
    if "scene" in factors:
        return _blocked_in_flats(factors["agent"][:, None] + SCAN_STEP * offsets, factors["scene"])
    points = factors["agent"][:, None] + offsets
    obstacles = factors["obstacles"]
    if obstacles.dtype == bool:
        outside = ((points < 0) | (points >= SIZE)).any(axis=-1)
        x, y = np.moveaxis(np.clip(points, 0, SIZE - 1), -1, 0)
        blocked: NDArray[np.bool_] = outside | obstacles[np.arange(len(points))[:, None], y, x]
        return blocked
    outside = (np.abs(points) > ROOM_SIZE / 2).any(axis=-1)
    within = (np.abs(points[:, :, None] - obstacles[:, None]) < _HALF_OBSTACLE).all(axis=-1)
    blocked = outside | within.any(axis=-1)
    return blocked


def _blocked_in_flats(points: NDArray[Any], scenes: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether an agent's center cannot be at (x, y) in m, (n, m, 2), of the flats (n,)."""
    blocked = np.ones(points.shape[:2], dtype=bool)
    for k in np.unique(scenes).tolist():
        scan = ScanMap.apartment(SEEDS[k])
        here = scenes == k
        column = np.floor((points[here, :, 0] - scan.origin[0]) / scan.meters_per_pixel).astype(np.int64)
        row = np.floor((scan.origin[1] - points[here, :, 1]) / scan.meters_per_pixel).astype(np.int64)
        height, width = scan.walkable.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        walkable = scan.walkable[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        blocked[here] = ~(inside & walkable)
    return blocked


def draw_point_mazes(
    agents: NDArray[Any], obstacles: NDArray[Any], backgrounds: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Observations of the point mazes from simulator states, byte for byte those of the environments.

    (Factors hold positions as float32; their rounding can change the agent's edge by two gray levels.)

    :param agents: (x, y) in meters, (n, 2)
    :param obstacles: (x, y) of their centers in meters, on the pixel grid, (n, n_obstacles, 2)
    :param backgrounds: what the floor shows, uint8 (n, 3, 64, 64); None for plain floor
    :return: uint8 (n, 3, 64, 64)
    """
    corners = np.rint(to_pixels(obstacles) - OBSTACLE_PIXELS / 2).astype(np.int64)
    solids = np.repeat(WALL_MASK[None], len(agents), axis=0)
    for solid, places in zip(solids, corners.tolist(), strict=True):
        for column, row in places:
            solid[row : row + OBSTACLE_PIXELS, column : column + OBSTACLE_PIXELS] = True
    pictures = np.array([static_layer(solid) for solid in solids])
    painter = top_down.DiscPainter(top_down.AGENT_RADIUS * PIXELS_PER_METER, top_down.IMAGE_SIZE)
    centers = to_pixels(agents)
    painter.draw(pictures, centers)
    if backgrounds is None:
        return pictures
    masks = solids | GOAL_MASK
    painter.mark(masks, centers)
    return composite(pictures, masks, backgrounds.copy())
