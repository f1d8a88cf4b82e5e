"""Nav2D: a 15 x 15 grid with random obstacles and the goal in the center (section "2D Navigation" of the paper)."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.grids import flood_fill
from sb3_abisim.envs.base import BatchEnv, SingleEnv

SIZE = 15
N_OBSTACLES = 20
OBSTACLE_SIZE = 2
GOAL = (7, 7)
# (dx, dy) of actions 0 to 3; x points right, y points down: up, down, left, right.
MOVES = ((0, -1), (0, 1), (-1, 0), (1, 0))
CHANNELS = ("agent", "obstacles", "goal")

# Fixed structures: "." can be reached, "#" is always an obstacle, "?" cannot be reached and shows random obstacles.
LAYOUTS = {
    "corridor": ("?" * 15,) * 5 + ("#" * 15,) + ("." * 15,) * 3 + ("#" * 15,) + ("?" * 15,) * 5,
    "maze": (
        "...............",
        ".######.######.",
        ".#????#.#????#.",
        ".#????#.#????#.",
        ".#??###.###??#.",
        ".#??#.....#??#.",
        ".####.###.####.",
        "......#........",
        ".####.###.####.",
        ".#??#.....#??#.",
        ".#??###.###??#.",
        ".#????#.#????#.",
        ".#????#.#????#.",
        ".######.######.",
        "...............",
    ),
}

_COLORS = {"floor": (240, 240, 235), "obstacles": (60, 64, 72), "goal": (46, 160, 67), "agent": (214, 40, 40)}
_CELL_PIXELS = 32

_N_CELLS = SIZE * SIZE
_GOAL_CELL = GOAL[1] * SIZE + GOAL[0]
# Bitboards of :mod:`~sb3_abisim.common.grids`; their sixteenth column is never free.
_STRIDE = SIZE + 1
_BITS = np.array([1 << (y * _STRIDE + x) for y in range(SIZE) for x in range(SIZE)], dtype=object)
_BOARD = int(_BITS.sum())
_CORNERS = [(x, y) for y in range(SIZE - OBSTACLE_SIZE + 1) for x in range(SIZE - OBSTACLE_SIZE + 1)]
_BLOCK_CELLS = np.array(
    [[(y + j) * SIZE + x + i for j in range(OBSTACLE_SIZE) for i in range(OBSTACLE_SIZE)] for x, y in _CORNERS]
)
_BLOCK_BITS = [int(_BITS[cells].sum()) for cells in _BLOCK_CELLS]


def _blocks_sparing(cell: int) -> NDArray[np.int64]:
    """Indices of the 2 x 2 blocks that cover neither ``cell`` nor the goal."""
    return np.flatnonzero(~np.isin(_BLOCK_CELLS, (cell, _GOAL_CELL)).any(axis=1))


_BLOCKS_SPARING = [_blocks_sparing(cell) for cell in range(SIZE * SIZE)]


def _neighbors() -> NDArray[np.int64]:
    """The cell that each move leads to on an empty grid, shape (SIZE * SIZE, 4)."""
    y, x = np.divmod(np.arange(_N_CELLS)[:, None], SIZE)
    dx, dy = np.array(MOVES).T
    # Clipping leaves a move off the grid in place, because a move changes one coordinate only.
    cells: NDArray[np.int64] = np.clip(y + dy, 0, SIZE - 1) * SIZE + np.clip(x + dx, 0, SIZE - 1)
    return cells


_NEIGHBORS = _neighbors()


def next_cells(obstacles: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Where each move leads from each cell, as cell indices (y * SIZE + x).

    :param obstacles: by cell, (SIZE * SIZE,)
    :return: (SIZE * SIZE, n_actions)
    """
    stay = np.arange(_N_CELLS)[:, None]
    cells: NDArray[np.int64] = np.where(obstacles[_NEIGHBORS], stay, _NEIGHBORS)
    return cells


