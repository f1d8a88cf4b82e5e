"""Nav2D: a 15 x 15 grid with random obstacles and the goal in the center (section "2D Navigation" of the paper)."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.grids import fewest_steps, flood_fill
from sb3_abisim.envs.base import BatchEnv, SingleEnv
from sb3_abisim.envs.shortest_paths import ShortestPaths

SIZE = 15
N_OBSTACLES = 20
OBSTACLE_SIZE = 2
GOAL = (7, 7)
# Places of the goal with goal="corners": four cells from the edges.
CORNERS = ((3, 3), (11, 3), (3, 11), (11, 11))
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
_CORNER_CELLS = np.array([y * SIZE + x for x, y in CORNERS])
# Bitboards of :mod:`~sb3_abisim.common.grids`; their sixteenth column is never free.
_STRIDE = SIZE + 1
_BITS = np.array([1 << (y * _STRIDE + x) for y in range(SIZE) for x in range(SIZE)], dtype=object)
_BOARD = int(_BITS.sum())
_CORNERS = [(x, y) for y in range(SIZE - OBSTACLE_SIZE + 1) for x in range(SIZE - OBSTACLE_SIZE + 1)]
_BLOCK_CELLS = np.array(
    [[(y + j) * SIZE + x + i for j in range(OBSTACLE_SIZE) for i in range(OBSTACLE_SIZE)] for x, y in _CORNERS]
)
_BLOCK_BITS = [int(_BITS[cells].sum()) for cells in _BLOCK_CELLS]


# [cell, block]: whether the 2 x 2 block leaves the cell free; and the blocks that spare a cell and the center.
_SPARES = np.array([np.not_equal(_BLOCK_CELLS, cell).all(axis=1) for cell in range(SIZE * SIZE)])
_BLOCKS_SPARING = [np.flatnonzero(spares & _SPARES[_GOAL_CELL]) for spares in _SPARES]


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
    """Navigate a 15 x 15 grid to its goal; ``num_envs`` copies at once. ``Nav2DEnv`` is the batch of one.

    **Observation**: ``Box(0, 255, (3, 15, 15), uint8)``; channels agent, obstacles, goal, each 255 where the thing is
    and 0 elsewhere, indexed ``[channel, y, x]``. **Action**: ``Discrete(4)``, the moves (dx, dy) = (0,-1), (0,1),
    (-1,0), (1,0), that is up, down, left, right; a move into an obstacle or off the grid leaves the agent in place.
    **Reward**: -1 a step, 0 for the step that reaches the goal, which ends the episode. **Truncation** after
    50 steps. ``info["is_success"]`` is true where the goal was reached.

    **Start**, ``layout="random"`` (``Nav2D-v0``): agent uniform over all cells but the goal; 20 obstacles of 2 x 2
    cells uniform over the positions inside the grid that cover neither agent nor goal (they may overlap); all is
    sampled again until a path exists. ``"corridor"`` (``Nav2DCorridor-v0``) and ``"maze"`` (``Nav2DMaze-v0``): the
    reachable region is fixed (:data:`LAYOUTS`) and empty; 20 blocks of 2 x 2 are sampled in each episode and shown
    where they fall on cells that cannot be reached. The paper prints both structures as small figures only, so we
    chose their cells.

    **Goal**: the center (7, 7). ``goal="random"`` (``Nav2DRandomGoal-v0``) samples it in each episode, uniformly over
    all cells, or over the reachable ones of a fixed structure, and then agent and obstacles as above. ``"corners"``
    samples it from (3, 3), (11, 3), (3, 11) and (11, 11), with random obstacles alone.

    **Factors**: agent (x, y), int64 (2,); obstacles by [y, x], bool (15, 15); unless the goal is the center also goal
    (x, y).

    :param num_envs: number of copies
    :param max_episode_steps: set by ``gymnasium.make_vec``
    :param render_mode: None or "rgb_array"
    :param autoreset: see :class:`BatchEnv`
    :param layout: "random", "corridor" or "maze"
    :param goal: "center", "random" or "corners"
    :raises ValueError: for another layout or goal, or corners in a fixed structure
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset: bool = True,
        layout: str = "random",
        goal: str = "center",
    ) -> None:
        if goal not in ("center", "random", "corners"):
            raise ValueError(f"goal must be 'center', 'random' or 'corners', got {goal!r}")
        if goal == "corners" and layout != "random":
            raise ValueError(f"goal='corners' may be blocked in layout={layout!r}; give goal='random'")
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
        self.layout, self.goal = layout, goal
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
            self._reachable = np.flatnonzero(cells == ".")

    def _reset_envs(self, indices: NDArray[np.int64]) -> None:
        sample = self._sample_random if self.layout == "random" else self._sample_fixed
        for i in indices:
            cell, goal, obstacles = sample(self._generators[i])
            self._agents[i] = self._first[i] + cell
            self._observations[i, 0] = 0
            self._observations[i, 0, cell] = 255
            self._observations[i, 1] = np.where(obstacles, 255, 0)
            if self.goal != "center":
                self._observations[i, 2] = 0
                self._observations[i, 2, goal] = 255
                self._goals[i] = self._first[i] + goal
            self._targets[i, :_N_CELLS] = self._first[i] + next_cells(obstacles)

    def _sample_random(self, generator: np.random.Generator) -> tuple[int, int, NDArray[np.bool_]]:
        """The cells of agent and goal, and obstacles (SIZE * SIZE,) that leave a path between them."""
        while True:
            goal = self._sample_goal(generator, np.arange(SIZE * SIZE))
            cell = int(generator.integers(SIZE * SIZE - 1))
            cell += cell >= goal
            allowed = _BLOCKS_SPARING[cell] if goal == _GOAL_CELL else np.flatnonzero(_SPARES[cell] & _SPARES[goal])
            blocks = allowed[generator.integers(len(allowed), size=N_OBSTACLES)]
            board = 0
            for block in blocks:
                board |= _BLOCK_BITS[block]
            start = _BITS[cell]
            if flood_fill(_BITS[goal], _BOARD & ~board, _STRIDE, stop=start) & start:
                obstacles = np.zeros(SIZE * SIZE, dtype=bool)
                obstacles[_BLOCK_CELLS[blocks]] = True
                return cell, goal, obstacles

    def _sample_goal(self, generator: np.random.Generator, cells: NDArray[np.int64]) -> int:
        """The goal's cell: the center, without sampling, or one of the corners or of ``cells``."""
        if self.goal == "center":
            return _GOAL_CELL
        return int(generator.choice(_CORNER_CELLS if self.goal == "corners" else cells))

    def _sample_fixed(self, generator: np.random.Generator) -> tuple[int, int, NDArray[np.bool_]]:
        """The cells of agent and goal in the fixed reachable region, and its walls with new scenery beyond them."""
        goal = self._sample_goal(generator, self._reachable)
        # The agent starts anywhere there but on the goal.
        starts = self._reachable[self._reachable != goal]
        cell = int(starts[generator.integers(len(starts))])
        scenery = np.zeros(SIZE * SIZE, dtype=bool)
        scenery[_BLOCK_CELLS[generator.integers(len(_BLOCK_CELLS), size=N_OBSTACLES)]] = True
        return cell, goal, self._walls | (scenery & self._scenery)

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
        """The simulator's state that the current observations show, for probes; see the class."""
        obstacles = self._observations[:, 1].reshape(-1, SIZE, SIZE) > 0
        factors = {"agent": self._positions(self._agents), "obstacles": obstacles}
        return factors | ({} if self.goal == "center" else {"goal": self._positions(self._goals)})

    def shortest_paths(self, factors: dict[str, NDArray[Any]]) -> ShortestPaths:
        """See :meth:`BatchEnv.shortest_paths`; distances in steps.

        :param factors: see the class
        """
        agents = factors["agent"]
        goals = np.broadcast_to(factors.get("goal", GOAL), agents.shape)
        cells, goal_cells = (places[:, 1] * SIZE + places[:, 0] for places in (agents, goals))
        optimal, geodesic = np.zeros((len(agents), len(MOVES)), dtype=bool), np.zeros(len(agents))
        for i, obstacles in enumerate(factors["obstacles"]):
            nexts = next_cells(obstacles.ravel())
            steps = fewest_steps(nexts, goal_cells[[i]])[:, 0]
            geodesic[i] = steps[cells[i]]
            optimal[i] = steps[nexts[cells[i]]] < geodesic[i]
        return ShortestPaths(optimal, geodesic, np.abs(agents - goals).sum(axis=1).astype(np.float64))

    def blocked_around(self, factors: dict[str, NDArray[Any]], offsets: NDArray[np.int64]) -> NDArray[np.bool_]:
        """See :meth:`BatchEnv.blocked_around`; points are cells.

        :param factors: see the class
        :param offsets: (n_points, 2)
        """
        points = factors["agent"][:, None] + offsets
        outside = ((points < 0) | (points >= SIZE)).any(axis=-1)
        x, y = np.moveaxis(np.clip(points, 0, SIZE - 1), -1, 0)
        blocked: NDArray[np.bool_] = outside | factors["obstacles"][np.arange(len(points))[:, None], y, x]
        return blocked

    def _positions(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """The (x, y) of one cell in each copy, shape (num_envs, 2)."""
        y, x = np.divmod(indices - self._first, SIZE)
        return np.stack([x, y], axis=1)

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
