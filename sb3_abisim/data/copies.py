"""Copies of any Gymnasium environment, stepped together as one that shows image observations, channels first.

What else an observation holds comes beside the images, as the ``factors()`` of a
:class:`~sb3_abisim.envs.base.BatchEnv` do. Copies may live in worker processes; what they show is the same.
"""

import contextlib
import itertools
import multiprocessing
import pickle
import re
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sb3_abisim.common.images import fits
from sb3_abisim.common.spaces import is_bounded_image_space, is_channels_first, is_float_image_space

MakeFn = Callable[[], gym.Env[Any, Any]]
_WRAPPERS = (
    "a wrapper makes images: --env-wrapper gymnasium.wrappers.AddRenderObservation --env-kwargs render_mode:rgb_array "
    "shows what the environment renders"
)
_FLOATS = (
    'two wrappers of gymnasium 1.4 make bytes of these floats: --env-wrapper "gymnasium.wrappers.RescaleObservation: '
    '{min_obs: 0, max_obs: 255}" "gymnasium.wrappers.DtypeObservation: {dtype: uint8}"'
)
# Of integers, differences and scaled numbers may not fit.
_INTEGERS = (
    'three wrappers of gymnasium 1.4 make them: --env-wrapper "gymnasium.wrappers.DtypeObservation: {dtype: float32}" '
    '"gymnasium.wrappers.RescaleObservation: {min_obs: 0, max_obs: 255}" '
    '"gymnasium.wrappers.DtypeObservation: {dtype: uint8}"'
)
# Where the channels of an observation are: (C, H, W), (H, W, C) or (H, W).
FIRST, LAST, NONE = "first", "last", "none"


