"""What is installed, or what is inside a file or folder, and whether it loads here: ``sb3-abisim doctor [PATH]``."""

import argparse
import os
import platform
import re
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from sb3_abisim._version import __version__
from sb3_abisim.common.cli import make_parser, one_line, run
from sb3_abisim.common.extras import DISTRIBUTION
from sb3_abisim.common.files import find
from sb3_abisim.common.paths import cache_folder, resource_path
from sb3_abisim.common.text import printable

# Line of the report: what it is about, what was found, and whether that is a fault.
Line = tuple[str, str, bool]
# Of extras that only developers need, nothing is said.
_DEVELOPERS = {"all", "docs", "tests"}


def installation() -> Iterator[Line]:
    """Versions, the extras that are there, and where files are kept."""
    import torch as th

    yield _fact(DISTRIBUTION, f"{__version__} in {Path(__file__).parent}")
    yield _fact("Python", f"{platform.python_version()} on {platform.platform()}")
    devices = [th.cuda.get_device_name(i) for i in range(th.cuda.device_count())]
    yield _fact("devices", f"{os.cpu_count()} processors, {', '.join(devices) or 'no GPU that PyTorch can use'}")
    extras: dict[str, list[Requirement]] = {}
    for requirement in map(Requirement, requires(DISTRIBUTION) or []):
        found = re.search(r"""extra == ['"](\w+)['"]""", str(requirement.marker or ""))
        if found is not None:
            extras.setdefault(found[1], []).append(requirement)
        elif requirement.marker is None or requirement.marker.evaluate():
            fault = _missing(requirement)
            yield requirement.name, fault or version(requirement.name), fault is not None
    for extra in sorted(extras.keys() - _DEVELOPERS):
        missing = [fault for fault in map(_missing, extras[extra]) if fault is not None]
        remedy = f"; run: pip install '{DISTRIBUTION}[{extra}]'"
        yield _fact(f"extra {extra}", f"{', '.join(missing)}{remedy}" if missing else "installed")
    shipped = sorted(resource_path("encoders").glob("*/*.safetensors"))
    yield "shipped encoders", f"{len(shipped)} in {resource_path('encoders')}", not shipped
    cache = cache_folder()
    there = next(folder for folder in (cache, *cache.parents) if folder.exists())
    writable = os.access(there, os.W_OK)
    yield "cache", f"{cache}, {'writable' if writable else 'not writable; set SB3_ABISIM_CACHE'}", not writable


def _missing(requirement: Requirement) -> str | None:
    """What is wrong with an installed package; None for nothing."""
    try:
        found = version(requirement.name)
    except PackageNotFoundError:
        return f"{requirement.name} is not installed"
    if requirement.specifier.contains(found, prereleases=True):
        return None
    return f"{requirement.name} {found} is installed, needed is {requirement.specifier}"


def encoder_lines(name: str) -> Iterator[Line]:
    """An encoder file.

    :param name: as for ``load_encoder``
    """
    from sb3_abisim.common.spaces import space_from_json
    from sb3_abisim.networks.encoder_file import load_encoder

    file = load_encoder(name)
    metadata, spec = file.metadata, file.encoder.spec()
    yield _fact("encoder file", str(file.path))
    yield _fact("hash", file.hash)
    yield _fact("method", f"{metadata['objective']}, {metadata['settings'].get('n_updates', '?')} updates")
    yield _fact("environment", f"{metadata['env_id']} {metadata['env_kwargs'] or ''}")
    yield _fact("observations", f"{metadata['observation_space']['shape']}, uint8, channels first")
    actions = metadata["action_space"]
    yield _fact("actions", "any" if actions is None else str(space_from_json(actions)))
    yield _fact("preprocessing", str(metadata["preprocessing"] or "none"))
    parameters = sum(weights.numel() for weights in file.encoder.parameters())
    yield _fact("network", f"{spec['name']} {spec['kwargs'] or ''}, {parameters} weights")
    yield _fact("features_dim", str(file.encoder.features_dim))
    yield _fact("dataset", metadata["dataset_hash"] or "none")
    yield _fact("made with", ", ".join(f"{name} {text}" for name, text in sorted(metadata["versions"].items())))
    yield _fact("loads here", "yes: its hash is right, and its reference batch gives the same embeddings")


def dataset_lines(folder: Path) -> Iterator[Line]:
    """A dataset, every byte of it verified.

    :param folder: with ``meta.json``
    """
    from sb3_abisim.data.dataset import TransitionDataset

    dataset = TransitionDataset(folder, verify=True)
    yield _fact("dataset", str(folder))
    yield _fact("hash", dataset.hash)
    yield _fact("environment", f"{dataset.env_id} {dataset.env_kwargs or ''}")
    n_shards = len(dataset.meta["shards"])
    yield _fact("transitions", f"{dataset.n_transitions} in {n_shards} shard{'s' * (n_shards != 1)}")
    yield _fact("observations", str(dataset.observation_space))
    yield _fact("actions", str(dataset.action_space))
    yield _fact("preprocessing", str(dataset.preprocessing or "none"))
    yield _fact("factors", ", ".join(dataset.meta.get("factors") or {}) or "none")
    yield _fact("loads here", "yes: every file has the size and the hash that meta.json says")


