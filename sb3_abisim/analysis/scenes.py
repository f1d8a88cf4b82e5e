"""States of new episodes, what surrounds the agent in them, and observations of states that no episode has been in."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.analysis.nav2d_exact import EVAL_SEED
from sb3_abisim.data.environments import Preprocessing, make_vector_env
from sb3_abisim.data.format import check_spaces
from sb3_abisim.data.rollout import collect_shard
from sb3_abisim.envs.backgrounds.player import composite
from sb3_abisim.envs.base import BatchEnv, batch_class, offers
from sb3_abisim.envs.nav2d import Nav2DVectorEnv
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.distractors import DistractorPointMazeVectorEnv
from sb3_abisim.envs.point_maze.env import PointMazeVectorEnv
from sb3_abisim.envs.point_maze.layout import (
    GOAL_MASK,
    OBSTACLE_PIXELS,
    PIXELS_PER_METER,
    WALL_MASK,
    static_layer,
    to_pixels,
)
from sb3_abisim.envs.scan_nav.env import ScanNavVectorEnv
from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.registry import get_traits
from sb3_abisim.zoo.preprocessing import recorded_preprocessing

# Copies collected at once; the 64 x 64 observations of a whole episode take 1.6 MB.
N_COPIES, N_SINGLE_COPIES = 50, 8
# Of an episode in an environment without a time limit, and of all observations that are held at once.
MAX_STEPS = 1000
MAX_BYTES = 2**30
# Points around the agent, this many cells, meters or steps in each direction.
LOCAL_REACH = 2


@dataclass(frozen=True)
class Samples:
    """Transitions of random play with the simulator's state at their beginning.

    :param env: the environment that they are from
    :param obs: s_t, uint8 (n, channels, height, width), stacked where encoders see stacks
    :param actions: a_t, (n,) or (n, action_dim)
    :param next_obs: s_{t+1}, as ``obs``
    :param factors: name to (n, ...); empty where the environment has none
    :param episodes: which episode, (n,); another episode is another layout, except where the environment has one only
    """

    env: Any
    obs: NDArray[np.uint8]
    actions: NDArray[Any]
    next_obs: NDArray[np.uint8]
    factors: dict[str, NDArray[Any]]
    episodes: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.obs)


def preprocessing_of(files: Mapping[str, EncoderFile]) -> Preprocessing:
    """What stood between the environment and encoders in pretraining.

    :param files: encoders by name
    :raises ValueError: if it is not the same for all, naming both sides
    """
    if not files:
        return Preprocessing()
    first, *others = files.items()
    for other in others:
        sides = [_recorded(file) for _, file in (first, other)]
        if sides[0] != sides[1]:
            raise ValueError(
                f"encoders were pretrained on different observations ({first[0]}: {sides[0]}, {other[0]}: {sides[1]}); "
                "look at one after the other"
            )
    return recorded_preprocessing(_recorded(first[1]), str(first[1].path))


def _recorded(file: EncoderFile) -> dict[str, Any]:
    # Where the channels were follows from the environment.
    return {key: value for key, value in file.metadata["preprocessing"].items() if value and key != "channels"}


def eval_settings(env_id: str, files: Mapping[str, EncoderFile] | None = None) -> dict[str, dict[str, Any]]:
    """What encoders are looked at on: name to the environment's keyword arguments. The first is that of pretraining.

    :param env_id: a registered id
    :param files: encoders by name; of an environment without splits, the arguments that they were pretrained with hold
    :raises ValueError: if these are not the same for all, naming both sides
    """
    traits, found = get_traits(env_id), batch_class(env_id)
    if {"train", "eval"} <= set(traits.splits):
        what, plain = "split", {}
        if found is not None and issubclass(found, DistractorPointMazeVectorEnv):
            what, plain = "clips", {"color_jitter": False}
        kwargs = dict(traits.collect_kwargs)
        return {f"train {what}": {**kwargs, "split": "train", **plain}, f"eval {what}": {**kwargs, "split": "eval"}}
    # Elsewhere a new episode need not be a new layout: there are five apartments.
    new_layouts = found is not None and issubclass(found, Nav2DVectorEnv | PointMazeVectorEnv)
    of_files = [(name, file.metadata) for name, file in (files or {}).items() if file.metadata["env_id"] == env_id]
    for name, metadata in of_files:
        if metadata["env_kwargs"] != of_files[0][1]["env_kwargs"]:
            raise ValueError(
                f"encoders were pretrained in {env_id} with different arguments ({of_files[0][0]}: "
                f"{of_files[0][1]['env_kwargs']}, {name}: {metadata['env_kwargs']}); look at one after the other"
            )
    kwargs = dict(of_files[0][1]["env_kwargs"] if of_files else traits.collect_kwargs)
    return {"eval layouts" if new_layouts else "eval episodes": kwargs}


def sample_episodes(
    env_id: str,
    n_episodes: int,
    per_episode: int,
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    preprocessing: Preprocessing | None = None,
) -> Samples:
    """Play new episodes at random and keep a few transitions of each.

    :param env_id: a registered id, of image observations
    :param n_episodes: at least 1
    :param per_episode: transitions sampled from each; shorter episodes give all they have
    :param seed: other seeds give other episodes; none are those of a dataset
    :param env_kwargs: passed to the environment
    :param preprocessing: what stands between the environment and its observations; None for nothing
    :raises ValueError: for ``n_episodes`` below 1, an unknown environment, or one without image observations
    """
    if n_episodes < 1:
        raise ValueError(f"the number of episodes must be at least 1, got {n_episodes}")
    # Copies that do not run as one batch may be whole simulators.
    most = N_COPIES if batch_class(env_id) is not None else N_SINGLE_COPIES
    env = make_vector_env(env_id, min(most, n_episodes), env_kwargs or {}, preprocessing)
    n_stack = 1 if preprocessing is None else preprocessing.frame_stack
    check_spaces(env.single_observation_space, env.single_action_space)
    batch = env.unwrapped
    # Segments of such environments come without observations.
    render = batch.render_factors if isinstance(batch, BatchEnv) and batch.renders_factors else None
    sequence = np.random.SeedSequence([EVAL_SEED, seed])
    generator = np.random.default_rng(sequence.spawn(1)[0])
    n_steps = (env.spec.max_episode_steps if env.spec is not None else None) or MAX_STEPS
    if render is None:
        # An episode is left where its observations would take too much memory.
        size = env.num_envs * math.prod(env.single_observation_space.shape or ())
        n_steps = min(n_steps, max(1, MAX_BYTES // size))
    rows: list[tuple[Any, ...]] = []
    n = 0
    while n < n_episodes:
        segments = collect_shard(env, n_steps, n_steps * env.num_envs, sequence.spawn(1)[0])
        for segment in segments[: n_episodes - n]:
            length = len(segment.actions)
            for t in np.sort(generator.permutation(length)[:per_episode]).tolist():
                state = {name: array[t] for name, array in segment.factors.items()}
                if render is None:
                    assert segment.frames is not None
                    obs, next_obs = (_stack(segment.frames, i, n_stack) for i in (t, t + 1))
                else:
                    obs, next_obs = render({name: array[t : t + 2] for name, array in segment.factors.items()})
                rows.append((obs, segment.actions[t], next_obs, state, n))
            n += 1
    env.close()
    observations, actions, next_observations, states, episodes = zip(*rows, strict=True)
    factors = {name: np.array([state[name] for state in states]) for name in states[0]}
    return Samples(
        batch, np.array(observations), np.array(actions), np.array(next_observations), factors, np.array(episodes)
    )


def _stack(frames: Sequence[NDArray[np.uint8]] | NDArray[np.uint8], t: int, n: int) -> NDArray[np.uint8]:
    """The n frames of an episode up to t, as ``VecFrameStack`` shows them."""
    shown = [frames[i] if i >= 0 else np.zeros_like(frames[0]) for i in range(t - n + 1, t + 1)]
    return np.concatenate(shown)


def agent_positions(samples: Samples) -> NDArray[np.float64] | None:
    """Where the agent is in the observation, (n, 2) in cells or meters; None where that is not known.

    In ScanNav the camera hangs above the goal, so that positions are from there.

    :param samples: of any environment
    """
    factors = samples.factors
    if isinstance(samples.env, ScanNavVectorEnv):
        return np.asarray(factors["agent"] - factors["goal"], dtype=np.float64)
    if isinstance(samples.env, Nav2DVectorEnv | PointMazeVectorEnv):
        return np.asarray(factors["agent"], dtype=np.float64)
    return None


def offsets_within(reach: int) -> NDArray[np.int64]:
    """(x, y) of the points around the agent, row by row, (n_points, 2).

    :param reach: points in each direction
    """
    steps = np.arange(-reach, reach + 1)
    square = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    offsets: NDArray[np.int64] = square[(square != 0).any(axis=1)]
    return offsets


def local_obstacles(samples: Samples) -> NDArray[np.bool_] | None:
    """Whether the points around the agent are blocked, by an obstacle or because they lie outside.

    Points are a cell (Nav2D), a meter (the point mazes) or a step (ScanNav) apart, up to :data:`LOCAL_REACH` in each
    direction.

    :param samples: of any environment
    :return: (n, (2 LOCAL_REACH + 1)^2 - 1), row by row; None where obstacles are not known
    """
    if not offers(type(samples.env), "blocked_around"):
        return None
    blocked: NDArray[np.bool_] = samples.env.blocked_around(samples.factors, offsets_within(LOCAL_REACH))
    return blocked


def render_point_mazes(
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
    observations = np.array([static_layer(solid) for solid in solids])
    painter = top_down.DiscPainter(top_down.AGENT_RADIUS * PIXELS_PER_METER, top_down.IMAGE_SIZE)
    centers = to_pixels(agents)
    painter.render(observations, centers)
    if backgrounds is None:
        return observations
    masks = solids | GOAL_MASK
    painter.mark(masks, centers)
    return composite(observations, masks, backgrounds.copy())
