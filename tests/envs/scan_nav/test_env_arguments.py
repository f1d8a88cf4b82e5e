"""What ScanNav refuses, and the message."""

import numpy as np
import pytest
from scan_inputs import empty_room, map_of_a_room  # noqa: F401

from sb3_abisim.envs.scan_nav.env import ScanNavEnv
from sb3_abisim.envs.scan_nav.files import SceneError


def test_refuses_scenes_without_episodes():
    with pytest.raises(SceneError, match=r"room: none of 300 goals .* lower min_geodesic, raise view_size"):
        ScanNavEnv(scenes=empty_room(), min_geodesic=8.0)
    with pytest.raises(SceneError, match="there is no scan file"):
        ScanNavEnv(scenes="nowhere.glb")
    with pytest.raises(SceneError, match="there is no scan map"):
        ScanNavEnv(scenes=["nowhere.npz"])


@pytest.mark.parametrize(
    "kwargs",
    [
        {"obs_mode": "depth"},
        {"marker": "disc"},
        {"stop": "never"},
        {"image_size": 127},
        {"image_size": 8},
        {"view_size": 0.5},
        {"turn_angle": 0},
        {"success_distance": -1},
        {"max_geodesic": 0.5},
        {"min_ratio": 0.5},
        {"goals_per_scene": 0},
        {"scenes": []},
        {"scenes": 1.5},
        {"scenes": -1},
    ],
    ids=str,
)
def test_refuses_settings(room, kwargs):
    name, value = next(iter(kwargs.items()))
    with pytest.raises(ValueError, match=f"{name.rstrip('s')}|seed") as error:
        ScanNavEnv(**({"scenes": room} | kwargs))
    assert str(value) in str(error.value) or value == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gaol": 1}, "unknown reset options.*gaol"),
        ({"start": (1, 1)}, "needs a goal"),
        ({"scene": 1}, "index of 1 scenes, got 1"),
        ({"goal": 3}, r"must be \(x, y\)"),
        ({"goal": (90.0, 1.0)}, "not on the walkable floor"),
        ({"goal": (4.0, 3.0), "start": (0.2, 3.0)}, "no way from the start"),
        ({"heading": np.nan}, "heading"),
    ],
    ids=str,
)
def test_refuses_reset_options(room, options, message):
    with pytest.raises(ValueError, match=message):
        ScanNavEnv(scenes=room).reset(seed=0, options=options)
