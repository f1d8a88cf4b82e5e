"""Collect transitions into a dataset: ``sb3-abisim collect --env ID -n N -o DIR``.

Shards follow each other in chains. Chain c follows from ``SeedSequence(seed, spawn_key=(c,))`` alone: at its start
environments are made anew and reset, and within it episodes run on from shard to shard. A shard that is not there is
collected by stepping from the start of its chain again. To resume after a kill, to extend a dataset and to repair a
damaged shard are therefore the same thing: collect the shards that are not there. The same command gives the same
bytes, whatever happened in between.

The batched environments of this package have chains of one shard, which takes whole time limits of episodes.
"""

import argparse
import difflib
import errno
import functools
import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from sb3_abisim.common.cli import add_trust, make_parser, parse_pairs, parse_value, run
from sb3_abisim.common.spaces import sample_actions, space_to_json
from sb3_abisim.data.copies import FIRST, EnvCopies, WorkerCopies
from sb3_abisim.data.format import (
    CHAINED_FORMAT_VERSION,
    CONFIG_NAME,
    CONTENT_HASH_KEY,
    CUT,
    FORMAT_VERSION,
    RENDERED_FORMAT_VERSION,
    TERMINATED,
    TRUNCATED,
    DatasetError,
    check_spaces,
    describe_factors,
    from_json_file,
)
from sb3_abisim.data.writer import Segment, check_folder, open_writer
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.envs.base import BatchEnv, batch_class

# A shard holds about this many transitions, in whole time limits of episodes where the environment has one.
SHARD_TRANSITIONS = 8192
MAX_SHARD_BYTES = 2**30
# In chains of several shards a kill loses at most this many transitions.
CHAINED_SHARD_TRANSITIONS = 1000
# Steps of each copy in a chain: a time limit, but no more than this; and where there is none.
MAX_CHAIN_STEPS = 32768
CHAIN_STEPS_WITHOUT_LIMIT = 8192
# Environments stepped together by default: those that run as one batch, and others.
N_BATCHED, N_COPIES = 64, 8

Wrapper = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]


@dataclass(frozen=True)
class Policy:
    """What chooses actions instead of chance.

    :param act_fn: from observations, uint8 (n_envs, C, H, W), stacked where the dataset is, to actions (n_envs, ...);
        the same observations must give the same actions
    :param name: recorded with the dataset; it should say which weights there are
    :param epsilon: probability of a uniformly random action in its place
    """

    act_fn: Callable[[NDArray[np.uint8]], NDArray[Any]]
    name: str
    epsilon: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.epsilon <= 1:
            raise ValueError(f"epsilon must be in 0..1, got {self.epsilon}")


@dataclass(frozen=True)
class Preprocessing:
    """What stands between an environment and its image observations.

    :param frame_stack: observations that are shown together, as Stable-Baselines3's ``VecFrameStack`` stacks them
    :param image_key: which key of a ``Dict`` of observations holds the image; None for the only one that does
    :param env_wrapper: as in a zoo YAML: dotted paths of wrappers, with or without arguments; JSON types
    :param wrapper: what ``env_wrapper`` names; it wraps one environment
    """

    frame_stack: int = 1
    image_key: str | None = None
    env_wrapper: Any = None
    wrapper: Wrapper | None = None


