"""From data to a trained agent in about three minutes on two cores: ``sb3-abisim demo -o demo``.

Runs the commands that a user would type, prints each before it starts, and ends with a learning curve, a GIF of the
trained agent and the folder where everything lies. The method, goal progress, is the one on whose frozen encoder PPO
learns the fastest. The budget is far below that of the shipped encoders: it shows the steps, no result.
"""

import argparse
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from sb3_abisim.common.cli import PROGRAM, make_parser, run
from sb3_abisim.common.extras import require_extra
from sb3_abisim.common.files import write_atomic
from sb3_abisim.zoo.record import record

ENV_ID = "DistractorPointMaze-v0"


def commands(folder: Path, n_transitions: int, n_updates: int, n_timesteps: int) -> list[list[str]]:
    """The commands, as words after ``python -m``, in order.

    :param folder: where they write
    :param n_transitions: random-action transitions to collect
    :param n_updates: pretraining updates for each of the two encoders
    :param n_timesteps: steps of PPO
    """
    data, base, encoder = folder / "data", folder / "ssi.safetensors", folder / "goal_progress.safetensors"
    pretrain = ["sb3_abisim", "pretrain", "--env", ENV_ID, "--data", str(data), "--verbose", "0"]
    updates = ["-params", f"n_updates:{n_updates}", f"checkpoint_interval:{n_updates}"]
    return [
        ["sb3_abisim", "collect", "--env", ENV_ID, "-n", str(n_transitions), "-o", str(data)],
        [*pretrain, "--objective", "ssi", "-o", str(base), *updates],
        [*pretrain, "--objective", "goal_progress", "--base", str(base), "-o", str(encoder), *updates],
        # The paper's rollouts of 65,536 steps and learning rate of 2.5e-5 are made for 7 million steps.
        ["sb3_abisim", "train", "--algo", "ppo", "--env", ENV_ID, "--conf-file", f"goal_progress={encoder},frozen",
         "-n", str(n_timesteps), "-f", str(folder / "logs"), "--seed", "0", "--verbose", "0", "-P",
         "--eval-freq", "-1", "-params", "n_envs:16", "n_steps:128", "batch_size:256", "n_epochs:4",
         "learning_rate:3e-4"],
    ]  # fmt: skip


def newest_run(folder: Path) -> Path:
    """The zoo's run folder that was written last.

    :param folder: the demo's folder
    """
    return max((folder / "logs" / "ppo").glob(f"{ENV_ID}_*"), key=lambda run: run.stat().st_mtime)


def plot_learning_curve(run: Path, path: Path, n_smooth: int = 100) -> None:
    """Plot the return and the success rate of the training episodes.

    :param run: zoo run folder with monitor files
    :param path: the PNG file to write
    :param n_smooth: episodes in a mean
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from stable_baselines3.common.monitor import load_results

    episodes = load_results(str(run)).sort_values("t")
    steps = episodes["l"].cumsum()
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), constrained_layout=True)
    for axis, column, label in zip(axes, ("r", "is_success"), ("return", "success rate"), strict=True):
        values = episodes[column].astype(float)
        axis.plot(steps, values.rolling(n_smooth, min_periods=n_smooth // 2).mean())
        axis.set(xlabel="environment steps", ylabel=f"{label} (mean of {n_smooth} episodes)")
        axis.locator_params(axis="x", nbins=5)
        axis.grid(alpha=0.3)
    figure.suptitle(f"PPO on a frozen encoder of goal progress, {ENV_ID}")
    write_atomic(path, lambda file: figure.savefig(file, format="png", dpi=120))
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: arguments, None for those of the process
    """
    parser = make_parser("demo", "From data to a trained agent in about three minutes on two cores.", "demo -o demo")
    parser.add_argument("-o", "--output", default="demo", metavar="DIR", help="folder for everything (default: demo)")
    parser.add_argument("--n-transitions", type=int, default=50_000, help="to pretrain on (default: %(default)s)")
    parser.add_argument("--n-updates", type=int, default=600, help="of pretraining (default: %(default)s)")
    parser.add_argument("--n-timesteps", type=int, default=65_536, help="of PPO (default: %(default)s)")
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> int:
    # Now, not after three minutes.
    require_extra("plots", "the demo", "matplotlib", "PIL")
    folder, start = Path(args.output), time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    for words in commands(folder, args.n_transitions, args.n_updates, args.n_timesteps):
        print(f"\n$ {shlex.join([PROGRAM, *words[1:]])}", flush=True)
        code = subprocess.run([sys.executable, "-m", *words], check=False).returncode
        if code:
            # It has said why.
            return code if code > 0 else 1
    zoo_run = newest_run(folder)
    plot_learning_curve(zoo_run, folder / "learning_curve.png")
    success = record(zoo_run, folder / "agent.gif").success
    minutes = (time.monotonic() - start) / 60
    print(f"\nDone in {minutes:.1f} minutes; the agent reached the goal in {success:.0%} of the recorded episodes.")
    print(f"  learning curve    {folder / 'learning_curve.png'}")
    print(f"  the agent         {folder / 'agent.gif'}")
    print(f"  everything        {folder.resolve()}")
    return 0
