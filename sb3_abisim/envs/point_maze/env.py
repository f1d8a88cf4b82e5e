"""PointMaze: a ball pushed through random obstacles to the center of a room, seen from above as pixels."""

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from sb3_abisim.envs.base import BatchEnv, SingleEnv
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.layout import (
    GOAL_RADIUS,
    N_OBSTACLES,
    OBSTACLE_PIXELS,
    PIXELS_PER_METER,
    ROOM_SIZE,
    WALL_PIXELS,
    goal_mask,
    sample_layout,
    static_layer,
    to_meters,
    to_pixels,
)
from sb3_abisim.envs.point_maze.paths import find_paths, solid_within
from sb3_abisim.envs.point_maze.top_down import AGENT_RADIUS, DIRECTIONS, IMAGE_SIZE
from sb3_abisim.envs.shortest_paths import ShortestPaths

MAX_THREADS = 1024

# The point body of gymnasium-robotics (assets/point/point.xml); a test compares the two.
BALL_RADIUS = 0.1  # m
TIMESTEP = 0.01  # s
GEAR = 100.0  # N
DAMPING = 1.0
FRICTION = 0.5
MAX_VELOCITY = 5.0  # m/s per axis
SUBSTEPS = 30
_MASS = 1000.0 * 4 / 3 * np.pi * BALL_RADIUS**3
_MARGIN = 0.002  # m, of each geom; two of them feel each other at the sum
_CLEARANCE = 2 * _MARGIN + 1e-4

# Time steps that cannot bring a freely pushed ball to this speed need no clip: what contacts add, when they turn the
# ball or an obstacle that it has dented pushes it out, stays below the 1 m/s left.
_SAFE_VELOCITY = 4.0
_FASTEST, _SLOWEST = np.array(MAX_VELOCITY), np.array(-MAX_VELOCITY)

_N_WALLS = 4
# What the next time step depends on; the solver begins from the last accelerations.
_SIMULATION_STATE = ("qpos", "qvel", "qacc_warmstart")

# The pixels (left, top, right, bottom) of a box in meters, the last two exclusive, with the room that a ball takes.
_BOX_MARGINS = IMAGE_SIZE // 2 + PIXELS_PER_METER * (BALL_RADIUS + _CLEARANCE) * np.array((-1, -1, 1, 1)) + (0, 0, 1, 1)
# From them to the box's corners in a flattened table of counts; with the signs, what the box holds of those counted.
_ROW = IMAGE_SIZE + 1
_BOX_CORNERS = np.array([(1, 0, 1, 0), (_ROW, _ROW, 0, 0), (0, 1, 0, 1), (0, 0, _ROW, _ROW)])
_CORNER_SIGNS = np.array((1, -1, -1, 1))


