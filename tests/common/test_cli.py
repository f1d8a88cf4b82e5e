"""The grammar and the manners that all commands share."""

import argparse
import errno
import threading

import pytest

from sb3_abisim.common.cli import import_packages, make_parser, parse_pairs, parse_value, run


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("1e-4", 1e-4),
        ("-2.5", -2.5),
        ("true", True),
        ("True", True),
        ("null", None),
        ("None", None),
        ("'3'", "3"),
        ("house.glb", "house.glb"),
        ("lin_0.001", "lin_0.001"),
        ("[1, 5]", [1, 5]),
        ("[1e-4, one]", [1e-4, "one"]),
        ("(1, 2)", (1, 2)),
        ("{c: 0.9, pairs: nearest, rate: 1e-3}", {"c": 0.9, "pairs": "nearest", "rate": 1e-3}),
        ("dict(net_arch=[1])", "dict(net_arch=[1])"),
        ("__import__('os').getcwd()", "__import__('os').getcwd()"),
        ("2020-01-01", "2020-01-01"),
        ("[unclosed", "[unclosed"),
        ("", None),
    ],
)
def test_values(text: str, value: object) -> None:
    parsed = parse_value(text)
    assert parsed == value and type(parsed) is type(value)


def test_pairs_keep_what_follows_the_first_colon() -> None:
    pairs = parse_pairs(["a:1", "objective_kwargs.c:0.9", "path:C:/x", "a:2"], "-params")
    assert pairs == {"a": 2, "objective_kwargs.c": 0.9, "path": "C:/x"}


@pytest.mark.parametrize("word", ["a", "a=1", ":1", "1a:2", "a b:1", "a.:1"])
def test_a_word_that_is_no_pair_is_named(word: str) -> None:
    with pytest.raises(ValueError, match="-params takes NAME:VALUE words such as k:5, got"):
        parse_pairs([word], "-params")


def outcome(function: object, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[object, str]:
    parser = make_parser("some command", "Do something.", "some command -n 3")
    with pytest.raises(SystemExit) as caught:
        run(parser, list(words), function, "stopped; go on")  # type: ignore[arg-type]
    return caught.value.code, capsys.readouterr().err


def raising(error: BaseException) -> object:
    def function(args: argparse.Namespace) -> None:
        raise error

    return function


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ValueError("two\n  lines"), 2),
        (FileNotFoundError("two lines"), 2),
        (ImportError("two lines"), 2),
        (OSError(errno.ENOSPC, "two lines"), 1),
        (FloatingPointError("two lines"), 1),
    ],
)
def test_an_error_is_one_line(error: BaseException, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    got, text = outcome(raising(error), capsys)
    assert got == code
    line = text.strip().splitlines()[-1]
    assert line.startswith("sb3-abisim some command: ") and "two lines" in line
    assert "Traceback" not in text


def test_an_error_of_a_thread_is_one_line_and_a_bug_in_one_is_not(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bugs = []
    monkeypatch.setattr(threading, "excepthook", lambda failed: bugs.append(failed.exc_value))
    before = threading.excepthook

    def function(args: argparse.Namespace) -> None:
        for error in (OSError(errno.ENOSPC, "two\nlines", "events"), RuntimeError("a bug")):
            thread = threading.Thread(target=raising(error), args=(args,))  # type: ignore[arg-type]
            thread.start()
            thread.join()

    run(make_parser("some command", "d", "x"), [], function)
    text = capsys.readouterr().err
    assert text.startswith("sb3-abisim some command: [Errno 28] two lines: 'events'") and text.count("\n") == 1
    assert [str(bug) for bug in bugs] == ["a bug"]
    assert threading.excepthook is before


def test_an_interrupt_says_how_to_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert outcome(raising(KeyboardInterrupt()), capsys) == (130, "sb3-abisim some command: stopped; go on\n")


def test_a_bug_keeps_its_traceback() -> None:
    with pytest.raises(RuntimeError):
        run(make_parser("x", "X.", "x"), [], raising(RuntimeError("a bug")))  # type: ignore[arg-type]


def test_the_example_of_the_help_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    example = "collect --env " + "x" * 120
    with pytest.raises(SystemExit):
        make_parser("collect", "Collect.", example).parse_args(["--help"])
    assert f"example: sb3-abisim {example}" in capsys.readouterr().out.splitlines()


def test_packages_are_imported_first_or_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=r"--packages: cannot import 'no_such_module'.*install it or set PYTHONPATH"):
        import_packages(["no_such_module"])
    got, text = outcome(lambda args: pytest.fail("ran"), capsys, "--packages", "no_such_module")
    assert got == 2 and "no_such_module" in text


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (
            PermissionError(13, "Permission denied", "/data/meta.json"),
            1,
            "denied: '/data/meta.json'; allow it, or name",
        ),
        (
            OSError(28, "No space left on device"),
            1,
            "No space left on device; free some space and run the same command",
        ),
        (FileExistsError(17, "File exists", "/x"), 2, "File exists: '/x'; something else is there; name another place"),
        (NotADirectoryError(20, "Not a directory", "/x/y"), 2, "'/x/y'; a file is where a folder should be"),
        (OSError(28, "full; training has stopped"), 1, "full; training has stopped\n"),
        (MemoryError(), 1, "out of memory; give it smaller inputs"),
        (MemoryError("Unable to allocate 8 TiB"), 1, "out of memory (Unable to allocate 8 TiB); give it"),
        (RecursionError("maximum"), 2, "error: an input is nested too deeply to be read"),
    ],
)
def test_faults_of_the_system_are_one_line(
    capsys: pytest.CaptureFixture[str], error: BaseException, code: int, message: str
) -> None:
    def fail(args: argparse.Namespace) -> None:
        raise error

    with pytest.raises(SystemExit) as stopped:
        run(make_parser("x", "d", "x"), [], fail)
    err = capsys.readouterr().err
    assert stopped.value.code == code and message in err and err.count("\n") == 1
