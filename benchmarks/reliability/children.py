"""Cases in child processes of their own, which are limited, watched and judged.

A child is a fork of this process, which has imported everything: a case costs what it does, and not the start of
Python. This process must therefore have one thread. Linux.
"""

import contextlib
import fcntl
import json
import os
import resource
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# What a case may take before it is stopped, far above what counts as a breach: of the clock, and of a processor.
SECONDS, CPU_SECONDS = 600.0, 90
ADDRESS_BYTES = 6 << 30
# More than any case prints; the system lets every user have so large a pipe.
OUTPUT_BYTES = 1 << 20
MAX_SECONDS, MAX_MEGABYTES = 30.0, 1000.0
# Exceptions that end in one sentence: of a command, it is what it prints.
SENTENCES = (ValueError, OSError, FloatingPointError, ImportError)
# Subclasses of them that Python raises from deep within, and whose text says nothing to a user.
_BARE = (UnicodeError, json.JSONDecodeError, EOFError)


@dataclass
class Outcome:
    """What became of a case.

    :param kind: "done"; "refused" in one sentence; "bare" for another exception; "killed" by a signal
    :param text: the message, or the end of the output
    :param value: what the case returned, JSON types
    :param seconds: of a processor
    :param megabytes: resident at most, with the libraries
    :param acts: programs started, connections, files written elsewhere
    """

    kind: str
    text: str = ""
    value: Any = None
    seconds: float = 0.0
    megabytes: float = 0.0
    acts: list[str] = field(default_factory=list)


def kind_of(error: BaseException) -> str:
    """Whether an exception is a sentence for a user: "refused", or "bare".

    :param error: of a call into this package
    """
    text = str(error).strip()
    is_sentence = isinstance(error, SENTENCES) and type(error) not in _BARE and len(text) > 12
    return "refused" if is_sentence and "Traceback" not in text else "bare"


def command(*words: str | Path) -> Callable[[], None]:
    """A case: ``sb3-abisim`` with these words.

    :param words: of the command
    """

    def case() -> None:
        from sb3_abisim.__main__ import main

        texts = list(map(str, words))
        # rl-zoo3 writes it into a run's folder.
        sys.argv, sys.orig_argv = ["sb3-abisim", *texts], ["sb3-abisim", *texts]
        try:
            main(texts)
        except Exception as error:
            raise RuntimeError(f"a traceback of {type(error).__name__}: {error}") from error

    return case


def run(
    case: Callable[[], Any],
    folder: Path,
    seconds: float = SECONDS,
    max_file_bytes: int | None = None,
    watched: bool = False,
) -> Outcome:
    """Run a case in a child and wait for its end.

    :param case: what it returns must be JSON
    :param folder: its working directory, and the only one that it may write in if it is watched
    :param seconds: after which it is killed
    :param max_file_bytes: of each file that it writes; more fails as on a full disk
    :param watched: whether its memory is limited and its acts are noted
    """
    with _output() as (written, read), tempfile.TemporaryFile() as result:
        child = os.fork()
        if not child:
            _child(case, folder, written, result.fileno(), max_file_bytes, watched)
        status, usage = _wait(child, time.monotonic() + seconds)
        outcome = _read(status, read(), result)
        outcome.seconds = usage.ru_utime + usage.ru_stime
        outcome.megabytes = usage.ru_maxrss / 1024
        return outcome


@contextlib.contextmanager
def _output() -> Iterator[tuple[int, Callable[[], str]]]:
    """A pipe, to which no limit of files applies: where to write, and what has been written so far."""
    source, sink = os.pipe()
    fcntl.fcntl(sink, fcntl.F_SETPIPE_SZ, OUTPUT_BYTES)
    os.set_blocking(source, False)

    def read() -> str:
        try:
            return os.read(source, OUTPUT_BYTES).decode(errors="replace")
        except BlockingIOError:
            return ""

    try:
        yield sink, read
    finally:
        os.close(source)
        os.close(sink)


