"""Places that may not be read or written, links, and full disks: one sentence of every command, and nothing is lost."""

import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from permission_inputs import permission_bits_hold
from zoo_inputs import SMALL, run, write_encoder

from sb3_abisim.__main__ import COMMANDS
from sb3_abisim.data.collect import collect

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="of Linux' capabilities, and limits on files")
RUN = "logs/dqn/Nav2D-v0_1"
YAML, ZIP = f"{RUN}/Nav2D-v0/config.yml", f"{RUN}/Nav2D-v0.zip"
ZOO = ("--algo", "dqn", "--env", "Nav2D-v0")
TRAIN = (*ZOO, "-n", "40", "--eval-freq", "20", "--eval-episodes", "1", "--num-threads", "1", "--verbose", "0",
         "--device", "cpu")  # fmt: skip
BENCHMARK = ("-o", "out", "--env", "Nav2D-v0", "--seeds", "0", "-n", "60", "--algo", "dqn")


@dataclass(frozen=True)
class Job:
    """``file`` or ``folder`` is what the command writes; ``reads`` are files and folders that it cannot do without."""

    words: tuple[str, ...]
    reads: tuple[str, ...] = ()
    file: str | None = None
    folder: str | None = None
    # Whether it writes within a second or two, and in this process.
    is_quick: bool = True


def _collect(*words: str) -> tuple[str, ...]:
    return ("collect", "-n", "40", "--n-envs", "2", "-o", "out", *words)


JOBS = {
    "collect": Job(_collect("--env", "Nav2D-v0"), folder="out"),
    "collect scans": Job(
        _collect("--env", "ScanNav-v0", "--env-kwargs", "scenes:scans/map.npz"), ("scans", "scans/map.npz")
    ),
    "collect clips": Job(
        _collect("--env", "DistractorPointMaze-v0", "--env-kwargs", "videos:clips"),
        ("clips", "clips/b", "clips/b/1.gif"),
    ),
    "collect policy": Job(_collect("--env", "Nav2D-v0", "--policy", RUN), (RUN, YAML, ZIP)),
    "data import": Job(
        ("data", "import", "arrays", "arrays", "--env", "Nav2D-v0", "-o", "out"), ("arrays", "arrays/1.npz"),
        folder="out",
    ),
    "data export": Job(("data", "export", "data", "nav2d/random-v0"), ("data/meta.json",), folder="minari"),
    "data show": Job(("data", "show", "data", "-o", "out.html"), ("data", "data/meta.json"), file="out.html"),
    "pretrain": Job(
        ("pretrain", "--objective", "ssi", "--data", "data", "-o", "out.safetensors", "--device", "cpu", "-params",
         "n_updates:2", "batch_size:8"), ("data", "data/frames-00000.npy"), file="out.safetensors",
    ),
    "train": Job(
        ("train", *TRAIN, "-f", "out", "--conf-file", "ssi=e.safetensors,frozen", "-params", *SMALL["dqn"]),
        # zoo/test_whole_files.py fills its disk.
        ("e.safetensors",), folder="out", is_quick=False,
    ),
    "enjoy": Job(("enjoy", *ZOO, "-f", "logs", "--no-render", "-n", "5", "--num-threads", "1"), (YAML, ZIP)),
    "record": Job(("record", RUN, "-o", "out.gif", "--episodes", "1"), (RUN, YAML, ZIP), file="out.gif"),
    "merge": Job(("merge", "--algo", "dqn", ZIP, "-o", "out.zip"), (RUN, YAML, ZIP), file="out.zip"),
    "export": Job(("export", "e.safetensors", "-o", "out.pt2"), ("e.safetensors",), file="out.pt2", is_quick=False),
    "push": Job(
        ("push", "e.safetensors", "me/x", "--no-evidence", "-o", "out"), ("e.safetensors",), folder="out"
    ),
    "analyze": Job(
        ("analyze", "exact", "e.safetensors", "--base", "e.safetensors", "-o", "out.json"), ("e.safetensors",),
        file="out.json", is_quick=False,
    ),
    "analyze perturbation": Job(
        ("analyze", "perturbation", "e.safetensors", "-n", "1", "--images", "out"), ("e.safetensors",), folder="out"
    ),
    "benchmark": Job(("benchmark", *BENCHMARK, "--methods", "vanilla", "--no-report"), folder="out", is_quick=False),
    "benchmark sweep": Job(
        ("benchmark", "sweep", *BENCHMARK, "--method", "ssi", "--space", "batch_size=8..16"), folder="out",
        is_quick=False,
    ),
    "benchmark report": Job(
        ("benchmark", "report", "logs", "-o", "out"), (RUN, f"{RUN}/Nav2D-v0", YAML, f"{RUN}/evaluations.npz"),
        folder="out",
    ),
    "benchmark export": Job(
        ("benchmark", "export", "logs", "-o", "out"), (RUN, YAML, f"{RUN}/hashes.json"), folder="out"
    ),
    "benchmark evaluate": Job(
        ("benchmark", "evaluate", RUN, "--episodes", "1"), (RUN, YAML, ZIP), file=f"{RUN}/final_evaluations.npz"
    ),
    "benchmark hash": Job(("benchmark", "hash", "logs"), (RUN, f"{RUN}/hashes.json", f"{RUN}/evaluations.npz")),
    "zoo record_video": Job(
        ("zoo", "record_video", *ZOO, "-f", "logs", "-o", "out", "-n", "5"), (YAML, ZIP), folder="out"
    ),
    "doctor": Job(("doctor", RUN), (RUN, YAML)),
    "doctor of data": Job(("doctor", "data"), ("data", "data/meta.json", "data/frames-00000.npy")),
    "doctor of runs": Job(("doctor", "logs"), ("logs", RUN, f"{RUN}/evaluations.npz")),
    "doctor of a model": Job(("doctor", ZIP), (ZIP,)),
    # Its commands are processes of their own.
    "demo": Job(("demo", "-o", "out"), folder="out", is_quick=False),
}  # fmt: skip


