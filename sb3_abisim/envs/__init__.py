"""The table of environment ids; importing it registers them with Gymnasium."""

import gymnasium as gym

from sb3_abisim.envs.pixel_wrapper import PointMazePixels

__all__ = ["ENV_IDS", "PointMazePixels"]

# id: (module, class name without the ending Env/VectorEnv, default keyword arguments, steps per episode)
_TABLE: dict[str, tuple[str, str, dict[str, object], int]] = {
    "Nav2D-v0": ("nav2d", "Nav2D", {}, 50),
    "Nav2DCorridor-v0": ("nav2d", "Nav2D", {"layout": "corridor"}, 50),
    "Nav2DMaze-v0": ("nav2d", "Nav2D", {"layout": "maze"}, 50),
    "PointMaze-v0": ("point_maze", "PointMaze", {}, 128),
    "ContinuousPointMaze-v0": ("point_maze", "PointMaze", {"continuous": True}, 128),
    "DistractorPointMaze-v0": ("distractors", "DistractorPointMaze", {}, 128),
    "ContinuousDistractorPointMaze-v0": ("distractors", "DistractorPointMaze", {"continuous": True}, 128),
    "ScanNav-v0": ("scan_nav", "ScanNav", {}, 500),
    # The paper's setting: Habitat's sensors and view, a plain box on the agent, detours preferred.
    "ScanNavPaper-v0": (
        "scan_nav",
        "ScanNav",
        {"image_size": 256, "view_size": 10.0, "marker": "box", "min_ratio": 1.1},
        500,
    ),
}

ENV_IDS = tuple(_TABLE)

for _id, (_module, _name, _kwargs, _steps) in _TABLE.items():
    gym.register(
        _id,
        entry_point=f"{__name__}.{_module}:{_name}Env",
        vector_entry_point=f"{__name__}.{_module}:{_name}VectorEnv",
        max_episode_steps=_steps,
        kwargs=_kwargs,
    )
