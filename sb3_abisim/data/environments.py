"""Makes the environments that are collected from, with what stands between them and their observations."""

import difflib
import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.vector import VectorEnv

from sb3_abisim.common.files import is_of_system
from sb3_abisim.data.copies import FIRST, EnvCopies, WorkerCopies
from sb3_abisim.data.vectorized import VectorizedCopies, difference, is_vectorized
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.envs.base import batch_class

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

# Environments stepped together by default: those that run as one batch, and others.
N_BATCHED, N_COPIES = 64, 8
# Key of recorded preprocessing: the classes of a vectorized environment that the zoo cannot make.
VEC_ENV_KEY = "vec_env"

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
    env: "str | Callable[..., Any] | VectorEnv[Any, Any, Any] | VecEnv",
    n_envs: int | None,
    env_kwargs: dict[str, Any],
    preprocessing: Preprocessing | None = None,
    n_workers: int = 1,
    as_made: bool = False,
) -> VectorEnv[Any, Any, Any]:
    """Copies of an environment that reset within the step that ends an episode.

    :param env: a registered id, a function that makes one environment or a vectorized one, or a vectorized one that is
        there; what is no :class:`~sb3_abisim.envs.base.BatchEnv`, or is wrapped, runs as
        :class:`~sb3_abisim.data.copies.EnvCopies`
    :param n_envs: number of copies; None for the default
    :param env_kwargs: passed to the environment
    :param preprocessing: what stands between the environment and its observations; None for nothing
    :param n_workers: processes that step copies, unless they run as one batch
    :param as_made: whether an id steps as its ``vector_entry_point``, see :func:`as_made_or_reason`
    :raises ValueError: for an unknown id, or if the environment refuses ``env_kwargs``
    """
    preprocessing = Preprocessing() if preprocessing is None else preprocessing
    wrapper, image_key = preprocessing.wrapper, preprocessing.image_key
    is_plain = wrapper is None and image_key is None
    if is_vectorized(env):
        return _vectorized(env, n_envs, preprocessing, owned=False)
    make_fn = _make_fn(env, env_kwargs)
    try:
        if isinstance(env, str) and is_plain and batch_class(env) is not None:
            return gym.make_vec(env, n_envs or N_BATCHED, "vector_entry_point", **env_kwargs)
        if isinstance(env, str) and as_made:
            whole = gym.make_vec(env, n_envs or N_COPIES, "vector_entry_point", **env_kwargs)
            return VectorizedCopies(whole, like_single=True)
        make_fns = [functools.partial(_wrapped, make_fn, wrapper)] * (n_envs or N_COPIES)
        if not isinstance(env, str):
            # Only what it makes says what it is.
            made = make_fn()
            if is_vectorized(made):
                return _vectorized(made, n_envs, preprocessing, owned=True)
            if n_workers > 1:
                made.close()  # workers make their own
            else:
                make_fns[0] = functools.partial(_wrapped, lambda: made, wrapper)
        return EnvCopies(make_fns, image_key) if n_workers == 1 else WorkerCopies(make_fns, image_key, n_workers)
    except Exception as error:
        # Whatever an environment raises: a library that is not there, arguments that it does not take, no display.
        if (isinstance(error, ValueError) and wrapper is None) or is_of_system(error):
            raise
        raise ValueError(_why_not_made(env, env_kwargs, preprocessing, error)) from error


# What the errors of environments and wrappers say, and what helps.
_HINTS = (
    (r"requires render_mode", "add --env-kwargs render_mode:rgb_array"),
    # Wrappers of Gymnasium 1.2 that render assert without a word.
    (r"^AssertionError AssertionError$", "where a wrapper renders, add --env-kwargs render_mode:rgb_array"),
    (r"unexpected keyword argument", "correct --env-kwargs, or env_kwargs of the zoo's entry"),
    (r"(?i)opengl|glfw|egl|osmesa", "rendering without a display needs MUJOCO_GL=egl in front of the command"),
    (r"to be a tuple, got .*list", "a YAML has lists only; rl_zoo3.wrappers.YAMLCompatResizeObservation takes one"),
)


