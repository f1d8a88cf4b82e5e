"""How hostile files are laid out on the disk, and what reads them."""

import base64
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reliability.children import command
from benchmarks.reliability.forge import MARKER, archive, pickled
from benchmarks.reliability.inputs import ALGO, ENV_ID, copy_of, run_folder, write_room

CHECKPOINT = "c/checkpoint-000000004.safetensors"
MAP_ARRAYS = ("format", "orthophoto", "height", "walkable", "meters_per_pixel", "origin", "source", "settings")
# Writes a hostile file into the folder, and gives what reads it.
Case = Callable[[Path], Callable[[], Any]]
# What a label may not become in a table or a page.
_LIVE = {
    ".csv": ("\x1b", *(f"{before}{formula}" for before in ("\n", ",", '"') for formula in ("=cmd", "@SUM", "+1+1"))),
    ".html": ("\x1b", "<script>x"),
}


# What reads each kind of file.


def load_encoder(path: Path) -> Callable[[], Any]:
    from sb3_abisim.networks.encoder_file import load_encoder

    return lambda: str(load_encoder(path).hash)


def load_map(path: Path) -> Callable[[], Any]:
    from sb3_abisim.envs.scan_nav.map import ScanMap

    return lambda: str(ScanMap.load(path).source)


def load_scan(path: Path) -> Callable[[], Any]:
    from sb3_abisim.envs.scan_nav.map import ScanMap

    return lambda: str(ScanMap.from_mesh(path, up="y", allow_implausible=True).walkable.shape)


def load_clips(path: Path) -> Callable[[], Any]:
    from sb3_abisim.envs.backgrounds.load import load_backgrounds

    return lambda: str(load_backgrounds(path, "train", min_frames=2).lengths)


def load_dataset(path: Path) -> Callable[[], Any]:
    from sb3_abisim.data.dataset import TransitionDataset

    return lambda: str(TransitionDataset(path).frames(np.arange(2)).shape)


def checkpoint(path: Path) -> Callable[[], Any]:
    from benchmarks.reliability.damage import _checkpoint as restore

    return lambda: str(restore(path)[0])


