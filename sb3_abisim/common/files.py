"""Files that are either whole or absent, and folders with one writer at a time.

A process may be killed between any two instructions. :func:`write_atomic` therefore writes under a temporary name and
renames at the end; a reader sees the old file or the new one. :func:`folder_lock` is a lock of the system, which frees
it when its holder dies, so that a kill leaves nothing to clean up by hand.
"""

import contextlib
import errno
import fnmatch
import hashlib
import os
import re
import secrets
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from filelock import FileLock, Timeout

LOCK_NAME = ".lock"
_TEMPORARY_SUFFIX = ".tmp"
# What the system says of a place, whatever a file holds: access, and space.
_OF_SYSTEM = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


class FolderLockedError(ValueError):
    """Another process is writing in the folder; the message names its pid and host."""


def write_atomic(path: str | os.PathLike[str], write_fn: Callable[[BinaryIO], object], size: int | None = None) -> None:
    """Create or replace a file so that a kill or a full disk leaves the old one (or none), never a part of the new one.

    The parent folder must exist. A link stays, and what it leads to is written. When this returns, the file and its
    name have reached the disk.

    :param path: the file
    :param write_fn: called with a binary file open for writing; writes the content
    :param size: bytes to reserve before writing, so that a full disk is found out at once; None reserves nothing.
        It must not exceed what ``write_fn`` writes
    :raises ValueError: for a device, a pipe or a folder
    :raises OSError: what the system says, ``errno.ENOSPC`` for a full disk; the temporary file is removed
    """
    path = check_output(path)
    # Random, since processes in containers that share a folder have equal numbers, and threads of one have one.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}{_TEMPORARY_SUFFIX}")
    try:
        with naming(path), open(temporary, "wb") as file:
            if size and hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            write_fn(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):  # what went wrong is said
            temporary.unlink()
        raise
    fsync_folder(path.parent)


def check_output(path: str | os.PathLike[str]) -> Path:
    """Whether :func:`write_atomic` could write a file; for commands, before they work for minutes.

    :param path: the file, whose folder may be absent yet
    :return: what it leads to, where it is a link
    :raises ValueError: for a device, a pipe or a folder
    :raises OSError: for a link that leads to itself, and what may not be written
    """
    path = Path(os.path.realpath(path))
    if path.is_symlink():
        # A rename would replace it, as what may not be written.
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is no file that could be replaced; name another")
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, "it may not be written; allow it, or name another file", str(path))
    if path.parent.exists() and not os.access(path.parent, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    return path


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Name the place in the system's errors that name none, as those of writing into an open file, or a temporary one.

    :param path: what is written
    :raises OSError: the same with its file name
    """
    try:
        yield
    except OSError as error:
        named = error.filename is not None and not is_temporary(os.path.basename(os.fsdecode(error.filename)))
        if named or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error


def is_of_system(error: BaseException) -> bool:
    """Whether an error says of a place that it may not be read or written, or is full: no fault of what lies there.

    :param error: any
    """
    return isinstance(error, OSError) and error.errno in _OF_SYSTEM


def find(folder: str | os.PathLike[str], pattern: str) -> list[Path]:
    """What ``Path.glob`` finds, sorted; that leaves out in silence what may not be read.

    :param folder: where to look; an absent one holds nothing
    :param pattern: such as ``*/args.yml`` or ``**/*.parquet``
    :raises PermissionError: for a folder on the way that may not be read
    """
    return sorted(_find(Path(folder), pattern.split("/")))


def _find(folder: Path, parts: Sequence[str]) -> Iterator[Path]:
    first, *rest = parts
    try:
        entries = list(os.scandir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return
    if first == "**":
        yield from _find(folder, rest)
    for entry in entries:
        if first == "**":
            if entry.is_dir(follow_symlinks=False):
                yield from _find(folder / entry.name, parts)
        elif fnmatch.fnmatchcase(entry.name, first):
            yield from _find(folder / entry.name, rest) if rest else (folder / entry.name,)


def fsync_folder(path: str | os.PathLike[str]) -> None:
    """Make the names in a folder (files created, renamed or removed) durable.

    :param path: the folder
    """
    if os.name == "nt":
        return  # where a folder cannot be opened
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def is_temporary(name: str) -> bool:
    """Whether a file name is one that :func:`write_atomic` uses before the rename.

    :param name: a file name without its folder
    """
    return re.fullmatch(rf"\..+\.[0-9a-f]{{16}}{re.escape(_TEMPORARY_SUFFIX)}", name) is not None


def remove_temporaries(folder: str | os.PathLike[str]) -> None:
    """Remove what killed calls of :func:`write_atomic` left in a folder; call it only while holding its lock.

    :param folder: an existing folder
    """
    for path in Path(folder).iterdir():
        if is_temporary(path.name):
            path.unlink()


@contextlib.contextmanager
def folder_lock(path: str | os.PathLike[str]) -> Iterator[None]:
    """Hold the right to write in a folder for the duration of a ``with`` block.

    The lock file ``.lock`` is removed at the end; one left by a killed process is taken over, since the system lets go
    of a dead process's lock.

    :param path: an existing folder
    :raises FolderLockedError: at once, if another process (or another block of this one) holds the lock
    """
    folder = Path(path)
    lock_path = folder / LOCK_NAME
    lock = FileLock(lock_path, thread_local=False)
    while True:
        try:
            lock.acquire(blocking=False)
            break
        except Timeout:
            # A holder removes the file when it ends: the name may no longer stand for what could not be locked.
            if not lock_path.exists():
                continue
        try:
            holder = lock_path.read_text(errors="replace") or "another process"
        except OSError:
            holder = "another process"
        raise FolderLockedError(
            f"{folder} is being written by {holder}; wait for it to end, stop it, or choose another folder"
        )
    try:
        # Windows lets nobody write in, or remove, a file that is locked.
        with naming(lock_path), contextlib.suppress(PermissionError):
            lock_path.write_text(f"process {os.getpid()} on host {socket.gethostname()}")
        yield
    finally:
        with contextlib.suppress(PermissionError):
            lock_path.unlink(missing_ok=True)
        lock.release()


def file_hash(path: str | os.PathLike[str]) -> str:
    """The sha256 of a file's content in hexadecimal.

    :param path: the file
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
