"""What every registered environment promises, checked over all ids."""

import copy
import inspect
import itertools
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import WrapperSpec
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_abisim.envs import ENV_IDS
from sb3_abisim.envs.base import batch_class as batch_class_of

DISCRETE = [env_id for env_id in ENV_IDS if "Continuous" not in env_id]
CONTINUOUS = [env_id for env_id in ENV_IDS if "Continuous" in env_id]


def make_batch(env_id, num_envs, **kwargs):
    return gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **kwargs)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_check_env(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    with warnings.catch_warnings():
        # A 15 x 15 grid is too small for NatureCNN, which is why it has another encoder.
        warnings.filterwarnings("ignore", message="The minimal resolution for an image is 36x36")
        sb3_check_env(env)
    gymnasium_check_env(env.unwrapped, skip_close_check=True)
    frame = env.render()
    assert min(frame.shape[:2]) >= 256, "a person must be able to see something"


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_batch_of_n_equals_n_single_environments(env_id):
    n, batch = 3, make_batch(env_id, 3)
    singles = [gym.make(env_id) for _ in range(n)]
    observations, _ = batch.reset(seed=7)
    for i, env in enumerate(singles):
        assert np.array_equal(env.reset(seed=7 + i)[0], observations[i])
    batch.action_space.seed(0)
    ended = 0
    for _ in range(140):
        actions = batch.action_space.sample()
        observations, rewards, terminated, truncated, infos = batch.step(actions)
        for i, env in enumerate(singles):
            last, reward, *done, info = env.step(actions[i])
            assert (reward, *done, info["is_success"]) == (
                rewards[i],
                terminated[i],
                truncated[i],
                infos["is_success"][i],
            )
            if any(done):
                ended += 1
                assert infos["_final_obs"][i] and np.array_equal(infos["final_obs"][i], last)
                last = env.reset()[0]
            assert np.array_equal(last, observations[i])
    assert ended >= n


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_seed_determines_everything(env_id):
    def rollout(seed):
        env = make_batch(env_id, 2)
        env.action_space.seed(1)
        first = env.reset(seed=seed)[0]
        return np.stack([first] + [env.step(env.action_space.sample())[0] for _ in range(10)])

    assert np.array_equal(rollout(3), rollout(3))
    assert not np.array_equal(rollout(3), rollout(4))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_callers_may_keep_and_change_observations(env_id):
    env = make_batch(env_id, 2)
    first, _ = env.reset(seed=0)
    kept = first.copy()
    env.action_space.seed(0)
    for _ in range(3):
        second = env.step(env.action_space.sample())[0]
    assert np.array_equal(first, kept)
    expected = env._observe(np.arange(2)).copy()
    second[:] = 77
    assert np.array_equal(env._observe(np.arange(2)), expected)


@pytest.mark.parametrize("env_id", DISCRETE)
@pytest.mark.parametrize("action", [4, -1, 1.5, np.nan, [1, 2]], ids=str)
def test_refuses_bad_discrete_actions(env_id, action):
    env = gym.make(env_id, disable_env_checker=True)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=str(action).replace("[", r"\[").replace("]", r"\]")):
        env.step(action)


@pytest.mark.parametrize("env_id", DISCRETE)
@pytest.mark.parametrize("dtype", np.typecodes["AllInteger"])
def test_takes_integers_of_any_type(env_id, dtype):
    one, other = (make_batch(env_id, 3) for _ in range(2))
    one.reset(seed=0), other.reset(seed=0)
    actions = np.array([3, 1, 0])
    assert np.array_equal(one.step(actions.astype(dtype))[0], other.step(actions)[0])


@pytest.mark.parametrize("env_id", CONTINUOUS)
@pytest.mark.parametrize("action", [[0.0, 1.1], [np.nan, 0.0], [np.inf, 0.0], [0.5], 0.5, ["a", "b"]], ids=str)
def test_refuses_bad_continuous_actions(env_id, action):
    env = gym.make(env_id, disable_env_checker=True)
    env.reset(seed=0)
    worst = str(np.ravel(action)[0 if np.size(action) == 1 else int(np.argmax([str(x) != "0.0" for x in action]))])
    with pytest.raises(ValueError, match=worst):
        env.step(action)


def test_step_needs_reset():
    env = make_batch("Nav2D-v0", 1)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.array([0]))


def test_single_environment_refuses_to_go_on_after_its_end():
    env = gym.make("Nav2D-v0").unwrapped
    env.batch.max_episode_steps = 1
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(RuntimeError, match="over"):
        env.step(0)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_step_after_the_end_is_an_error(env_id, monkeypatch):
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    advance = env.batch._advance
    monkeypatch.setattr(env.batch, "_advance", lambda actions: (advance(actions)[0], np.ones(1, bool)))
    assert env.step(env.action_space.sample())[2]
    for _ in range(2):
        with pytest.raises(RuntimeError, match=r"over .*: call reset\(\)"):
            env.step(env.action_space.sample())
    env.reset()
    assert env.step(env.action_space.sample())[2]