def free_displacement(forces: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """How far one step moves the ball from rest where nothing is in its way: MuJoCo's Euler integration, summed up.

    With the damping taken implicitly, as MuJoCo does, a time step turns the velocity v into decay * v + push, and the
    clip, once it bites, bites before each of the remaining time steps.

    :param forces: -1..1, any shape
    :return: m, same shape
    """
    forces = forces.astype(np.float64)
    reach = np.searchsorted(_SPEEDS, MAX_VELOCITY / np.maximum(np.abs(forces), 1e-9), side="right")
    n_free = np.minimum(reach, SUBSTEPS)
    clipped_speed = _DECAY * MAX_VELOCITY * np.sign(forces) + _PUSH * forces
    distance: NDArray[np.float64] = forces * _DISTANCES[n_free] + (SUBSTEPS - n_free) * TIMESTEP * clipped_speed
    return distance


_DECAY = 1 / (1 + TIMESTEP * DAMPING / _MASS)
_PUSH = _DECAY * TIMESTEP * GEAR / _MASS
_N_UNCLIPPED = int(_SAFE_VELOCITY / _PUSH)
# Of a ball pushed with full force, after 0 to SUBSTEPS time steps without the clip.
_SPEEDS = _PUSH * (1 - _DECAY ** np.arange(SUBSTEPS + 1)) / (1 - _DECAY)
_DISTANCES = TIMESTEP * np.cumsum(_SPEEDS)


def point_model() -> mujoco.MjModel:
    """The room with its walls, obstacles (placed per simulation through ``geom_pos``) and the ball."""
    half, thick, box = ROOM_SIZE / 2, WALL_PIXELS / PIXELS_PER_METER / 2, OBSTACLE_PIXELS / PIXELS_PER_METER / 2
    boxes = [(side * (half + thick), 0.0, thick, half) for side in (-1, 1)]
    boxes += [(0.0, side * (half + thick), half + 2 * thick, thick) for side in (-1, 1)]
    # Compiled away from the origin: MuJoCo takes a geom compiled at its body's frame to stay there (geom_sameframe).
    boxes += [(1.0, 1.0, box, box)] * N_OBSTACLES
    geoms = "".join(f'<geom type="box" pos="{x} {y} 0" size="{a} {b} {thick}"/>' for x, y, a, b in boxes)
    axes = "".join(f'<joint name="{n}" type="slide" axis="{a}"/>' for n, a in (("x", "1 0 0"), ("y", "0 1 0")))
    motors = "".join(f'<motor joint="{n}" gear="{GEAR}" ctrllimited="true" ctrlrange="-1 1"/>' for n in "xy")
    # Without the midphase: its bounding volumes would stay where the obstacles were when the model was compiled, and
    # the ball would pass through them. Without islands: one ball is one, and looking for it takes a twelfth of a step.
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco>
        <option timestep="{TIMESTEP}" gravity="0 0 0" iterations="20" integrator="Euler">
          <flag midphase="disable" island="disable"/>
        </option>
        <default>
          <joint damping="{DAMPING}"/>
          <geom friction="{FRICTION} .1 .1" density="1000" margin="{_MARGIN}" condim="1"/>
        </default>
        <worldbody>{geoms}<body name="ball"><geom type="sphere" size="{BALL_RADIUS}"/>{axes}</body></worldbody>
        <actuator>{motors}</actuator></mujoco>"""
    )


class PointMazeVectorEnv(BatchEnv):
    """``num_envs`` point mazes, their physics advanced by one call.

    **World.** A room of 15 m x 15 m inside walls of 0.5 m; the observation shows 16 m x 16 m at exactly 4 pixels per
    meter. Positions are (x, y) in meters from the center of the room, x to the right and y *down*. Each episode has 20
    obstacles of 2 m x 2 m with corners on the pixel grid, uniform over the room outside the 2 m x 2 m square around the
    goal; they may overlap. The start is uniform over the positions that keep 0.125 m between the ball's center and
    everything solid and lie outside the goal. Obstacles and start are sampled again until a corridor 0.5 m wide leads
    from the start to the goal, which is the center (0, 0). With ``goal="random"`` (``PointMazeRandomGoal-v0`` and its
    siblings) each episode samples the goal first, uniformly over the corners between pixels at least 1 m inside the
    walls; with ``"corners"`` from (-3.5, -3.5), (3.5, -3.5), (-3.5, 3.5) and (3.5, 3.5).

    **Actions.** 0, 1, 2, 3 push with full force up, down, left, right; with ``continuous`` a force (x, y) in
    ``Box(-1, 1, (2,), float32)``, x to the right and y down, in units of 100 N per axis.

    **Physics.** MuJoCo on the point body of gymnasium-robotics: a ball of 4.19 kg and 0.1 m radius, joint damping 1,
    friction 0.5, time step 0.01 s, velocity clipped to 5 m/s per axis before every time step. A step of the
    environment is 30 time steps. It begins from rest, so that one observation is the whole state, and a push covers
    about 1 m of free floor; ``momentum=True`` keeps the velocity instead. Where nothing lies in the ball's way, the 30
    time steps from rest are summed in closed form (:func:`free_displacement`, equal to MuJoCo's to 1e-12 m).

    **Observation.** uint8 (3, 64, 64), RGB: light floor, dark walls and obstacles, a green square of 1 m at the goal,
    and the agent as a red disc of 0.3 m radius, antialiased, so that its position can be read to a fraction of a
    pixel.

    **Reward.** -1 per step and 0 on the step that ends with the ball's center within 1 m of the goal, which ends
    the episode; with ``reward_type="sparse"`` 0 and 1. 128 steps under the registered ids.

    **Factors.** ``agent`` (2,), ``velocity`` (2,) with momentum only, ``obstacles`` (20, 2) centers, ``goal`` (2,),
    all float32, in meters and m/s.

    :param num_envs: number of copies, at least 1
    :param continuous: two-dimensional forces instead of four pushes
    :param reward_type: "step" or "sparse"
    :param goal: "center", "random" or "corners"
    :param momentum: keep the velocity from one step to the next
    :param n_threads: threads for the physics, at least 1; the results do not depend on it
    :param max_episode_steps: steps after which an episode is truncated, None for no limit
    :param render_mode: None or "rgb_array", which renders 512 x 512 pixels
    :param autoreset: False leaves finished copies for :class:`PointMazeEnv` to reset
    :raises ValueError: for an unknown ``reward_type`` or ``goal``, or ``n_threads`` below 1
    """

    def __init__(
        self,
        num_envs: int = 1,
        continuous: bool = False,
        reward_type: str = "step",
        momentum: bool = False,
        n_threads: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset: bool = True,
        goal: str = "center",
    ) -> None:
        if goal not in ("center", "random", "corners"):
            raise ValueError(f"goal must be 'center', 'random' or 'corners', got {goal!r}")
        if reward_type not in ("step", "sparse"):
            raise ValueError(f"reward_type must be 'step' or 'sparse', got {reward_type!r}")
        if not 1 <= n_threads <= MAX_THREADS:
            raise ValueError(f"n_threads must lie between 1 and {MAX_THREADS}, got {n_threads}")
        action_space: gym.Space[Any]
        if continuous:
            action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        else:
            action_space = gym.spaces.Discrete(len(DIRECTIONS))
        observation_space = gym.spaces.Box(0, 255, (3, IMAGE_SIZE, IMAGE_SIZE), np.uint8)
        super().__init__(num_envs, observation_space, action_space, max_episode_steps, render_mode, autoreset)
        self.continuous = continuous
        self.reward_type = reward_type
        self.momentum = momentum
        self.goal = goal
        # In meters.
        self._goals = np.zeros((num_envs, 2))
        self._connect(n_threads)
        self._layers = np.zeros((num_envs, *observation_space.shape), dtype=np.uint8)
        # 255 where floor is seen, and the layer elsewhere: to lay the layer over backgrounds by bitwise operations.
        self._floor = np.zeros((num_envs, 1, IMAGE_SIZE, IMAGE_SIZE), dtype=np.uint8)
        self._standing = np.zeros_like(self._layers)
        self._agent = top_down.DiscPainter(AGENT_RADIUS * PIXELS_PER_METER, IMAGE_SIZE)
        # [row, column]: how many pixels above and to the left are walls or obstacles.
        self._solid_counts = np.zeros((num_envs, IMAGE_SIZE + 1, IMAGE_SIZE + 1), dtype=np.int64)
        self._first_count = self._everyone[:, None] * (IMAGE_SIZE + 1) ** 2
        self._pushes = free_displacement(DIRECTIONS)

    def _connect(self, n_threads: int) -> None:
        self._physics = Batch(point_model(), self.num_envs, n_threads)
        self._position = self._physics.bind("qpos")
        self._velocity = self._physics.bind("qvel")
        self._force = self._physics.bind("ctrl")
        self._obstacle_pos = self._physics.expand("geom_pos")[:, _N_WALLS : _N_WALLS + N_OBSTACLES, :2]

    def __getstate__(self) -> dict[str, Any]:
        """For ``copy`` and ``pickle``, which know no MuJoCo batch: the numbers that it goes on from, in its place."""
        live = ("_physics", "_position", "_velocity", "_force", "_obstacle_pos")
        state = {name: value for name, value in self.__dict__.items() if name not in live}
        state["n_threads"] = self._physics.nthread
        state["obstacle_pos"] = self._obstacle_pos.copy()
        state["simulation"] = {name: self._physics.bind(name).copy() for name in _SIMULATION_STATE}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        n_threads, obstacle_pos, simulation = (state.pop(name) for name in ("n_threads", "obstacle_pos", "simulation"))
        self.__dict__.update(state)
        self._connect(n_threads)
        self._obstacle_pos[:] = obstacle_pos
        for name, array in simulation.items():
            self._physics.bind(name)[:] = array

    def _reset_envs(self, indices: NDArray[np.int64]) -> None:
        self._physics.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        for i in indices:
            layout = sample_layout(self._generators[i], self.goal)
            solid, mark = layout.solid, goal_mask(layout.goal)
            self._obstacle_pos[i] = to_meters(layout.corners + OBSTACLE_PIXELS / 2)
            self._position[i] = layout.start
            self._goals[i] = to_meters(np.array(layout.goal))
            self._solid_counts[i, 1:, 1:] = solid.cumsum(axis=0).cumsum(axis=1)
            self._layers[i] = static_layer(solid, mark)
            self._floor[i] = np.where(solid | mark, 0, 255)
            self._standing[i] = self._layers[i] & ~self._floor[i]

    def _advance(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        self._force[:] = actions if self.continuous else DIRECTIONS[actions]
        if self.momentum:
            self._simulate(None, SUBSTEPS)
        else:
            self._move_from_rest(free_displacement(actions) if self.continuous else self._pushes[actions])
        away = self._position - self._goals
        reached = np.hypot(away[:, 0], away[:, 1]) <= GOAL_RADIUS
        rewards = reached - 1.0 if self.reward_type == "step" else reached.astype(np.float64)
        return rewards, reached

    def _move_from_rest(self, displacements: NDArray[np.float64]) -> None:
        """Move the balls that nothing is in the way of by ``displacements``; MuJoCo simulates the others."""
        targets = self._position + displacements
        touching = self._solid_between(self._position, targets)
        n_touching = np.count_nonzero(touching)
        if n_touching == self.num_envs:
            self._simulate_from_rest(None)
            return
        np.copyto(self._position, targets, where=~touching[:, None])
        if n_touching:
            self._simulate_from_rest(np.flatnonzero(touching))

    def _simulate_from_rest(self, indices: NDArray[np.int64] | None) -> None:
        """The time steps of one step; those that no clip can concern in as few calls as possible."""
        self._velocity[:] = 0.0
        self._physics.step(indices, nstep=_N_UNCLIPPED)
        remaining = SUBSTEPS - _N_UNCLIPPED
        if np.abs(self._velocity).max() + remaining * _PUSH < _SAFE_VELOCITY:
            self._physics.step(indices, nstep=remaining)
        else:
            self._simulate(indices, remaining)

    def _simulate(self, indices: NDArray[np.int64] | None, substeps: int) -> None:
        for _ in range(substeps):
            np.minimum(self._velocity, _FASTEST, out=self._velocity)
            np.maximum(self._velocity, _SLOWEST, out=self._velocity)
            self._physics.step(indices)

    def _solid_between(self, starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the box that a ball sweeps from start to end holds any solid pixel, shape (num_envs,)."""
        box = np.empty((self.num_envs, 4))
        np.minimum(starts, ends, out=box[:, :2])
        np.maximum(starts, ends, out=box[:, 2:])
        pixels = (box * PIXELS_PER_METER + _BOX_MARGINS).astype(np.int64)
        np.maximum(pixels, 0, out=pixels)
        np.minimum(pixels, IMAGE_SIZE, out=pixels)
        counts = self._solid_counts.reshape(-1)[pixels @ _BOX_CORNERS + self._first_count]
        solid: NDArray[np.bool_] = counts @ _CORNER_SIGNS > 0
        return solid

    def _observe(self, indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        observations: NDArray[np.uint8] = self._layers[indices]
        self._agent.render(observations, to_pixels(self._position[indices]))
        return observations

    def _observe_over(self, backgrounds: NDArray[np.uint8], indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        """The observations with backgrounds in place of the floor.

        Pixels that agent, obstacles, goal or walls touch, the agent's antialiased edge among them, have the bytes of
        the plain observation.

        :param backgrounds: contiguous, shape (len(indices), 3, 64, 64), overwritten
        :return: ``backgrounds``
        """
        self._lay_over(backgrounds, indices)
        self._agent.render(backgrounds, to_pixels(self._position[indices]), over=self._rows(self._layers, indices))
        return backgrounds

    def _lay_over(self, backgrounds: NDArray[np.uint8], indices: NDArray[np.int64]) -> None:
        """Replace all of the backgrounds but the floor by the static layers, in place."""
        np.bitwise_and(backgrounds, self._rows(self._floor, indices), out=backgrounds)
        np.bitwise_or(backgrounds, self._rows(self._standing, indices), out=backgrounds)

    def _rows(self, array: NDArray[np.uint8], indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        """What an array holds of some copies, to read only: without copying it for all of them."""
        rows: NDArray[np.uint8] = array if indices is self._everyone else array[indices]
        return rows

    def _backdrop(self, index: int) -> NDArray[np.uint8]:
        """The observation of one copy without its agent, shape (3, 64, 64); what ``render`` enlarges."""
        backdrop: NDArray[np.uint8] = self._layers[index]
        return backdrop

    def _render_frame(self, index: int) -> NDArray[np.uint8]:
        return top_down.enlarge(self._backdrop(index), to_pixels(self._position[index]), self._agent.radius)

    def factors(self) -> dict[str, NDArray[Any]]:
        """The simulator's state that the current observations show, for probes; see the class."""
        factors = {
            "agent": self._position.astype(np.float32),
            "obstacles": self._obstacle_pos.astype(np.float32),
            "goal": self._goals.astype(np.float32),
        }
        if self.momentum:
            factors["velocity"] = self._velocity.astype(np.float32)
        return factors

    def shortest_paths(self, factors: dict[str, NDArray[Any]]) -> ShortestPaths:
        """See :meth:`BatchEnv.shortest_paths`: of full pushes up, down, left and right from rest, distances in m.

        :param factors: see the class
        """
        agents, obstacles, goals = (factors[name].astype(np.float64) for name in ("agent", "obstacles", "goal"))
        return find_paths(agents, obstacles, goals, BALL_RADIUS, float(np.abs(self._pushes).max()))

    def blocked_around(self, factors: dict[str, NDArray[Any]], offsets: NDArray[np.int64]) -> NDArray[np.bool_]:
        """See :meth:`BatchEnv.blocked_around`; points are a meter apart.

        :param factors: see the class
        :param offsets: (n_points, 2)
        """
        return solid_within(factors["agent"][:, None] + offsets, factors["obstacles"])


class PointMazeEnv(SingleEnv):
    """One :class:`PointMazeVectorEnv`, as a ``gymnasium.Env``; the specification stands there."""

    batch_class = PointMazeVectorEnv
