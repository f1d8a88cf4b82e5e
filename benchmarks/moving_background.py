"""A wrapper that shows a dm_control task over the moving backgrounds of this package, for docs/others.md.

From the root of this repository, with ``MUJOCO_GL=egl``: ``--packages shimmy benchmarks.moving_background`` and
``--env-wrapper benchmarks.moving_background.MovingBackground``.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.envs.backgrounds.load import load_backgrounds
from sb3_abisim.envs.backgrounds.player import BackgroundPlayer, composite

SIZE = 64
# What MuJoCo calls a geom in a segmentation, and a plane among the types of geoms.
GEOM, PLANE = 5, 0
# A shadow on a floor that is not shown costs most of the time.
FLAGS = {"skybox": False, "shadow": False, "reflection": False}


class MovingBackground(gym.Wrapper[NDArray[np.uint8], Any, Any, Any]):
    """Observations are what a camera sees, with a clip in place of the sky and of planes.

    :param env: of dm_control through shimmy
    :param split: "train" or "eval", of the built-in clips
    :param camera_id: of the task's cameras
    """

    def __init__(self, env: gym.Env[Any, Any], split: str = "train", camera_id: int = 0) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8)
        self.camera_id = camera_id
        self._player = BackgroundPlayer(load_backgrounds(None, split), 1)
        self._generator = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with a clip of its own.

        :param seed: of the task and of the clips
        :param options: of the task
        """
        if seed is not None:
            self._generator = np.random.default_rng(seed)
        _, info = self.env.reset(seed=seed, options=options)
        self._player.start(0, self._generator)
        return self._observe(), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Go on by one step and one frame of the clip.

        :param action: of the task
        """
        _, reward, terminated, truncated, info = self.env.step(action)
        self._player.advance()
        return self._observe(), reward, terminated, truncated, info

    def _observe(self) -> NDArray[np.uint8]:
        physics = self.unwrapped._env.physics  # type: ignore[attr-defined]
        size: dict[str, Any] = {"height": SIZE, "width": SIZE, "camera_id": self.camera_id}
        seen = physics.render(**size, segmentation=True)
        planes = np.flatnonzero(physics.model.geom_type == PLANE)
        mask = (seen[..., 0] >= 0) & ~((seen[..., 1] == GEOM) & np.isin(seen[..., 0], planes))
        frame = physics.render(**size, render_flag_overrides=FLAGS).transpose(2, 0, 1)
        return composite(np.ascontiguousarray(frame)[None], mask[None], self._player.frames(np.array([0])))[0]
