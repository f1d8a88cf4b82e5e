"""Kills at random moments, and disks that are full: the next call must end as if nothing had happened."""

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.reliability.children import command, kill_at, orphans, run
from benchmarks.reliability.inputs import (
    ALGO,
    ENV_ID,
    collect_words,
    content,
    copy_of,
    pretrain_words,
    run_folder,
    train_words,
)

# Of the runs' files, what holds times or commands.
_TIMED = ("command.txt", "args.yml", "report.json")


@dataclass(frozen=True)
class Job:
    """A command that is disturbed.

    :param name: in the table
    :param needs: what it finds in its folder, below the folder of inputs
    :param words: of the command
    :param output: what it makes, below its folder
    :param n_kills: how often it is killed
    :param n_full: how often its disk is full
    :param leave_out: beginnings of the names of files that differ between two runs
    :param twice: whether an output of before is there, which must stay or be replaced as a whole
    """

    name: str
    needs: tuple[str, ...]
    words: Sequence[str]
    output: str
    n_kills: int
    n_full: int
    leave_out: tuple[str, ...] = ()
    twice: bool = False


def jobs(scale: float, inputs: Path) -> list[Job]:
    """All of them.

    :param scale: of how often each is disturbed
    :param inputs: of :func:`~benchmarks.reliability.inputs.make_all`
    """

    def n(times: int) -> int:
        return int(scale * times) or min(times, 1)

    place = run_folder(Path("."))
    one = ["benchmark", "-o", "out", "--env", ENV_ID, "--methods", "vanilla", "--seeds", "0", "-n", "60",
           "--algo", ALGO, "--eval-freq", "60", "--eval-episodes", "1", "--n-eval-envs", "1", "--final-episodes", "1",
           "--jobs", "1", "--device", "cpu", "--no-report",
           "--params", "buffer_size:100", "learning_starts:20"]  # fmt: skip
    untimed = (*_TIMED, "0.monitor", "1.monitor", "hashes", f"{ENV_ID}.zip", "best_model.zip")
    report = ["benchmark", "report", "bench", "-o", "out"]
    evaluate = ["benchmark", "evaluate", str(place), "--episodes", "2"]
    merge = ["merge", "--algo", ALGO, str(place / f"{ENV_ID}.zip"), "-o", "out.zip"]
    record = ["record", str(place), "-o", "out.gif", "--episodes", "1"]
    return [
        Job("collect", (), collect_words("out"), "out", n(100), n(40)),
        Job("pretrain", ("data",), pretrain_words("data", "out/e.safetensors"), "out", n(60), n(40),
            ("progress.csv", "e.json")),
        Job("benchmark", (), one, "out/runs", n(12), 0, untimed),
        Job("benchmark report", ("bench",), report, "out", n(20), n(20), ("report.html", "index.html"), True),
        Job("benchmark export", ("bench",), ["benchmark", "export", "bench", "-o", "out"], "out", n(40), n(30)),
        Job("benchmark evaluate", ("bench",), evaluate, str(place), n(20), n(20), (), True),
        Job("merge", ("bench",), merge, "out.zip", n(30), n(30), (), True),
        Job("record", ("bench",), record, "out.gif", 0, n(20), (), True),
        Job("train", (), train_words("vanilla", "out"), "out", 0, n(30)),
    ]  # fmt: skip


