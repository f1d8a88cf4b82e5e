"""PointMaze: physics against gymnasium-robotics' point body, determinism, copies, rewards, observations."""

import copy
import importlib.util
import pickle
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from point_maze_inputs import solid_pixels
from stable_baselines3.common.env_checker import check_env

import sb3_abisim  # noqa: F401
from sb3_abisim.envs.point_maze import env as point_maze
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.env import PointMazeEnv, PointMazeVectorEnv, free_displacement, point_model

UP, DOWN, LEFT, RIGHT = range(4)
FAR = 100.0  # where an obstacle is out of the way


def place(env: PointMazeVectorEnv, agent: tuple[float, float], obstacles: tuple[tuple[float, float], ...] = ()) -> None:
    """Put the ball and the obstacles of every copy where a test wants them."""
    env._obstacle_pos[:] = FAR
    for slot, center in enumerate(obstacles):
        env._obstacle_pos[:, slot] = center
    env._solid_counts[:, 1:, 1:] = solid_pixels(np.array(obstacles).reshape(-1, 2)).cumsum(axis=0).cumsum(axis=1)
    env._position[:] = agent
    env._velocity[:] = 0.0


def batch(n: int = 1, **kwargs: object) -> PointMazeVectorEnv:
    env = PointMazeVectorEnv(num_envs=n, **kwargs)  # type: ignore[arg-type]
    env.reset(seed=0)
    return env


def random_actions(env: PointMazeVectorEnv, generator: np.random.Generator) -> np.ndarray:
    if env.continuous:
        return generator.choice([-1.0, 1.0, 1.0, 0.3], size=(env.num_envs, 2)).astype(np.float32)
    return generator.integers(4, size=env.num_envs)


def as_forces(actions: np.ndarray) -> np.ndarray:
    return actions if actions.ndim == 2 else np.array([(0, -1), (0, 1), (-1, 0), (1, 0)])[actions]


# The physics.


@pytest.fixture(scope="module")
def point_xml() -> Path:
    """gymnasium-robotics' point body; the package is found, not imported."""
    spec = importlib.util.find_spec("gymnasium_robotics")
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).parent / "envs/assets/point/point.xml"


def test_the_model_has_the_numbers_of_gymnasium_robotics(point_xml: Path) -> None:
    ours, theirs = point_model(), mujoco.MjModel.from_xml_path(str(point_xml))
    our_ball, their_ball = ours.ngeom - 1, theirs.geom("particle_geom").id
    np.testing.assert_array_equal(ours.dof_damping, theirs.dof_damping)
    np.testing.assert_array_equal(ours.body_mass[1], theirs.body_mass[1])
    np.testing.assert_array_equal(ours.actuator_gear, theirs.actuator_gear)
    np.testing.assert_array_equal(ours.actuator_ctrlrange, theirs.actuator_ctrlrange)
    for name in ("geom_size", "geom_friction", "geom_margin", "geom_condim", "geom_solref", "geom_solimp"):
        np.testing.assert_array_equal(getattr(ours, name)[our_ball], getattr(theirs, name)[their_ball], err_msg=name)
    for name in ("timestep", "integrator", "iterations", "solver", "tolerance", "cone", "impratio", "gravity"):
        np.testing.assert_array_equal(getattr(ours.opt, name), getattr(theirs.opt, name), err_msg=name)


