"""Observations of the PointMaze kind for the point mazes of gymnasium-robotics."""

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.arguments import checked_arguments
from sb3_abisim.envs.backgrounds.clips import Backgrounds
from sb3_abisim.envs.backgrounds.player import BackgroundPlayer, composite
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.top_down import AGENT_RADIUS, DIRECTIONS, IMAGE_SIZE, DiscPainter

GOAL_RADIUS = 0.45  # m, within which gymnasium-robotics counts a success
MIN_CELL_PIXELS = 3


class PointMazePixels(gym.Env[NDArray[np.uint8], Any]):
    """Shows a gymnasium-robotics ``PointMaze`` from above, as ``PointMaze-v0`` shows its rooms::

        gym.register_envs(gymnasium_robotics)
        env = PointMazePixels(gym.make("PointMaze_UMaze-v3", continuing_task=False, max_episode_steps=3000),
                              continuous=False, frame_skip=30, momentum=False)

    **Observation.** uint8 (3, 64, 64), RGB, in the colors of ``PointMaze-v0``, rendered without GL: walls where the map
    has 1, the floor within 0.45 m (the success radius) of the wrapped environment's goal in green, the agent as a red
    disc of 0.3 m radius. A cell of the map takes the whole number of pixels that fits the map into the observation;
    what lies around the map is shown as wall. With ``backgrounds`` the floor shows video clips.

    **Actions.** As in ``PointMaze-v0``: forces (x, y) in ``Box(-1, 1, (2,), float32)``, x to the right and y *down*
    (gymnasium-robotics has y up), or with ``continuous=False`` 0, 1, 2, 3 for a full push up, down, left, right.

    **Steps.** A step of gymnasium-robotics is 0.01 s with momentum. ``frame_skip=30, momentum=False`` gives the steps
    of ``PointMaze-v0``, about 1 m each. Rewards of skipped steps are summed, and skipping stops where an episode ends.
    The limit of ``gym.make`` counts the steps of the wrapped environment: raise it by the same factor.

    **Info.** ``is_success`` is true where the goal was reached during the step (gymnasium-robotics' ``success``).

    This is an environment that holds the other as ``env``, not a ``gymnasium.Wrapper``: Stable-Baselines3 takes
    whatever has a goal-conditioned environment at its core for one.

    :param env: a ``PointMaze`` of gymnasium-robotics, with any map
    :param continuous: forces; False for four pushes
    :param frame_skip: steps of the wrapped environment per action, at least 1
    :param momentum: False sets the velocity to zero before each action
    :param backgrounds: clips to show on the floor, from
        :func:`~sb3_abisim.envs.backgrounds.load.load_backgrounds`; None for plain floor
    :param order: "video" or "shuffled", of the frames of a clip
    :param color_jitter: whether each episode shows its clip with another color jitter, as train episodes of the
        Distractor environments do
    :raises ValueError: for another kind of environment, a map of more than 21 cells a side, or ``frame_skip`` below 1
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

    @checked_arguments
    def __init__(
        self,
        env: gym.Env[Any, Any],
        continuous: bool = True,
        frame_skip: int = 1,
        momentum: bool = True,
        backgrounds: Backgrounds | None = None,
        order: str = "video",
        color_jitter: bool = False,
    ) -> None:
        self.env = env
        self.render_mode = "rgb_array"
        self._maze_env: Any = env.unwrapped
        if not hasattr(self._maze_env, "point_env") or not hasattr(self._maze_env, "maze"):
            raise ValueError(f"PointMazePixels wraps the PointMaze ids of gymnasium-robotics, got {env}")
        if frame_skip < 1:
            raise ValueError(f"frame_skip must be at least 1, got {frame_skip}")
        self.continuous = continuous
        self.frame_skip = frame_skip
        self._over = True
        self.momentum = momentum
        self.observation_space = gym.spaces.Box(0, 255, (3, IMAGE_SIZE, IMAGE_SIZE), np.uint8)
        if continuous:
            self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        else:
            self.action_space = gym.spaces.Discrete(len(DIRECTIONS))
        self._walls = self._render_walls()
        self._goal = DiscPainter(GOAL_RADIUS * self._pixels_per_meter, IMAGE_SIZE, top_down.GOAL)
        self._agent = DiscPainter(AGENT_RADIUS * self._pixels_per_meter, IMAGE_SIZE)
        self._player = None if backgrounds is None else BackgroundPlayer(backgrounds, 1, order, color_jitter)

    def _render_walls(self) -> NDArray[np.bool_]:
        """The map fitted into the observation; sets the scale."""
        maze = self._maze_env.maze
        walls = np.array([[cell == 1 for cell in row] for row in maze.maze_map])
        cell = IMAGE_SIZE // max(walls.shape)
        if cell < MIN_CELL_PIXELS:
            raise ValueError(
                f"a map of {walls.shape[0]} x {walls.shape[1]} cells does not fit {IMAGE_SIZE} pixels a side; "
                f"use one of at most {IMAGE_SIZE // MIN_CELL_PIXELS} cells a side"
            )
        self._pixels_per_meter = cell / maze.maze_size_scaling
        mask = np.ones((IMAGE_SIZE, IMAGE_SIZE), dtype=bool)
        height, width = (cell * n for n in walls.shape)
        top, left = (IMAGE_SIZE - height) // 2, (IMAGE_SIZE - width) // 2
        mask[top : top + height, left : left + width] = walls.repeat(cell, axis=0).repeat(cell, axis=1)
        self._center = np.array([left + width / 2, top + height / 2])
        return mask

    def _to_pixels(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """The wrapped environment's (x, y), y up, as one (column, row): shape (1, 2)."""
        pixels: NDArray[np.float64] = self._center + position * (1.0, -1.0) * self._pixels_per_meter
        return pixels[None]

    @property
    def _agent_pixels(self) -> NDArray[np.float64]:
        return self._to_pixels(self._maze_env.data.qpos[:2])

    @property
    def _goal_pixels(self) -> NDArray[np.float64]:
        return self._to_pixels(self._maze_env.goal)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Start a new episode.

        :param seed: determines the wrapped environment and the clips
        :param options: of the wrapped environment (``goal_cell``, ``reset_cell``)
        """
        # The clips sample from `np_random` here, the maze from the wrapped environment's: any clips, the same mazes.
        super().reset(seed=seed)
        _, info = self.env.reset(seed=seed, options=options)
        self._over = False
        if self._player is not None:
            self._player.start(0, self.np_random)
        return self._observe(), info

    def step(self, action: Any) -> tuple[NDArray[np.uint8], SupportsFloat, bool, bool, dict[str, Any]]:
        """Take one action.

        :param action: an element of the action space
        :raises ValueError: for an action of the wrong shape, out of range, or not finite
        :raises RuntimeError: before the first reset, or after the episode's end
        """
        force = self._force(action)
        if self._over:
            raise RuntimeError("the episode is over (or has not begun): call reset() before step()")
        if not self.momentum:
            point_env = self._maze_env.point_env
            point_env.set_state(point_env.data.qpos, np.zeros(2))
        total, success = 0.0, False
        for _ in range(self.frame_skip):
            _, reward, terminated, truncated, info = self.env.step(force)
            total += float(reward)
            success |= bool(info["success"])
            if terminated or truncated:
                break
        if self._player is not None:
            self._player.advance()
        self._over = bool(terminated or truncated)
        return self._observe(), total, terminated, truncated, {**info, "is_success": success}

    def _force(self, action: Any) -> NDArray[np.float32]:
        """The wrapped environment's action."""
        array = np.asarray(action, dtype=np.float32) if self.continuous else np.asarray(action)
        if not self.action_space.contains(array):
            raise ValueError(f"action {action!r} is outside {self.action_space}; clip or rescale it before step()")
        force = array if self.continuous else DIRECTIONS[int(array)]
        return (force * (1, -1)).astype(np.float32)

    def _observe(self, agent: bool = True) -> NDArray[np.uint8]:
        """The current observation, with or without the agent, shape (3, 64, 64)."""
        observations = top_down.floor(IMAGE_SIZE)[None]
        self._goal.render(observations, self._goal_pixels)
        top_down.paint(observations[0], self._walls, top_down.WALL)
        if agent:
            self._agent.render(observations, self._agent_pixels)
        if self._player is not None:
            masks = self._walls[None].copy()
            self._goal.mark(masks, self._goal_pixels)
            if agent:
                self._agent.mark(masks, self._agent_pixels)
            observations = composite(observations, masks, self._player.frames(np.arange(1)))
        observation: NDArray[np.uint8] = observations[0]
        return observation

    def render(self) -> NDArray[np.uint8]:
        """An image for people, (512, 512, 3) uint8, RGB."""
        return top_down.enlarge(self._observe(agent=False), self._agent_pixels[0], self._agent.radius)

    def close(self) -> None:
        """Close the wrapped environment."""
        self.env.close()

    def factors(self) -> dict[str, NDArray[np.float32]]:
        """``agent``, ``velocity`` and ``goal``, each (2,) float32, in meters and m/s from the middle of the map, x to
        the right and y down."""
        data, flip = self._maze_env.data, np.array([1, -1])
        values = {"agent": data.qpos[:2], "velocity": data.qvel[:2], "goal": self._maze_env.goal}
        return {name: (value * flip).astype(np.float32) for name, value in values.items()}
