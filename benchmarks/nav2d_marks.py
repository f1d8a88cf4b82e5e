"""What an agent reaches on Nav2D that is told what encoders have to see: the upper marks of docs/results_appendix.md.

Importing this module registers two ids. Both have Nav2D's episodes, actions and rewards, and vectors as observations:

* ``Nav2DNeighborhood-v0``: the agent's cell (one-hot) and which of the 9 x 9 cells around it are blocked;
* ``Nav2DGains-v0``: the same, and by how many steps each move brings the agent nearer to the goal.

``sb3-abisim train --algo ppo --env Nav2DGains-v0 --packages benchmarks.nav2d_marks --conf-file
benchmarks/nav2d_marks.yml`` is PPO with the settings of Nav2D.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.grids import fewest_steps
from sb3_abisim.envs.nav2d import GOAL, MOVES, SIZE, next_cells

N_CELLS = SIZE * SIZE
GOAL_CELL = GOAL[1] * SIZE + GOAL[0]
RADIUS = 4
N_AROUND = (2 * RADIUS + 1) ** 2


class Privileged(gym.ObservationWrapper[NDArray[np.float32], Any, NDArray[np.uint8]]):
    """Nav2D's state as a vector.

    :param env: a Nav2D
    :param gains: whether each move's gain is part of it
    """

    def __init__(self, env: gym.Env[NDArray[np.uint8], Any], gains: bool = False) -> None:
        super().__init__(env)
        self.gains = gains
        size = N_CELLS + N_AROUND + gains * len(MOVES)
        self.observation_space = gym.spaces.Box(-float(SIZE), float(SIZE), (size,), np.float32)
        self._obstacles = np.zeros(N_CELLS, dtype=bool)
        self._gains = np.zeros((N_CELLS, len(MOVES)), dtype=np.float32)

    def observation(self, observation: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The vector.

        :param observation: of Nav2D, uint8 (3, 15, 15)
        """
        agent, obstacles = observation[0] > 0, observation[1] > 0
        y, x = (int(index[0]) for index in np.nonzero(agent))
        # Numbers of variance 1 and so, as embeddings are. Off the grid is blocked, too.
        around = np.pad(obstacles, RADIUS, constant_values=True)[y : y + 2 * RADIUS + 1, x : x + 2 * RADIUS + 1]
        parts = [SIZE * agent.ravel(), 2.0 * around.ravel() - 1.0]
        if self.gains:
            if not np.array_equal(obstacles.ravel(), self._obstacles):
                self._obstacles = obstacles.ravel()
                nexts = next_cells(self._obstacles)
                # Cells without a path to the goal are never visited.
                steps = np.minimum(fewest_steps(nexts, np.array([GOAL_CELL]))[:, 0], N_CELLS)
                self._gains = steps[:, None] - steps[nexts]
            parts.append(SIZE * np.clip(self._gains[y * SIZE + x], -1, 1))
        return np.concatenate(parts).astype(np.float32)


def make(gains: bool, **kwargs: Any) -> gym.Env[Any, Any]:
    """What the two ids are made with.

    :param gains: as in :class:`Privileged`
    :param kwargs: of Nav2D
    """
    return Privileged(gym.make("Nav2D-v0", **kwargs).unwrapped, gains)


for _id, _gains in (("Nav2DNeighborhood-v0", False), ("Nav2DGains-v0", True)):
    gym.register(_id, entry_point=f"{__name__}:make", kwargs={"gains": _gains}, max_episode_steps=50)