@pytest.mark.parametrize("momentum", [False, True])
def test_free_motion_equals_point_envs_loop(point_xml: Path, momentum: bool) -> None:
    """One decision is 30 times PointEnv.step: clip the velocity, then one MuJoCo step."""
    model = mujoco.MjModel.from_xml_path(str(point_xml))
    data = mujoco.MjData(model)
    env = batch(continuous=True, momentum=momentum)
    place(env, (-3.0, 2.0))
    data.qpos[:] = (-3.0, 2.0)
    for action in ((1.0, -0.5), (1.0, -1.0), (-0.25, 0.125), (1.0, 1.0)):
        env._advance(np.array([action], dtype=np.float32))
        if not momentum:
            data.qvel[:] = 0
        data.ctrl[:] = action
        for _ in range(30):
            data.qvel[:] = np.clip(data.qvel, -5, 5)
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(env._position[0], data.qpos, rtol=0, atol=1e-12)
        if momentum:
            np.testing.assert_allclose(env._velocity[0], data.qvel, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("continuous", [False, True])
def test_shortcuts_equal_the_plain_simulation(seed: int, continuous: bool) -> None:
    """Free ways in closed form and no clip in the first time steps, against 30 clipped time steps of MuJoCo."""
    env, plain = batch(32, continuous=continuous), batch(32, continuous=continuous)
    generator = np.random.default_rng(seed)
    n_simulated = 0
    for _ in range(60):
        actions = random_actions(env, generator)
        plain._position[:] = env._position
        moved_freely = ~env._solid_between(env._position, env._position + free_displacement(as_forces(actions)))
        env._advance(actions)
        plain._force[:], plain._velocity[:] = as_forces(actions), 0.0
        for _ in range(point_maze.SUBSTEPS):
            plain._velocity[:] = np.clip(plain._velocity, -point_maze.MAX_VELOCITY, point_maze.MAX_VELOCITY)
            plain._physics.step()
        np.testing.assert_allclose(env._position, plain._position, rtol=0, atol=1e-12)
        n_simulated += (~moved_freely).sum()
    assert 200 < n_simulated < 60 * 32 - 200


def test_without_islands_nothing_moves_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the bit: the bytes of datasets hang on it."""
    env = batch(32)
    model = point_model()
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ISLAND
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    monkeypatch.setattr(point_maze, "point_model", lambda: model)
    with_islands = batch(32)
    generator = np.random.default_rng(0)
    for _ in range(60):
        actions = random_actions(env, generator)
        for one in (env, with_islands):
            one._advance(actions)
        assert np.array_equal(env._position, with_islands._position)


def test_free_displacement_for_any_force(point_xml: Path) -> None:
    forces = np.array([-1, -0.9, -0.69, -0.5, -0.01, 0, 0.3, 0.68, 0.7, 0.71, 0.75, 0.99, 1])
    model = mujoco.MjModel.from_xml_path(str(point_xml))
    for force, expected in zip(forces, free_displacement(forces), strict=True):
        data = mujoco.MjData(model)
        data.ctrl[:] = (0.0, force)
        for _ in range(30):
            data.qvel[:] = np.clip(data.qvel, -5, 5)
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.qpos, (0.0, expected), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("action", "direction"), [(UP, (0, -1)), (DOWN, (0, 1)), (LEFT, (-1, 0)), (RIGHT, (1, 0))])
def test_a_push_covers_one_meter_in_its_direction(action: int, direction: tuple[int, int]) -> None:
    env = batch()
    place(env, (-3.0, 4.0))
    env.step(np.array([action]))
    moved = env._position[0] - (-3.0, 4.0)
    np.testing.assert_allclose(moved, direction, atol=0.1)
    # The next step must not inherit the 5 m/s that the ball now has.
    env.step(np.array([action]))
    np.testing.assert_allclose(env._position[0] - (-3.0, 4.0) - moved, moved, atol=1e-9)


def test_momentum_carries_the_ball_on() -> None:
    env = batch(continuous=True, momentum=True)
    place(env, (-6.0, 4.0))
    env.step(np.array([(1.0, 0.0)], dtype=np.float32))
    before = env._position[0].copy()
    env.step(np.zeros((1, 2), dtype=np.float32))
    assert 1.2 < env._position[0, 0] - before[0] < 1.6
    np.testing.assert_array_equal(env.factors()["velocity"], env._velocity.astype(np.float32))


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize(
    ("action", "axis", "side"),
    [(UP, 1, 1), (DOWN, 1, -1), (LEFT, 0, 1), (RIGHT, 0, -1)],
    ids=["up", "down", "left", "right"],
)
@pytest.mark.parametrize("center", [(3.0, -4.0), (1.25, 2.5), (-4.5, 0.25)])
def test_an_obstacle_stops_the_ball(n: int, action: int, axis: int, side: int, center: tuple[float, float]) -> None:
    """MuJoCo passes through static geoms that were moved, without a word, unless the model is built for it."""
    env = batch(n)
    start = np.array(center)
    start[axis] += side * 1.7
    place(env, tuple(start), (center,))
    for _ in range(4):
        env._advance(np.full(n, action))
    gap = (env._position[:, axis] - center[axis]) * side - 1.0
    np.testing.assert_allclose(gap, point_maze.BALL_RADIUS, atol=0.02)
    np.testing.assert_allclose(env._position[:, 1 - axis], center[1 - axis], atol=1e-3)


def test_nothing_is_left_where_the_obstacles_were() -> None:
    env = batch(2)
    place(env, (-1.9, 3.0), ((0.0, 3.0),))
    env._advance(np.full(2, RIGHT))
    env._obstacle_pos[1, 0] = FAR
    for _ in range(4):
        env._advance(np.full(2, RIGHT))
    assert env._position[0, 0] < -1.0
    assert env._position[1, 0] > 1.5


@pytest.mark.parametrize(("action", "axis", "sign"), [(UP, 1, -1), (DOWN, 1, 1), (LEFT, 0, -1), (RIGHT, 0, 1)])
def test_walls_hold_the_ball(action: int, axis: int, sign: int) -> None:
    env = batch()
    place(env, (2.0, 3.0))
    for _ in range(12):
        env._advance(np.array([action]))
    np.testing.assert_allclose(env._position[0, axis] * sign, 7.5 - point_maze.BALL_RADIUS, atol=0.02)


def test_random_play_never_enters_an_obstacle() -> None:
    env = batch(32, max_episode_steps=50)
    generator = np.random.default_rng(3)
    for _ in range(150):
        env.step(random_actions(env, generator))
        inside = np.abs(env._position[:, None] - env._obstacle_pos).max(axis=-1) < 1.0
        assert not inside.any()
        assert np.abs(env._position).max() < 7.5


# Determinism.


@pytest.mark.parametrize("kwargs", [{}, {"continuous": True}, {"momentum": True}, {"n_threads": 2}])
def test_a_batch_equals_single_environments_bit_for_bit(kwargs: dict[str, object]) -> None:
    n = 4
    together = PointMazeVectorEnv(num_envs=n, autoreset=False, **kwargs)  # type: ignore[arg-type]
    alone = [PointMazeEnv(**kwargs) for _ in range(n)]
    generator = np.random.default_rng(5)
    observations, _ = together.reset(seed=10)
    for i, env in enumerate(alone):
        np.testing.assert_array_equal(env.reset(seed=10 + i)[0], observations[i])
    for _ in range(25):
        actions = random_actions(together, generator)
        if together._needs_reset:
            break
        observations, rewards, reached, _, _ = together.step(actions)
        for i, env in enumerate(alone):
            observation, reward, terminated, _, _ = env.step(actions[i])
            np.testing.assert_array_equal(observation, observations[i])
            assert (reward, terminated) == (rewards[i], reached[i])
            for name, value in env.factors().items():
                np.testing.assert_array_equal(value, together.factors()[name][i])


def test_reset_with_a_seed_determines_everything() -> None:
    def play(seed: int) -> list[bytes]:
        env = PointMazeVectorEnv(num_envs=3, max_episode_steps=5)
        env.reset(seed=99)
        observations = [env.reset(seed=seed)[0]]
        generator = np.random.default_rng(0)
        observations += [env.step(random_actions(env, generator))[0] for _ in range(12)]
        return [observation.tobytes() for observation in observations]

    assert play(1) == play(1)
    assert play(1)[0] != play(2)[0]


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("kwargs", [{"continuous": True}, {"momentum": True}])
def test_a_copy_goes_on_bit_for_bit(
    duplicate: Callable[[PointMazeVectorEnv], PointMazeVectorEnv], kwargs: dict[str, bool]
) -> None:
    env = PointMazeVectorEnv(num_envs=16, max_episode_steps=40, n_threads=2, **kwargs)
    env.reset(seed=3)
    generator = np.random.default_rng(6)
    for _ in range(20):
        env.step(random_actions(env, generator))
    twin = duplicate(env)
    assert twin._physics.nthread == 2
    for _ in range(30):
        actions = random_actions(env, generator)
        (observations, rewards, *_), (others, other_rewards, *_) = env.step(actions), twin.step(actions)
        np.testing.assert_array_equal(observations, others)
        np.testing.assert_array_equal(rewards, other_rewards)
        np.testing.assert_array_equal(env._position, twin._position)
    # Two of each, not one.
    place(twin, (3.0, 3.0))
    assert not np.array_equal(env._position, twin._position)


# Rewards, episode ends and observations.


@pytest.mark.parametrize(("reward_type", "expected"), [("step", [-1.0, 0.0]), ("sparse", [0.0, 1.0])])
def test_the_goal_ends_the_episode(reward_type: str, expected: list[float]) -> None:
    env = batch(reward_type=reward_type, autoreset=False)
    place(env, (2.9, 0.1))
    _, rewards, terminated, truncated, infos = env.step(np.array([LEFT]))
    assert (rewards[0], terminated[0], infos["is_success"][0]) == (expected[0], False, False)
    _, rewards, terminated, truncated, infos = env.step(np.array([LEFT]))
    assert (rewards[0], terminated[0], truncated[0], infos["is_success"][0]) == (expected[1], True, False, True)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.array([LEFT]))


@pytest.mark.parametrize(("end", "expected"), [((1.02, 0.0), False), ((0.98, 0.0), True), ((0.8, 0.8), False)])
def test_success_is_within_one_meter(end: tuple[float, float], expected: bool) -> None:
    env = batch(autoreset=False)
    place(env, (end[0] + 1.01072805, end[1]))
    assert env.step(np.array([LEFT]))[2][0] == expected


@pytest.mark.parametrize(("end", "expected"), [((1.02, 0.0), False), ((0.98, 0.0), True), ((0.8, 0.8), False)])
def test_success_is_at_the_goal_wherever_it_is(end: tuple[float, float], expected: bool) -> None:
    env = batch(autoreset=False, goal="random")
    goal = env.factors()["goal"][0]
    assert np.hypot(*goal) > 1.0
    place(env, (goal[0] + end[0] + 1.01072805, goal[1] + end[1]))
    # No longer at the center.
    _, rewards, terminated, *_ = env.step(np.array([LEFT]))
    assert (rewards[0], terminated[0]) == ((0.0, True) if expected else (-1.0, False))
    other = batch(autoreset=False, goal="random")
    place(other, (0.5 + 1.01072805, 0.0))
    assert not other.step(np.array([LEFT]))[2][0]


@pytest.mark.parametrize("goal", ["center", "random"])
def test_the_observation_shows_what_the_factors_are(goal: str) -> None:
    env = batch(20, goal=goal)
    observations = env._observe(np.arange(20))
    factors = env.factors()
    states = (factors[name] for name in ("agent", "obstacles", "goal"))
    for observation, (x, y), obstacles, at in zip(observations, *states, strict=True):
        solid = solid_pixels(obstacles)
        walls = solid_pixels(np.zeros((0, 2)))
        left, top = ((at + 8) * 4).astype(int) - 2
        expected = np.empty((64, 64, 3), dtype=np.uint8)
        expected[:] = top_down.FLOOR
        expected[top : top + 4, left : left + 4] = top_down.GOAL
        expected[solid] = top_down.OBSTACLE
        expected[walls] = top_down.WALL
        column, row = (x + 8) * 4, (y + 8) * 4
        distance = np.hypot(np.arange(64) + 0.5 - column, (np.arange(64) + 0.5 - row)[:, None])
        away = distance > 1.2 + 0.75
        np.testing.assert_array_equal(observation.transpose(1, 2, 0)[away], expected[away])
        assert (observation[:, int(row), int(column)] == top_down.AGENT).sum() >= 2 or distance.min() > 0.4


def test_observe_over_replaces_the_floor_and_nothing_else() -> None:
    env = batch(12)
    indices = np.array([1, 4, 11])
    plain = env._observe(indices)
    black = env._observe_over(np.zeros_like(plain), indices)
    white = env._observe_over(np.full_like(plain, 255), indices)
    floor = (plain == np.array(top_down.FLOOR, dtype=np.uint8)[:, None, None]).all(axis=1)
    replaced = (black != white).any(axis=1)
    for observation, value in ((black, 0), (white, 255)):
        np.testing.assert_array_equal(
            observation.transpose(0, 2, 3, 1)[~replaced], plain.transpose(0, 2, 3, 1)[~replaced]
        )
        assert (observation.transpose(0, 2, 3, 1)[replaced] == value).all()
    assert not (replaced & ~floor).any()
    # A pixel of which the agent covers less than half a percent may keep the color of the floor.
    assert (floor & ~replaced).sum() <= 2


def test_render_shows_the_same_scene_enlarged() -> None:
    env = gym.make("PointMaze-v0", render_mode="rgb_array")
    observation, _ = env.reset(seed=1)
    frame = env.render()
    assert frame.shape == (512, 512, 3) and frame.dtype == np.uint8
    shrunk = frame.reshape(64, 8, 64, 8, 3).mean(axis=(1, 3)).transpose(2, 0, 1)
    assert np.abs(shrunk - observation).max() <= 3
    env.close()


# The interface.


@pytest.mark.parametrize("env_id", ["PointMaze-v0", "ContinuousPointMaze-v0"])
def test_registered_ids_pass_the_checkers(env_id: str) -> None:
    check_env(gym.make(env_id).unwrapped, skip_render_check=False)
    env = gym.make(env_id)
    env.reset(seed=0)
    done, steps = False, 0
    while not done:
        action = np.array([0.0, 0.0], dtype=np.float32) if "Continuous" in env_id else 0
        _, reward, terminated, truncated, info = env.step(action)
        done, steps = terminated or truncated, steps + 1
        assert reward == -1.0 or terminated
        assert info["is_success"] == terminated
    assert terminated or steps == 128
    vector = gym.make_vec(env_id, num_envs=2, vectorization_mode="vector_entry_point")
    assert isinstance(vector, PointMazeVectorEnv) and vector.max_episode_steps == 128


@pytest.mark.parametrize(
    ("continuous", "action"),
    [(False, 4), (False, -1), (False, 1.0), (False, [0]), (True, [1.5, 0]), (True, [np.nan, 0]), (True, [0.0])],
)
def test_bad_actions_are_refused(continuous: bool, action: object) -> None:
    env = PointMazeEnv(continuous=continuous)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(action)


@pytest.mark.parametrize(("kwargs", "message"), [({"reward_type": "dense"}, "dense"), ({"n_threads": 0}, "n_threads")])
def test_bad_arguments_are_refused(kwargs: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PointMazeEnv(**kwargs)
