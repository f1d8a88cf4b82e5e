"""One implementation of each environment: a batch of n, and the Gymnasium environment as its batch of one.

A subclass of :class:`BatchEnv` writes the dynamics once, over a leading batch dimension. :class:`SingleEnv` turns a
batch of one into a ``gymnasium.Env``. Every copy owns a random generator, so copy ``i`` of a batch reset with
``seed=s`` and a single environment reset with ``seed=s + i`` see the same episodes.
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sb3_abisim.common.arguments import checked_arguments
from sb3_abisim.envs.shortest_paths import ShortestPaths

# Observations of all copies together take no more.
MAX_BATCH_BYTES = 2**32


class BatchEnv(gym.vector.VectorEnv):
    """``num_envs`` independent copies of an environment, stepped by one call.

    Finished copies start their next episode within the same ``step`` (``AutoresetMode.SAME_STEP``): the returned
    observation is the new episode's first and ``infos["final_obs"]`` holds the last one of the old episode, as
    Stable-Baselines3 expects of a ``VecEnv``. ``infos["is_success"]`` is a bool array, true where the goal has just
    been reached (it describes the step, before any reset).

    :param num_envs: number of copies, at least 1
    :param observation_space: of one copy
    :param action_space: of one copy, ``Discrete`` or ``Box``
    :param max_episode_steps: steps after which an episode is truncated, None for no limit
    :param render_mode: None or "rgb_array"
    :param autoreset: False leaves finished copies for :class:`SingleEnv` to reset
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    # Whether :meth:`render_factors` is there: datasets then hold the factors alone, and render observations on reading.
    renders_factors: ClassVar[bool] = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Arguments of every constructor are checked against its annotations."""
        super().__init_subclass__(**kwargs)
        if "__init__" in cls.__dict__:
            cls.__init__ = checked_arguments(cls.__init__)  # type: ignore[method-assign]

    @checked_arguments
    def __init__(
        self,
        num_envs: int,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset: bool = True,
    ) -> None:
        n_bytes = sum(map(_n_bytes, (observation_space, action_space)))
        if not 1 <= num_envs <= MAX_BATCH_BYTES // n_bytes:
            raise ValueError(
                f"num_envs must be at least 1, and at most {MAX_BATCH_BYTES // n_bytes} for observations and actions "
                f"of {n_bytes} bytes, got {num_envs}"
            )
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be at least 1 or None, got {max_episode_steps}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.max_episode_steps = max_episode_steps
        self.single_observation_space = observation_space
        self.single_action_space = action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self._autoreset = autoreset
        self._generators: list[np.random.Generator] = []
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._everyone = np.arange(num_envs)
        self._always = np.ones(num_envs, dtype=bool)
        self._needs_reset = True
        self._action_shape = (num_envs, *(action_space.shape or ()))
        self._action_kinds = "iu" if isinstance(action_space, gym.spaces.Discrete) else "iuf"
        self._action_bounds = _bounds(action_space)

    # The dynamics, written by subclasses over index arrays.

    def _reset_envs(self, indices: NDArray[np.int64]) -> None:
        """Start a new episode in each of the copies ``indices``, sampling from ``self._generators[i]`` alone."""
        raise NotImplementedError

    def _advance(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Move every copy by one step.

        :param actions: valid actions, shape (num_envs, *action shape)
        :return: rewards and whether the episode has ended by itself, each of shape (num_envs,)
        """
        raise NotImplementedError

    def _observe(self, indices: NDArray[np.int64]) -> Any:
        """Observations of the copies ``indices`` in a new array, shape (len(indices), *observation shape).

        Where the observation space is a ``Dict``, a dictionary of such arrays.
        """
        raise NotImplementedError

    def _infos(self, ended: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        """What ``infos`` reports of the step just taken; by default, an episode that has ended is a success.

        :param ended: as returned by :meth:`_advance`
        :return: name to array (num_envs,)
        """
        return {"is_success": ended.copy()}

    def _take_options(self, options: dict[str, Any]) -> None:
        """Note what the coming reset is asked for; it is called before each, mostly with no options.

        :param options: of ``reset``
        """
        if options:
            raise ValueError(f"{type(self).__name__} knows no reset options, got {sorted(options)}")

    def _render_frame(self, index: int) -> NDArray[np.uint8]:
        """An image of one copy for people, shape (height, width, 3), RGB."""
        raise NotImplementedError

    def factors(self) -> dict[str, NDArray[Any]]:
        """The simulator's state that the current observations show, for probes; no loss may read it.

        :return: name to array of shape (num_envs, ...), copies
        """
        raise NotImplementedError

    def render_factors(self, factors: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
        """The observations of states, equal to the bit to those at that time; changes nothing.

        Called from any thread, by one at a time: pretraining renders a batch while it learns from another.

        :param factors: name to array of shape (n, ...), as of :meth:`factors`, at any time and in any copies
        :return: (n, *observation shape)
        :raises ValueError: for factors that this environment cannot have
        """
        raise NotImplementedError

    def shortest_paths(self, factors: dict[str, NDArray[Any]]) -> ShortestPaths:
        """What leads to the goal from some states, for read-outs; no loss may read it. Optional.

        :param factors: name to array of shape (n, ...), as of :meth:`factors`, at any time and in any copies
        """
        raise NotImplementedError

    def blocked_around(self, factors: dict[str, NDArray[Any]], offsets: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which points around the agent it cannot be at, for probes and read-outs; no loss may read it. Optional.

        :param factors: name to array of shape (n, ...), as of :meth:`factors`, at any time and in any copies
        :param offsets: (x, y) from the agent, in the unit that suits the environment, (n_points, 2)
        :return: (n, n_points); also true outside the world
        """
        raise NotImplementedError

    # The Gymnasium interface.

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start a new episode in every copy.

        :param seed: copy i gets ``seed + i``, or ``seed[i]`` of a list; None goes on with the present generators
        :param options: none are known, unless the environment documents some
        """
        self._take_options(options or {})
        seeds = list(seed) if isinstance(seed, (list, tuple)) else None
        if seeds is None:
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]  # type: ignore[arg-type]
        if len(seeds) != self.num_envs:
            raise ValueError(f"got {len(seeds)} seeds for {self.num_envs} environments")
        fresh = not self._generators
        for i, one in enumerate(seeds):
            if fresh:
                self._generators.append(seeding.np_random(one)[0])
            elif one is not None:
                self._generators[i] = seeding.np_random(one)[0]
        self._begin(self._everyone)
        self._needs_reset = False
        return self._observe(self._everyone), {}

    def take_generator(self, generator: np.random.Generator) -> None:
        """Sample from a given generator, in a batch of one.

        :param generator: :class:`SingleEnv`'s
        """
        self._generators = [generator]

    def _begin(self, indices: NDArray[np.int64]) -> None:
        self._reset_envs(indices)
        self._elapsed[indices] = 0

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Take one action in every copy.

        :param actions: shape (num_envs, *action shape)
        :raises ValueError: for an action of the wrong shape, out of range, or not finite
        :raises RuntimeError: before the first reset, or for a finished copy that was not reset
        """
        actions = self._check_actions(actions)
        if self._needs_reset:
            raise RuntimeError("the episode is over (or has not begun): call reset() before step()")
        rewards, ended = self._advance(actions)
        self._elapsed += 1
        truncated, done = np.zeros(self.num_envs, dtype=bool), ended
        if self.max_episode_steps is not None:
            done = ended | (self._elapsed >= self.max_episode_steps)
            truncated = done & ~ended
        infos: dict[str, Any] = self._infos(ended)
        for name in tuple(infos):
            infos[f"_{name}"] = self._always.copy()
        observations = self._observe(self._everyone)
        # Counting is the fastest way to see whether there is any.
        if np.count_nonzero(done):
            if self._autoreset:
                infos |= self._restart(np.flatnonzero(done), observations, infos)
            else:
                self._needs_reset = True
        return observations, rewards, ended, truncated, infos

    def _restart(self, ended: NDArray[np.int64], observations: Any, infos: dict[str, Any]) -> dict[str, Any]:
        """Begin new episodes in ``ended``, put their first observations in place, return the final infos."""
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[ended] = True
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in ended:
            final_obs[i] = one_of(observations, i, copy=True)
        final_factors = {
            name: np.where(_along(mask, array), array, np.zeros_like(array)) for name, array in self.factors().items()
        }
        self._begin(ended)
        first = self._observe(ended)
        if isinstance(observations, dict):
            for name, array in observations.items():
                array[ended] = first[name]
        else:
            observations[ended] = first
        final_info: dict[str, Any] = {}
        for name, array in infos.items():
            final_info[name] = mask.copy() if name[0] == "_" else np.where(mask, array, np.zeros_like(array))
        final_info |= {"factors": final_factors, "_factors": mask.copy()}
        return {"final_obs": final_obs, "_final_obs": mask, "final_info": final_info, "_final_info": mask.copy()}

    def _check_actions(self, actions: Any) -> NDArray[Any]:
        array = np.asarray(actions)
        if array.shape != self._action_shape:
            raise ValueError(f"actions must have shape {self._action_shape}, got shape {array.shape}: {actions!r}")
        if array.dtype.kind not in self._action_kinds:
            kind = "integers" if self._action_kinds == "iu" else "numbers"
            raise ValueError(f"actions must be {kind}, got dtype {array.dtype}: {actions!r}")
        low, high = self._action_bounds
        # Written so that NaN, which compares false, counts as out of range.
        inside = (array >= low) & (array <= high)
        if np.count_nonzero(inside) < inside.size:
            bad = array[~inside.reshape(self.num_envs, -1).all(axis=1)][0]
            raise ValueError(f"action {bad!r} is outside {self.single_action_space}; clip or rescale it before step()")
        # NumPy makes floats of int64 and uint64 together, and those are no indices.
        return array.astype(np.int64) if array.dtype.kind == "u" else array

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """An image of every copy, each (height, width, 3) uint8 RGB; None without ``render_mode``."""
        if self.render_mode is None:
            return None
        return tuple(self._render_frame(i) for i in range(self.num_envs))


class SingleEnv(gym.Env):
    """A ``gymnasium.Env`` made of a :class:`BatchEnv` of one copy.

    ``info["is_success"]`` is a bool at every step; what else the batch reports of a step stands beside it. Episodes
    have no time limit here: ``gymnasium.make`` adds the registered one.

    :param render_mode: None or "rgb_array"
    :param kwargs: passed to the batch class
    """

    batch_class: ClassVar[type[BatchEnv]]
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None, **kwargs: Any) -> None:
        self.batch = self.batch_class(num_envs=1, render_mode=render_mode, autoreset=False, **kwargs)
        self.render_mode = render_mode
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode; ``seed`` determines it and all that follow.

        :param seed: None goes on with the present generator
        :param options: none are known, unless the environment documents some
        """
        super().reset(seed=seed)
        # One generator: a wrapper that samples from `env.np_random` advances the same stream as the environment.
        self.batch.take_generator(self.np_random)
        observations, _ = self.batch.reset(options=options)
        return one_of(observations, 0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one action.

        :param action: an element of the action space
        :raises ValueError: for an action of the wrong shape, out of range, or not finite
        :raises RuntimeError: before the first reset, or after the episode has terminated
        """
        observations, rewards, terminated, truncated, infos = self.batch.step(np.asarray(action)[None])
        info = {name: array[0].item() for name, array in infos.items() if name[0] != "_"}
        return one_of(observations, 0), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def factors(self) -> dict[str, NDArray[Any]]:
        """The simulator's state that the current observation shows, for probes; see :meth:`BatchEnv.factors`."""
        return {name: array[0] for name, array in self.batch.factors().items()}

    def render(self) -> NDArray[np.uint8] | None:
        """An image for people, (height, width, 3) uint8 RGB; None without ``render_mode``."""
        frames = self.batch.render()
        return None if frames is None else frames[0]


def batch_class(env_id: str) -> type[BatchEnv] | None:
    """The class of an environment's batch.

    :param env_id: any id
    :return: None for an id that is not registered, or is no environment of this kind
    """
    spec = gym.registry.get(env_id)
    creator: Any = None if spec is None else spec.vector_entry_point
    if isinstance(creator, str):
        creator = gym.envs.registration.load_env_creator(creator)
    return creator if isinstance(creator, type) and issubclass(creator, BatchEnv) else None


def offers(env: type, method: str) -> bool:
    """Whether a class writes an optional method of :class:`BatchEnv`.

    :param env: any class
    :param method: its name
    """
    return issubclass(env, BatchEnv) and getattr(env, method) is not getattr(BatchEnv, method)


def one_of(observations: Any, index: int, copy: bool = False) -> Any:
    """One observation of a batch.

    :param observations: an array, or a dictionary of arrays
    :param index: which
    :param copy: False gives a view
    """
    if isinstance(observations, dict):
        return {name: one_of(array, index, copy) for name, array in observations.items()}
    return observations[index].copy() if copy else observations[index]


def _n_bytes(space: gym.Space[Any]) -> int:
    """Of one element."""
    if isinstance(space, gym.spaces.Dict):
        return sum(map(_n_bytes, space.values()))
    return int(np.prod(space.shape or (), dtype=np.int64)) * np.dtype(space.dtype).itemsize


def _bounds(space: gym.Space[Any]) -> tuple[Any, Any]:
    """The least and the greatest action, inclusive."""
    if isinstance(space, gym.spaces.Discrete):
        return int(space.start), int(space.start + space.n - 1)
    assert isinstance(space, gym.spaces.Box)
    return space.low, space.high


def _along(mask: NDArray[np.bool_], array: NDArray[Any]) -> NDArray[np.bool_]:
    """``mask`` with trailing axes added, so that it broadcasts against ``array``."""
    return mask.reshape(-1, *[1] * (array.ndim - 1))