def tree(folder: Path) -> dict[str, bytes | str]:
    """Every file of a folder with its content, and where links lead."""
    paths = [Path(top) / name for top, folders, names in os.walk(folder) for name in [*folders, *names]]
    return {str(path): os.readlink(path) if path.is_symlink() else path.read_bytes() for path in paths
            if path.is_symlink() or path.is_file()}  # fmt: skip


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from PIL import Image

    from sb3_abisim.envs.scan_nav.map import ScanMap

    folder = tmp_path_factory.mktemp("inputs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        collect("Nav2D-v0", 100, "data", n_envs=2)
        write_encoder(folder / "e.safetensors", "Nav2D-v0", "ssi")
        run(patch, "train", *TRAIN, "-f", "logs", "--conf-file", "ssi=e.safetensors,frozen", "-params", *SMALL["dqn"])
    for name in ("scans", "arrays", "clips/a", "clips/b", "clips/c"):
        (folder / name).mkdir(parents=True)
    shape, draw = (60, 80), np.random.default_rng(0)
    colors = draw.integers(0, 255, (*shape, 3)).astype(np.uint8)
    scan = ScanMap(colors, np.zeros(shape, np.float32), np.ones(shape, bool), 0.05, (0.0, 3.0), "room")
    scan.save(folder / "scans" / "map.npz")
    frames = draw.integers(0, 2, (9, 3, 15, 15)).astype(np.uint8) * 255
    np.savez(folder / "arrays" / "1.npz", observations=frames, actions=draw.integers(0, 4, 8))
    for number, name in enumerate("abc"):
        images = [Image.new("RGB", (64, 64), (10 * k, 60 * number, 7)) for k in range(16)]
        images[0].save(folder / "clips" / name / "1.gif", save_all=True, append_images=images[1:], duration=40)
    return folder


@pytest.fixture
def place(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the inputs, in which the command is called."""
    folder = tmp_path / "place"
    shutil.copytree(inputs, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("SB3_ABISIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    yield folder
    for top, _, _ in os.walk(folder, onerror=lambda error: os.chmod(error.filename, 0o700)):
        os.chmod(top, 0o700)


def sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], job: Job, codes: tuple[int, ...] = (1, 2)
) -> str:
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, *job.words)
    said = capsys.readouterr().err
    assert "Traceback" not in said, said
    last = said.strip().splitlines()[-1]
    assert stopped.value.code in codes and re.match(rf"sb3-abisim {job.words[0]}[\w ]*: (error: )?\S", last), said
    return last


def test_every_command_is_tried() -> None:
    assert {job.words[0] for job in JOBS.values()} == set(COMMANDS)


@pytest.mark.parametrize(
    ("name", "read"), [pytest.param(n, r, id=f"{n}: {Path(r).name}") for n, job in JOBS.items() for r in job.reads]
)
def test_what_may_not_be_read(
    name: str, read: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = tree(place)
    (place / read).chmod(0)
    with permission_bits_hold():
        said = sentence(monkeypatch, capsys, JOBS[name], (1,))
    (place / read).chmod(0o700)
    assert "Permission denied" in said and Path(read).name in said
    assert said.endswith("; allow it, or name another place") and "damaged" not in said
    assert tree(place) == before


def _folder(path: Path) -> None:
    path.mkdir()
    (path / "kept").write_text("kept")


FILE_FAULTS: dict[str, Callable[[Path], object]] = {
    "a folder": _folder,
    "a link to a folder": lambda path: (_folder(path.with_name("else")), path.symlink_to("else")),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "not to be written": lambda path: (path.write_bytes(b"kept"), path.chmod(0o444)),
    "in a folder not to be written": lambda path: path.parent.chmod(0o555),
}
FOLDER_FAULTS: dict[str, Callable[[Path], object]] = {
    "a file": lambda path: path.write_text("kept"),
    "a link to a file": lambda path: (path.with_name("else").write_text("kept"), path.symlink_to("else")),
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "not to be written": lambda path: (_folder(path), path.chmod(0o555)),
    "in a folder not to be written": lambda path: path.parent.chmod(0o555),
}


def faults() -> Iterator[tuple[str, str]]:
    for name, job in JOBS.items():
        for fault in (FILE_FAULTS if job.file else FOLDER_FAULTS) if job.file or job.folder else ():
            # A process of root's is root again.
            if not (name == "demo" and fault == "not to be written"):
                yield name, fault


@pytest.mark.parametrize(("name", "fault"), list(faults()))
def test_an_output_that_cannot_be(
    name: str, fault: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    job = JOBS[name]
    output = place / (job.file or job.folder or "")
    (FILE_FAULTS if job.file else FOLDER_FAULTS)[fault](output)
    before = tree(place)
    with permission_bits_hold():
        said = sentence(monkeypatch, capsys, job)
    assert "; " in said, "a remedy"
    assert ("else" if fault == "a link to a folder" else output.stem) in said and ".tmp" not in said
    place.chmod(0o700)
    assert tree(place) == before


@pytest.mark.parametrize("name", [name for name, job in JOBS.items() if job.is_quick and (job.file or job.folder)])
def test_a_full_disk(
    name: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A limit on the size of files stands for it."""
    import resource

    job, limits = JOBS[name], resource.getrlimit(resource.RLIMIT_FSIZE)
    if job.file:
        (place / job.file).write_bytes(b"kept")
    if name == "pretrain":
        (place / "out.safetensors").unlink()
    before = tree(place)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, limits[1]))
    try:
        said = sentence(monkeypatch, capsys, job, (1,))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "; " in said and not list(place.rglob("*.tmp"))
    after = tree(place)
    assert {path: after[path] for path in before} == before