def collect(
    env_id: str | Callable[[], gym.Env[Any, Any]],
    n_transitions: int,
    folder: str | Path,
    *,
    seed: int = 0,
    n_envs: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    env_wrapper: Any = None,
    frame_stack: int = 1,
    image_key: str | None = None,
    policy: Policy | None = None,
    n_workers: int = 1,
    progress: bool = False,
) -> str:
    """Collect transitions; go on where an earlier call was stopped.

    :param env_id: a registered id, or a function that makes one environment
    :param n_transitions: size of the dataset, at least 1; a larger one than before extends it
    :param folder: new, empty, or begun with the same arguments
    :param seed: at least 0
    :param n_envs: environments stepped together; part of what determines the data. None for those of the folder, else
        64 of an environment that runs as one batch, and 8 of another
    :param env_kwargs: passed to the environment, JSON types
    :param env_wrapper: wrappers of the environment as in a zoo YAML: dotted paths, with or without arguments
    :param frame_stack: observations that readers of the dataset show together, as ``VecFrameStack`` does; each is
        stored once
    :param image_key: which key of a ``Dict`` of observations holds the image; None for the only one that does
    :param policy: chooses the actions; None for uniformly random ones
    :param n_workers: processes that step the environments, unless these run as one batch; the bytes do not depend on it
    :param progress: show a progress bar on stderr
    :return: the dataset's hash
    :raises ValueError: for mistakes in the arguments, naming the remedy
    :raises OSError: ``errno.ENOSPC`` for a full disk; the same call goes on once there is space
    """
    for name, value, least in (
        ("n_transitions", n_transitions, 1),
        ("seed", seed, 0),
        ("n_envs", 1 if n_envs is None else n_envs, 1),
        ("frame_stack", frame_stack, 1),
        ("n_workers", n_workers, 1),
    ):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    folder = Path(folder)
    check_folder(folder)
    try:
        env_kwargs, env_wrapper = json.loads(json.dumps([env_kwargs or {}, env_wrapper or None]))
    except TypeError as error:
        raise ValueError(
            f"env_kwargs and env_wrapper must be what JSON can hold ({error}), got {env_kwargs}, {env_wrapper}"
        ) from None
    if env_wrapper is not None and not isinstance(env_wrapper, list):
        env_wrapper = [env_wrapper]
    wrapper = None if env_wrapper is None else _resolve_wrapper(env_wrapper)
    preprocessing = Preprocessing(frame_stack, image_key, env_wrapper, wrapper)
    there = _identity_of(folder)
    if n_envs is None:
        n_envs = there.get("n_envs")
    make_fn = functools.partial(make_vector_env, env_id, n_envs, env_kwargs, preprocessing, n_workers)
    source = _Source(make_fn, env_id, env_kwargs, seed, there, preprocessing, policy)
    try:
        return _collect(source, n_transitions, folder, progress)
    finally:
        source.env.close()


def _identity_of(folder: Path) -> dict[str, Any]:
    """What a folder was begun with; empty for a new one."""
    try:
        return from_json_file(folder / CONFIG_NAME)
    except (FileNotFoundError, NotADirectoryError, DatasetError):
        return {}  # the writer says what is wrong


