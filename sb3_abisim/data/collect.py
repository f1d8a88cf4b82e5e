"""Collect random-action transitions into a dataset: ``sb3-abisim collect --env ID -n N -o DIR``.

Shard k follows from ``SeedSequence(seed, spawn_key=(k,))`` alone: environments are reset at its start, and actions are
uniform. To resume after a kill, to extend a dataset and to repair a damaged shard are therefore the same thing: collect
the shards that are not there. The same command gives the same bytes, whatever happened in between.
"""

import argparse
import difflib
import errno
import json
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from sb3_abisim.common.cli import make_parser, parse_pairs, run
from sb3_abisim.common.spaces import sample_actions, space_to_json
from sb3_abisim.data.format import (
    CONTENT_HASH_KEY,
    CUT,
    FORMAT_VERSION,
    RENDERED_FORMAT_VERSION,
    TERMINATED,
    TRUNCATED,
    check_spaces,
    describe_factors,
)
from sb3_abisim.data.writer import Segment, check_folder, open_writer
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.envs.base import BatchEnv, batch_class

# A shard holds about this many transitions, in whole time limits of episodes where the environment has one.
SHARD_TRANSITIONS = 8192
MAX_SHARD_BYTES = 2**30


def collect(
    env_id: str,
    n_transitions: int,
    folder: str | Path,
    *,
    seed: int = 0,
    n_envs: int = 64,
    env_kwargs: dict[str, Any] | None = None,
    progress: bool = False,
) -> str:
    """Collect transitions under uniformly random actions; go on where an earlier call was stopped.

    :param env_id: a registered id
    :param n_transitions: size of the dataset, at least 1; a larger one than before extends it
    :param folder: new, empty, or begun with the same arguments
    :param seed: at least 0
    :param n_envs: environments stepped together; part of what determines the data
    :param env_kwargs: passed to the environment, JSON types
    :param progress: show a progress bar on stderr
    :return: the dataset's hash
    :raises ValueError: for mistakes in the arguments, naming the remedy
    :raises OSError: ``errno.ENOSPC`` for a full disk; the same call goes on once there is space
    """
    for name, value, least in (("n_transitions", n_transitions, 1), ("seed", seed, 0), ("n_envs", n_envs, 1)):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    folder = Path(folder)
    check_folder(folder)
    try:
        env_kwargs = json.loads(json.dumps(env_kwargs or {}))
    except TypeError as error:
        raise ValueError(f"env_kwargs must be what JSON can hold ({error}), got {env_kwargs}") from None
    env = make_vector_env(env_id, n_envs, env_kwargs)
    try:
        return _collect(env, env_id, env_kwargs, n_transitions, folder, seed, progress)
    finally:
        env.close()


