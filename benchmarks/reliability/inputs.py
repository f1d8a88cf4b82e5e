"""What the cases damage, forge and interrupt: one small thing of each kind that this package writes or reads."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reliability.children import Outcome, command, run

ENV_ID = "Nav2D-v0"
ALGO = "dqn"
N_TRANSITIONS = 300
PRETRAIN = ("n_updates:6", "log_interval:3", "checkpoint_interval:2", "batch_size:32")
RL = ("buffer_size:200", "learning_starts:20")
METHODS = {"ssi": ",frozen", "vanilla": ""}


def collect_words(output: str | Path) -> list[str]:
    """The command that makes the dataset."""
    return ["collect", "--env", ENV_ID, "-n", str(N_TRANSITIONS), "--n-envs", "4", "-o", str(output)]


def pretrain_words(data: str | Path, output: str | Path) -> list[str]:
    """The command that makes the encoder."""
    words = ["pretrain", "--objective", "ssi", "--data", str(data), "-o", str(output), "--device", "cpu"]
    return [*words, "--keep-checkpoint", "-params", *PRETRAIN]


def train_words(method: str, logs: str | Path, *more: str) -> list[str]:
    """The command that makes a run."""
    words = ["train", "--algo", ALGO, "--env", ENV_ID, "-f", str(logs), "--conf-file", method, "-n", "120"]
    return [*words, "--eval-freq", "60", "--eval-episodes", "1", "--device", "cpu", "--num-threads", "1", *more,
            "-params", *RL]  # fmt: skip


def make_all(folder: Path) -> Path:
    """Everything, with relative paths in it where a command writes down its own.

    :param folder: a new one
    """
    folder.mkdir(parents=True)
    _must(run(command(*collect_words("data")), folder))
    _must(run(command(*pretrain_words("data", "encoder.safetensors")), folder))
    bench = folder / "bench"
    entries = []
    for number, (method, how) in enumerate(METHODS.items()):
        word = f"{method}={folder / 'encoder.safetensors'}{how}" if how else method
        _must(run(command(*train_words(word, bench / "runs" / method)), folder))
        place = f"runs/{method}/{ALGO}/{ENV_ID}_1"
        _must(run(command("benchmark", "evaluate", bench / place, "--episodes", "2"), folder))
        entries.append({"folder": place, "label": method})
        manifest = {"name": f"run-{number}", "output": place, "inputs": [], "seconds": 1.0}
        (bench / "jobs").mkdir(exist_ok=True)
        (bench / "jobs" / f"run-{number}.json").write_text(json.dumps(manifest))
    (bench / "benchmark.json").write_text(json.dumps({"plan": {}, "runs": entries}))
    _must(run(command("benchmark", "hash", bench), folder))
    _must(run(command("benchmark", "export", bench, "-o", folder / "export"), folder))
    write_clips(folder / "clips")
    write_room(folder / "room.ply")
    _must(run(lambda: _write_map(folder / "map.npz"), folder))
    return folder


def _must(outcome: Outcome) -> None:
    if outcome.kind != "done":
        raise RuntimeError(f"an input could not be made: {outcome.text}")


def run_folder(folder: Path, method: str = "ssi") -> Path:
    """Of a run.

    :param folder: of :func:`make_all`
    :param method: of the run
    """
    return folder / "bench" / "runs" / method / ALGO / f"{ENV_ID}_1"


def copy_of(source: Path, target: Path) -> Path:
    """A copy of a file or a folder, in place of what is there."""
    if target.is_dir():
        shutil.rmtree(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copyfile(source, target)
    return target


def write_clips(folder: Path) -> None:
    """Two GIFs of 16 frames, one on each side of the split."""
    from PIL import Image

    for number, side in enumerate(("train", "eval")):
        (folder / side).mkdir(parents=True)
        frames = [Image.new("RGB", (64, 64), (10 * k, 80 * number, 7)) for k in range(16)]
        frames[0].save(folder / side / "clip.gif", save_all=True, append_images=frames[1:], duration=40)


def write_room(path: Path, header: str = "", size: tuple[float, float] = (4, 3)) -> None:
    """A scan: floor and ceiling, and the walls, as text.

    :param path: a .ply file
    :param header: lines in place of the one that counts the vertices
    :param size: of the floor, in meters
    """
    plan = (0, 0), (size[0], 0), size, (0, size[1])
    corners = [(x, y, z) for z in (0.0, 2.5) for x, y in plan]
    faces = [(0, 1, 2, 3), (7, 6, 5, 4)] + [(i, i + 4, (i + 1) % 4 + 4, (i + 1) % 4) for i in range(4)]
    lines = ["ply", "format ascii 1.0", header or f"element vertex {len(corners)}"]
    lines += [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {name}" for name in ("red", "green", "blue")
    ]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [f"{x} {y} {z} {30 * i} 90 120" for i, (x, y, z) in enumerate(corners)]
    lines += [f"4 {a} {b} {c} {d}" for a, b, c, d in faces]
    path.write_text("\n".join(lines) + "\n")


def _write_map(path: Path) -> None:
    from sb3_abisim.envs.scan_nav.map import ScanMap

    draw = np.random.default_rng(0)
    shape = 60, 80
    colors, walkable = draw.integers(0, 255, (*shape, 3)).astype(np.uint8), np.ones(shape, bool)
    ScanMap(colors, np.zeros(shape, np.float32), walkable, 0.05, (0.0, 3.0), "room").save(path)


def content(folder: Path, leave_out: tuple[str, ...] = ()) -> dict[str, str]:
    """The hash of every file below a folder, hidden ones and logs left out.

    :param folder: any
    :param leave_out: beginnings of the names of further files to leave out
    """
    from sb3_abisim.common.files import file_hash

    return {
        path.relative_to(folder).as_posix(): file_hash(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith((".", "events.", *leave_out))
    }


def as_text(value: Any) -> str:
    """Any content as a text that is equal where it is equal: arrays and tensors by their bytes."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        return f"{array.dtype}{array.shape}{array.tobytes().hex()}"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key!r}:{as_text(value[key])}" for key in sorted(value, key=repr)) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(as_text, value)) + "]"
    return os.fspath(value) if isinstance(value, Path) else repr(value)