@dataclass(frozen=True)
class ImageLayout:
    """Where the image is in an observation, and how it lies there.

    :param space: of the images as a dataset holds them: uint8 (C, H, W) in 0..255
    :param channels: ``FIRST``, ``LAST`` or ``NONE``
    :param key: of a ``Dict`` observation; None for one that is an image
    :param factors: of a ``Dict`` observation, the keys that hold numbers, by the names of the factors that they become
    :param layouts: dtype and shape of one row of each factor
    :param declared: the observation space
    """

    space: spaces.Box
    channels: str
    key: str | None
    factors: dict[str, str]
    layouts: dict[str, tuple[np.dtype[Any], tuple[int, ...]]]
    declared: gym.Space[Any]

    @classmethod
    def of(cls, space: gym.Space[Any], image_key: str | None = None, remedy: str = _WRAPPERS) -> "ImageLayout":
        """The layout of an observation space.

        :param space: of one environment
        :param image_key: which key of a ``Dict`` space holds the image; None for the only one that does
        :param remedy: what to do about observations that are no such images, for messages
        :raises ValueError: if there is no image, or several and no ``image_key``
        """
        factors: dict[str, str] = {}
        layouts: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        declared = space
        if isinstance(space, spaces.Dict):
            images = [key for key, part in space.spaces.items() if _is_image(part)]
            if image_key is None and len(images) != 1:
                if not images:
                    raise ValueError(f"no observation of {space} is a uint8 image in 0..255; {remedy}")
                raise ValueError(
                    f"the observations have {len(images)} images ({', '.join(images)}) in {space}; choose one with "
                    "--image-key"
                )
            image_key = images[0] if image_key is None else image_key
            if image_key not in images:
                raise ValueError(
                    f"image_key {image_key!r} is not one of the images {images} in {space}; give one of them"
                )
            for key, part in space.spaces.items():
                if key != image_key and isinstance(part, spaces.Box | spaces.Discrete | spaces.MultiBinary):
                    name = factor_name(key)
                    if name in factors:
                        raise ValueError(
                            f"the observations {factors[name]!r} and {key!r} would both become the factor {name!r}; "
                            "rename one"
                        )
                    factors[name], layouts[name] = key, (np.dtype(part.dtype), tuple(part.shape or ()))
            space = space.spaces[image_key]
        elif image_key is not None:
            raise ValueError(f"image_key {image_key!r} chooses from a Dict of observations, got {space}; leave it out")
        if not _is_image(space):
            if remedy == _WRAPPERS and is_bounded_image_space(space):
                remedy = _FLOATS if is_float_image_space(space) else _INTEGERS
            raise ValueError(
                "observations must be uint8 images in 0..255 of shape (channels, height, width), (height, width, "
                f"channels) or (height, width), got {space}; {remedy}"
            )
        shape = space.shape
        assert shape is not None
        stored: tuple[int, ...] = shape
        channels = FIRST
        if len(shape) == 2:
            channels, stored = NONE, (1, *shape)
        elif not is_channels_first(shape):
            channels, stored = LAST, (shape[2], *shape[:2])
        return cls(spaces.Box(0, 255, stored, np.uint8), channels, image_key, factors, layouts, declared)

    def require_declared(self, observation: Any, name: str) -> None:
        """Refuse an observation that is not what the space declares.

        Parts of a ``Dict`` that are neither image nor factor are not looked at.

        :param observation: as the environment shows it
        :param name: of the environment, for the message
        :raises ValueError: for another dtype, shape or key, or numbers out of range, with both sides
        """
        space, where = self.declared, "observations"
        if isinstance(space, spaces.Dict):
            there = set(observation) if isinstance(observation, Mapping) else f"{type(observation).__name__}"
            if there != set(space.spaces):
                keys = sorted(there) if isinstance(there, set) else there
                raise _undeclared(name, where, f"the keys {sorted(space.spaces)}", f"{keys}")
            for key in self.factors.values():
                _require_factor(observation[key], space.spaces[key], name, f"observations[{key!r}]")
            assert self.key is not None
            where, observation, space = f"observations[{self.key!r}]", observation[self.key], space.spaces[self.key]
        image = np.asarray(observation)
        if image.dtype != np.uint8 or image.shape != space.shape:
            raise _undeclared(name, where, f"{space}", describe_array(image))

    def image(self, observation: Any) -> NDArray[np.uint8]:
        """The image of one observation, channels first, a copy.

        :param observation: as the environment shows it
        """
        image = observation if self.key is None else observation[self.key]
        if self.channels == LAST:
            image = np.moveaxis(image, -1, 0)
        return np.array(image, np.uint8).reshape(self.space.shape)

    def images(self, observations: Any) -> NDArray[np.uint8]:
        """The images of several observations, channels first, a view where that is possible.

        :param observations: array [n, ...] of what the environment shows, for a ``Dict`` one array by key
        :return: [n, C, H, W] of the arrays' own dtype
        :raises ValueError: for observations of another shape
        """
        images = np.asarray(observations if self.key is None else observations[self.key])
        if self.channels == LAST and images.ndim == 4:
            images = np.moveaxis(images, -1, 1)
        elif self.channels == NONE and images.ndim == 3:
            images = images[:, None]
        if images.shape[1:] != self.space.shape:
            raise ValueError(f"observations are {images.shape[1:]}, channels first, in place of {self.space.shape}")
        return images

    def rests(self, observations: Any) -> dict[str, NDArray[Any]]:
        """What else several observations hold, by the names of the factors.

        :param observations: as for :meth:`images`
        """
        rows = {name: (np.asarray(observations[key]), *self.layouts[name]) for name, key in self.factors.items()}
        return {name: array.astype(dtype).reshape(len(array), *shape) for name, (array, dtype, shape) in rows.items()}

    def rest(self, observation: Any) -> dict[str, NDArray[Any]]:
        """What else the observation holds, by the names of the factors.

        :param observation: as the environment shows it
        """
        return {name: np.array(observation[key], self.layouts[name][0]) for name, key in self.factors.items()}

    def blank(self) -> dict[str, NDArray[Any]]:
        """What :meth:`rest` returns, zeros."""
        return {name: np.zeros(shape, dtype) for name, (dtype, shape) in self.layouts.items()}


def _require_factor(value: Any, space: gym.Space[Any], name: str, where: str) -> None:
    array = np.asarray(value)
    low: Any = 0
    high: Any = 1
    if isinstance(space, spaces.Box):
        low, high = space.low, space.high
    elif isinstance(space, spaces.Discrete):
        low, high = space.start, space.start + space.n - 1
    assert space.dtype is not None
    if array.shape != tuple(space.shape or ()) or not fits(array, np.dtype(space.dtype), low, high):
        raise _undeclared(name, where, f"{space}", describe_array(array))


