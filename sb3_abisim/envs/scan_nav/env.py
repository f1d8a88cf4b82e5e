"""ScanNav: the paper's Habitat task on maps of scanned places (its appendix on environments, section "Habitat")."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.extras import require_extra
from sb3_abisim.envs.base import BatchEnv, SingleEnv
from sb3_abisim.envs.point_maze.top_down import enlarge
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.view import MARKER_RADIUS, MARKERS, MarkerPainter, SceneView
from sb3_abisim.envs.scan_nav.world import NODE, ScanWorld, StartRule
from sb3_abisim.envs.shortest_paths import ShortestPaths, open_distances

MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 32, 2048
OBS_MODES = ("rgbd", "dict", "rgb")
ACTIONS = ("stop", "move_forward", "turn_left", "turn_right")
_OPTIONS = ("scene", "goal", "start", "heading")

Scene = ScanMap | str | os.PathLike[str] | int


class ScanNavVectorEnv(BatchEnv):
    """Walk to the middle of the view in scanned places; ``num_envs`` copies. ``ScanNavEnv`` is the batch of one.

    **Observation.** What an orthographic camera above the goal sees, north up, the goal in the middle, the agent shown
    as a yellow marker with a magenta nose. ``obs_mode="rgbd"``: ``Box(0, 255, (4, image_size, image_size), uint8)``,
    red, green, blue, and depth as 255 (3 m - z) / 3 m for a surface z above the floor; where there is no surface all
    are 0. ``"rgb"``: the first three. ``"dict"``: Habitat's form, ``rgb`` uint8 (image_size, image_size, 3) and
    ``depth`` float32 (image_size, image_size, 1) in 0..1, meters below the camera (at 3 m) divided by 10. The depth
    has no marker.

    **Action.** ``Discrete(4)``: stop, move forward 0.25 m, turn left 10 degrees, turn right 10 degrees.
    ``stop="auto"``: ``Discrete(3)``, without stop. The border of the view is a wall.

    **Reward.** -0.01 + decrease of the geodesic distance to the goal + 2.5 on success. **Termination**: stop; it is a
    success at a geodesic distance under 0.2 m. With ``stop="auto"``: success, as soon as the distance is that small.
    **Truncation** after 500 steps. ``info``: ``distance_to_goal`` in m, ``collided``, ``success`` (0 or 1) and
    ``spl``, success weighted by path length: success * d0 / max(d0, length of the path), d0 the distance at the start.

    **Start.** A scene, uniformly; one of its ``goals_per_scene`` goals; a start from which the geodesic distance is
    within ``min_geodesic`` and ``max_geodesic``, and a heading, all uniformly. With ``min_ratio``, starts whose
    geodesic distance divided by the straight one, r, is less are kept with probability 20 (r - 0.98)^2, Habitat's rule.
    Distances are those of :class:`~sb3_abisim.envs.scan_nav.world.DistanceGrid` within the view, interpolated.

    **Reset options**, for all copies: ``scene`` (index), ``goal`` and ``start`` (x, y in m, in the scan's coordinates;
    a goal is moved to the nearest corner of a pixel), ``heading`` (degrees, 0 north, 90 west).

    **Factors**: ``agent`` and ``goal`` (x, y in m), ``heading`` (degrees), ``scene`` (index).

    :param num_envs: number of copies
    :param max_episode_steps: set by ``gymnasium.make_vec``
    :param render_mode: None or "rgb_array"
    :param autoreset: see :class:`BatchEnv`
    :param scenes: a scan file, a map's ``.npz`` file, a :class:`ScanMap`, the seed of an apartment, or a list of these;
        None for the five apartments
    :param image_size: pixels per side, even, at least 32
    :param view_size: meters per side
    :param obs_mode: "rgbd", "dict" or "rgb"
    :param marker: "arrow", whose nose shows the heading, or "box", the paper's plain square
    :param stop: "action" or "auto"
    :param forward_step: in m
    :param turn_angle: in degrees
    :param allow_sliding: whether the agent slides along obstacles
    :param success_distance: in m
    :param slack_reward: of every step
    :param success_reward: added on success
    :param min_geodesic: in m
    :param max_geodesic: in m
    :param min_ratio: None keeps all starts
    :param goals_per_scene: size of the fixed pool of goals; distances of each are computed once, when it is first used
    :raises SceneError: (a ``ValueError``) for a scan that cannot be used, at once and never later
    :raises ValueError: for settings out of range
    """

    renders_factors = True

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset: bool = True,
        scenes: Scene | Sequence[Scene] | None = None,
        image_size: int = 128,
        view_size: float = 6.0,
        obs_mode: str = "rgbd",
        marker: str = "arrow",
        stop: str = "action",
        forward_step: float = 0.25,
        turn_angle: float = 10.0,
        allow_sliding: bool = True,
        success_distance: float = 0.2,
        slack_reward: float = -0.01,
        success_reward: float = 2.5,
        min_geodesic: float = 1.0,
        max_geodesic: float = 30.0,
        min_ratio: float | None = None,
        goals_per_scene: int = 256,
    ) -> None:
        require_extra("scan", "ScanNav", "scipy", "PIL")
        _check_choice("obs_mode", obs_mode, OBS_MODES)
        _check_choice("marker", marker, tuple(MARKERS))
        _check_choice("stop", stop, ("action", "auto"))
        if not MIN_IMAGE_SIZE <= image_size <= MAX_IMAGE_SIZE or image_size % 2:
            raise ValueError(
                f"image_size must be an even number from {MIN_IMAGE_SIZE} to {MAX_IMAGE_SIZE}, got {image_size!r}"
            )
        if goals_per_scene < 1:
            raise ValueError(f"goals_per_scene must be a whole number of at least 1, got {goals_per_scene!r}")
        for name, value, low, high in (
            ("view_size", view_size, 2.0, 100.0),
            ("forward_step", forward_step, 0.01, 10.0),
            ("turn_angle", turn_angle, 0.1, 180.0),
            ("success_distance", success_distance, 0.01, 10.0),
            ("min_geodesic", min_geodesic, success_distance, 1000.0),
            ("max_geodesic", max_geodesic, min_geodesic, 1000.0),
            ("slack_reward", slack_reward, -1e6, 1e6),
            ("success_reward", success_reward, -1e6, 1e6),
            ("min_ratio", 1.0 if min_ratio is None else min_ratio, 1.0, 10.0),
        ):
            if not low <= value <= high:
                raise ValueError(f"{name} must lie between {low} and {high}, got {value!r}")
        super().__init__(
            num_envs,
            _observation_space(obs_mode, image_size),
            gym.spaces.Discrete(4 if stop == "action" else 3),
            max_episode_steps,
            render_mode,
            autoreset,
        )
        self.obs_mode, self.marker, self.stop, self.image_size = obs_mode, marker, stop, image_size
        self.forward_step, self.turn_angle, self.allow_sliding = forward_step, turn_angle, allow_sliding
        self.success_distance, self.slack_reward, self.success_reward = success_distance, slack_reward, success_reward
        self._pitch = view_size / image_size
        self.scans = [load_scene(scene) for scene in _as_list(scenes)]
        self._views = [SceneView(scan, image_size, view_size) for scan in self.scans]
        self._painter = MarkerPainter(marker, image_size, self._pitch)
        # The marker and a pixel stay inside the view.
        self._reach = view_size / 2 - MARKER_RADIUS - 2 * self._pitch
        rule = StartRule(min_geodesic, max_geodesic, min_ratio)
        self._world = ScanWorld(self.scans, self._pitch, self._reach, goals_per_scene, num_envs, rule)
        self._options: dict[str, Any] = {}
        self._scene = np.zeros(num_envs, dtype=np.int64)
        self._field = np.zeros(num_envs, dtype=np.int64)
        self._position = np.zeros((num_envs, 2))  # east and north of the goal, in m
        self._heading = np.zeros(num_envs)
        self._distance, self._first_distance, self._path = np.ones((3, num_envs))
        self._success, self._collided = np.zeros((2, num_envs), dtype=bool)

    @property
    def content_hash(self) -> str:
        """sha256 over the maps and the agent's marker."""
        parts = [scan.content_hash for scan in self.scans] + [repr(MARKERS[self.marker])]
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    # Episodes.

    def _take_options(self, options: dict[str, Any]) -> None:
        unknown = sorted(set(options) - set(_OPTIONS))
        if unknown:
            raise ValueError(f"unknown reset options {unknown}; known are {list(_OPTIONS)}")
        if "start" in options and "goal" not in options:
            raise ValueError(f"the option start={options['start']!r} needs a goal, which decides what is in view")
        scene = options.get("scene", 0)
        if isinstance(scene, bool) or not isinstance(scene, int | np.integer) or not 0 <= scene < len(self.scans):
            raise ValueError(f"the option scene must be an index of {len(self.scans)} scenes, got {scene!r}")
        for name in ("goal", "start"):
            if name in options and not _are_numbers(options[name], 2):
                raise ValueError(f"the option {name} must be (x, y) in meters, got {options[name]!r}")
        if not _are_numbers([options.get("heading", 0.0)], 1):
            raise ValueError(f"the option heading must be a number of degrees, got {options['heading']!r}")
        # A goal without a scene is in the first one.
        self._options = {"scene": 0, **options} if "goal" in options else dict(options)

    def _reset_envs(self, indices: NDArray[np.int64]) -> None:
        options, self._options = self._options, {}
        world = self._world
        if "goal" in options:
            self._place_goal(options, indices)
        for i in indices.tolist():
            generator = self._generators[i]
            scene, k = int(generator.integers(len(self.scans))), int(generator.integers(world.n_goals))
            self._scene[i] = options.get("scene", scene)
            if "goal" in options:
                self._field[i] = world.custom_fields[i]
            else:
                self._field[i] = world.prepare_goal(int(self._scene[i]), k)
            if "start" in options:
                goal = world.goal_positions(self._scene[[i]], self._field[[i]])[0]
                self._position[i] = np.array(options["start"], dtype=np.float64) - goal
            else:
                self._position[i] = world.sample_start(int(self._field[i]), generator)
            heading = generator.uniform(0, 360)
            self._heading[i] = options.get("heading", heading) % 360
        self._distance[indices] = world.distances(self._field[indices], self._position[indices])
        self._first_distance[indices] = self._distance[indices]
        self._path[indices] = 0
        self._success[indices] = self._collided[indices] = False

    def _place_goal(self, options: dict[str, Any], indices: NDArray[np.int64]) -> None:
        """Place the goal that reset is asked for, and refuse one without starts, or a start without a way."""
        world, scene, field = self._world, int(options["scene"]), self._world.custom_fields[indices[:1]]
        world.place_goal(scene, np.array(options["goal"], dtype=np.float64), indices)
        if "start" not in options:
            if not world.has_starts(int(field[0])):
                raise ValueError(
                    f"the goal {options['goal']} has too few starts in its view; take another, or give a start"
                )
            return
        start = np.array(options["start"], dtype=np.float64) - world.goal_positions(np.array([scene]), field)[0]
        if not world.reaches(int(field[0]), start):
            raise ValueError(
                f"there is no way from the start {options['start']} to the goal {options['goal']} within the view; "
                "take another start"
            )

    # Steps.

    def _advance(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        code = actions if self.stop == "action" else actions + 1
        before = self._distance
        forward = np.flatnonzero(code == 1)
        self._collided = np.zeros(self.num_envs, dtype=bool)
        if len(forward):
            old = self._position[forward]
            new, self._collided[forward] = self._world.moves(
                self._field[forward], old, self._heading[forward], self.forward_step, self.allow_sliding
            )
            self._position[forward] = new
            self._path[forward] += np.hypot(*(new - old).T)
            self._distance = before.copy()
            self._distance[forward] = self._world.distances(self._field[forward], new)
        turn = (code == 2) * self.turn_angle - (code == 3) * self.turn_angle
        self._heading = (self._heading + turn) % 360
        near = self._distance < self.success_distance
        ended = code == 0 if self.stop == "action" else near
        self._success = ended & near
        return self.slack_reward + (before - self._distance) + self.success_reward * self._success, ended

    def _infos(self, ended: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        longer = np.maximum(self._first_distance, self._path)
        # Whoever starts at the goal and stays there takes the shortest path.
        spl = self._success * np.divide(self._first_distance, longer, out=np.ones_like(longer), where=longer > 0)
        return {
            "is_success": self._success.copy(),
            "success": self._success.astype(np.float64),
            "spl": spl,
            "distance_to_goal": self._distance.copy(),
            "collided": self._collided.copy(),
        }

    def oracle_actions(self) -> NDArray[np.int64]:
        """The actions of one who knows the map: turn to where a step forward gains most, step, stop at the goal.

        :return: shape (num_envs,)
        """
        return self._oracle_actions(self._field, self._position, self._heading, self._distance)

    def _oracle_actions(
        self,
        fields: NDArray[np.int64],
        positions: NDArray[np.float64],
        headings: NDArray[np.float64],
        distances: NDArray[np.float64],
    ) -> NDArray[np.int64]:
        best = self._world.best_turns(
            fields, positions, headings, self.turn_angle, self.forward_step, self.allow_sliding
        )
        actions = np.where(best == 0, 1, np.where(best > 0, 2, 3))
        if self.stop == "auto":
            return np.asarray(actions - 1)
        return np.where(distances < self.success_distance, 0, actions)

    def shortest_paths(self, factors: dict[str, NDArray[Any]]) -> ShortestPaths:
        """See :meth:`BatchEnv.shortest_paths`: the actions of :meth:`oracle_actions`, and distances in m.

        :param factors: see the class
        :raises ValueError: for a goal that was given as a reset option
        """
        fields = self._world.fields_of(factors["scene"], factors["goal"])
        offsets = factors["agent"] - factors["goal"]
        distances = self._world.distances(fields, offsets)
        actions = self._oracle_actions(fields, offsets, factors["heading"], distances)
        optimal = actions[:, None] == np.arange(self.single_action_space.n)  # type: ignore[attr-defined]
        return ShortestPaths(optimal, distances, open_distances(offsets))

    def blocked_around(self, factors: dict[str, NDArray[Any]], offsets: NDArray[np.int64]) -> NDArray[np.bool_]:
        """See :meth:`BatchEnv.blocked_around`; points are a step forward apart, their y to the north.

        :param factors: see the class
        :param offsets: (n_points, 2)
        """
        return self._world.blocked(factors["scene"], factors["agent"][:, None] + self.forward_step * offsets)

    # Observations.

    def _observe(self, indices: NDArray[np.int64]) -> Any:
        scenes, fields = self._scene[indices], self._field[indices]
        goals = self._world.goal_positions(scenes, fields)
        # Not simply the position: the factors hold the sum, and what they render must not differ by a rounding.
        offsets = (goals + self._position[indices]) - goals
        return self._render(scenes, self._world.corners[fields], offsets, self._heading[indices])

    def render_factors(self, factors: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
        """See :meth:`BatchEnv.render_factors`.

        :param factors: ``agent``, ``goal``, ``heading`` and ``scene``, see the class
        """
        scenes, offsets = factors["scene"], factors["agent"] - factors["goal"]
        # Written so that NaN counts as outside.
        if not (((scenes >= 0) & (scenes < len(self.scans))).all() and (abs(offsets) <= self._reach + NODE).all()):
            raise ValueError(
                "factors with a scene that is not there, or an agent outside the view: not of this setting"
            )
        corners = self._world.corners_at(scenes, factors["goal"])
        sizes = np.array([scan.rgbd.shape[1:] for scan in self._views])[scenes] - self.image_size
        if not ((corners >= 0) & (corners <= sizes)).all():
            raise ValueError("factors with a goal outside its scene: not of this setting")
        observations: NDArray[np.uint8] = self._render(scenes, corners, offsets, factors["heading"])
        return observations

    def _render(
        self,
        scenes: NDArray[np.int64],
        corners: NDArray[np.int64],
        offsets: NDArray[np.float64],
        headings: NDArray[np.float64],
    ) -> Any:
        """Observations with the goals at these corners of pixels and the agents this far from them."""
        n = self.image_size
        observations = np.empty((len(scenes), 3 if self.obs_mode == "rgb" else 4, n, n), dtype=np.uint8)
        views = list(zip(scenes.tolist(), corners.tolist(), strict=True))
        for observation, (scene, (row, column)) in zip(observations, views, strict=True):
            observation[:] = self._views[scene].rgbd[: len(observation), row : row + n, column : column + n]
        centers = n / 2 + offsets * (1 / self._pitch, -1 / self._pitch)
        self._painter.render(observations, centers, headings)
        if self.obs_mode != "dict":
            return observations
        depth = [self._views[scene].depth[row : row + n, column : column + n] for scene, (row, column) in views]
        rgb = np.ascontiguousarray(observations[:, :3].transpose(0, 2, 3, 1))
        return {"rgb": rgb, "depth": np.stack(depth)[..., None]}

    def factors(self) -> dict[str, NDArray[Any]]:
        """The simulator's state that the current observations show; see the class."""
        goal = self._world.goal_positions(self._scene, self._field)
        return {
            "agent": goal + self._position,
            "goal": goal,
            "heading": self._heading.copy(),
            "scene": self._scene.copy(),
        }

    def _render_frame(self, index: int) -> NDArray[np.uint8]:
        observation = self._observe(np.array([index]))
        frame = np.moveaxis(observation["rgb"][0], -1, 0) if self.obs_mode == "dict" else observation[0][:3]
        middle = np.full(2, self.image_size / 2)
        radius = self.success_distance / self._pitch / 2
        return enlarge(frame, middle, radius, scale=max(1, 512 // self.image_size))


class ScanNavEnv(SingleEnv):
    """One :class:`ScanNavVectorEnv`, as a ``gymnasium.Env``; the specification stands there."""

    batch_class = ScanNavVectorEnv

    @property
    def content_hash(self) -> str:
        """sha256 over the maps and the agent's marker."""
        # Within BatchedVecEnv the batch is one row of another, which passes this on.
        return str(self.batch.content_hash)  # type: ignore[attr-defined]

    def oracle_action(self) -> int:
        """See :meth:`ScanNavVectorEnv.oracle_actions`."""
        return int(self.batch.oracle_actions()[0])  # type: ignore[attr-defined]


def load_scene(scene: Scene) -> ScanMap:
    """The map of a scene.

    :param scene: a map, a map's ``.npz`` file, a scan file, or the seed of an apartment
    :raises SceneError: for a file that cannot be used
    :raises ValueError: for anything else
    """
    if isinstance(scene, ScanMap):
        return scene
    if isinstance(scene, int) and not isinstance(scene, bool):
        return ScanMap.apartment(scene)
    if isinstance(scene, str | os.PathLike):
        return ScanMap.load(scene) if Path(scene).suffix.lower() == ".npz" else ScanMap.from_mesh(scene)
    raise ValueError(f"a scene is a ScanMap, a file, or the seed of an apartment, got {scene!r}")


def _as_list(scenes: Any) -> list[Any]:
    if scenes is None:
        from sb3_abisim.envs.scan_nav.apartment import SEEDS

        return list(SEEDS)
    if isinstance(scenes, list | tuple):
        if not scenes:
            raise ValueError("scenes is empty; give at least one, or None for the five apartments")
        return list(scenes)
    return [scenes]


def _are_numbers(values: Any, n: int) -> bool:
    try:
        array = np.asarray(values)
    except ValueError:  # lists of several lengths
        return False
    return array.shape == (n,) and array.dtype.kind in "iuf" and bool(np.isfinite(array).all())


def _check_choice(name: str, value: Any, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name} must be one of {list(known)}, got {value!r}")


def _observation_space(obs_mode: str, image_size: int) -> gym.Space[Any]:
    if obs_mode == "dict":
        return gym.spaces.Dict(
            {
                "rgb": gym.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8),
                "depth": gym.spaces.Box(0, 1, (image_size, image_size, 1), np.float32),
            }
        )
    return gym.spaces.Box(0, 255, (4 if obs_mode == "rgbd" else 3, image_size, image_size), np.uint8)
