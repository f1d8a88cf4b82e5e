"""``sb3-abisim record``: a GIF of the agent that a zoo run ended with.

rl-zoo3's ``record_video`` makes an MP4. A GIF plays in a README and in any browser.
"""

import argparse
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_abisim.common.cli import make_parser, run
from sb3_abisim.common.files import write_atomic
from sb3_abisim.registry import get_traits
from sb3_abisim.zoo.evaluate import final_model, split_kwargs
from sb3_abisim.zoo.runs import read_run

if TYPE_CHECKING:
    from PIL import Image

# Of each frame; GIF counts in hundredths of a second.
MILLISECONDS = 80
# The last frame of an episode is shown this many times.
N_LAST = 12
PIXELS = 192
# Frames of an episode; of a longer one every second, third, ... is shown.
MAX_FRAMES = 128


def record(run_folder: str | Path, path: str | Path, n_episodes: int = 4, seed: int = 0) -> float:
    """Record the final model of a run, in its environment, on the evaluation split where there are splits.

    The policy is stochastic: a deterministic one can get stuck at a corner.

    :param run_folder: zoo run folder that has ended
    :param path: the GIF to write; the last frame of an episode stays for a second
    :param n_episodes: at least 1
    :param seed: of the episodes and of the actions
    :return: share of the recorded episodes that were successful
    :raises ValueError: if the folder holds no finished run, or ``n_episodes`` is below 1
    """
    import gymnasium as gym
    from stable_baselines3.common.utils import set_random_seed

    if n_episodes < 1:
        raise ValueError(f"n_episodes must be at least 1, got {n_episodes}")
    zoo_run = read_run(run_folder)
    model = final_model(zoo_run)
    kwargs = split_kwargs(zoo_run.env_id, zoo_run.env_kwargs, get_traits(zoo_run.env_id).eval_split)
    env = gym.make(zoo_run.env_id, render_mode="rgb_array", **kwargs)
    set_random_seed(seed)
    frames: list[Image.Image] = []
    successes = 0
    try:
        for episode in range(n_episodes):
            observation, _ = env.reset(seed=seed + episode)
            shown, done = [_frame(env.render())], False
            state: Any = None
            while not done:
                episode_start = np.array([state is None])
                action, state = model.predict(observation, state, episode_start, deterministic=False)
                observation, _, terminated, truncated, info = env.step(action)
                shown.append(_frame(env.render()))
                done = terminated or truncated
            successes += bool(info.get("is_success", False))
            frames += shown[:: -(-len(shown) // MAX_FRAMES)] + [shown[-1]] * (N_LAST - 1)
    finally:
        env.close()
    rest = {"save_all": True, "append_images": frames[1:], "duration": MILLISECONDS, "loop": 0}
    write_atomic(Path(path), lambda file: frames[0].save(file, format="GIF", **rest))
    return successes / n_episodes


def _frame(rendered: Any) -> "Image.Image":
    from PIL import Image

    small = Image.fromarray(rendered).resize((PIXELS, PIXELS))
    # Of Pillow's ways to choose 256 colors this one keeps the red of the small agent.
    return small.quantize(method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: the program's arguments by default
    """
    parser = make_parser(
        "record",
        "Record the agent that a zoo run ended with, as a GIF.",
        "record logs/ppo/PointMaze-v0_1 -o agent.gif",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder of rl-zoo3, such as logs/ppo/PointMaze-v0_1")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the GIF to write")
    parser.add_argument("--episodes", type=int, default=4, help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes (default: %(default)s)")
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> None:
    if importlib.util.find_spec("PIL") is None:
        raise ValueError("a GIF needs Pillow; run: pip install 'sb3_abisim[plots]'")
    if not args.output.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {args.output.parent} for {args.output.name}; make it first")
    success = record(args.run, args.output, args.episodes, args.seed)
    print(f"Wrote {args.output}; {success:.0%} of its {args.episodes} episodes were successful")