class Layout:
    """Cases by the file that is hostile.

    :param inputs: of :func:`~benchmarks.reliability.inputs.make_all`
    """

    def __init__(self, inputs: Path) -> None:
        self.inputs = inputs

    def _run_case(self, change: Callable[[Path], Any], *words: str, method: str = "ssi") -> Case:
        """A changed run folder, read by a command; "RUN" in its words is the folder, "MODEL" the zip."""

        def case(folder: Path) -> Callable[[], Any]:
            logs = folder / "logs"
            place = copy_of(run_folder(self.inputs, method), logs / ALGO / f"{ENV_ID}_1")
            (place / "hashes.json").unlink()
            change(place)
            names = {
                "RUN": str(place),
                "MODEL": str(place / f"{ENV_ID}.zip"),
                "OUT": str(folder / "out"),
                "LOGS": str(logs),
            }
            return command(*[names.get(word, word) for word in words])

        return case

    def _readers(self) -> dict[str, tuple[str, ...]]:
        enjoy = (
            "enjoy",
            "--algo",
            ALGO,
            "--env",
            ENV_ID,
            "-f",
            "LOGS",
            "--no-render",
            "-n",
            "20",
            "--num-threads",
            "1",
        )
        train = (
            "train", "--algo", ALGO, "--env", ENV_ID, "-f", "OUT", "--conf-file", "vanilla", "-i", "MODEL", "-n", "40",
            "--eval-freq", "-1", "--num-threads", "1", "-params", "buffer_size:200",
        )  # fmt: skip
        return {
            "evaluate": ("benchmark", "evaluate", "RUN", "--episodes", "1"),
            "record": ("record", "RUN", "-o", "OUT", "--episodes", "1"),
            "merge": ("merge", "--algo", ALGO, "MODEL", "-o", "OUT"),
            "collect": ("collect", "--env", ENV_ID, "-n", "20", "--policy", "RUN", "-o", "OUT"),
            "enjoy": enjoy,
            "train": train,
        }

    @staticmethod
    def _beside(name: str) -> Callable[[Path], Any]:
        def change(place: Path) -> None:
            where = place / ENV_ID / name if name.startswith("vec") else place / name
            where.write_bytes(pickled(place.parents[2]))
            if name.startswith("vec"):
                config = place / ENV_ID / "config.yml"
                config.write_text(config.read_text().rstrip() + "\n  - - normalize\n    - true\n")

        return change

    @staticmethod
    def _pickle_in_zip(where: str) -> Callable[[Path], Any]:
        def change(place: Path) -> None:
            path = place / f"{ENV_ID}.zip"
            with zipfile.ZipFile(path) as whole:
                members = {name: whole.read(name) for name in whole.namelist()}
            data = pickled(place.parents[2])
            if where.endswith(".pth"):
                members[where] = data
            else:
                document = json.loads(members["data"])
                entry = document.get(where)
                entry = entry if isinstance(entry, dict) else {":type:": "<class 'x'>"}
                document[where] = {**entry, ":serialized:": base64.b64encode(data).decode()}
                members["data"] = json.dumps(document).encode()
            path.write_bytes(archive(members, compress=False))

        return change

    # How a case is laid out.

    @staticmethod
    def _file(name: str, data: Callable[[Path], bytes], read: Callable[[Path], Callable[[], Any]]) -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            path = folder / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(data(folder))
            return read(path)

        return case

    def _dataset(self, change: Callable[[Path, Path], Any]) -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            place = copy_of(self.inputs / "data", folder / "data")
            change(place, folder)
            forge(place)
            return load_dataset(place)

        return case

    def _meta(self, key: str, value: Any) -> Case:
        def change(place: Path, _: Path) -> None:
            path = place / "meta.json"
            meta = json.loads(path.read_bytes())
            for space in ("observation_space", "action_space"):
                meta[space][key] = value
            path.write_text(json.dumps(meta))

        return self._dataset(change)

    @staticmethod
    def _imported(members: Callable[[Path], dict[str, bytes]]) -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            (folder / "source").mkdir()
            for name, data in members(folder).items():
                (folder / "source" / (name if "." in name else f"{name}.npy")).write_bytes(data)
            return command("data", "import", "arrays", folder / "source", "-o", folder / "out")

        return case

    def _bench(self, name: str, data: Callable[[Path], bytes], verb: str = "report") -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            bench = copy_of(self.inputs / "bench", folder / "bench")
            for path in [*bench.rglob("hashes.json")]:
                path.unlink()
            for place in bench.glob(f"runs/*/{ALGO}/*"):
                (place / name).write_bytes(data(folder))
            return command("benchmark", verb, bench, "-o", folder / "out")

        return case

    def _bench_text(self, name: str, text: str, verb: str = "report") -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            bench = copy_of(self.inputs / "bench", folder / "bench")
            for path in [*bench.rglob("hashes.json")]:
                path.unlink()
            (bench / name).write_text(text)
            return command("benchmark", verb, bench, "-o", folder / "out")

        return case

    def _index(self, place: str, verb: str) -> Case:
        return self._bench_text("benchmark.json", json.dumps({"runs": [{"folder": place, "label": "x"}]}), verb)

    def _label(self, label: str) -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            make = self._bench_text("benchmark.json", "{}")
            read = make(folder)
            index = json.loads((self.inputs / "bench" / "benchmark.json").read_bytes())
            index["runs"][0]["label"] = label
            (folder / "bench" / "benchmark.json").write_text(json.dumps(index))

            def checked() -> None:
                read()
                for path in (folder / "out").rglob("*"):
                    text = path.read_text(errors="replace") if path.suffix in _LIVE else ""
                    if any(bad in text for bad in _LIVE.get(path.suffix, ())):
                        (folder / MARKER).mkdir(exist_ok=True)

            return checked

        return case

    @staticmethod
    def _clips(members: dict[str, bytes]) -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            for name, data in members.items():
                path = folder / "clips" / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
            return load_clips(folder / "clips")

        return case

    @staticmethod
    def _scan(name: str, content: bytes | str, others: dict[str, str] | None = None) -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            path = folder / name
            path.write_bytes(content.encode() if isinstance(content, str) else content)
            for other, text in (others or {}).items():
                (folder / other).write_text(text)
            return load_scan(path)

        return case

    @staticmethod
    def _ply(header: str) -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            write_room(folder / "s.ply", header)
            return load_scan(folder / "s.ply")

        return case

    @staticmethod
    def _room(side: float) -> Case:
        def case(folder: Path) -> Callable[[], Any]:
            from sb3_abisim.envs.scan_nav.env import ScanNavEnv
            from sb3_abisim.envs.scan_nav.map import ScanMap

            write_room(folder / "s.ply", size=(side, side))

            def read() -> str:
                scan = ScanMap.from_mesh(folder / "s.ply", up="z", allow_implausible=True)
                return str(ScanNavEnv(scenes=scan).reset(seed=0)[0].shape)

            return read

        return case

    def _forged_encoder(self, name: str) -> Case:
        def data(_: Path) -> bytes:
            import safetensors.torch

            from sb3_abisim.networks import encoder_file

            whole = (self.inputs / "encoder.safetensors").read_bytes()
            header = encoder_file._header(Path("e"), whole)
            document = json.loads(header["__metadata__"][encoder_file._DOCUMENT_KEY])
            document["network"]["kwargs"][name] = 10**9
            tensors = safetensors.torch.load(whole)
            tensors.pop(encoder_file._HASH_KEY)
            forged: bytes = encoder_file._serialize(tensors, json.dumps(document))[0]
            return forged

        return self._file("e.safetensors", data, load_encoder)


def link(path: Path, target: Path) -> None:
    path.unlink()
    path.symlink_to(target)


def forge(folder: Path) -> None:
    """Make all hashes of a dataset right, as far as its meta.json can be read."""
    from sb3_abisim.common.files import file_hash
    from sb3_abisim.data.format import DOCUMENT_HASH_KEY, HASH_KEY, make_meta

    path = folder / "meta.json"
    try:
        meta = json.loads(path.read_bytes())
        for shard in meta["shards"]:
            for name, entry in shard["files"].items():
                entry |= {"bytes": (folder / name).stat().st_size, "sha256": file_hash(folder / name)}
        computed = ("n_transitions", "n_frames", "shards", HASH_KEY, DOCUMENT_HASH_KEY)
        config = {key: value for key, value in meta.items() if key not in computed}
        path.write_text(json.dumps(make_meta(config, meta["shards"])))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return
