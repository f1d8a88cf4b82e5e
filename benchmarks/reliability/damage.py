"""Damaged files: flipped bits, missing ends, exchanged and zeroed blocks, in everything that this package writes."""

import contextlib
import io
import random
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reliability.children import kind_of, run
from benchmarks.reliability.inputs import ENV_ID, as_text, collect_words, content, copy_of, run_folder

DAMAGES = ("flip", "cut", "swap", "zero")


@dataclass(frozen=True)
class Artifact:
    """Something that is damaged and read.

    :param name: in the table
    :param source: below the folder of inputs
    :param patterns: of the files to damage, below it; none where it is a file itself
    :param read: takes its copy, gives all that it holds
    :param n: how often
    :param prepare: makes files to damage beside the copy, once
    """

    name: str
    source: str
    patterns: tuple[str, ...]
    read: Callable[[Path], Any]
    n: int
    prepare: Callable[[Path], Any] | None = None


def damaged(data: bytes, how: str, draw: random.Random) -> bytes:
    """A damaged content.

    :param data: the whole one
    :param how: one of :data:`DAMAGES`
    :param draw: where
    """
    changed = bytearray(data)
    if how == "flip":
        changed[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif how == "cut":
        del changed[draw.randrange(len(data)) :]
    else:
        size = draw.randint(1, max(1, min(512, len(data) // 3)))
        first, second = sorted(draw.randrange(len(data) - size + 1) for _ in range(2))
        if how == "zero" or second < first + size:
            changed[first : first + size] = bytes(size)
        else:
            changed[first : first + size] = data[second : second + size]
            changed[second : second + size] = data[first : first + size]
    return bytes(changed)


def _dataset(path: Path) -> Any:
    from sb3_abisim.data.dataset import TransitionDataset

    dataset = TransitionDataset(path, eval_fraction=0.0)
    return dataset.meta, dataset.frames(np.arange(dataset.n_frames)), dataset.ends, dataset.pairs(1, "train")


def _collect_again(path: Path) -> Any:
    from sb3_abisim.data.collect import collect

    words = collect_words(path)
    collect(ENV_ID, int(words[words.index("-n") + 1]), path, n_envs=4)
    return content(path)


def _encoder(path: Path) -> Any:
    from sb3_abisim.networks.encoder_file import load_encoder

    file = load_encoder(path)
    return file.hash, file.metadata, file.encoder.state_dict()


def _checkpoint(path: Path) -> Any:
    import torch as th

    from sb3_abisim.pretraining.checkpoint import Checkpoints

    module, optimizer = _network()
    place = Checkpoints(path, {"learning_rate": 1e-3, "n_updates": 10})
    n_updates, rows = place.restore(module, optimizer)
    return n_updates, rows, module.state_dict(), optimizer.state_dict(), th.get_rng_state()


def _network() -> Any:
    import torch as th

    th.manual_seed(0)
    module = th.nn.Linear(40, 8)
    optimizer = th.optim.Adam(module.parameters())
    module(th.ones(1, 40)).sum().backward()
    optimizer.step()
    return module, optimizer


def _write_checkpoint(path: Path) -> None:
    from sb3_abisim.pretraining.checkpoint import Checkpoints

    path.mkdir(parents=True)
    module, optimizer = _network()
    Checkpoints(path, {"learning_rate": 1e-3, "n_updates": 10}).save(
        module, optimizer, 4, [{"n_updates": 4, "loss": 1.5}]
    )


def _results(path: Path) -> Any:
    from sb3_abisim.zoo.runs import find_runs, missing_runs

    found = []
    for each in find_runs(path):
        curves = each.evaluations(), each.training()
        found.append([repr(each), *([c.steps, c.returns, c.successes] for c in curves), each.final()])
    return found, missing_runs(path)


def _model(path: Path) -> Any:
    from sb3_abisim.zoo.models import load_model
    from sb3_abisim.zoo.runs import read_run

    model = load_model(path / f"{ENV_ID}.zip", read_run(path))
    return model.get_parameters(), model.num_timesteps, repr(model.observation_space), repr(model.action_space)


def _clips(path: Path) -> Any:
    from sb3_abisim.envs.backgrounds import load, video_cache

    video_cache.load_split.cache_clear()
    with contextlib.redirect_stderr(io.StringIO()):
        clips = load.load_backgrounds(path / "clips", "train", min_frames=8)
        length = clips.lengths[0]
        return clips.frames(np.zeros(length, np.int64), np.arange(length))


def _map(path: Path) -> Any:
    from sb3_abisim.envs.scan_nav.map import ScanMap

    return vars(ScanMap.load(path))


def _scan(path: Path) -> Any:
    from sb3_abisim.envs.scan_nav.map import ScanMap

    with contextlib.redirect_stderr(io.StringIO()):
        return vars(ScanMap.from_mesh(path / "room.ply", up="z"))


def _card(path: Path) -> Any:
    from sb3_abisim.pretraining.card import read_card

    return read_card(path)


RUN_PATTERNS = ("**/config.yml", "**/args.yml", "**/*.monitor.csv", "**/method.json", "**/*.npz", "**/hashes.json")


def artifacts(scale: float) -> list[Artifact]:
    """All of them.

    :param scale: of how often each is damaged
    """

    def n(times: int) -> int:
        return max(len(DAMAGES), int(scale * times))

    return [
        Artifact("dataset: shards", "data", ("*.npy",), _dataset, n(8000)),
        Artifact("dataset: meta.json", "data", ("meta.json",), _dataset, n(8000)),
        Artifact("dataset, collected again", "data", ("*.npy", "*.json"), _collect_again, n(1000)),
        Artifact("encoder file", "encoder.safetensors", (), _encoder, n(8000)),
        Artifact("checkpoint", "", ("*.safetensors",), _checkpoint, n(8000), _write_checkpoint),
        *(
            Artifact(f"run: {pattern.rpartition('/')[2]}", "bench", (pattern,), _results, n(2000))
            for pattern in RUN_PATTERNS
        ),
        Artifact("benchmark.json", "bench", ("benchmark.json",), _results, n(2000)),
        Artifact("export: all files", "export", ("**/*",), _results, n(8000)),
        Artifact("saved model", run_folder(Path()).as_posix(), ("*.zip",), _model, n(2000)),
        Artifact("clip cache", "clips", ("../cache/**/*",), _clips, n(2000)),
        Artifact("scan map", "map.npz", (), _map, n(4000)),
        Artifact("scan cache", "room.ply", ("../cache/**/*.npz",), _scan, n(1000)),
    ]  # fmt: skip


def count(artifact: Artifact, inputs: Path, work: Path, seed: int) -> dict[str, Any]:
    """Damage an artifact often, in a child.

    :param artifact: which
    :param inputs: of :func:`~benchmarks.reliability.inputs.make_all`
    :param work: a new folder
    :param seed: of the damages
    :return: ``n`` and how many of them were refused, equal, silent and bare, with examples of the last two
    """
    work.mkdir(parents=True)
    outcome = run(lambda: _count(artifact, inputs, work, seed), work, seconds=3600)
    if outcome.kind != "done":
        raise RuntimeError(f"{artifact.name}: {outcome.text}")
    found: dict[str, Any] = outcome.value
    return found


def _count(artifact: Artifact, inputs: Path, work: Path, seed: int) -> dict[str, Any]:
    draw = random.Random(f"{seed} {artifact.name}")
    warnings.simplefilter("ignore")
    place = work / "copy"
    if artifact.prepare is not None:
        artifact.prepare(place)
    else:
        # In a folder of its own, so that caches lie beside it.
        source = inputs / artifact.source
        copy_of(source, place / source.name if source.name in ("clips", "room.ply") else place)
    whole = as_text(artifact.read(place))
    files = [place] if place.is_file() else sorted({
        path.resolve() for pattern in artifact.patterns for path in place.glob(pattern)
        if path.is_file() and path.stat().st_size and "/jobs/" not in path.as_posix().replace("copy/jobs", "jobs")
    })  # fmt: skip
    contents = {path: path.read_bytes() for path in files}
    if not files:
        raise RuntimeError(f"{artifact.name}: there is nothing to damage")
    counts: Counter[str] = Counter(n=artifact.n, refused=0, equal=0, silent=0, bare=0)
    examples: list[str] = []
    for turn in range(artifact.n):
        path, how = draw.choice(files), DAMAGES[turn % len(DAMAGES)]
        broken = contents[path]
        while broken == contents[path]:
            # Blocks of zeros are exchanged with each other.
            broken = damaged(contents[path], how, draw)
        path.write_bytes(broken)
        try:
            kind = "equal" if as_text(artifact.read(place)) == whole else "silent"
            text = "other content"
        except BaseException as error:
            kind, text = kind_of(error), f"{type(error).__name__}: {error}"
        counts[kind] += 1
        if kind in ("silent", "bare") and len(examples) < 8:
            examples.append(f"{path.name}, {how}, turn {turn}: {text}"[:300])
        # Others may have been written anew, such as the note of a clip.
        for each, data in contents.items():
            if not each.is_file() or each.read_bytes() != data:
                each.write_bytes(data)
    return {**counts, "examples": examples}