class _Source:
    """Where shards come from: environments, and how far they are in a chain of shards.

    :param make_fn: makes the environments
    :param env_id: see :func:`collect`
    :param env_kwargs: see :func:`collect`
    :param seed: see :func:`collect`
    :param there: what the folder was begun with, empty for a new one
    :param preprocessing: see :class:`Preprocessing`
    :param policy: see :func:`collect`
    """

    def __init__(
        self,
        make_fn: Callable[[], VectorEnv[Any, Any, Any]],
        env_id: str | Callable[[], gym.Env[Any, Any]],
        env_kwargs: dict[str, Any],
        seed: int,
        there: dict[str, Any],
        preprocessing: Preprocessing,
        policy: Policy | None,
    ) -> None:
        self._policy, self._frame_stack = policy, preprocessing.frame_stack
        self._make_fn, self._seed = make_fn, seed
        self.env = env = make_fn()
        observation_space, action_space = env.single_observation_space, env.single_action_space
        check_spaces(observation_space, action_space)
        if isinstance(env.unwrapped, BatchEnv):
            env.reset(seed=seed)  # factors need a state; every chain resets again
        limit = _time_limit(env_id, env_kwargs)
        channels = env.layout.channels if isinstance(env, EnvCopies) else FIRST
        described = _describe_preprocessing(preprocessing, channels, env)
        # Datasets of before, and batches whose shards of whole time limits fit into memory.
        old = there.get("format_version") in (FORMAT_VERSION, RENDERED_FORMAT_VERSION) and not described
        whole = old or (isinstance(env.unwrapped, BatchEnv) and _fits(env, limit))
        if whole:
            self.steps, self.shards_per_chain = _steps_of_whole_limits(env, env_id, limit), 1
        else:
            self.steps, self.shards_per_chain = _steps_of_chain(env, limit)
        version = FORMAT_VERSION
        if _renders_factors(env):
            version = RENDERED_FORMAT_VERSION
        if not whole or described:
            version = CHAINED_FORMAT_VERSION
        if version == CHAINED_FORMAT_VERSION and _renders_factors(env):
            raise ValueError(
                f"{env_id} renders its observations from factors, in shards of whole time limits; leave frame_stack "
                "and env_wrapper out, and use fewer n_envs if its episodes do not fit into memory"
            )
        self.identity = {
            "format_version": version,
            "env_id": env_id if isinstance(env_id, str) else _name_of(env_id),
            "env_kwargs": env_kwargs,
            "observation_space": space_to_json(observation_space),
            "action_space": space_to_json(action_space),
            "factors": describe_factors(_factors(env)),
            CONTENT_HASH_KEY: _content_hash(env),
            "policy": "uniform" if policy is None else f"{policy.name}, epsilon {policy.epsilon:g}",
            "seed": seed,
            "n_envs": env.num_envs,
            "steps_per_shard": self.steps,
            "source": None,
        }
        if version == CHAINED_FORMAT_VERSION:
            self.identity |= {"shards_per_chain": self.shards_per_chain, "preprocessing": described}
        self._whole = whole
        self._rollout: _Rollout | None = None
        self._next = 0

    def shard(self, k: int, n_transitions: int, advanced: Callable[[int], object]) -> list[Segment]:
        """The segments of shard k; those before it in its chain are stepped through again where need be.

        :param k: number of the shard
        :param n_transitions: how many of its transitions to keep
        :param advanced: called with the number of transitions gained
        """
        chain, position = divmod(k, self.shards_per_chain)
        first = k - position
        if self._rollout is None or not first < self._next <= k:
            if self._rollout is not None and not self._whole:
                # A reset does not undo all that wrappers and simulators remember.
                self.env.close()
                self.env = self._make_fn()
            chain_seed = np.random.SeedSequence(self._seed, spawn_key=(chain,))
            self._rollout = _Rollout(self.env, chain_seed, self._policy, self._frame_stack)
            self._next = first
        per_shard = self.steps * self.env.num_envs
        while self._next < k:
            self._rollout.advance(self.steps, per_shard, lambda n: None)
            self._next += 1
        segments = self._rollout.advance(self.steps, n_transitions, advanced)
        self._next += 1
        if n_transitions < per_shard:
            self._next = -1  # it has not run to the end of the shard
        return segments


