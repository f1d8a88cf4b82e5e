"""Makes the environments that are collected from, with what stands between them and their observations."""

import difflib
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorEnv

from sb3_abisim.data.copies import FIRST, EnvCopies, WorkerCopies
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.envs.base import batch_class

# Environments stepped together by default: those that run as one batch, and others.
N_BATCHED, N_COPIES = 64, 8


Wrapper = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]


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


def resolve_wrapper(env_wrapper: Any) -> Wrapper:
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


def describe_preprocessing(
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


def name_of(make_fn: Callable[[], gym.Env[Any, Any]]) -> str:
    return f"{make_fn.__module__}:{getattr(make_fn, '__qualname__', type(make_fn).__qualname__)}"


def content_hash(env: VectorEnv[Any, Any, Any]) -> str | None:
    copies = getattr(env.unwrapped, "envs", None)
    value = getattr(copies[0].unwrapped if copies else env.unwrapped, "content_hash", None)
    return None if value is None else str(value)


def time_limit(env_id: str | Callable[[], gym.Env[Any, Any]], env_kwargs: dict[str, Any]) -> int:
    """Steps of an episode at most; 0 for no limit that Gymnasium knows."""
    registered = gym.registry[env_id].max_episode_steps if isinstance(env_id, str) else None
    # -1 is Gymnasium's word for none; it refuses other numbers below 1.
    return max(0, int(env_kwargs.get("max_episode_steps") or registered or 0))
