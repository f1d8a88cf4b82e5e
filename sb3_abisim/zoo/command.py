"""``sb3-abisim train``, ``enjoy`` and ``zoo``: rl-zoo3's commands with our methods, from any folder."""

import importlib
import runpy
import sys
from collections.abc import Sequence

from sb3_abisim.common.cli import PROGRAM, one_line, parse_pairs

# The commands of rl-zoo3 by name: the module, and an example.
SCRIPTS = {
    "train": ("rl_zoo3.train", "--algo ppo --env PointMaze-v0 --conf-file abisim,frozen -n 100000"),
    "enjoy": ("rl_zoo3.enjoy", "--algo ppo --env PointMaze-v0 -f logs"),
    "record_video": ("rl_zoo3.record_video", "--algo ppo --env PointMaze-v0 -f logs"),
    "plot_train": ("rl_zoo3.plots.plot_train", "-a ppo -e PointMaze-v0 -f logs"),
    "all_plots": ("rl_zoo3.plots.all_plots", "-a ppo -e PointMaze-v0 -f logs -o curves"),
    "plot_from_file": ("rl_zoo3.plots.plot_from_file", "-i curves.pkl"),
}
_NAMES = ("train", "enjoy")
_PAIRS = ("-params", "--hyperparams", "--env-kwargs", "--eval-env-kwargs")


def main(argv: Sequence[str]) -> None:
    """Run a command of rl-zoo3; exits with 2 for a mistake before training has begun.

    :param argv: "train" or "enjoy" and their flags, or "zoo", a command of rl-zoo3 and its flags
    """
    command, *flags = argv
    prog = f"{PROGRAM} {command}"
    if command == "zoo":
        if not flags or flags[0] in ("-h", "--help"):
            print(f"usage: {prog} COMMAND ...\n\nA command of rl-zoo3: {', '.join(SCRIPTS)}.")
            print(f"example: {prog} all_plots {SCRIPTS['all_plots'][1]}")
            return
        command, *flags = flags
        if command not in SCRIPTS:
            print(f"{prog}: error: unknown command {command!r}; known are {', '.join(SCRIPTS)}", file=sys.stderr)
            sys.exit(2)
        prog = f"{prog} {command}"
    module, example = SCRIPTS[command]
    try:
        words = for_rl_zoo3(flags)
        if any(flag in ("-h", "--help") for flag in flags):
            _print_help(prog, command, example)
        # Teaches rl-zoo3 our methods.
        importlib.import_module("sb3_abisim.zoo")
        sys.argv = [prog, *words]
        runpy.run_module(module, run_name="__main__")
    except (ValueError, OSError, ImportError, AssertionError) as error:
        if importlib.import_module("sb3_abisim.zoo.manager").MethodExperimentManager.has_begun:
            raise
        print(f"{prog}: error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)


def for_rl_zoo3(flags: Sequence[str]) -> list[str]:
    """Flags in rl-zoo3's words: our ``--packages``, and ``NAME:VALUE`` pairs, whose values it evaluates as Python.

    :param flags: as a user types them
    :raises ValueError: for a pair that cannot be read
    """
    words: list[str] = []
    option = ""
    for flag in flags:
        if flag.startswith("-") and not flag[1:2].isdigit():
            option = flag
            words.append("--gym-packages" if flag == "--packages" else flag)
        elif option in _PAIRS:
            words += [f"{name}:{value!r}" for name, value in parse_pairs([flag], option).items()]
        else:
            words.append(flag)
    return words


def _print_help(prog: str, command: str, example: str) -> None:
    from sb3_abisim.zoo.methods import grammar

    if command == "train":
        print(f"rl-zoo3's {command}; --conf-file also takes {grammar()}.")
    print(f"--packages MODULE ... is its --gym-packages.\nexample: {prog} {example}\n")