def _collect(source: _Source, n_transitions: int, folder: Path, progress: bool) -> str:
    from tqdm import tqdm  # type: ignore[import-untyped, unused-ignore]

    per_shard = source.steps * source.env.num_envs
    n_shards = -(-n_transitions // per_shard)
    with (
        open_writer(folder, source.identity) as writer,
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
            writer.write_shard(k, source.shard(k, size, bar.update))
            written += 1
        hash = writer.finish(n_shards)
        ends = writer.count_ends(n_shards)
    if not ends[TERMINATED] + ends[TRUNCATED]:
        warnings.warn(
            f"no episode ends among the {n_transitions} transitions in {folder}: they show only the first "
            f"{-(-n_transitions // source.env.num_envs)} steps; use a larger -n, fewer --n-envs, or shorter episodes "
            "(--env-kwargs max_episode_steps:K)",
            stacklevel=3,
        )
    if progress:
        state = "already complete, nothing to do" if was_finished and not written else "complete"
        print(f"{folder}: {n_transitions} transitions of {source.identity['env_id']}, {state} (hash {hash[:16]})")
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
    return _Rollout(env, seed).advance(n_steps, n_transitions, advanced)


class _Rollout:
    """Environments that were reset, and the actions that they get.

    :param env: see :func:`collect_shard`
    :param seed: see :func:`collect_shard`
    :param policy: see :func:`collect`
    :param frame_stack: observations that the policy sees together
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        seed: np.random.SeedSequence,
        policy: Policy | None = None,
        frame_stack: int = 1,
    ) -> None:
        reset_seed, action_seed = seed.spawn(2)
        self._env, self._generator = env, np.random.default_rng(action_seed)
        self._observation, _ = env.reset(seed=reset_seed.generate_state(env.num_envs).tolist())
        self._policy = policy
        # Oldest first, zeros before an episode's first observation.
        self._stack = np.zeros((env.num_envs, frame_stack, *self._observation.shape[1:]), np.uint8)
        self._stack[:, -1] = self._observation

    def _choose(self, actions: NDArray[Any], by_policy: NDArray[np.bool_]) -> None:
        """Put the policy's actions in place of some random ones."""
        if self._policy is not None and by_policy.any():
            n_envs, _, _, *size = self._stack.shape
            chosen = np.asarray(self._policy.act_fn(self._stack.reshape(n_envs, -1, *size)))
            actions[by_policy] = chosen.reshape(actions.shape)[by_policy]

    def _push(self, done: NDArray[np.bool_]) -> None:
        """Move on to the observations after a step."""
        self._stack = np.roll(self._stack, -1, axis=1)
        self._stack[done] = 0
        self._stack[:, -1] = self._observation

    def advance(self, n_steps: int, n_transitions: int, advanced: Callable[[int], object]) -> list[Segment]:
        """The next ``n_steps`` of every copy as segments, copy after copy; see :func:`collect_shard`."""
        env, n_envs = self._env, self._env.num_envs
        kept = n_transitions // n_envs + (np.arange(n_envs) < n_transitions % n_envs)
        actions = sample_actions(env.single_action_space, (n_steps, n_envs), self._generator)
        by_policy = np.zeros((n_steps, n_envs), bool)
        if self._policy is not None:
            by_policy = self._generator.random((n_steps, n_envs)) >= self._policy.epsilon
        # Frames that can be rendered again are not kept.
        rendered = _renders_factors(env)
        observations, factors = [] if rendered else [self._observation], [_factors(env)]
        # Per copy: (steps taken at the episode's end, how it ended, last frame, last factors).
        endings: list[list[_Ending]] = [[] for _ in range(n_envs)]
        for t in range(kept.max()):
            self._choose(actions[t], by_policy[t])
            self._observation, _, terminated, truncated, infos = env.step(actions[t])
            if self._policy is not None:
                self._push(terminated | truncated)
            if not rendered:
                observations.append(self._observation)
            factors.append(_factors(env))
            for j in np.flatnonzero((terminated | truncated) & (t < kept)):
                last_factors = {name: infos["final_info"]["factors"][name][j] for name in factors[0]}
                end = TERMINATED if terminated[j] else TRUNCATED
                endings[j].append((t + 1, end, infos["final_obs"][j], last_factors))
            advanced(int((t < kept).sum()))
        return _cut(observations, actions, factors, endings, kept)


def _cut(
    observations: list[NDArray[np.uint8]],
    actions: NDArray[Any],
    factors: list[dict[str, NDArray[Any]]],
    endings: list[list["_Ending"]],
    kept: NDArray[np.int64],
) -> list[Segment]:
    """Segments of what copies did: per step, then per copy."""
    states = {name: np.stack([step[name] for step in factors]) for name in factors[0]}
    segments = []
    for i, n in enumerate(kept.tolist()):
        begin = 0
        if n and (not endings[i] or endings[i][-1][0] < n):
            last_frame = observations[n][i] if observations else None
            endings[i].append((n, CUT, last_frame, {name: array[n, i] for name, array in states.items()}))
        for stop, end, last_frame, last in endings[i]:
            frames = [observations[t][i] for t in range(begin, stop)] + [last_frame] if observations else None
            rows = {
                name: np.concatenate([array[begin:stop, i], np.asarray(last[name], array.dtype)[None]])
                for name, array in states.items()
            }
            segments.append(Segment(frames, actions[begin:stop, i], end, rows))
            begin = stop
    return segments


_Ending = tuple[int, int, NDArray[np.uint8] | None, dict[str, Any]]


def make_vector_env(
    env_id: str | Callable[[], gym.Env[Any, Any]],
    n_envs: int | None,
    env_kwargs: dict[str, Any],
    preprocessing: Preprocessing | None = None,
    n_workers: int = 1,
) -> VectorEnv[Any, Any, Any]:
    """Copies of an environment that reset within the step that ends an episode.

    :param env_id: a registered one, or a function that makes one environment; what is no
        :class:`~sb3_abisim.envs.base.BatchEnv`, or is wrapped, runs as :class:`~sb3_abisim.data.copies.EnvCopies`
    :param n_envs: number of copies; None for the default
    :param env_kwargs: passed to the environment
    :param preprocessing: what stands between the environment and its observations; None for nothing
    :param n_workers: processes that step copies, unless they run as one batch
    :raises ValueError: for an unknown id, or if the environment refuses ``env_kwargs``
    """
    wrapper = None if preprocessing is None else preprocessing.wrapper
    image_key = None if preprocessing is None else preprocessing.image_key
    if isinstance(env_id, str):
        spec = gym.registry.get(env_id)
        if spec is None:
            close = difflib.get_close_matches(env_id, gym.registry, n=3)
            hint = f"did you mean {' or '.join(close)}?" if close else f"known are {', '.join(ENV_IDS)}"
            raise ValueError(f"unknown environment {env_id!r}: {hint} (--packages imports what registers others)")
        make_fn = functools.partial(_make_one, functools.partial(gym.make, spec, **env_kwargs), wrapper)
    else:
        make_fn = functools.partial(_make_one, functools.partial(env_id, **env_kwargs), wrapper)
    try:
        if isinstance(env_id, str) and batch_class(env_id) is not None and wrapper is None and image_key is None:
            return gym.make_vec(env_id, n_envs or N_BATCHED, "vector_entry_point", **env_kwargs)
        make_fns = [make_fn] * (n_envs or N_COPIES)
        return EnvCopies(make_fns, image_key) if n_workers == 1 else WorkerCopies(make_fns, image_key, n_workers)
    except ValueError as error:
        if wrapper is None or preprocessing is None:
            raise
        raise ValueError(
            f"{error} (with env_wrapper {preprocessing.env_wrapper}; --env-wrapper takes the place of the zoo's)"
        ) from error
    except (TypeError, OSError, gym.error.Error) as error:
        raise ValueError(f"cannot make {env_id} with {env_kwargs}: {error}") from error


def _make_one(make_fn: Callable[[], gym.Env[Any, Any]], wrapper: Wrapper | None) -> gym.Env[Any, Any]:
    env = make_fn()
    return env if wrapper is None else wrapper(env)


def _resolve_wrapper(env_wrapper: Any) -> Wrapper:
    """What ``env_wrapper`` of a zoo YAML names."""
    from rl_zoo3.utils import get_wrapper_class  # type: ignore[import-untyped, unused-ignore]

    try:
        wrapper = get_wrapper_class({"env_wrapper": env_wrapper})
    except (ImportError, AttributeError, AssertionError, TypeError, ValueError) as error:
        raise ValueError(
            f"env_wrapper {env_wrapper!r} cannot be imported ({error}); give dotted paths of wrappers as in a zoo YAML"
        ) from error
    assert wrapper is not None
    return wrapper


def _name_of(make_fn: Callable[[], gym.Env[Any, Any]]) -> str:
    return f"{make_fn.__module__}:{getattr(make_fn, '__qualname__', type(make_fn).__qualname__)}"


def _factors(env: VectorEnv[Any, Any, Any]) -> dict[str, NDArray[Any]]:
    unwrapped = env.unwrapped
    return unwrapped.factors() if isinstance(unwrapped, BatchEnv | EnvCopies) else {}


def _renders_factors(env: VectorEnv[Any, Any, Any]) -> bool:
    unwrapped = env.unwrapped
    return isinstance(unwrapped, BatchEnv) and unwrapped.renders_factors


def _content_hash(env: VectorEnv[Any, Any, Any]) -> str | None:
    copies = getattr(env.unwrapped, "envs", None)
    value = getattr(copies[0].unwrapped if copies else env.unwrapped, "content_hash", None)
    return None if value is None else str(value)


def _time_limit(env_id: str | Callable[[], gym.Env[Any, Any]], env_kwargs: dict[str, Any]) -> int:
    """Steps of an episode at most; 0 for no limit that Gymnasium knows."""
    registered = gym.registry[env_id].max_episode_steps if isinstance(env_id, str) else None
    # -1 is Gymnasium's word for none; it refuses other numbers below 1.
    return max(0, int(env_kwargs.get("max_episode_steps") or registered or 0))


def _describe_preprocessing(
    preprocessing: Preprocessing, channels: str, env: VectorEnv[Any, Any, Any]
) -> dict[str, Any]:
    """What is recorded of it: only what is there, so that older datasets keep their hashes."""
    n, shape = preprocessing.frame_stack, env.single_observation_space.shape or ()
    if n > 1 and n * shape[0] > min(shape[1:]):
        raise ValueError(
            f"a stack of {n} observations of shape {shape} has more channels than rows or columns, and "
            "Stable-Baselines3 would take them for those; stack fewer, or enlarge the observations "
            "(gymnasium.wrappers.ResizeObservation)"
        )
    described: dict[str, Any] = {}
    if channels != FIRST:
        described["channels"] = channels
    if n > 1:
        described["frame_stack"] = n
    if preprocessing.env_wrapper is not None:
        described["env_wrapper"] = preprocessing.env_wrapper
    if isinstance(env, EnvCopies) and env.layout.key is not None:
        described["image_key"] = env.layout.key
    return described


def _row_bytes(env: VectorEnv[Any, Any, Any]) -> int:
    """Bytes of one observation, or of what it is rendered from."""
    if _renders_factors(env):
        return sum(array[0].nbytes for array in _factors(env).values())
    return math.prod(env.single_observation_space.shape or ())


def _fits(env: VectorEnv[Any, Any, Any], limit: int) -> bool:
    """Whether a shard of one time limit may be in memory."""
    return env.num_envs * max(1, limit) * _row_bytes(env) <= MAX_SHARD_BYTES


def _steps_of_whole_limits(env: VectorEnv[Any, Any, Any], env_id: Any, limit: int) -> int:
    """Steps of each copy: whole time limits, so that late stages of episodes are seen as often as early ones."""
    whole, row = max(1, limit), _row_bytes(env)
    steps = max(1, min(SHARD_TRANSITIONS, MAX_SHARD_BYTES // row) // (env.num_envs * whole)) * whole
    if not _fits(env, limit):
        most = MAX_SHARD_BYTES // (whole * row)
        remedy = f"use --n-envs {most} or fewer" if most else "use shorter ones: --env-kwargs max_episode_steps:K"
        raise ValueError(
            f"a shard of {env.num_envs} episodes of {whole} steps would take "
            f"{steps * env.num_envs * row / 2**30:.1f} GiB of memory, more than {MAX_SHARD_BYTES / 2**30:.1f}; {remedy}"
        )
    if limit < 1:
        warnings.warn(
            f"{env_id} has no time limit, so that each episode is left after {steps} steps; if its episodes last "
            "longer, give one (--env-kwargs max_episode_steps:K) or fewer --n-envs",
            stacklevel=4,
        )
    return steps


def _steps_of_chain(env: VectorEnv[Any, Any, Any], limit: int) -> tuple[int, int]:
    """Steps of each copy in a shard, and shards of a chain: a whole time limit, so that late stages are seen."""
    most = min(CHAINED_SHARD_TRANSITIONS, MAX_SHARD_BYTES // _row_bytes(env))
    steps = max(1, most // env.num_envs)
    return steps, -(-min(limit or CHAIN_STEPS_WITHOUT_LIMIT, MAX_CHAIN_STEPS) // steps)


EntryFn = Callable[[str, str | None], dict[str, Any]]
PolicyFn = Callable[[str, float, bool], Policy]


def main(argv: Sequence[str] | None = None, entry_fn: EntryFn | None = None, policy_fn: PolicyFn | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its arguments; None for those of the process
    :param entry_fn: from an id and ``--conf-file`` to ``env_wrapper``, ``frame_stack`` and ``env_kwargs``, which flags
        override; None for nothing
    :param policy_fn: from ``--policy``, ``--epsilon`` and ``--trust`` to a policy; None where there is none but chance
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
    parser.add_argument(
        "--n-envs", type=int,
        help=f"environments stepped together (default: {N_BATCHED} that run as one batch, {N_COPIES} others)",
    )  # fmt: skip
    parser.add_argument(
        "--n-workers", type=int, default=1,
        help="processes that step the environments; the data do not depend on it (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--env-kwargs", nargs="+", action="extend", default=[], metavar="NAME:VALUE",
        help="keyword arguments of the environment, such as continuous:true",
    )  # fmt: skip
    parser.add_argument(
        "--env-wrapper", nargs="+", action="extend", default=[], metavar="CLASS",
        help="dotted paths of wrappers, such as gymnasium.wrappers.GrayscaleObservation, or none (default: the zoo's "
        "for ID)",
    )  # fmt: skip
    parser.add_argument(
        "--frame-stack", type=int, metavar="N", help="observations shown together (default: the zoo's for ID, else 1)"
    )
    parser.add_argument(
        "--conf-file", metavar="FILE",
        help="zoo YAML whose env_wrapper, frame_stack and env_kwargs for ID hold (default: rl-zoo3's own)",
    )  # fmt: skip
    parser.add_argument(
        "--image-key", metavar="KEY", help="which of a Dict of observations is the image (default: the only one)"
    )
    if policy_fn is not None:
        parser.add_argument(
            "--policy", default="random", metavar="RUN",
            help="who acts: random, a run's folder (its final model) or a model's .zip in one (default: %(default)s)",
        )  # fmt: skip
        parser.add_argument(
            "--epsilon", type=float, default=0.0,
            help="probability of a random action in place of the policy's (default: %(default)s)",
        )  # fmt: skip
        add_trust(parser)
    parser.set_defaults(entry_fn=entry_fn, policy_fn=policy_fn)
    run(parser, argv, _command, "stopped; finished shards are kept, the same command goes on from there")


def _command(args: argparse.Namespace) -> None:
    # An unknown id is refused below.
    known = args.entry_fn is not None and args.env in gym.registry
    entry = args.entry_fn(args.env, args.conf_file) if known else {}
    env_kwargs = {**(entry.get("env_kwargs") or {}), **parse_pairs(args.env_kwargs, "--env-kwargs")}
    wrappers, policy = [parse_value(text) for text in args.env_wrapper], None
    if args.policy_fn is not None and args.policy != "random":
        policy = args.policy_fn(args.policy, args.epsilon, args.trust)
    try:
        collect(
            args.env,
            args.n,
            args.output,
            seed=args.seed,
            n_envs=args.n_envs,
            env_kwargs=env_kwargs,
            env_wrapper=None if args.env_wrapper == ["none"] else wrappers or entry.get("env_wrapper"),
            frame_stack=entry.get("frame_stack", 1) if args.frame_stack is None else args.frame_stack,
            image_key=args.image_key,
            policy=policy,
            n_workers=args.n_workers,
            progress=True,
        )
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise OSError(
            f"no space left for {args.output}: {error.strerror}; finished shards are kept: free some space and run the "
            "same command again"
        ) from error