# Something of each type, and what could be mistaken for it.
ODD = (
    None, True, 0, 1, -1, 2.5, 1e9, float("nan"), float("inf"), 10**30, "", "no", "\0", b"x", [], [1], ["a"], (1, 2),
    {}, {"a": 1}, {1: 2}, 1j, object(), len, int, set(), np.int8(2), np.array([1, 2]), [[1], [2, 3]],
)  # fmt: skip


def named(batch_class):
    """The arguments of a batch class and of those that it is made of."""
    constructors = [each.__dict__["__init__"] for each in batch_class.__mro__ if "__init__" in each.__dict__]
    names = {name for each in constructors for name in inspect.signature(each).parameters}
    return sorted(names - {"self", "args", "kwargs", "observation_space", "action_space"})


@pytest.mark.parametrize("env_id", sorted({gym.spec(env_id).vector_entry_point: env_id for env_id in ENV_IDS}.values()))
def test_arguments_of_a_wrong_type_are_refused_by_name(env_id):
    """Each argument with each odd value works, or ends in a ValueError that names the argument."""
    batch_class = batch_class_of(env_id)
    names, n_refused = named(batch_class), 0
    # Where the argument is right, there is no apartment of that seed.
    others = {"scenes": -1, "goals_per_scene": 1} if "scenes" in names else {}
    for name, value in itertools.product(names, ODD):
        if name == "scenes" and isinstance(value, int | np.integer | list | tuple):
            continue  # an apartment, which takes a while to make
        if name in ("scenes", "videos") and isinstance(value, str):
            continue  # a place that may be there
        try:
            batch_class(**{**others, name: value})
        except ValueError as error:
            n_refused += name in str(error)
            # It may also not fit another argument, which is named then.
            assert any(each in str(error) for each in (*names, "-1")), (name, value, error)
    assert n_refused > 10 * len(names)


def test_unknown_arguments_are_refused_by_name():
    with pytest.raises(ValueError, match=r"Nav2DVectorEnv takes no argument 'size'; it takes num_envs, max_episode"):
        gym.make("Nav2D-v0", size=3)
    with pytest.raises(
        ValueError, match="num_envs must be at least 1, and at most 6288385 for observations and actions"
    ):
        make_batch("Nav2D-v0", 10**9)


def test_final_info_holds_the_factors_of_the_last_observation():
    env = make_batch("Nav2D-v0", 4, max_episode_steps=3)
    env.reset(seed=0)
    for _ in range(3):
        infos = env.step(np.array([0, 1, 2, 3]))[-1]
    for i in np.flatnonzero(infos["_final_obs"]):
        y, x = np.argwhere(infos["final_obs"][i][0])[0]
        assert tuple(infos["final_info"]["factors"]["agent"][i]) == (x, y)
    assert infos["_final_obs"].all()


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_np_random_is_the_environments(env_id):
    """As in the environments of Gymnasium: its seed is the one in use, and a generator that is put there is used."""
    env = gym.make(env_id).unwrapped
    first = env.reset()[0].copy()
    again = gym.make(env_id).unwrapped
    assert np.array_equal(again.reset(seed=env.np_random_seed)[0], first)
    env.np_random = np.random.Generator(np.random.PCG64(4))
    again.np_random = np.random.Generator(np.random.PCG64(4))
    assert np.array_equal(env.reset()[0], again.reset()[0])
    untouched = np.random.Generator(np.random.PCG64(4)).random()
    assert env.np_random.random() == again.np_random.random() != untouched


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        ("PointMaze-v0", "continuous"), ("PointMaze-v0", "momentum"), ("DistractorPointMaze-v0", "color_jitter"),
        ("ScanNav-v0", "allow_sliding"),
    ],
)  # fmt: skip
def test_words_are_no_flags(env_id, name):
    with pytest.raises(ValueError, match=f"{name} must be True or False, got 'no'"):
        gym.make(env_id, **{name: "no"})


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"num_envs": 0}, "num_envs"), ({"num_envs": 2, "max_episode_steps": 0}, "max_episode_steps")],
    ids=str,
)
def test_refuses_bad_settings(kwargs, message):
    from sb3_abisim.envs.nav2d import Nav2DVectorEnv

    with pytest.raises(ValueError, match=message):
        Nav2DVectorEnv(**kwargs)
    with pytest.raises(ValueError, match="human"):
        Nav2DVectorEnv(render_mode="human")
    with pytest.raises(ValueError, match="3 seeds for 2"):
        Nav2DVectorEnv(num_envs=2).reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="goal"):
        Nav2DVectorEnv(num_envs=2).reset(options={"goal": 3})


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_why_no_wrapper_refuses_steps_after_a_truncation(env_id: str) -> None:
    """Gymnasium makes no batch of an id that is registered with one, and tells the environment nothing of its limit."""
    spec = copy.deepcopy(gym.spec(env_id))
    assert spec.max_episode_steps and gym.make(spec).unwrapped.spec.max_episode_steps is None
    spec.additional_wrappers = (WrapperSpec("W", "gymnasium.wrappers:OrderEnforcing", {}),)
    with pytest.raises(
        gym.error.Error, match="Cannot use `vector_entry_point` vectorization mode with the additional_w"
    ):
        gym.make_vec(spec, 2, vectorization_mode="vector_entry_point")
