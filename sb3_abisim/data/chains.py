"""Where the shards of a dataset come from: chains of them, each from a seed of its own.

Chain c follows from ``SeedSequence(seed, spawn_key=(c,))`` alone: at its start environments are made anew and reset,
and within it episodes run on from shard to shard. A shard that is not there is collected by stepping from the start of
its chain again.

The batched environments of this package have chains of one shard, which takes whole time limits of episodes.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from sb3_abisim.common.spaces import space_to_json
from sb3_abisim.data.copies import FIRST, EnvCopies
from sb3_abisim.data.environments import (
    VEC_ENV_KEY,
    Preprocessing,
    content_hash,
    describe_preprocessing,
    name_of,
    time_limit,
)
from sb3_abisim.data.format import (
    CHAINED_FORMAT_VERSION,
    CONTENT_HASH_KEY,
    FORMAT_VERSION,
    RENDERED_FORMAT_VERSION,
    check_spaces,
    describe_factors,
)
from sb3_abisim.data.rollout import Policy, Rollout, factors_of, renders_factors
from sb3_abisim.data.writer import Segment
from sb3_abisim.envs.base import BatchEnv

# A shard holds about this many transitions, in whole time limits of episodes where the environment has one.
SHARD_TRANSITIONS = 8192
MAX_SHARD_BYTES = 2**30
# In chains of several shards a kill loses at most this many transitions.
CHAINED_SHARD_TRANSITIONS = 1000
# Steps of each copy in a chain: a time limit, but no more than this; and where there is none.
MAX_CHAIN_STEPS = 32768
CHAIN_STEPS_WITHOUT_LIMIT = 8192


class ShardSource:
    """Where shards come from: environments, and how far they are in a chain of shards.

    :param make_fn: makes the environments
    :param env: see :func:`~sb3_abisim.data.collect.collect`
    :param env_kwargs: see :func:`~sb3_abisim.data.collect.collect`
    :param seed: see :func:`~sb3_abisim.data.collect.collect`
    :param there: what the folder was begun with, empty for a new one
    :param preprocessing: see :class:`~sb3_abisim.data.environments.Preprocessing`
    :param policy: see :func:`~sb3_abisim.data.collect.collect`
    :param one_pass: for what cannot be made again, the size of the dataset, which is one chain; else None
    """

    def __init__(
        self,
        make_fn: Callable[[], VectorEnv[Any, Any, Any]],
        env: Any,
        env_kwargs: dict[str, Any],
        seed: int,
        there: dict[str, Any],
        preprocessing: Preprocessing,
        policy: Policy | None,
        one_pass: int | None = None,
    ) -> None:
        self._policy, self._frame_stack = policy, preprocessing.frame_stack
        self._make_fn, self._seed = make_fn, seed
        self.env = made = make_fn()
        observation_space, action_space = made.single_observation_space, made.single_action_space
        check_spaces(observation_space, action_space)
        if isinstance(made.unwrapped, BatchEnv):
            made.reset(seed=seed)  # factors need a state; every chain resets again
        limit = time_limit(env, env_kwargs)
        channels = made.layout.channels if isinstance(made, EnvCopies) else FIRST
        described = describe_preprocessing(preprocessing, channels, made)
        # Datasets of before, and batches whose shards of whole time limits fit into memory.
        old = there.get("format_version") in (FORMAT_VERSION, RENDERED_FORMAT_VERSION) and not described
        whole = old or (isinstance(made.unwrapped, BatchEnv) and _fits(made, limit))
        if whole:
            self.steps, self.shards_per_chain = _steps_of_whole_limits(made, env, limit), 1
        else:
            self.steps, self.shards_per_chain = _steps_of_chain(made, limit)
        if one_pass is not None:
            self.shards_per_chain = -(-one_pass // (self.steps * made.num_envs))
        version = FORMAT_VERSION
        if renders_factors(made):
            version = RENDERED_FORMAT_VERSION
        if not whole or described:
            version = CHAINED_FORMAT_VERSION
        if version == CHAINED_FORMAT_VERSION and renders_factors(made):
            raise ValueError(
                f"{env} renders its observations from factors, in shards of whole time limits; leave frame_stack "
                "and env_wrapper out, and use fewer n_envs if its episodes do not fit into memory"
            )
        self.identity = {
            "format_version": version,
            "env_id": name_of(env, made),
            "env_kwargs": env_kwargs,
            "observation_space": space_to_json(observation_space),
            "action_space": space_to_json(action_space),
            "factors": describe_factors(factors_of(made)),
            CONTENT_HASH_KEY: content_hash(made),
            "policy": "uniform" if policy is None else f"{policy.name}, epsilon {policy.epsilon:g}",
            "seed": seed,
            "n_envs": made.num_envs,
            "steps_per_shard": self.steps,
            "source": None if one_pass is None else {"one_pass": described[VEC_ENV_KEY]},
        }
        if version == CHAINED_FORMAT_VERSION:
            self.identity |= {"shards_per_chain": self.shards_per_chain, "preprocessing": described}
        self._whole = whole
        self._rollout: Rollout | None = None
        self._next = 0

    def shard(
        self,
        k: int,
        n_transitions: int,
        advanced: Callable[[int], object],
        skips: Callable[[int], object] = lambda n: None,
    ) -> list[Segment]:
        """The segments of shard k; those before it in its chain are stepped through again where need be, once.

        :param k: number of the shard, never below that of the call before
        :param n_transitions: how many of its transitions to keep
        :param advanced: called with the number of transitions gained
        :param skips: called before steps are taken again, with the number of their transitions
        """
        chain, position = divmod(k, self.shards_per_chain)
        first = k - position
        if self._rollout is None or not first < self._next <= k:
            if self._rollout is not None and not self._whole:
                # A reset does not undo all that wrappers and simulators remember.
                self.env.close()
                self.env = self._make_fn()
            chain_seed = np.random.SeedSequence(self._seed, spawn_key=(chain,))
            self._rollout = Rollout(self.env, chain_seed, self._policy, self._frame_stack)
            self._next = first
        per_shard = self.steps * self.env.num_envs
        if self._next < k:
            skips((k - self._next) * per_shard)
        while self._next < k:
            self._rollout.skip(self.steps)
            self._next += 1
        segments = self._rollout.advance(self.steps, n_transitions, advanced)
        self._next += 1
        if n_transitions < per_shard:
            self._next = -1  # it has not run to the end of the shard
        return segments


def _row_bytes(env: VectorEnv[Any, Any, Any]) -> int:
    """Bytes of one observation, or of what it is rendered from."""
    if renders_factors(env):
        return sum(array[0].nbytes for array in factors_of(env).values())
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