def describe_array(array: NDArray[Any]) -> str:
    """Dtype, shape and range of an array, for messages.

    :param array: of any dtype and shape
    """
    text = f"{array.dtype} {array.shape}"
    if array.dtype.kind not in "biuf" or not array.size:
        return text
    if array.dtype.kind == "f" and np.isnan(array).any():
        return f"{text} with NaN"
    return f"{text} in {array.min():g}..{array.max():g}"


def _undeclared(name: str, where: str, declared: str, returned: str) -> ValueError:
    return ValueError(
        f"{name} declares {where} as {declared}, but returned {returned}; make them what the observation space "
        "declares, or correct the space"
    )


def factor_name(key: str) -> str:
    """The name of the factor that a key of observations becomes, of letters, digits and underscores.

    :param key: such as "observation.state"
    """
    return re.sub(r"\W|^(?=\d)", "_", key, flags=re.ASCII)


def _is_image(space: gym.Space[Any]) -> bool:
    if (
        not isinstance(space, spaces.Box)
        or space.dtype != np.uint8
        or len(space.shape) not in (2, 3)
        or 0 in space.shape
    ):
        return False
    return bool(space.low.min() == 0 and space.high.max() == 255)


class EnvCopies(VectorEnv[Any, Any, Any]):
    """Copies of an environment that reset within the step that ends an episode.

    :param make_fns: each makes one copy
    :param image_key: see :meth:`ImageLayout.of`
    """

    # What is closed when making the copies fails: Gymnasium 1.2 closes what was never made.
    envs: Sequence[gym.Env[Any, Any]] = ()

    def __init__(self, make_fns: Sequence[MakeFn], image_key: str | None = None) -> None:
        self.envs = [make_fn() for make_fn in make_fns]
        self.layout = ImageLayout.of(self.envs[0].observation_space, image_key)
        self._describe(len(self.envs), self.layout.space, self.envs[0].action_space)
        self._rest: Sequence[dict[str, NDArray[Any]]] = [self.layout.blank()] * self.num_envs

    def _describe(self, num_envs: int, observation_space: gym.Space[Any], action_space: gym.Space[Any]) -> None:
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space, self.single_action_space = observation_space, action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start all episodes anew.

        :param seed: of every copy, or one: copy i gets ``seed + i``
        :param options: of every copy
        """
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed or [None] * self.num_envs
        shown = [env.reset(seed=s, options=options)[0] for env, s in zip(self.envs, seeds, strict=True)]
        return self._images(shown), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all copies.

        :param actions: of every copy
        :return: as from any ``VectorEnv``, with images for observations, and for the last ones of episodes
        """
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), bool)
        final_obs = np.full(self.num_envs, None, object)
        final_rest: list[dict[str, NDArray[Any]]] = [{} for _ in self.envs]
        shown = []
        for i, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            observation, rewards[i], terminated[i], truncated[i], _ = env.step(action)
            if terminated[i] or truncated[i]:
                final_obs[i], final_rest[i] = self._take(observation)
                observation, _ = env.reset()
            shown.append(observation)
        factors = {name: [rest.get(name) for rest in final_rest] for name in self.layout.factors}
        infos = {"final_obs": final_obs, "final_info": {"factors": factors}}
        return self._images(shown), rewards, terminated, truncated, infos

    def _images(self, shown: list[Any]) -> NDArray[np.uint8]:
        images, self._rest = zip(*map(self._take, shown), strict=True)
        return np.stack(images)

    def _take(self, observation: Any) -> tuple[NDArray[np.uint8], dict[str, NDArray[Any]]]:
        """The image of one observation, and what else it holds."""
        self.layout.require_declared(observation, self._name)
        return self.layout.image(observation), self.layout.rest(observation)

    @property
    def _name(self) -> str:
        spec = self.envs[0].spec
        return type(self.envs[0].unwrapped).__name__ if spec is None else str(spec.id)

    def factors(self) -> dict[str, NDArray[Any]]:
        """What else the present observations hold: name to (n, ...); zeros before the first reset."""
        return {name: np.stack([rest[name] for rest in self._rest]) for name in self.layout.factors}

    def close_extras(self, **kwargs: Any) -> None:
        """Close every copy."""
        for env in self.envs:
            env.close()


