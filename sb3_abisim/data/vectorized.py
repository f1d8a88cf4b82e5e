"""Environments that somebody else has vectorized: a ``VectorEnv`` of Gymnasium, or a ``VecEnv`` of SB3.

An id may have a ``vector_entry_point`` beside its single environment. Its vector environment is stepped where it shows
what single environments show, byte for byte, since agents are trained and evaluated on single ones. That is found out
by stepping both. Where they differ (ale-py's preprocesses by itself), single environments are stepped, and
:func:`difference` says why.
"""

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from sb3_abisim.common.spaces import sample_actions
from sb3_abisim.data.copies import EnvCopies, ImageLayout

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

# Steps over which a vector environment is compared with single ones, and copies of each.
PROBE_STEPS, PROBE_COPIES = 64, 2
# Simulators in C often keep seeds in 31 bits.
MAX_SEED = 2**31 - 1


def is_vectorized(env: Any) -> bool:
    """Whether an object is a ``VectorEnv`` or a ``VecEnv``.

    :param env: any object
    """
    # Where no module has imported it, the object is none; importing it takes seconds.
    module = sys.modules.get("stable_baselines3.common.vec_env")
    return isinstance(env, VectorEnv) or (module is not None and isinstance(env, module.VecEnv))


class VectorizedCopies(EnvCopies):
    """The copies of a vector environment.

    :param env: a ``VectorEnv`` with any autoreset, or a ``VecEnv``
    :param image_key: see :meth:`~sb3_abisim.data.copies.ImageLayout.of`
    :param like_single: whether it shows what single environments show; every copy then gets the seed that a single one
        would get, and else they get consecutive ones, which more vector environments take
    :param owned: whether :meth:`close` closes it
    """

    def __init__(
        self,
        env: "VectorEnv[Any, Any, Any] | VecEnv",
        image_key: str | None = None,
        like_single: bool = False,
        owned: bool = True,
    ) -> None:
        from sb3_abisim.envs.sb3_vec_env import VectorEnvAdapter

        self.class_paths, self.spec = _class_paths(env), _find_spec(env)
        self._venv: VecEnv = VectorEnvAdapter(env) if isinstance(env, VectorEnv) else env
        self.like_single, self._owned = like_single, owned
        self.envs = []
        self.layout = ImageLayout.of(self._venv.observation_space, image_key)
        self._describe(self._venv.num_envs, self.layout.space, self._venv.action_space)
        self._rest = [self.layout.blank()] * self.num_envs

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See :class:`~sb3_abisim.data.copies.EnvCopies`."""
        if self.like_single:
            self._venv.seed_each(seed)  # type: ignore[attr-defined]
        elif seed is not None:
            first = seed if isinstance(seed, int) else seed[0]
            self._venv.seed(first % (MAX_SEED - self.num_envs))
        return self._images(self._rows(self._venv.reset())), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """See :class:`~sb3_abisim.data.copies.EnvCopies`."""
        observations, rewards, dones, rows = self._venv.step(np.asarray(actions))
        truncated = np.array([bool(row.get("TimeLimit.truncated")) for row in rows]) & dones
        final_obs = np.full(self.num_envs, None, object)
        final_rest: list[dict[str, NDArray[Any]]] = [{} for _ in rows]
        for i in np.flatnonzero(dones):
            if "terminal_observation" not in rows[i]:
                raise ValueError(
                    f"{self._venv} ended an episode without infos['terminal_observation'], its last observation"
                )
            last = rows[i]["terminal_observation"]
            final_obs[i], final_rest[i] = self._take(last)
        factors = {name: [rest.get(name) for rest in final_rest] for name in self.layout.factors}
        infos = {"final_obs": final_obs, "final_info": {"factors": factors}}
        return self._images(self._rows(observations)), rewards, dones & ~truncated, truncated, infos

    @property
    def _name(self) -> str:
        return self.class_paths[-1] if self.spec is None else str(self.spec.id)

    def _rows(self, observations: Any) -> list[Any]:
        if isinstance(observations, dict):
            return [{key: part[i] for key, part in observations.items()} for i in range(self.num_envs)]
        return list(observations)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment, if it was made for this."""
        if self._owned:
            self._venv.close()


def _class_paths(env: Any) -> list[str]:
    """Its wrappers' classes, the outermost first, and its own."""
    paths = []
    while True:
        paths.append(f"{type(env).__module__}:{type(env).__qualname__}")
        inner = getattr(env, "venv", None) or (getattr(env, "env", None) if isinstance(env, VectorEnv) else None)
        if not is_vectorized(inner):
            return paths
        env = inner


def _find_spec(env: Any) -> Any:
    """What Gymnasium knows of its copies; None where nobody says."""
    if isinstance(env, VectorEnv):
        return env.spec
    try:
        return env.get_attr("spec")[0]
    except Exception:  # a copy without one may raise whatever it likes
        return None


def difference(
    make_vec_fn: Callable[[int], VectorEnv[Any, Any, Any]], make_fn: Callable[[], gym.Env[Any, Any]]
) -> str | None:
    """In what a vector environment differs from copies of the single one, in the same seeds and actions.

    :param make_vec_fn: makes it, of a number of copies
    :param make_fn: makes a single one
    :return: None for nothing, over ``PROBE_STEPS`` steps
    """
    try:
        vectorized = VectorizedCopies(make_vec_fn(PROBE_COPIES), like_single=True)
    except Exception as error:  # somebody else's code, which is not needed
        return f"it cannot be made ({error})"
    copies = None
    try:
        # What is wrong with these is for the caller, who makes them again.
        copies = EnvCopies([make_fn] * PROBE_COPIES)
        return _compare(vectorized, copies)
    finally:
        for env in (vectorized, copies):
            if env is not None:
                env.close()


def _compare(vectorized: EnvCopies, copies: EnvCopies) -> str | None:
    for name in ("single_observation_space", "single_action_space"):
        ours, theirs = getattr(vectorized, name), getattr(copies, name)
        if ours != theirs:
            return f"its {name.removeprefix('single_').replace('_', ' ')} is {ours}, that of a single one {theirs}"
    generator = np.random.default_rng(0)
    seeds = generator.integers(MAX_SEED, size=PROBE_COPIES).tolist()
    first, _ = copies.reset(seed=seeds)
    try:
        same = np.array_equal(vectorized.reset(seed=seeds)[0], first) and _same_factors(vectorized, copies)
        for t in range(PROBE_STEPS):
            if not same:
                return f"its observations differ from those of single ones after {t} steps"
            actions = sample_actions(copies.single_action_space, (PROBE_COPIES,), generator)
            images, _, *ends, infos = vectorized.step(actions)
            expected, _, *their_ends, their_infos = copies.step(actions)
            same = np.array_equal(images, expected) and np.array_equal(ends, their_ends)
            same = same and _same_factors(vectorized, copies)
            for i in np.flatnonzero(np.any(their_ends, axis=0)):
                same = same and np.array_equal(infos["final_obs"][i], their_infos["final_obs"][i])
    except Exception as error:
        return f"it cannot be stepped as single ones are ({error})"
    return None if same else "its observations differ from those of single ones"


def _same_factors(one: EnvCopies, other: EnvCopies) -> bool:
    ours, theirs = one.factors(), other.factors()
    return ours.keys() == theirs.keys() and all(np.array_equal(ours[name], theirs[name]) for name in ours)