def run_lines(folder: Path) -> Iterator[Line]:
    """A run of rl-zoo3.

    :param folder: with ``<env id>/args.yml``
    """
    from sb3_abisim.zoo.models import load_model
    from sb3_abisim.zoo.runs import read_run

    found = read_run(folder)
    record = found.record
    yield _fact("run", str(folder))
    yield _fact("algorithm", f"{found.algo}, seed {found.seed}, {found.n_timesteps} steps")
    yield _fact("environment", f"{found.env_id} {found.env_kwargs or ''}")
    yield _fact("method", found.label if record is not None else "none of ours")
    if record is not None and record.encoder is not None:
        yield _fact("encoder", f"{record.encoder}, hash {record.encoder_hash}")
    models = [path for path in (folder / f"{found.env_name}.zip", folder / "best_model.zip") if path.is_file()]
    if not models:
        yield "models", "none: the run has not ended, or saved none", True
    for path in models:
        # A reason not to load is what was asked for.
        fault = _reason(load_model, path, found)
        yield f"{path.name} loads here", fault or "yes: built from config.yml, the weights alone are read", bool(fault)


def model_lines(path: Path) -> Iterator[Line]:
    """A saved model of Stable-Baselines3, of which nothing is unpickled.

    :param path: the zip
    """
    import torch as th

    from sb3_abisim.zoo.models import read_weights

    data, policy = read_weights(path)
    yield _fact("model", f"{path}, {data.get('num_timesteps', '?')} steps")
    yield _fact(
        "policy", f"{len(policy)} tensors, {sum(weights.numel() for weights in policy.values())} numbers in all"
    )
    # Beside a pickle, Stable-Baselines3 keeps what it stands for as texts.
    kwargs = data.get("policy_kwargs")
    extractor = kwargs.get("features_extractor_class") if isinstance(kwargs, dict) else None
    named = re.fullmatch(r"<class '(.*)'>", str(extractor))
    yield _fact("features extractor", named[1] if named else str(extractor or "Stable-Baselines3's default"))
    hashes = {
        bytes(value.tolist()).hex()
        for name, value in policy.items()
        if name.endswith(".encoder_hash") and value.dtype == th.uint8
    }
    yield _fact("encoder", ", ".join(map(_named, sorted(hashes))) or "none of ours in the model")
    if not find(path.parent, "*/args.yml"):
        yield _fact("loads here", "not tried: a zip alone can only be unpickled; give its run folder")
    else:
        yield from run_lines(path.parent)


def _named(hash: str) -> str:
    """A hash, with the shipped encoder that has it."""
    from sb3_abisim.networks.encoder_file import load_encoder

    for path in sorted(resource_path("encoders").glob("*/*.safetensors")):
        if load_encoder(path).hash == hash:
            return f"{path.parent.name}/{path.stem} ({hash})"
    return hash


def benchmark_lines(folder: Path) -> Iterator[Line]:
    """The folder of a benchmark, or any folder of runs.

    :param folder: with ``benchmark.json``, or with runs anywhere below it
    """
    from sb3_abisim.zoo.runs import find_runs, missing_runs

    runs = find_runs(folder)
    yield _fact("runs", f"{len(runs)} below {folder}")
    for label in sorted({found.label for found in runs}):
        seeds = sorted(found.seed for found in runs if found.label == label)
        yield _fact(f"  {label}", f"seeds {', '.join(map(str, seeds))}")
    for missing in missing_runs(folder):
        yield "missing", missing, True


def lines(path: str | None) -> Iterator[Line]:
    """The report.

    :param path: a file, a folder or the name of an encoder; None for the installation
    :raises ValueError: for what cannot be read, with the reason
    """
    if path is None:
        yield from installation()
        return
    place = Path(path)
    if place.is_dir():
        if (place / "meta.json").is_file():
            yield from dataset_lines(place)
        elif find(place, "*/args.yml"):
            yield from run_lines(place)
        else:
            yield from benchmark_lines(place)
    elif place.suffix == ".zip":
        yield from model_lines(place)
    else:
        yield from encoder_lines(path)


def _fact(name: str, text: str) -> Line:
    return name, text.strip(), False


def _reason(function: Any, *args: Any) -> str | None:
    """Why a call fails; None if it does not."""
    try:
        function(*args)
    except (ValueError, OSError, ImportError) as error:
        return one_line(error)
    return None


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its words; the program's arguments by default
    """
    parser = make_parser(
        "doctor",
        "Say what is installed and what is missing, or what is inside a file or folder and whether it loads here. "
        "Nothing is unpickled. Exits with 1 for a fault.",
        "doctor logs/ppo/PointMaze-v0_1",
    )
    parser.add_argument(
        "path", nargs="?", metavar="PATH",
        help="an encoder file or its name, a dataset, a zoo run or its zip, a benchmark (default: the installation)",
    )  # fmt: skip
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> int:
    faults = 0
    width = 18
    for name, text, is_fault in lines(args.path):
        faults += is_fault
        print(f"{'!' if is_fault else ' '} {printable(name):{width}}  {printable(text)}", flush=True)
    if faults:
        print(f"{faults} fault{'s' * (faults > 1)}, marked with !", file=sys.stderr)
    return 1 if faults else 0
