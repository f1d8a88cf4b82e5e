import errno
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import pytest

from sb3_abisim.common.files import (
    LOCK_NAME,
    FolderLockedError,
    file_hash,
    find,
    folder_lock,
    remove_temporaries,
    write_atomic,
)

HOLD_LOCK = """
import sys, time
from sb3_abisim.common.files import folder_lock
with folder_lock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_write_replaces_the_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for content in (b"a longer first content", b"short"):
        write_atomic(path, lambda file, content=content: file.write(content))
        assert path.read_bytes() == content
    assert os.listdir(tmp_path) == ["file"]


def test_a_file_that_may_not_be_written_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rename would replace it all the same; to root everything is allowed, so that the system's answer is made."""
    path, link = tmp_path / "kept", tmp_path / "link"
    path.write_text("old")
    link.symlink_to(path)
    monkeypatch.setattr(os, "access", lambda name, mode: not (Path(name) == path and mode == os.W_OK))
    for name in (path, link):
        with pytest.raises(PermissionError, match=r"it may not be written; allow it, or name another file.*kept"):
            write_atomic(name, lambda file: file.write(b"new"))
    assert path.read_text() == "old" and sorted(tmp_path.iterdir()) == [path, link]


def test_data_is_durable_before_the_name_and_the_name_before_the_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    real_fsync, real_replace = os.fsync, os.replace

    def fsync(descriptor: int) -> None:
        is_folder = os.path.samestat(os.fstat(descriptor), os.stat(tmp_path))
        # The content must have left Python's buffer by now.
        calls.append("folder" if is_folder else f"file of {os.fstat(descriptor).st_size}")
        real_fsync(descriptor)

    def replace(source: Path, target: Path) -> None:
        assert Path(source).parent == tmp_path
        calls.append("replace")
        real_replace(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    write_atomic(tmp_path / "file", lambda file: file.write(b"12345"))
    assert calls == ["file of 5", "replace", "folder"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def fail(file: object) -> None:
        file.write(b"new")  # type: ignore[attr-defined]
        raise error

    with pytest.raises(error):
        write_atomic(path, fail)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_a_failed_write_names_the_file(tmp_path: Path) -> None:
    def fill_the_disk(file: BinaryIO) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=r"No space left on device: '.*name\.npy'") as caught:
        write_atomic(tmp_path / "name.npy", fill_the_disk)
    assert caught.value.errno == errno.ENOSPC


def test_a_lock_that_cannot_be_written_names_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill_the_disk(self: Path, *args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", fill_the_disk)
    with pytest.raises(OSError, match=rf"No space left on device: '.*{LOCK_NAME}'"), folder_lock(tmp_path):
        pytest.fail("it was entered")
    assert os.listdir(tmp_path) == []


def test_full_disk_is_found_out_before_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int, offset: int, size: int) -> None:
        assert size == 3
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomic(tmp_path / "file", lambda file: pytest.fail("written"), size=3)
    assert os.listdir(tmp_path) == []


def test_writers_of_one_process_do_not_share_a_temporary_file(tmp_path: Path) -> None:
    """As processes in containers with a common folder, which may have one number, do not."""
    contents = [bytes([i]) * 10 for i in range(2)]

    def write(content: bytes, inner: bytes | None) -> None:
        def both(file: BinaryIO) -> None:
            file.write(content)
            if inner is not None:
                write(inner, None)

        write_atomic(tmp_path / "file", both)

    write(contents[0], contents[1])
    assert (tmp_path / "file").read_bytes() == contents[0]
    assert os.listdir(tmp_path) == ["file"]


def test_remove_temporaries_spares_other_files(tmp_path: Path) -> None:
    for name in (f".file.{'0a' * 8}.tmp", "file", "notes.tmp", ".draft.tmp", ".lock"):
        (tmp_path / name).touch()
    remove_temporaries(tmp_path)
    assert sorted(os.listdir(tmp_path)) == [".draft.tmp", ".lock", "file", "notes.tmp"]


def test_file_hash_is_sha256(tmp_path: Path) -> None:
    (tmp_path / "abc").write_bytes(b"abc")  # the example of FIPS 180-2
    assert file_hash(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_second_writer_is_refused_with_pid_and_host_until_the_first_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD_LOCK, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "held\n"
            with pytest.raises(FolderLockedError) as caught, folder_lock(tmp_path):
                pass
            assert f"process {holder.pid} on host {socket.gethostname()}" in str(caught.value)
            assert str(tmp_path) in str(caught.value)
        finally:
            holder.send_signal(signal.SIGKILL)
    assert os.listdir(tmp_path) == [LOCK_NAME]
    with folder_lock(tmp_path):
        assert (tmp_path / LOCK_NAME).read_text() == f"process {os.getpid()} on host {socket.gethostname()}"
    assert os.listdir(tmp_path) == []


def test_lock_is_not_taken_twice_in_a_process_and_is_freed_by_an_error(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="inner"), folder_lock(tmp_path):
        with pytest.raises(FolderLockedError), folder_lock(tmp_path):
            pass
        assert (tmp_path / LOCK_NAME).exists()
        raise RuntimeError("inner")
    with folder_lock(tmp_path):
        pass


def test_lock_on_a_file_that_its_holder_has_just_removed_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    real_flock, removed = fcntl.flock, []

    def flock(descriptor: int, operation: int) -> None:
        if not removed:
            removed.append((tmp_path / LOCK_NAME).unlink())
        real_flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    with folder_lock(tmp_path), pytest.raises(FolderLockedError), folder_lock(tmp_path):
        pass


def test_a_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to("target")
    (tmp_path / "dangling").symlink_to("made")
    for name in ("link", "dangling"):
        write_atomic(tmp_path / name, lambda file: file.write(b"new"))
        assert (tmp_path / name).is_symlink() and (tmp_path / name).read_text() == "new"
    assert (tmp_path / "target").read_text() == (tmp_path / "made").read_text() == "new"


def test_a_link_to_itself_stays(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("other")
    (tmp_path / "other").symlink_to("link")
    with pytest.raises(OSError, match="Too many levels") as caught:
        write_atomic(tmp_path / "link", lambda file: file.write(b"new"))
    assert caught.value.errno == errno.ELOOP and (tmp_path / "link").is_symlink() and (tmp_path / "other").is_symlink()


def test_errors_name_the_file_and_no_temporary_one(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    for path in (tmp_path / "absent" / "new", tmp_path / "file" / "new"):
        with pytest.raises((FileNotFoundError, NotADirectoryError)) as caught:
            write_atomic(path, lambda file: file.write(b"new"))
        assert caught.value.filename == str(path)


def test_what_is_found_is_what_glob_finds_and_sorted(tmp_path: Path) -> None:
    for name in ("b/args.yml", "a/args.yml", "a/c/args.yml", "a/c/other", ".d/args.yml", "args.yml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "a" / "back").symlink_to(tmp_path)
    for pattern in ("*/args.yml", "**/args.yml", "args.yml", "*.yml", "a/*/other", "**/c", "absent/*"):
        assert find(tmp_path, pattern) == sorted(tmp_path.glob(pattern)), pattern
    assert find(tmp_path / "absent", "*") == find(tmp_path / "args.yml", "*") == []


def test_a_folder_that_may_not_be_read_is_not_taken_for_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``Path.glob`` leaves it out; to root everything is allowed, so that the system's answer is made."""
    (tmp_path / "a").mkdir()
    real = os.scandir

    def scandir(path: Path) -> object:
        if Path(path).name == "a":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    for pattern in ("*/args.yml", "**/args.yml"):
        with pytest.raises(PermissionError):
            find(tmp_path, pattern)


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/null")):
        with pytest.raises(ValueError, match="is no file that could be replaced"):
            write_atomic(path, lambda file: file.write(b"new"))
    assert Path("/dev/null").is_char_device()
