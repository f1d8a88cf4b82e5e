"""What the commands have in common: one grammar for ``NAME:VALUE``, ``--packages``, and mistakes as one line.

Nothing heavy is imported here, so that ``--help`` answers at once.
"""

import argparse
import ast
import errno
import functools
import importlib
import re
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

from sb3_abisim.common.text import printable
from sb3_abisim.registry import import_network, is_import_path, load_plugins, name_package

PROGRAM = "sb3-abisim"
# By what the system says.
_REMEDIES = {
    errno.EACCES: "allow it, or name another place",
    errno.EPERM: "allow it, or name another place",
    errno.EROFS: "name a place that can be written",
    errno.EEXIST: "something else is there; name another place",
    errno.ENOTDIR: "a file is where a folder should be; name another place",
    errno.EISDIR: "a folder is where a file should be; name a file",
    errno.ENOENT: "correct the path",
    errno.ENOSPC: "free some space and run the same command again",
    errno.EDQUOT: "free some space and run the same command again",
    errno.EFBIG: "name a place that takes files of this size",
    errno.ELOOP: "a link leads to itself; name another place",
}
_EXPONENT = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+")


def make_parser(command: str, description: str, example: str) -> argparse.ArgumentParser:
    """A parser of a command, with ``--packages``.

    :param command: its name, such as "collect" or "benchmark report"
    :param description: what it does
    :param example: a call that works, without the program's name
    """
    parser = argparse.ArgumentParser(
        f"{PROGRAM} {command}",
        description=description,
        epilog=f"example: {PROGRAM} {example}",
        formatter_class=_Formatter,
    )
    add_packages(parser)
    return parser


class _Formatter(argparse.HelpFormatter):
    def _fill_text(self, text: str, width: int, indent: str) -> str:
        # An example is to be copied, so its line stays whole.
        return indent + text if text.startswith("example: ") else super()._fill_text(text, width, indent)


def add_packages(parser: argparse.ArgumentParser) -> None:
    """Add ``--packages``, for :func:`import_packages`.

    :param parser: of a command
    """
    parser.add_argument(
        "--packages", nargs="+", action="extend", default=[], metavar="MODULE",
        help="imported first: modules that register environments, methods, networks or readers; pkg.module:Factory "
        "names a network, so that an encoder file may name it, too",
    )  # fmt: skip


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Add ``--trust``, for what opens saved models.

    :param parser: of a command
    """
    parser.add_argument(
        "--trust", action="store_true",
        help="unpickle the model, which executes whatever its zip holds; only for a zip that you or somebody you trust "
        "made, where its YAML does not say how to build it",
    )  # fmt: skip


def import_packages(names: Sequence[str]) -> None:
    """Import modules that register something, and the plugins of installed packages.

    :param names: of the modules, and ``pkg.module:Factory`` of networks
    :raises ValueError: for one that cannot be imported
    """
    load_plugins()
    for name in names:
        name_package(name)
        if is_import_path(name):
            import_network(name)
            continue
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise ValueError(f"--packages: cannot import {name!r} ({error}); install it or set PYTHONPATH") from None


def run(
    parser: argparse.ArgumentParser,
    argv: Sequence[str] | None,
    function: Callable[[argparse.Namespace], int | None],
    interrupted: str = "stopped",
) -> None:
    """Parse the words of a command and run it, its mistakes in one line on standard error.

    Exits with 2 for a mistake of the user, 1 when the system failed (a full disk) or numbers did, 130 after Ctrl-C.

    :param parser: of :func:`make_parser`
    :param argv: the words; None for those of the process
    :param function: the command; what it returns, if anything, is the exit code
    :param interrupted: said after Ctrl-C
    """
    args = parser.parse_args(argv)
    # A writer in the background, as TensorBoard's, hands its error to whoever writes next: one line here, too.
    usual = threading.excepthook
    threading.excepthook = functools.partial(_say_in_one_line, parser.prog, usual)
    try:
        import_packages(args.packages)
        code = function(args)
    except (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, ImportError) as error:
        parser.exit(2, f"{parser.prog}: error: {with_remedy(error)}\n")
    except (OSError, FloatingPointError) as error:
        parser.exit(1, f"{parser.prog}: {with_remedy(error)}\n")
    except MemoryError as error:
        what = str(error) and f" ({one_line(error)})"
        parser.exit(1, f"{parser.prog}: out of memory{what}; give it smaller inputs, or more memory\n")
    except RecursionError:
        parser.exit(2, f"{parser.prog}: error: an input is nested too deeply to be read\n")
    except ValueError as error:
        parser.exit(2, f"{parser.prog}: error: {one_line(error)}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"{parser.prog}: {interrupted}\n")
    finally:
        threading.excepthook = usual
    if code:
        sys.exit(code)


def _say_in_one_line(
    program: str, usual: Callable[[threading.ExceptHookArgs], object], failed: threading.ExceptHookArgs
) -> None:
    if isinstance(failed.exc_value, OSError):
        print(f"{program}: {with_remedy(failed.exc_value)}", file=sys.stderr)
    else:
        usual(failed)


def with_remedy(error: BaseException) -> str:
    """A message in one line; what the system says of a path ends in what to do.

    :param error: any
    """
    remedy = _REMEDIES.get(error.errno or 0) if isinstance(error, OSError) else None
    text = one_line(error)
    return f"{text}; {remedy}" if remedy and ";" not in text else text


def one_line(error: BaseException) -> str:
    """An exception's message as one line, with control characters spelled out.

    :param error: whose message may have several
    """
    return printable(" ".join(str(error).split())) or type(error).__name__


def parse_pairs(words: Sequence[str], option: str) -> dict[str, Any]:
    """Read ``NAME:VALUE`` words.

    :param words: such as ``n_updates:100``, ``objective_kwargs.c:0.9`` or ``scenes:house.glb``
    :param option: that took them, for messages
    :return: name to value, see :func:`parse_value`
    :raises ValueError: for a word without a name or a colon
    """
    pairs: dict[str, Any] = {}
    for word in words:
        name, colon, text = word.partition(":")
        if not colon or not all(part.isidentifier() for part in name.split(".")):
            raise ValueError(f"{option} takes NAME:VALUE words such as k:5, got {word!r}")
        pairs[name] = parse_value(text)
    return pairs


def parse_value(text: str) -> Any:
    """A value as Python or YAML write it; what is neither is a string.

    :param text: such as ``1e-4``, ``'a text'``, ``[1, 5]``, ``{c: 0.9}``, ``true``, ``null``, ``lin_0.001``
    :return: JSON types, or a tuple
    """
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        pass
    import yaml

    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    return _numbers(value) if isinstance(value, bool | int | float | str | list | dict | None) else text


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _numbers(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_numbers(part) for part in value]
    # YAML 1.1 takes 1e-4, without a dot, for a text.
    return float(value) if isinstance(value, str) and _EXPONENT.fullmatch(value) else value
