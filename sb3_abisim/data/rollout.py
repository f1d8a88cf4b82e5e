"""Steps environments and cuts what happened into segments, under random actions or a policy's."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from sb3_abisim.common.spaces import sample_actions
from sb3_abisim.data.copies import EnvCopies, describe_array
from sb3_abisim.data.format import CUT, TERMINATED, TRUNCATED
from sb3_abisim.data.writer import Segment
from sb3_abisim.envs.base import BatchEnv

_Ending = tuple[int, int, NDArray[np.uint8] | None, dict[str, Any]]


@dataclass(frozen=True)
class Policy:
    """What chooses actions instead of chance.

    :param act_fn: from observations, uint8 (n_envs, C, H, W), stacked where the dataset is, to actions (n_envs, ...);
        the same observations must give the same actions
    :param name: recorded with the dataset; it should say which weights there are
    :param epsilon: probability of a uniformly random action in its place
    :param action_space: of its actions; None where that is not known
    """

    act_fn: Callable[[NDArray[np.uint8]], NDArray[Any]]
    name: str
    epsilon: float = 0.0
    action_space: gym.Space[Any] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.epsilon <= 1:
            raise ValueError(f"epsilon must be in 0..1, got {self.epsilon}")

    def require_actions(self, space: gym.Space[Any]) -> None:
        """Refuse an environment whose actions the policy does not choose.

        :param space: of one environment's actions
        :raises ValueError: with both sides
        """
        if self.action_space is not None and self.action_space != space:
            raise ValueError(
                f"{self.name} chooses from {self.action_space}, and the environment takes {space}; give the policy's "
                "environment, with its --env-kwargs and --env-wrapper"
            )


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
    return Rollout(env, seed).advance(n_steps, n_transitions, advanced)


class Rollout:
    """Environments that were reset, and the actions that they get.

    :param env: see :func:`collect_shard`
    :param seed: see :func:`collect_shard`
    :param policy: see :func:`~sb3_abisim.data.collect.collect`
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
        self._require_declared(self._observation, env.num_envs)
        self._policy = policy
        # Oldest first, zeros before an episode's first observation.
        self._stack = np.zeros((env.num_envs, frame_stack, *self._observation.shape[1:]), np.uint8)
        self._stack[:, -1] = self._observation

    def _require_declared(self, observations: Any, n: int) -> None:
        """Refuse batches that are not what they declare; copies look at each observation by themselves."""
        space = self._env.single_observation_space
        array = np.asarray(observations)
        if array.dtype != np.uint8 or array.shape != (n, *(space.shape or ())):
            spec = self._env.unwrapped.spec
            name = type(self._env.unwrapped).__name__ if spec is None else spec.id
            raise ValueError(
                f"{name} declares observations as {space} of {n} copies, but returned "
                f"{describe_array(array)}; make them what the observation space declares, or correct the space"
            )

    def _choose(self, actions: NDArray[Any], by_policy: NDArray[np.bool_]) -> None:
        """Put the policy's actions in place of some random ones."""
        if self._policy is not None and by_policy.any():
            n_envs, _, _, *size = self._stack.shape
            chosen = np.asarray(self._policy.act_fn(self._stack.reshape(n_envs, -1, *size)))
            self._policy.require_actions(self._env.single_action_space)
            if chosen.size != actions.size:
                raise ValueError(
                    f"{self._policy.name} chose actions of shape {chosen.shape} for {n_envs} environments that take "
                    f"{self._env.single_action_space}; let it choose one for each of them"
                )
            actions[by_policy] = chosen.reshape(actions.shape)[by_policy]

    def _push(self, done: NDArray[np.bool_]) -> None:
        """Move on to the observations after a step."""
        self._stack = np.roll(self._stack, -1, axis=1)
        self._stack[done] = 0
        self._stack[:, -1] = self._observation

    def _sample(self, n_steps: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Random actions of the next steps, and which of them the policy replaces."""
        size = n_steps, self._env.num_envs
        actions = sample_actions(self._env.single_action_space, size, self._generator)
        if self._policy is None:
            return actions, np.zeros(size, bool)
        return actions, self._generator.random(size) >= self._policy.epsilon

    def _step(self, actions: NDArray[Any], by_policy: NDArray[np.bool_]) -> tuple[Any, Any, dict[str, Any]]:
        """One step of every copy; how episodes ended, and infos."""
        self._choose(actions, by_policy)
        self._observation, _, terminated, truncated, infos = self._env.step(actions)
        self._require_declared(self._observation, self._env.num_envs)
        if self._policy is not None:
            self._push(terminated | truncated)
        return terminated, truncated, infos

    def skip(self, n_steps: int) -> None:
        """Step as :meth:`advance` does with as many steps, and keep nothing.

        :param n_steps: of every copy
        """
        for actions, by_policy in zip(*self._sample(n_steps), strict=True):
            self._step(actions, by_policy)

    def advance(self, n_steps: int, n_transitions: int, advanced: Callable[[int], object]) -> list[Segment]:
        """The next ``n_steps`` of every copy as segments, copy after copy; see :func:`collect_shard`."""
        env, n_envs = self._env, self._env.num_envs
        kept = n_transitions // n_envs + (np.arange(n_envs) < n_transitions % n_envs)
        actions, by_policy = self._sample(n_steps)
        # Frames that can be rendered again are not kept.
        rendered = renders_factors(env)
        observations, factors = [] if rendered else [self._observation], [factors_of(env)]
        # Per copy: (steps taken at the episode's end, how it ended, last frame, last factors).
        endings: list[list[_Ending]] = [[] for _ in range(n_envs)]
        for t in range(kept.max()):
            terminated, truncated, infos = self._step(actions[t], by_policy[t])
            if not rendered:
                observations.append(self._observation)
            factors.append(factors_of(env))
            for j in np.flatnonzero((terminated | truncated) & (t < kept)):
                last_factors = {name: infos["final_info"]["factors"][name][j] for name in factors[0]}
                end = TERMINATED if terminated[j] else TRUNCATED
                if not rendered:
                    self._require_declared(np.asarray(infos["final_obs"][j])[None], 1)
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


def factors_of(env: VectorEnv[Any, Any, Any]) -> dict[str, NDArray[Any]]:
    unwrapped = env.unwrapped
    return unwrapped.factors() if isinstance(unwrapped, BatchEnv | EnvCopies) else {}


def renders_factors(env: VectorEnv[Any, Any, Any]) -> bool:
    unwrapped = env.unwrapped
    return isinstance(unwrapped, BatchEnv) and unwrapped.renders_factors