def _collect(
    env: VectorEnv[Any, Any, Any],
    env_id: str,
    env_kwargs: dict[str, Any],
    n_transitions: int,
    folder: Path,
    seed: int,
    progress: bool,
) -> str:
    from tqdm import tqdm  # type: ignore[import-untyped, unused-ignore]

    observation_space, action_space = env.single_observation_space, env.single_action_space
    check_spaces(observation_space, action_space)
    env.reset(seed=seed)  # factors need a state; every shard resets again
    steps = _steps_per_shard(env, env_id, env_kwargs)
    identity = {
        "format_version": RENDERED_FORMAT_VERSION if _renders_factors(env) else FORMAT_VERSION,
        "env_id": env_id,
        "env_kwargs": env_kwargs,
        "observation_space": space_to_json(observation_space),
        "action_space": space_to_json(action_space),
        "factors": describe_factors(_factors(env)),
        CONTENT_HASH_KEY: _content_hash(env),
        "policy": "uniform",
        "seed": seed,
        "n_envs": env.num_envs,
        "steps_per_shard": steps,
        "source": None,
    }
    per_shard = steps * env.num_envs
    n_shards = -(-n_transitions // per_shard)
    with (
        open_writer(folder, identity) as writer,
        tqdm(total=n_transitions, unit=" transitions", unit_scale=True, disable=not progress) as bar,
    ):
        if writer.n_transitions() > n_transitions:
            raise ValueError(
                f"{folder} already holds {writer.n_transitions()} transitions, more than {n_transitions}; "
                "ask for at least as many, or name a new folder"
            )
        was_finished, written = writer.is_finished, 0
        for k in range(n_shards):
            size = min(per_shard, n_transitions - k * per_shard)
            if writer.has_shard(k, size):
                bar.update(size)
                bar.initial = getattr(bar, "initial", 0) + size  # keeps the rate that of new transitions
                continue
            shard_seed = np.random.SeedSequence(seed, spawn_key=(k,))
            writer.write_shard(k, collect_shard(env, steps, size, shard_seed, bar.update))
            written += 1
        hash = writer.finish(n_shards)
    if progress:
        state = "already complete, nothing to do" if was_finished and not written else "complete"
        print(f"{folder}: {n_transitions} transitions of {env_id}, {state} (hash {hash[:16]})")
    return hash


def collect_shard(
    env: VectorEnv[Any, Any, Any],
    n_steps: int,
    n_transitions: int,
    seed: np.random.SeedSequence,
    advanced: Callable[[int], object] = lambda n: None,
) -> list[Segment]:
    """Run every copy for ``n_steps`` and cut what happened into segments, copy after copy.

    :param env: with ``AutoresetMode.SAME_STEP``; it is reset
    :param n_steps: of a full shard
    :param n_transitions: how many to keep: every copy's first ones, copies sharing them evenly
    :param seed: determines resets and actions
    :param advanced: called with the number of transitions gained
    """
    n_envs = env.num_envs
    kept = n_transitions // n_envs + (np.arange(n_envs) < n_transitions % n_envs)
    reset_seed, action_seed = seed.spawn(2)
    actions = sample_actions(env.single_action_space, (n_steps, n_envs), np.random.default_rng(action_seed))
    observation, _ = env.reset(seed=reset_seed.generate_state(n_envs).tolist())
    # Frames that can be rendered again are not kept.
    rendered = _renders_factors(env)
    observations, factors = [] if rendered else [observation], [_factors(env)]
    # Per copy: (steps taken at the episode's end, how it ended, last frame, last factors).
    endings: list[list[_Ending]] = [[] for _ in range(n_envs)]
    for t in range(kept.max()):
        observation, _, terminated, truncated, infos = env.step(actions[t])
        if not rendered:
            observations.append(observation)
        factors.append(_factors(env))
        for j in np.flatnonzero((terminated | truncated) & (t < kept)):
            last_factors = {name: infos["final_info"]["factors"][name][j] for name in factors[0]}
            end = TERMINATED if terminated[j] else TRUNCATED
            endings[j].append((t + 1, end, infos["final_obs"][j], last_factors))
        advanced(int((t < kept).sum()))
    states = {name: np.stack([step[name] for step in factors]) for name in factors[0]}
    segments = []
    for i, n in enumerate(kept.tolist()):
        begin = 0
        if n and (not endings[i] or endings[i][-1][0] < n):
            last_frame = None if rendered else observations[n][i]
            endings[i].append((n, CUT, last_frame, {name: array[n, i] for name, array in states.items()}))
        for stop, end, last_frame, last in endings[i]:
            frames = None if rendered else [observations[t][i] for t in range(begin, stop)] + [last_frame]
            rows = {
                name: np.concatenate([array[begin:stop, i], np.asarray(last[name], array.dtype)[None]])
                for name, array in states.items()
            }
            segments.append(Segment(frames, actions[begin:stop, i], end, rows))
            begin = stop
    return segments


_Ending = tuple[int, int, NDArray[np.uint8] | None, dict[str, Any]]


def make_vector_env(env_id: str, n_envs: int, env_kwargs: dict[str, Any]) -> VectorEnv[Any, Any, Any]:
    """Copies of a registered environment that reset within the step that ends an episode.

    :param env_id: a registered one; those that are no :class:`~sb3_abisim.envs.base.BatchEnv` run as a
        ``SyncVectorEnv``
    :param n_envs: number of copies
    :param env_kwargs: passed to the environment
    :raises ValueError: for an unknown id, or if the environment refuses ``env_kwargs``
    """
    spec = gym.registry.get(env_id)
    if spec is None:
        close = difflib.get_close_matches(env_id, gym.registry, n=3)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known are {', '.join(ENV_IDS)}"
        raise ValueError(f"unknown environment {env_id!r}: {hint} (--packages imports what registers others)")
    try:
        if batch_class(env_id) is not None:
            return gym.make_vec(env_id, n_envs, "vector_entry_point", **env_kwargs)
        same_step = {"autoreset_mode": AutoresetMode.SAME_STEP}
        wrappers = (_copy_observations,)
        return gym.make_vec(env_id, n_envs, "sync", vector_kwargs=same_step, wrappers=wrappers, **env_kwargs)
    except (TypeError, OSError, gym.error.Error) as error:
        raise ValueError(f"cannot make {env_id} with {env_kwargs}: {error}") from error


def _copy_observations(env: gym.Env[Any, Any]) -> gym.Wrapper[Any, Any, Any, Any]:
    """For environments that write into the array that they returned before: its last frame would be the next first."""
    return gym.wrappers.TransformObservation(env, np.copy, env.observation_space)


def _factors(env: VectorEnv[Any, Any, Any]) -> dict[str, NDArray[Any]]:
    unwrapped = env.unwrapped
    return unwrapped.factors() if isinstance(unwrapped, BatchEnv) else {}


def _renders_factors(env: VectorEnv[Any, Any, Any]) -> bool:
    unwrapped = env.unwrapped
    return isinstance(unwrapped, BatchEnv) and unwrapped.renders_factors


def _content_hash(env: VectorEnv[Any, Any, Any]) -> str | None:
    copies = getattr(env.unwrapped, "envs", None)
    value = getattr(copies[0].unwrapped if copies else env.unwrapped, "content_hash", None)
    return None if value is None else str(value)


def _steps_per_shard(env: VectorEnv[Any, Any, Any], env_id: str, env_kwargs: dict[str, Any]) -> int:
    """Steps of each copy: whole time limits, so that late stages of episodes are seen as often as early ones."""
    spec = gym.registry[env_id]
    given = int(env_kwargs.get("max_episode_steps") or spec.max_episode_steps or 0)
    limit = max(1, given)  # -1 is Gymnasium's word for none; it refuses other numbers below 1
    row = math.prod(env.single_observation_space.shape or ())
    if _renders_factors(env):
        row = sum(array[0].nbytes for array in _factors(env).values())
    steps = max(1, min(SHARD_TRANSITIONS, MAX_SHARD_BYTES // row) // (env.num_envs * limit)) * limit
    if steps * env.num_envs * row > MAX_SHARD_BYTES:
        most = MAX_SHARD_BYTES // (limit * row)
        remedy = f"use --n-envs {most} or fewer" if most else "use shorter ones: --env-kwargs max_episode_steps:K"
        raise ValueError(
            f"a shard of {env.num_envs} episodes of {limit} steps would take "
            f"{steps * env.num_envs * row / 2**30:.1f} GiB of memory, more than {MAX_SHARD_BYTES / 2**30:.1f}; {remedy}"
        )
    if given < 1:
        warnings.warn(
            f"{env_id} has no time limit, so that each episode is left after {steps} steps; if its episodes last "
            "longer, give one (--env-kwargs max_episode_steps:K) or fewer --n-envs",
            stacklevel=4,
        )
    return steps


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its arguments; None for those of the process
    """
    parser = make_parser(
        "collect",
        "Collect random-action transitions into a dataset folder. Killed at any moment, the same command "
        "goes on and ends with the same bytes; a larger -n extends the dataset.",
        "collect --env PointMaze-v0 -n 200000 -o data/pointmaze",
    )
    parser.add_argument("--env", required=True, metavar="ID", help="environment id, such as DistractorPointMaze-v0")
    parser.add_argument("-n", type=int, required=True, metavar="N", help="number of transitions")
    parser.add_argument("-o", "--output", required=True, metavar="DIR", help="the dataset's folder")
    parser.add_argument("--seed", type=int, default=0, help="of resets and actions (default: %(default)s)")
    parser.add_argument("--n-envs", type=int, default=64, help="environments stepped together (default: %(default)s)")
    parser.add_argument(
        "--env-kwargs", nargs="+", action="extend", default=[], metavar="NAME:VALUE",
        help="keyword arguments of the environment, such as continuous:true",
    )  # fmt: skip
    run(parser, argv, _command, "stopped; finished shards are kept, the same command goes on from there")


def _command(args: argparse.Namespace) -> None:
    env_kwargs = parse_pairs(args.env_kwargs, "--env-kwargs")
    try:
        collect(args.env, args.n, args.output, seed=args.seed, n_envs=args.n_envs, env_kwargs=env_kwargs, progress=True)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise OSError(
            f"no space left for {args.output}: {error.strerror}; finished shards are kept: free some space and run the "
            "same command again"
        ) from error