class Nav2DVectorEnv(BatchEnv):
    """Navigate a 15 x 15 grid to its center; ``num_envs`` copies at once. ``Nav2DEnv`` is the batch of one.

    **Observation**: ``Box(0, 255, (3, 15, 15), uint8)``; channels agent, obstacles, goal, each 255 where the thing is
    and 0 elsewhere, indexed ``[channel, y, x]``. **Action**: ``Discrete(4)``, the moves (dx, dy) = (0,-1), (0,1),
    (-1,0), (1,0), that is up, down, left, right; a move into an obstacle or off the grid leaves the agent in place.
    **Reward**: -1 a step, 0 for the step that reaches the goal (7, 7), which ends the episode. **Truncation** after
    50 steps. ``info["is_success"]`` is true where the goal was reached.

    **Start**, ``layout="random"`` (``Nav2D-v0``): agent uniform over all cells but the goal; 20 obstacles of 2 x 2
    cells uniform over the positions inside the grid that cover neither agent nor goal (they may overlap); all is
    sampled again until a path exists. ``"corridor"`` (``Nav2DCorridor-v0``) and ``"maze"`` (``Nav2DMaze-v0``): the
    reachable region is fixed (:data:`LAYOUTS`) and empty; 20 blocks of 2 x 2 are sampled in each episode and shown
    where they fall on cells that cannot be reached. The paper prints both structures as small figures only, so we
    chose their cells.

    :param num_envs: number of copies
    :param max_episode_steps: set by ``gymnasium.make_vec``
    :param render_mode: None or "rgb_array"
    :param autoreset: see :class:`BatchEnv`
    :param layout: "random", "corridor" or "maze"
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset: bool = True,
        layout: str = "random",
    ) -> None:
        if layout != "random" and layout not in LAYOUTS:
            raise ValueError(f"layout must be one of {['random', *LAYOUTS]}, got {layout!r}")
        super().__init__(
            num_envs,
            gym.spaces.Box(0, 255, (len(CHANNELS), SIZE, SIZE), np.uint8),
            gym.spaces.Discrete(len(MOVES)),
            max_episode_steps,
            render_mode,
            autoreset,
        )
        self.layout = layout
        # Observations are kept up to date move by move; channel order as in CHANNELS, cells flattened.
        self._observations = np.zeros((num_envs, len(CHANNELS), SIZE * SIZE), dtype=np.uint8)
        self._observations[:, 2, _GOAL_CELL] = 255
        # Agents are kept as indices into the flattened observations, and so is where each move leads from each index.
        # A step is then one lookup.
        self._first = np.arange(num_envs) * len(CHANNELS) * _N_CELLS
        self._agents = self._first.copy()
        self._goals = self._first + _GOAL_CELL
        self._targets = np.zeros((num_envs, len(CHANNELS) * _N_CELLS, len(MOVES)), dtype=np.int64)
        if layout != "random":
            cells = np.array([list(row) for row in LAYOUTS[layout]]).ravel()
            self._walls, self._scenery = cells == "#", cells == "?"
            # The agent starts anywhere in the reachable region but on the goal.
            self._starts = np.flatnonzero((cells == ".") & (np.arange(SIZE * SIZE) != _GOAL_CELL))

    def _reset_envs(self, indices: NDArray[np.int64]) -> None:
        sample = self._sample_random if self.layout == "random" else self._sample_fixed
        for i in indices:
            cell, obstacles = sample(self._generators[i])
            self._agents[i] = self._first[i] + cell
            self._observations[i, 0] = 0
            self._observations[i, 0, cell] = 255
            self._observations[i, 1] = np.where(obstacles, 255, 0)
            self._targets[i, :_N_CELLS] = self._first[i] + next_cells(obstacles)

    def _sample_random(self, generator: np.random.Generator) -> tuple[int, NDArray[np.bool_]]:
        """An agent's cell and obstacles (SIZE * SIZE,) with a path to the goal."""
        while True:
            cell = int(generator.integers(SIZE * SIZE - 1))
            cell += cell >= _GOAL_CELL
            allowed = _BLOCKS_SPARING[cell]
            blocks = allowed[generator.integers(len(allowed), size=N_OBSTACLES)]
            board = 0
            for block in blocks:
                board |= _BLOCK_BITS[block]
            start = _BITS[cell]
            if flood_fill(_BITS[_GOAL_CELL], _BOARD & ~board, _STRIDE, stop=start) & start:
                obstacles = np.zeros(SIZE * SIZE, dtype=bool)
                obstacles[_BLOCK_CELLS[blocks]] = True
                return cell, obstacles

    def _sample_fixed(self, generator: np.random.Generator) -> tuple[int, NDArray[np.bool_]]:
        """An agent's cell in the fixed reachable region, and its walls with new scenery beyond them."""
        cell = int(self._starts[generator.integers(len(self._starts))])
        scenery = np.zeros(SIZE * SIZE, dtype=bool)
        scenery[_BLOCK_CELLS[generator.integers(len(_BLOCK_CELLS), size=N_OBSTACLES)]] = True
        return cell, self._walls | (scenery & self._scenery)

    def _advance(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        pixels = self._observations.reshape(-1)
        pixels[self._agents] = 0
        self._agents = self._targets.reshape(-1)[self._agents * len(MOVES) + actions]
        pixels[self._agents] = 255
        reached = self._agents == self._goals
        return reached - 1.0, reached

    def _observe(self, indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        # Indexing with an array copies, so callers may keep what they get.
        return self._observations[indices].reshape(-1, len(CHANNELS), SIZE, SIZE)

    def factors(self) -> dict[str, NDArray[Any]]:
        """Agent (x, y), int64 (num_envs, 2); obstacles by [y, x], bool (num_envs, 15, 15)."""
        y, x = np.divmod(self._agents - self._first, SIZE)
        obstacles = self._observations[:, 1].reshape(-1, SIZE, SIZE) > 0
        return {"agent": np.stack([x, y], axis=1), "obstacles": obstacles}

    def _render_frame(self, index: int) -> NDArray[np.uint8]:
        agent, obstacles, goal = self._observations[index].reshape(-1, SIZE, SIZE) > 0
        cells = np.empty((SIZE, SIZE, 3), dtype=np.uint8)
        cells[:] = _COLORS["floor"]
        cells[obstacles] = _COLORS["obstacles"]
        cells[goal] = _COLORS["goal"]
        frame = cells.repeat(_CELL_PIXELS, axis=0).repeat(_CELL_PIXELS, axis=1)
        frame[::_CELL_PIXELS] = frame[:, ::_CELL_PIXELS] = (215, 215, 210)
        y, x = (int(k[0]) for k in np.nonzero(agent))
        rows, columns = np.ogrid[: frame.shape[0], : frame.shape[1]]
        center_y, center_x = (y + 0.5) * _CELL_PIXELS, (x + 0.5) * _CELL_PIXELS
        disc = (rows + 0.5 - center_y) ** 2 + (columns + 0.5 - center_x) ** 2 < (0.38 * _CELL_PIXELS) ** 2
        frame[disc] = _COLORS["agent"]
        return frame


class Nav2DEnv(SingleEnv):
    """One :class:`Nav2DVectorEnv`, as a ``gymnasium.Env``; the specification stands there."""

    batch_class = Nav2DVectorEnv
