"""Nav2D against a plain per-cell reading of its specification."""

import gymnasium as gym
import numpy as np
import pytest

from sb3_abisim.envs.nav2d import CORNERS, GOAL, LAYOUTS, MOVES, Nav2DEnv, Nav2DVectorEnv

IDS = ["Nav2D-v0", "Nav2DCorridor-v0", "Nav2DMaze-v0", "Nav2DRandomGoal-v0"]


def cells(observation):
    """Agent (x, y), obstacle set, goal (x, y) of an observation."""
    (agent,), (goal,) = ([(int(x), int(y)) for y, x in np.argwhere(observation[c])] for c in (0, 2))
    return agent, {(int(x), int(y)) for y, x in np.argwhere(observation[1])}, goal


def reachable(start, obstacles):
    found, front = {start}, [start]
    while front:
        x, y = front.pop()
        for dx, dy in MOVES:
            cell = (x + dx, y + dy)
            if cell not in found and cell not in obstacles and 0 <= cell[0] < 15 and 0 <= cell[1] < 15:
                found.add(cell)
                front.append(cell)
    return found


@pytest.mark.parametrize("env_id", IDS)
def test_steps_follow_the_rules(env_id):
    env = gym.make(env_id)
    rng = np.random.default_rng(0)
    moved, blocked, successes = 0, 0, 0
    for episode in range(30):
        observation, _ = env.reset(seed=episode)
        (x, y), obstacles, goal = cells(observation)
        assert (x, y) != goal and (goal == GOAL == (7, 7) or env_id == "Nav2DRandomGoal-v0")
        for step in range(1, 51):
            action = int(rng.integers(4))
            dx, dy = ((0, -1), (0, 1), (-1, 0), (1, 0))[action]
            target = (x + dx, y + dy)
            inside = 0 <= target[0] < 15 and 0 <= target[1] < 15
            expected = target if inside and target not in obstacles else (x, y)
            moved, blocked = moved + (expected != (x, y)), blocked + (expected == (x, y))
            observation, reward, terminated, truncated, info = env.step(action)
            (x, y), now, there = cells(observation)
            assert ((x, y), now, there) == (expected, obstacles, goal)
            assert (reward, terminated, info["is_success"]) == (
                (0.0, True, True) if expected == goal else (-1.0, False, False)
            )
            assert truncated == (step == 50 and not terminated)
            if terminated or truncated:
                successes += terminated
                break
    assert moved > 100 and blocked > 100 and successes > 0


def test_layouts_leave_a_path_and_hold_2x2_obstacles():
    env = Nav2DEnv()
    starts, counts = set(), []
    for seed in range(300):
        agent, obstacles, goal = cells(env.reset(seed=seed)[0])
        starts.add(agent)
        counts.append(len(obstacles))
        assert goal in reachable(agent, obstacles) and agent not in obstacles and goal not in obstacles
        for x, y in obstacles:
            assert any(
                {(x - i, y - j), (x + 1 - i, y - j), (x - i, y + 1 - j), (x + 1 - i, y + 1 - j)} <= obstacles
                for i in (0, 1)
                for j in (0, 1)
            )
    assert len(starts) > 150, "the agent starts anywhere"
    # 20 blocks of 4 cells at random positions overlap; by simulation 66 cells are covered on average.
    assert 60 < np.mean(counts) < 70 and max(counts) <= 80


@pytest.mark.parametrize("layout", LAYOUTS)
def test_fixed_structures(layout):
    env = Nav2DEnv(layout=layout)
    structure = {(x, y): c for y, row in enumerate(LAYOUTS[layout]) for x, c in enumerate(row)}
    shown = []
    for seed in range(20):
        agent, obstacles, _ = cells(env.reset(seed=seed)[0])
        assert reachable(agent, obstacles) == {cell for cell, c in structure.items() if c == "."}
        assert {cell for cell, c in structure.items() if c == "#"} <= obstacles
        shown.append(frozenset(obstacles))
    assert len(set(shown)) > 15, "the obstacles that cannot be reached are sampled in each episode"


