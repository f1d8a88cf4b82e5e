"""``sb3-abisim record``: a GIF of the agent that a zoo run ended with.

rl-zoo3's ``record_video`` makes an MP4. A GIF plays in a README and in any browser.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_abisim.common.cli import add_trust, make_parser, run
from sb3_abisim.common.extras import needs_extra, require_extra
from sb3_abisim.common.files import check_output, write_atomic
from sb3_abisim.registry import get_traits
from sb3_abisim.zoo.run_envs import final_model, make_run_env, split_kwargs
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


class Recording(NamedTuple):
    """What was recorded.

    :param mean_return: of the episodes, as the environment gives rewards
    :param success: share of the episodes that were successful; None where the environment does not say
    """

    mean_return: float
    success: float | None


def record(
    run_folder: str | Path, path: str | Path, n_episodes: int = 4, seed: int = 0, trust: bool = False
) -> Recording:
    """Record the final model of a run, in its environment, on the evaluation split where there are splits.

    The policy is stochastic: a deterministic one can get stuck at a corner.

    :param run_folder: zoo run folder that has ended
    :param path: the GIF to write; the last frame of an episode stays for a second
    :param n_episodes: at least 1
    :param seed: of the episodes and of the actions
    :param trust: see :func:`~sb3_abisim.zoo.models.load_model`
    :return: how the episodes went
    :raises ValueError: if the folder holds no finished run, ``n_episodes`` is below 1, or the file is named otherwise
    """
    from stable_baselines3.common.utils import set_random_seed

    if n_episodes < 1:
        raise ValueError(f"n_episodes must be at least 1, got {n_episodes}")
    if Path(path).suffix.lower() != ".gif":
        raise ValueError(f"what is written is a GIF, and {Path(path).name} would say otherwise; call it NAME.gif")
    check_output(path)
    zoo_run = read_run(run_folder)
    model = final_model(zoo_run, trust)
    kwargs = split_kwargs(zoo_run.env_id, zoo_run.env_kwargs, get_traits(zoo_run.env_id).eval_split)
    camera = _Camera()
    env = make_run_env(zoo_run, model, 1, {**kwargs, "render_mode": "rgb_array"}, seed, camera.watch)
    set_random_seed(seed)
    frames: list[Image.Image] = []
    returns, successes = list[float](), list[bool]()
    try:
        for episode in range(n_episodes):
            env.seed(seed + episode)
            observation: Any = env.reset()
            state: Any = None
            started, info = np.ones(1, bool), dict[str, Any]()
            # Wrappers may end episodes within an episode, as Atari's do where a life is lost.
            while "episode" not in info:
                action, state = model.predict(observation, state, started, deterministic=False)
                observation, _, started, (info,) = env.step(action)
            returns.append(float(info["episode"]["r"]))
            if "is_success" in info:
                successes.append(bool(info["is_success"]))
            shown = camera.last_episode
            frames += shown[:: -(-len(shown) // MAX_FRAMES)] + [shown[-1]] * (N_LAST - 1)
    finally:
        env.close()
    rest = {"save_all": True, "append_images": frames[1:], "duration": MILLISECONDS, "loop": 0}
    write_atomic(Path(path), lambda file: frames[0].save(file, format="GIF", **rest))
    return Recording(float(np.mean(returns)), float(np.mean(successes)) if successes else None)


class _Camera:
    """Keeps what an environment renders: of the present episode, and of the last one that ended."""

    def __init__(self) -> None:
        self.last_episode: list[Image.Image] = []
        self._shown: list[Image.Image] = []

    def watch(self, env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        """Wrap the environment."""
        return _Watched(env, self)

    def begin(self, rendered: Any) -> None:
        """The first frame of an episode."""
        self.last_episode, self._shown = self._shown, [_frame(rendered)]

    def add(self, rendered: Any) -> None:
        """The next frame."""
        self._shown.append(_frame(rendered))


class _Watched(gym.Wrapper[Any, Any, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any], camera: _Camera) -> None:
        super().__init__(env)
        self._camera = camera

    def reset(self, **kwargs: Any) -> Any:
        outcome = self.env.reset(**kwargs)
        self._camera.begin(self.env.render())
        return outcome

    def step(self, action: Any) -> Any:
        outcome = self.env.step(action)
        self._camera.add(self.env.render())
        return outcome


def _frame(rendered: Any) -> "Image.Image":
    with needs_extra("plots", "a GIF"):
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
    add_trust(parser)
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> None:
    require_extra("plots", "a GIF", "PIL")
    if not args.output.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {args.output.parent} for {args.output.name}; make it first")
    mean_return, success = record(args.run, args.output, args.episodes, args.seed, args.trust)
    successful = "" if success is None else f", {success:.0%} successful"
    print(f"Wrote {args.output}; episodes: {args.episodes}, mean return {mean_return:.4g}{successful}")