def _wait(child: int, deadline: float) -> tuple[int, Any]:
    pause = 0.001
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            _end_group(child)
            return status, usage
        if time.monotonic() > deadline:
            _end_group(child)
            _, status, usage = os.wait4(child, 0)
            return status, usage
        time.sleep(pause)
        pause = min(2 * pause, 0.05)


def _end_group(child: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)


def kill_at(case: Callable[[], Any], folder: Path, seconds: float) -> bool:
    """Kill a case by SIGKILL, itself alone and not what it has started.

    :param case: as for :func:`run`
    :param folder: its working directory
    :param seconds: after which
    :return: whether it was still running
    """
    with open(os.devnull, "r+b") as nothing, tempfile.TemporaryFile() as result:
        child = os.fork()
        if not child:
            _child(case, folder, nothing.fileno(), result.fileno(), None, False)
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        return os.WIFSIGNALED(status)


def orphans(folder: Path, seconds: float = 10.0) -> list[int]:
    """Processes that work in a folder, after those that are about to end have had time to; they are ended.

    :param folder: of a case that was killed
    :param seconds: that they have
    """
    deadline = time.monotonic() + seconds
    while (found := _working_in(folder)) and time.monotonic() < deadline:
        time.sleep(0.2)
    for pid in found:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return found


def _working_in(folder: Path) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            if Path(os.readlink(entry / "cwd")).is_relative_to(folder) and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


def _child(
    case: Callable[[], Any], folder: Path, output: int, result: int, max_file_bytes: int | None, watched: bool
) -> None:
    """Never returns."""
    found: dict[str, Any] = {"kind": "done"}
    try:
        os.setsid()
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(folder)
        os.environ["SB3_ABISIM_CACHE"] = str(folder / "cache")
        if max_file_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (max_file_bytes, resource.RLIM_INFINITY))
        acts: list[str] = []
        if watched:
            resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES + _address_bytes(), resource.RLIM_INFINITY))
            resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
            sys.addaudithook(lambda event, args: _note(acts, folder, event, args))
        try:
            found["value"] = case()
        finally:
            found["acts"] = list(acts)
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    except SystemExit as stop:
        found["kind"] = "refused" if stop.code in (1, 2) else "done" if not stop.code else "bare"
    except BaseException as error:
        found |= {"kind": kind_of(error), "text": f"{type(error).__name__}: {error}"}
        traceback.print_exc()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
        os.pwrite(result, json.dumps(found).encode(), 0)
    finally:
        os._exit(0)


def _address_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


_PROGRAMS = ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.spawn")


def _note(acts: list[str], folder: Path, event: str, args: Sequence[Any]) -> None:
    """What a file of data must never lead to. (A hook that raises would be part of the case.)"""
    connects = event == "socket.connect" and getattr(args[0], "family", None) != socket.AF_UNIX
    if event in (*_PROGRAMS, "socket.getaddrinfo") or connects:
        acts.append(f"{event} {args[0]}")
    elif event == "open" and isinstance(args[0], str) and isinstance(args[2], int):
        writes = args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        path = os.path.abspath(args[0])
        if writes and not path.startswith((str(folder), "/dev/", "/proc/", tempfile.gettempdir() + "/tmp")):
            acts.append(f"write {path}")


def _read(status: int, text: str, result: Any) -> Outcome:
    last = text.rstrip().rpartition("\n")[2]
    result.seek(0)
    content = result.read()
    if not content:
        signal_number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        return Outcome("killed", f"signal {signal_number}; {last}")
    found = json.loads(content)
    kind, told = found["kind"], found.get("text", "")
    if kind == "refused" and not told:
        # A command's: the last line says why, and nothing but it.
        kind, told = ("bare" if "Traceback" in text or not last else kind), last
    return Outcome(kind, told or last, found.get("value"), acts=found.get("acts", []))