@pytest.mark.parametrize("env_id", IDS)
def test_render_shows_the_agent(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    agent = cells(env.reset(seed=3)[0])[0]
    frame = env.render()
    assert frame.shape == (480, 480, 3) and frame.dtype == np.uint8
    red = (frame.astype(int) @ (2, -1, -1)) > 150
    assert tuple(np.argwhere(red).mean(axis=0) // 32) == agent[::-1]


@pytest.mark.parametrize("layout", ["random", *LAYOUTS])
def test_random_goals_lie_on_any_cell_that_the_agent_can_reach(layout):
    env = Nav2DVectorEnv(num_envs=1200, layout=layout, goal="random")
    observations, _ = env.reset(seed=0)
    goals, agents = [], []
    for observation, factor in zip(observations, env.factors()["goal"], strict=True):
        agent, obstacles, goal = cells(observation)
        assert goal == tuple(factor) != agent and goal not in obstacles
        assert goal in reachable(agent, obstacles)
        goals.append(goal)
        agents.append(agent)
    free = 225 if layout == "random" else "".join(LAYOUTS[layout]).count(".")
    assert len(set(goals)) > 0.97 * free and len(set(agents)) > 0.97 * free
    # All are as likely, also at the border, which fewer obstacles would cover.
    assert max(map(goals.count, goals)) < 3 * max(1200 / free, 6)
    if layout == "random":
        assert sum(not {0, 14}.isdisjoint(goal) for goal in goals) == pytest.approx(1200 * 56 / 225, abs=24)


def test_goals_in_the_corners():
    env = Nav2DVectorEnv(num_envs=400, goal="corners")
    observations, _ = env.reset(seed=0)
    goals = []
    for observation, factor in zip(observations, env.factors()["goal"], strict=True):
        agent, obstacles, goal = cells(observation)
        assert goal == tuple(factor) != agent and goal in reachable(agent, obstacles)
        goals.append(goal)
    assert {goal: goals.count(goal) for goal in goals} == pytest.approx(dict.fromkeys(CORNERS, 100), abs=30)


def test_a_center_goal_is_not_sampled():
    """The episodes of a seed are those of before there were random goals."""
    generator = np.random.default_rng(5)
    cell = int(generator.integers(224))
    agent = cells(Nav2DEnv().reset(seed=5)[0])[0]
    cell += cell >= 7 * 15 + 7
    assert agent == (cell % 15, cell // 15)
    assert "goal" not in Nav2DVectorEnv(num_envs=2).factors()


def test_factors_describe_the_observation():
    batch = Nav2DVectorEnv(num_envs=3)
    observations, _ = batch.reset(seed=0)
    factors = batch.factors()
    for observation, agent, obstacles in zip(observations, factors["agent"], factors["obstacles"], strict=True):
        assert cells(observation)[0] == tuple(agent)
        assert np.array_equal(observation[1] > 0, obstacles)


def test_unknown_layout():
    with pytest.raises(ValueError, match="spiral"):
        Nav2DEnv(layout="spiral")
    with pytest.raises(ValueError, match="goal must be 'center', 'random' or 'corners', got 'corner'"):
        Nav2DEnv(goal="corner")
    with pytest.raises(ValueError, match="goal='corners' may be blocked in layout='maze'; give goal='random'"):
        Nav2DEnv(layout="maze", goal="corners")


def test_shortest_paths_solved_by_hand():
    """Nothing but a wall of three cells left of the goal, and states two cells to the left and five to the right."""
    obstacles = np.zeros((15, 15), dtype=bool)
    x, y = GOAL
    obstacles[y - 1 : y + 2, x - 1] = True
    env = Nav2DVectorEnv()
    states = {"agent": np.array([(x - 2, y), (x + 5, y)]), "obstacles": np.array([obstacles, obstacles])}
    up, down, left, right = ((0, -1), (0, 1), (-1, 0), (1, 0))
    for goal, factors in ((GOAL, {}), ((0, 0), {"goal": np.zeros((2, 2), dtype=np.int64)})):
        paths = env.shortest_paths({**states, **factors})
        best = [{move for move, is_best in zip(MOVES, row, strict=True) if is_best} for row in paths.optimal]
        if goal == GOAL:
            assert best == [{up, down}, {left}], "around the wall, up or down"
            assert paths.geodesic.tolist() == [6, 5] and paths.straight.tolist() == [2, 5]
        else:
            assert best == [{up, left}, {up, left}]
            assert paths.geodesic.tolist() == paths.straight.tolist() == [x - 2 + y, x + 5 + y]
    around = env.blocked_around(states, np.array([right, left, (1, -1), (3, 0)]))
    assert around.tolist() == [[True, False, True, False], [False, False, False, True]]
