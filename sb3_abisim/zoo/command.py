"""``sb3-abisim train``, ``enjoy`` and ``zoo``: rl-zoo3's commands with our methods, from any folder."""

import contextlib
import runpy
import sys
import warnings
from collections.abc import Sequence

import gymnasium as gym

from sb3_abisim.common.cli import PROGRAM, import_packages, one_line, parse_pairs, with_remedy
from sb3_abisim.common.files import is_of_system
from sb3_abisim.registry import is_import_path
from sb3_abisim.zoo.auxiliary import GRAMMAR, parse_auxiliary
from sb3_abisim.zoo.guard import GUARDED, guarded
from sb3_abisim.zoo.manager import MethodExperimentManager
from sb3_abisim.zoo.methods import grammar, split_options
from sb3_abisim.zoo.whole_files import saves_whole

# The commands of rl-zoo3 by name: the module, and an example.
SCRIPTS = {
    "train": ("rl_zoo3.train", "--algo ppo --env PointMaze-v0 --conf-file abisim,frozen -n 100000"),
    "enjoy": ("rl_zoo3.enjoy", "--algo ppo --env PointMaze-v0 -f logs --no-render"),
    "record_video": ("rl_zoo3.record_video", "--algo ppo --env PointMaze-v0 -f logs"),
    "plot_train": ("rl_zoo3.plots.plot_train", "-a ppo -e PointMaze-v0 -f logs"),
    "all_plots": ("rl_zoo3.plots.all_plots", "-a ppo -e PointMaze-v0 -f logs -o curves"),
    "plot_from_file": ("rl_zoo3.plots.plot_from_file", "-i curves.pkl"),
}
# Those that import packages themselves; train writes their names into the run's folder.
_WITH_PACKAGES = ("train", "enjoy")
# Reads a pickle that only it and its like write.
_UNPICKLES = "plot_from_file"
_TRUST = "--trust"
# Before training has begun, they are mistakes of the command.
_MISTAKES = (ValueError, OSError, ImportError, AssertionError, TypeError, gym.error.Error)
# What Stable-Baselines3 says of actions that an algorithm does not choose, and what helps.
_OTHER_ACTIONS, _OTHER_ALGORITHM = " as action spaces but ", "; give an --algo for such actions, ppo or a2c for any"
_PACKAGES = ("--packages", "--gym-packages")
_CONF_FILE = ("-conf", "--conf-file")
_AUXILIARY, _IMAGE_KEY = "--auxiliary", "--image-key"
# What becomes an option of the method, by name, and an example.
_OPTIONS = {_AUXILIARY: ("auxiliary", "ssi"), _IMAGE_KEY: ("image_key", "camera")}
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
    if {"-h", "--help"} & set(flags):
        if command == "train":
            print(f"rl-zoo3's train; --conf-file also takes {grammar()}.")
            print(
                "Without =ENCODER, it is the one that ships for the environment; frozen keeps its weights as they are."
            )
            print(f"{_AUXILIARY} {GRAMMAR} trains the encoder by an objective, too: --auxiliary abisim:weight=0.5.")
            print(
                f"{_IMAGE_KEY} KEY: the image that the method is for, of a Dict of observations (default: the file's)."
            )
        print("--packages MODULE ... imports modules that register environments, methods, networks or readers.")
        if command in (*GUARDED, _UNPICKLES, "train"):
            print(f"{_TRUST} opens the pickles of a run folder, which execute whatever they hold: for your own alone.")
        print(f"example: {prog} {example}\n")
    MethodExperimentManager.has_begun = False
    is_trusted = _TRUST in flags
    MethodExperimentManager.builds_from_yaml = not is_trusted
    try:
        if command == _UNPICKLES and not is_trusted and not {"-h", "--help"} & set(flags):
            raise ValueError(
                f"a file of all_plots is a pickle, which executes whatever it holds; add {_TRUST} for yours"
            )
        words, packages = for_rl_zoo3([flag for flag in flags if flag != _TRUST])
        import_packages(packages)
        if command == "train":
            words = _with_options(words)
        modules = [name for name in packages if not is_import_path(name)]
        if modules and command in _WITH_PACKAGES:
            words += ["--gym-packages", *modules]
        sys.argv = [prog, *words]
        # rl_zoo3.plots imports its commands, which runpy would warn of.
        warnings.filterwarnings("ignore", "'rl_zoo3.plots", RuntimeWarning)
        with contextlib.ExitStack() as stack:
            if command in GUARDED and not is_trusted:
                stack.enter_context(guarded())
            if command in ("train", "record_video"):
                stack.enter_context(saves_whole())
            runpy.run_module(module, run_name="__main__")
    except FloatingPointError as error:
        # Training has stopped, and no final model was saved.
        print(f"{prog}: {one_line(error)}", file=sys.stderr)
        sys.exit(1)
    except Exception as error:
        if MethodExperimentManager.has_begun and (system := _system_error(error)) is not None:
            print(f"{prog}: {one_line(system)}; training has stopped", file=sys.stderr)
            sys.exit(1)
        if not isinstance(error, _MISTAKES):
            raise
        # Of TypeErrors, an unknown hyperparameter or argument of an environment is a mistake of the command.
        is_mistake = not isinstance(error, TypeError) or "unexpected keyword argument" in str(error)
        if MethodExperimentManager.has_begun or not is_mistake:
            raise
        # As of every other command.
        code = 1 if is_of_system(error) else 2
        text = with_remedy(error)
        text += _OTHER_ALGORITHM if _OTHER_ACTIONS in text else ""
        print(f"{prog}: {'error: ' if code == 2 else ''}{text}", file=sys.stderr)
        sys.exit(code)
    finally:
        MethodExperimentManager.builds_from_yaml = False


