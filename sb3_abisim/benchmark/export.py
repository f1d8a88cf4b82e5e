"""Copy of a benchmark that is small enough to commit: what the report reads, and how each job was made.

Models, datasets, encoders and monitor files are left out, and so are the names of the folders that they were in. Of the
training episodes the curve is kept.
"""

import io
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.benchmark.jobs.job import read_manifest
from sb3_abisim.common.arrays import read_npz
from sb3_abisim.common.files import find, write_atomic
from sb3_abisim.common.hashes import HASHES_NAME, write_hashes
from sb3_abisim.zoo.run_files import TRAINING_CURVE, NoEpisodesError, hash_run
from sb3_abisim.zoo.runs import INDEX_NAME, Run, find_runs

TEXTS = ("args.yml", "config.yml", "command.txt", "method.json")
EVALUATIONS = ("evaluations.npz", "final_evaluations.npz")
# How JSON and YAML write a letter that is not ASCII.
_ESCAPED = r"\\(?:x[0-9A-Fa-f]{2}|u[0-9A-Fa-f]{4}|U[0-9A-Fa-f]{8})"
# An absolute path up to its last part: not within a word, a relative path or a URL.
_ABSOLUTE = re.compile(rf"(?<![\w.~/-])/(?:(?:[^\s/'\",:=\\]|{_ESCAPED})++/)*(?=[\w.]|{_ESCAPED})")


def export(folder: str | Path, output: str | Path) -> Path:
    """Copy what a report on the runs of a folder needs; it gives the same tables from the copy.

    :param folder: a benchmark's folder, or a zoo's log folder
    :param output: a new folder
    :return: ``output``
    :raises ValueError: if there are no runs, one cannot be read, or ``output`` is there
    """
    folder, output = Path(folder), Path(output)
    if output.exists() or output.is_symlink():
        raise ValueError(f"{output} is there; remove it, or name another folder")
    runs = find_runs(folder)
    # Under another name until it is whole.
    part = output.with_name(f".{output.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        for run in runs:
            _copy_run(run, folder, part / run.folder.relative_to(folder))
            hash_run(part / run.folder.relative_to(folder))
        _copy_manifests(runs, folder, part)
        index = json.loads((folder / INDEX_NAME).read_bytes()) if (folder / INDEX_NAME).is_file() else dict[str, Any]()
        index["runs"] = [{"folder": run.folder.relative_to(folder).as_posix(), "label": run.label} for run in runs]
        _write(part / INDEX_NAME, without_folders(json.dumps(index, indent=1, ensure_ascii=False), folder))
        hash_index(part)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    part.rename(output)
    return output


def hash_index(root: Path) -> None:
    """Write the hashes of ``benchmark.json`` and of the manifests of its jobs; those of runs are in their folders.

    :param root: of an export
    """
    manifests = [path.relative_to(root).as_posix() for path in find(root / "jobs", "*.json")]
    write_hashes(root, [INDEX_NAME, *manifests])


def add_hashes(folder: str | Path) -> int:
    """Give results from before hashes theirs; what has some is verified and stays as it is.

    :param folder: an export, a benchmark's folder whose jobs have ended, or a zoo's log folder
    :return: number of folders that have got some
    :raises ValueError: if one is damaged
    """
    root, added = Path(folder), 0
    for run in find_runs(root):
        if not (run.folder / HASHES_NAME).is_file():
            hash_run(run.folder)
            added += 1
    if (root / INDEX_NAME).is_file() and not (root / HASHES_NAME).is_file():
        hash_index(root)
        added += 1
    return added


def without_folders(text: str, root: Path) -> str:
    """A text with no absolute path in it: those below ``root`` become relative, of all others the last part stays.

    :param text: of a settings file or a command
    :param root: the benchmark's folder
    """
    text = text.replace(f"{root.resolve()}/", "")
    # The zoo writes commands without quotes, so that nothing says where a path with a space in it begins and ends.
    for folder in map(str, (Path.cwd(), Path.home())):
        text = text.replace(folder, re.sub(r"\s", "_", folder))
    return _ABSOLUTE.sub("", text)


def _copy_run(run: Run, root: Path, target: Path) -> None:
    for name in TEXTS:
        source = run.folder / run.env_name / name
        if source.is_file():
            _write(target / run.env_name / name, without_folders(source.read_text(encoding="utf-8"), root))
    for name in EVALUATIONS:
        if (run.folder / name).is_file():
            _write_arrays(target / name, read_npz(run.folder / name))
    if not (find(run.folder, "*.monitor.csv") or (run.folder / TRAINING_CURVE).is_file()):
        return
    try:
        curve = run.training()
    except NoEpisodesError:
        return
    # Shapes as in evaluations.npz, with one episode at each point.
    columns = {"results": curve.returns} | ({} if curve.successes is None else {"successes": curve.successes})
    _write_arrays(
        target / TRAINING_CURVE, {"timesteps": curve.steps} | {key: value[:, None] for key, value in columns.items()}
    )


def _copy_manifests(runs: list[Run], root: Path, target: Path) -> None:
    """How the runs, and what they rest on, were made: by which command, with which versions, on what, for how long."""
    manifests: dict[str, dict[str, Any]] = {}
    for path in find(root / "jobs", "*.json"):
        manifests[path.stem] = read_manifest(path)
    outputs = {run.folder.relative_to(root).as_posix() for run in runs}
    names = [name for name, manifest in manifests.items() if manifest["output"] in outputs]
    for name in names:  # grows while it is walked
        names += [source for source in manifests[name]["inputs"] if source in manifests and source not in names]
    for name in names:
        # The name of a machine says nothing elsewhere.
        kept = {key: value for key, value in manifests[name].items() if key != "host"}
        _write(target / "jobs" / f"{name}.json", without_folders(json.dumps(kept, indent=1, ensure_ascii=False), root))


def _write_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_atomic(path, lambda file: file.write(buffer.getvalue()))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, lambda file: file.write(text.encode()))