def _prepare(job: Job, inputs: Path, folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in job.needs:
        copy_of(inputs / name, folder / name)
    return folder


def _content(job: Job, folder: Path) -> Any:
    path = folder / job.output
    if path.is_file():
        from sb3_abisim.common.files import file_hash

        return _of_zip(path) if path.suffix == ".zip" else file_hash(path)
    return content(path, job.leave_out) if path.is_dir() else None


def _of_zip(path: Path) -> Any:
    """Without the times that it holds."""
    import zipfile

    try:
        with zipfile.ZipFile(path) as archive:
            return sorted((each.filename, each.CRC) for each in archive.infolist() if each.filename != "data")
    except (zipfile.BadZipFile, OSError) as error:
        return f"damaged: {error}"


def count(job: Job, inputs: Path, work: Path, seed: int) -> dict[str, Any]:
    """Disturb a command often.

    :param job: which
    :param inputs: of :func:`~benchmarks.reliability.inputs.make_all`
    :param work: a new folder
    :param seed: of the moments, and of the sizes of files
    :return: ``kills``, ``full``, how many of each hit, what was lost, orphans, tracebacks, with examples
    """
    draw = random.Random(f"{seed} {job.name}")
    reference = _prepare(job, inputs, work / "reference")
    begin = time.monotonic()
    _must(run(command(*job.words), reference))
    seconds = time.monotonic() - begin
    expected = _content(job, reference)
    made = reference / job.output
    largest = max((p.stat().st_size for p in [made, *made.rglob("*")] if p.is_file()), default=1)
    row: dict[str, Any] = {"kills": 0, "full": 0, "lost": 0, "orphans": 0, "bare": 0, "examples": []}
    checked: Callable[..., None] = lambda *args: _check(row, job, expected, *args)  # noqa: E731
    for turn in range(job.n_kills):
        folder = _folder(job, inputs, work / f"kill-{turn}", reference)
        moment = draw.uniform(0, seconds)
        was_killed = kill_at(command(*job.words), folder, moment)
        row["kills"] += was_killed
        if job.name == "benchmark":
            found = orphans(folder)
            row["orphans"] += len(found)
        checked(folder, f"kill {turn} after {moment:.2f} s", was_killed)
    for turn in range(job.n_full):
        folder = _folder(job, inputs, work / f"full-{turn}", reference)
        limit = int(2 ** draw.uniform(3, max(4.0, largest.bit_length() + 0.5)))
        outcome = run(command(*job.words), folder, max_file_bytes=limit)
        row["full"] += outcome.kind == "refused"
        if outcome.kind in ("bare", "killed"):
            row["bare"] += 1
            row["examples"].append(f"{job.name}, files of {limit} bytes: {outcome.kind}, {outcome.text[:200]}")
        checked(folder, f"files of {limit} bytes", outcome.kind != "done")
    return row


def _folder(job: Job, inputs: Path, folder: Path, reference: Path) -> Path:
    _prepare(job, inputs, folder)
    if job.twice and (reference / job.output).exists():
        copy_of(reference / job.output, folder / job.output)
    return folder


def _check(row: dict[str, Any], job: Job, expected: Any, folder: Path, what: str, was_disturbed: bool) -> None:
    """The old output is whole, and the same command gives what it always does."""
    if not was_disturbed:
        if _content(job, folder) != expected and job.name != "train":
            row["lost"] += 1
            row["examples"].append(f"{job.name}, {what}: it ended, with another output")
        _remove(folder)
        return
    if job.twice and Path(job.output).suffix and _content(job, folder) != expected:
        row["lost"] += 1
        row["examples"].append(f"{job.name}, {what}: the old {job.output} is no more")
    if job.name == "train":
        # The next run gets a folder of its own.
        _remove(folder / "out")
    outcome = run(command(*job.words), folder)
    found = _content(job, folder)
    if outcome.kind != "done" or (job.name != "train" and found != expected):
        row["lost"] += 1
        differ = ""
        if isinstance(found, dict) and isinstance(expected, dict):
            differ = ", ".join(n for n in sorted({*found, *expected}) if found.get(n) != expected.get(n))[:200]
        row["examples"].append(f"{job.name}, {what}: then {outcome.kind}, {outcome.text[:200]}; {differ}")
    _remove(folder)


def _must(outcome: Any) -> None:
    if outcome.kind != "done":
        raise RuntimeError(outcome.text)


def _remove(folder: Path) -> None:
    import shutil

    shutil.rmtree(folder, ignore_errors=True)