def _why_not_made(env: Any, env_kwargs: dict[str, Any], preprocessing: Preprocessing, error: Exception) -> str:
    text = f"{error}" or type(error).__name__
    hints = [hint for pattern, hint in _HINTS if re.search(pattern, f"{type(error).__name__} {text}")]
    if preprocessing.wrapper is not None:
        hints = hints or ["--env-wrapper takes the place of the zoo's"]
        text += f" (with env_wrapper {preprocessing.env_wrapper}; {'; '.join(hints)})"
    elif hints:
        text += f"; {'; '.join(hints)}"
    return text if isinstance(error, ValueError) else f"cannot make {env} with {env_kwargs}: {text}"


def as_made_or_reason(env_id: str, env_kwargs: dict[str, Any], preprocessing: Preprocessing) -> tuple[bool, str]:
    """Whether an id steps as its ``vector_entry_point``, as the environments of this package always do.

    :param env_id: any id
    :param env_kwargs: passed to the environment
    :param preprocessing: what stands between the environment and its observations
    :return: whether it does, and else why it does not; no reason for an id that has none
    """
    spec = gym.registry.get(env_id)
    if spec is None or spec.vector_entry_point is None or spec.entry_point is None or batch_class(env_id) is not None:
        return False, ""
    if preprocessing.wrapper is not None or preprocessing.image_key is not None:
        return False, "env_wrapper and --image-key, here or in the zoo's entry, apply to single environments"
    make_vec_fn = functools.partial(gym.make_vec, env_id, vectorization_mode="vector_entry_point", **env_kwargs)
    reason = difference(make_vec_fn, _make_fn(env_id, env_kwargs))
    return reason is None, reason or ""


def _make_fn(env: Any, env_kwargs: dict[str, Any]) -> Callable[[], Any]:
    if not isinstance(env, str):
        return functools.partial(env, **env_kwargs)
    spec = gym.registry.get(env)
    if spec is None:
        close = difflib.get_close_matches(env, gym.registry, n=3)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known are {', '.join(ENV_IDS)}"
        raise ValueError(f"unknown environment {env!r}: {hint} (--packages imports what registers others)")
    return functools.partial(gym.make, spec, **env_kwargs)


def _vectorized(env: Any, n_envs: int | None, preprocessing: Preprocessing, owned: bool) -> VectorizedCopies:
    if n_envs not in (None, env.num_envs):
        raise ValueError(f"{env} has {env.num_envs} copies, not n_envs {n_envs}; leave n_envs out")
    if preprocessing.wrapper is not None:
        raise ValueError(
            f"env_wrapper {preprocessing.env_wrapper} wraps single environments, and {env} is vectorized; wrap the "
            "environments in it before, and leave env_wrapper out"
        )
    return VectorizedCopies(env, preprocessing.image_key, owned=owned)


def _wrapped(make_fn: Callable[[], gym.Env[Any, Any]], wrapper: Wrapper | None) -> gym.Env[Any, Any]:
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
    if isinstance(env, VectorizedCopies) and not env.like_single:
        described[VEC_ENV_KEY] = env.class_paths
    return described


def name_of(env: Any, made: VectorEnv[Any, Any, Any]) -> str:
    """How a dataset calls its environment: its id if it has one.

    :param env: see :func:`make_vector_env`
    :param made: what that has made of it
    """
    if isinstance(env, str):
        return env
    if isinstance(made, VectorizedCopies):
        return made.class_paths[-1] if made.spec is None else str(made.spec.id)
    return f"{env.__module__}:{getattr(env, '__qualname__', type(env).__qualname__)}"


def content_hash(env: VectorEnv[Any, Any, Any]) -> str | None:
    copies = getattr(env.unwrapped, "envs", None)
    value = getattr(copies[0].unwrapped if copies else env.unwrapped, "content_hash", None)
    return None if value is None else str(value)


def time_limit(env: Any, env_kwargs: dict[str, Any]) -> int:
    """Steps of an episode at most; 0 for no limit that Gymnasium knows."""
    registered = gym.registry[env].max_episode_steps if isinstance(env, str) else None
    # -1 is Gymnasium's word for none; it refuses other numbers below 1.
    return max(0, int(env_kwargs.get("max_episode_steps") or registered or 0))