class WorkerCopies(EnvCopies):
    """The same copies in worker processes, each of which steps its share of them.

    :param make_fns: each makes one copy; what cloudpickle can send
    :param image_key: see :meth:`ImageLayout.of`
    :param n_workers: number of processes
    """

    def __init__(self, make_fns: Sequence[MakeFn], image_key: str | None, n_workers: int) -> None:
        import cloudpickle  # type: ignore[import-untyped, unused-ignore]  # Gymnasium depends on it

        bounds = np.linspace(0, len(make_fns), min(n_workers, len(make_fns)) + 1).astype(int)
        self._shares = [slice(begin, end) for begin, end in itertools.pairwise(bounds)]
        self._pipes: list[Connection] = []
        self._processes = []
        self.envs = []
        context = multiprocessing.get_context()
        for share in self._shares:
            here, there = context.Pipe()
            data = cloudpickle.dumps((list(make_fns[share]), image_key))
            process = context.Process(target=_work, args=(there, data), daemon=True)
            process.start()
            there.close()
            self._pipes.append(here)
            self._processes.append(process)
        self.layout, action_space, self.content_hash = self._receive()[0]
        self._describe(len(make_fns), self.layout.space, action_space)
        self._factors = {name: np.stack([row] * self.num_envs) for name, row in self.layout.blank().items()}

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See :class:`EnvCopies`."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed or [None] * self.num_envs
        images, _ = self._ask("reset", [{"seed": seeds[share], "options": options} for share in self._shares])
        return images, {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """See :class:`EnvCopies`."""
        outcome = self._ask("step", [{"actions": actions[share]} for share in self._shares])
        images, rewards, terminated, truncated, infos = outcome
        return images, rewards, terminated, truncated, infos

    def factors(self) -> dict[str, NDArray[Any]]:
        """See :class:`EnvCopies`."""
        return self._factors

    def _ask(self, name: str, arguments: list[dict[str, Any]]) -> list[Any]:
        for pipe, kwargs in zip(self._pipes, arguments, strict=True):
            pipe.send((name, kwargs))
        answers = self._receive()
        self._factors = {key: np.concatenate([rest[key] for _, rest in answers]) for key in self.layout.factors}
        *arrays, infos = zip(*(outcome for outcome, _ in answers), strict=True)
        merged: dict[str, Any] = {}
        if name == "step":
            merged["final_obs"] = np.concatenate([info["final_obs"] for info in infos])
            rows = [info["final_info"]["factors"] for info in infos]
            factors = {key: list(itertools.chain(*(row[key] for row in rows))) for key in self.layout.factors}
            merged["final_info"] = {"factors": factors}
        return [*(np.concatenate(parts) for parts in arrays), merged]

    def _receive(self) -> list[Any]:
        answers = []
        for pipe in self._pipes:
            try:
                answer, error = pipe.recv()
            except EOFError:
                raise RuntimeError("a worker process of the environments has died; try fewer --n-workers") from None
            if error is not None:
                error.add_note(f"in a worker process:\n{answer}")
                raise error
            answers.append(answer)
        return answers

    def close_extras(self, **kwargs: Any) -> None:
        """End the workers."""
        for pipe in self._pipes:
            # Workers hold ends of each other's pipes where they were forked: closing ours does not end them.
            with contextlib.suppress(OSError):
                pipe.send(None)
            pipe.close()
        for process in self._processes:
            process.join(timeout=10)
            if process.is_alive():
                process.kill()


def _work(pipe: Connection, data: bytes) -> None:
    """A worker: answers until it gets None, the parent dies or somebody interrupts both."""
    try:
        # What cloudpickle writes, pickle reads.
        copies = EnvCopies(*pickle.loads(data))
        content_hash = getattr(copies.envs[0].unwrapped, "content_hash", None)
        pipe.send(((copies.layout, copies.single_action_space, content_hash), None))
        while (asked := pipe.recv()) is not None:
            name, kwargs = asked
            outcome = getattr(copies, name)(**kwargs)
            pipe.send(((outcome, copies.factors()), None))
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        pass
    except Exception as error:
        # The parent raises it.
        pipe.send((traceback.format_exc(), error))
