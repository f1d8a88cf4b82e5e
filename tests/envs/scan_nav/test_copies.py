"""A copied or pickled ScanNav goes on exactly as its original, and bounded settings."""

import copy
import pickle

import numpy as np
import pytest
from scan_inputs import empty_room, map_of_a_room  # noqa: F401

from sb3_abisim.envs.scan_nav.env import ScanNavEnv, ScanNavVectorEnv
from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap

COPIES = {"copy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


def rooms():
    return [empty_room(), empty_room(walls=[np.s_[:80, 70:75]])]


@pytest.mark.parametrize("duplicate", COPIES.values(), ids=COPIES)
@pytest.mark.parametrize("fresh", [True, False])
def test_a_single_environment(duplicate, fresh):
    """Over many episodes, the goals of which are computed on the way; within an episode, and before the first one."""
    env = ScanNavEnv(scenes=rooms(), goals_per_scene=4, image_size=32)
    rng = np.random.default_rng(0)
    if not fresh:
        env.reset(seed=3)
        for _ in range(5):
            env.step(int(rng.integers(1, 4)))
    other = duplicate(env)
    if fresh:
        assert np.array_equal(env.reset(seed=3)[0], other.reset(seed=3)[0])
    over = False
    for _ in range(300):
        if over:
            assert np.array_equal(env.reset()[0], other.reset()[0])
        action = int(rng.choice(4, p=(0.1, 0.5, 0.2, 0.2)))
        (seen, *rest), (copied, *copied_rest) = env.step(action), other.step(action)
        assert np.array_equal(seen, copied) and rest == copied_rest
        over = rest[1]


@pytest.mark.parametrize("duplicate", COPIES.values(), ids=COPIES)
def test_a_vector_in_use(duplicate):
    env = ScanNavVectorEnv(5, 20, scenes=rooms(), goals_per_scene=3, image_size=32)
    env.reset(seed=0, options={"goal": (4.0, 3.0)})  # goals of their own, which are no part of the pool
    other = duplicate(env)
    rng = np.random.default_rng(1)
    for k in range(120):
        actions = rng.choice(4, 5, p=(0.05, 0.55, 0.2, 0.2))
        ours, theirs = env.step(actions), other.step(actions)
        for mine, its in zip(ours[:4], theirs[:4], strict=True):
            assert np.array_equal(mine, its)
        if k == 60:
            other = duplicate(env)
    assert all(np.array_equal(v, other.factors()[name]) for name, v in env.factors().items())


def test_the_original_and_its_copy_share_nothing():
    env = ScanNavEnv(scenes=empty_room(), goals_per_scene=2, image_size=32)
    env.reset(seed=0)
    before = copy.deepcopy(env)
    for _ in range(30):
        env.reset()
        env.step(1)
    assert not np.shares_memory(env.batch._world._fields, before.batch._world._fields)
    again = ScanNavEnv(scenes=empty_room(), goals_per_scene=2, image_size=32)
    again.reset(seed=0)
    for _ in range(5):
        assert np.array_equal(before.reset()[0], again.reset()[0])


def test_a_pickle_holds_no_memory_that_was_never_written(room):
    env = ScanNavEnv(scenes=room, goals_per_scene=2000, image_size=32)
    env.reset(seed=0)
    assert env.batch._world._fields.nbytes > 50_000_000 > len(pickle.dumps(env)) * 10


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"image_size": 100_000}, "image_size must be an even number from 32 to 2048, got 100000"),
        ({"goals_per_scene": 10**9}, "would take .* GB; lower goals_per_scene or view_size"),
        ({"view_size": 2.0, "image_size": 2048}, None),
    ],
)
def test_settings_are_bounded_before_memory_is_taken(room, kwargs, message):
    if message is None:
        message, room = "has .* pixels, more than 16000000; lower image_size, raise view_size", empty_room(30.0, 30.0)
    with pytest.raises(ValueError, match=message):
        ScanNavEnv(scenes=room, **kwargs)


def test_a_map_of_huge_pixels_is_refused():
    small = empty_room()
    with pytest.raises(SceneError, match=r"meters_per_pixel 1000\.0 must be above 0 and at most 1"):
        ScanMap(small.orthophoto, small.height, small.walkable, 1000.0, small.origin, "huge")
