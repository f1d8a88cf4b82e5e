"""The table of environment ids and their traits; importing it registers both."""

import dataclasses
from typing import Any

import gymnasium as gym

from sb3_abisim.registry import EnvTraits, register_traits


def _like(env_id: str, traits: EnvTraits) -> EnvTraits:
    """Traits of an environment whose observations the encoders of another one fit."""
    return dataclasses.replace(traits, same_observations_as=env_id)


_NAV2D = EnvTraits(
    algo="dqn", n_transitions=1_000_000, return_range=(-50.0, 0.0), free_kwargs=("goal",), length_unit="cells"
)
# The fixed structures look like the random layouts.
_NAV2D_STRUCTURE = _like("Nav2D-v0", _NAV2D)
_POINT_MAZE = EnvTraits(n_transitions=250_000, return_range=(-128.0, 0.0), free_kwargs=("goal",))
_DISTRACTOR = EnvTraits(
    n_transitions=250_000,
    return_range=(-128.0, 0.0),
    splits=("eval", "train", "clean"),
    split_kwargs=("split", "clips"),
    free_kwargs=("split", "clips", "videos", "goal"),
)
# Encoders that were pretrained with the goal in the center fit, though they have not seen it elsewhere.
_RANDOM_GOAL: dict[str, Any] = {"goal": "random"}
# A random agent that may stop does so after four steps.
_SCAN_NAV = EnvTraits(n_transitions=100_000, collect_kwargs={"stop": "auto"})
# The paper's setting: Habitat's sensors and view, a plain box on the agent, detours preferred.
_PAPER_VIEW: dict[str, Any] = {"image_size": 256, "view_size": 10.0, "marker": "box", "min_ratio": 1.1}

# id: (module and class name without the ending Env/VectorEnv, default keyword arguments, steps per episode, traits)
_TABLE: dict[str, tuple[str, dict[str, Any], int, EnvTraits]] = {
    "Nav2D-v0": ("nav2d:Nav2D", {}, 50, _NAV2D),
    "Nav2DCorridor-v0": ("nav2d:Nav2D", {"layout": "corridor"}, 50, _NAV2D_STRUCTURE),
    "Nav2DMaze-v0": ("nav2d:Nav2D", {"layout": "maze"}, 50, _NAV2D_STRUCTURE),
    "Nav2DRandomGoal-v0": ("nav2d:Nav2D", _RANDOM_GOAL, 50, _like("Nav2D-v0", _NAV2D)),
    "PointMaze-v0": ("point_maze.env:PointMaze", {}, 128, _POINT_MAZE),
    "ContinuousPointMaze-v0": ("point_maze.env:PointMaze", {"continuous": True}, 128, _POINT_MAZE),
    "PointMazeRandomGoal-v0": ("point_maze.env:PointMaze", _RANDOM_GOAL, 128, _like("PointMaze-v0", _POINT_MAZE)),
    "ContinuousPointMazeRandomGoal-v0": (
        "point_maze.env:PointMaze",
        {"continuous": True, **_RANDOM_GOAL},
        128,
        _like("ContinuousPointMaze-v0", _POINT_MAZE),
    ),
    "DistractorPointMaze-v0": ("point_maze.distractors:DistractorPointMaze", {}, 128, _DISTRACTOR),
    "ContinuousDistractorPointMaze-v0": (
        "point_maze.distractors:DistractorPointMaze",
        {"continuous": True},
        128,
        _DISTRACTOR,
    ),
    "DistractorPointMazeRandomGoal-v0": (
        "point_maze.distractors:DistractorPointMaze",
        _RANDOM_GOAL,
        128,
        _like("DistractorPointMaze-v0", _DISTRACTOR),
    ),
    "ContinuousDistractorPointMazeRandomGoal-v0": (
        "point_maze.distractors:DistractorPointMaze",
        {"continuous": True, **_RANDOM_GOAL},
        128,
        _like("ContinuousDistractorPointMaze-v0", _DISTRACTOR),
    ),
    "ScanNav-v0": ("scan_nav.env:ScanNav", {}, 500, _SCAN_NAV),
    "ScanNavPaper-v0": ("scan_nav.env:ScanNav", _PAPER_VIEW, 500, _SCAN_NAV),
}

ENV_IDS = tuple(_TABLE)

for _id, (_path, _kwargs, _steps, _traits) in _TABLE.items():
    gym.register(
        _id,
        entry_point=f"{__name__}.{_path}Env",
        vector_entry_point=f"{__name__}.{_path}VectorEnv",
        max_episode_steps=_steps,
        kwargs=_kwargs,
    )
    register_traits(_id, _traits)


def __getattr__(name: str) -> Any:
    # Later, since it imports the rasterizer.
    if name == "PointMazePixels":
        from sb3_abisim.envs.point_maze.pixel_wrapper import PointMazePixels

        return PointMazePixels
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