def _system_error(error: BaseException) -> OSError | None:
    """What the system said, such as that a disk is full: it may lie beneath what a library made of it."""
    below: BaseException | None = error
    while below is not None and not isinstance(below, OSError):
        below = below.__cause__ or below.__context__
    return below


def for_rl_zoo3(flags: Sequence[str]) -> tuple[list[str], list[str]]:
    """Flags in rl-zoo3's form, which evaluates the values of its ``NAME:VALUE`` pairs as Python.

    :param flags: as a user types them
    :return: the flags without those that name packages, and the packages
    :raises ValueError: for a pair that cannot be read
    """
    words: list[str] = []
    packages: list[str] = []
    option = ""
    for flag in flags:
        value = flag
        if flag.startswith("-") and not flag[1:2].isdigit():
            option, equals, value = flag.partition("=")
            if option not in (*_PACKAGES, *_PAIRS):
                words.append(flag)
                continue
            if option in _PAIRS:
                words.append(option)
            if not equals:
                continue
        if option in _PACKAGES:
            packages.append(value)
        elif option in _PAIRS:
            words += [_pair(name, content, option) for name, content in parse_pairs([value], option).items()]
        else:
            words.append(value)
    return words, packages


def _with_options(words: Sequence[str]) -> list[str]:
    """``--auxiliary X`` as ``--conf-file ...,auxiliary=X``, which the run's folder then records; so ``--image-key``.

    :param words: flags in rl-zoo3's form
    :raises ValueError: for one without its word, or two of them
    """
    rest: list[str] = []
    found: dict[str, list[str]] = {flag: [] for flag in (*_OPTIONS, "--conf-file")}
    words = list(words)
    while words:
        word = words.pop(0)
        option, equals, value = word.partition("=")
        if option not in (*_OPTIONS, *_CONF_FILE):
            rest.append(word)
            continue
        if not equals and not words:
            raise ValueError(f"{option} takes a word, such as {option} {_OPTIONS.get(option, ('', 'abisim'))[1]}")
        found[option if option in _OPTIONS else "--conf-file"].append(value if equals else words.pop(0))
    configs = found["--conf-file"][-1:]
    for flag, (name, _) in _OPTIONS.items():
        if len(found[flag]) > 1:
            raise ValueError(f"{flag} is given twice, {' and '.join(found[flag])}; give one")
        for value in found[flag]:
            config = configs[0] if configs else ""
            if name in split_options(config)[1]:
                raise ValueError(f"--conf-file {config} says {name} already; leave {flag} out")
            if flag == _AUXILIARY:
                parse_auxiliary(value)
            configs = [f"{config},{name}={value}"]
    return rest + [word for config in configs for word in ("--conf-file", config)]


def _pair(name: str, value: object, option: str) -> str:
    if "." in name:
        raise ValueError(
            f"{option} sets whole hyperparameters, got {name!r}; give {name.partition('.')[0]}, or write a YAML file "
            "for --conf-file"
        )
    return f"{name}:{value!r}"
