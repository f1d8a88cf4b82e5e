"""The hostile files, by kind and name."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path

from benchmarks.reliability.children import command
from benchmarks.reliability.forge import (
    HUGE,
    MARKER,
    archive,
    bomb,
    gif,
    glb,
    glb_triangle,
    mp4,
    npy,
    objects,
    pickled,
    png,
    safetensors_file,
    with_hash,
)
from benchmarks.reliability.inputs import ALGO, ENV_ID
from benchmarks.reliability.layout import (
    CHECKPOINT,
    MAP_ARRAYS,
    Case,
    Layout,
    checkpoint,
    link,
    load_encoder,
    load_map,
)


def _floors(side: int, n: int) -> str:
    corners = [(0, 0), (0, side), (side, side), (side, 0)]
    lines = [f"v {x} {0.001 * k:.3f} {z}" for k in range(n) for x, z in corners]
    return "\n".join([*lines, *(f"f {4 * k + 1} {4 * k + 2} {4 * k + 3} {4 * k + 4}" for k in range(n)), ""])


class Corpus(Layout):
    """The cases, each with a name.

    :param inputs: of :func:`~benchmarks.reliability.inputs.make_all`
    """

    def all(self) -> Iterator[tuple[str, str, Case]]:
        """Kind, name and case of each."""
        for kind in ("pickles", "yaml", "paths", "arrays", "weights", "images", "videos", "scans", "texts", "names"):
            for name, case in getattr(self, kind)().items():
                yield kind, name, case

    def pickles(self) -> dict[str, Case]:
        """Pickles in place of data."""
        cases: dict[str, Case] = {}
        for reader, words in self._readers().items():
            method = "ssi" if reader == "merge" else "vanilla"
            for where in ("policy_class", "observation_space", "lr_schedule", "policy.pth"):
                change = self._pickle_in_zip(where)
                cases[f"{where} of a model, {reader}"] = self._run_case(change, *words, method=method)
            for name in ("vecnormalize.pkl", "replay_buffer.pkl"):
                cases[f"{name} beside a model, {reader}"] = self._run_case(self._beside(name), *words, method=method)
        cases |= {
            "encoder file": self._file("e.safetensors", pickled, load_encoder),
            "scan map": self._file(
                "m.npz", lambda f: archive({f"{name}.npy": objects(f) for name in MAP_ARRAYS}), load_map
            ),
            "dataset": self._dataset(lambda place, folder: (place / "actions-00000.npy").write_bytes(objects(folder))),
            "checkpoint": self._file(CHECKPOINT, lambda f: with_hash(pickled(f)), lambda p: checkpoint(p.parent)),
            "arrays": self._imported(lambda f: {"observations": objects(f), "actions": objects(f)}),
        }  # fmt: skip
        for name in ("evaluations.npz", "final_evaluations.npz"):
            cases[name] = self._bench(
                f"{name}",
                lambda f: archive(
                    {"timesteps.npy": objects(f), "results.npy": objects(f), "a/b/results.npy": objects(f)}
                ),
            )
        return cases

    def yaml(self) -> dict[str, Case]:
        """Tags that call, and anchors and depths without end, in a run's YAML."""
        cases: dict[str, Case] = {}
        texts = {
            "apply": "!!python/object/apply:os.mkdir ['{marker}']",
            "new": "!!python/object/new:os.mkdir ['{marker}']",
            "object": "!!python/object:pathlib.Path {{}}",
            "module": "!!python/module:antigravity ''",
            "name": "!!python/name:this.s ''",
            "anchors": "&a [x, x]\nb0: &b0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
                f"b{k}: &b{k} [{', '.join([f'*b{k - 1}'] * 9)}]\n" for k in range(1, 12)),
            "depth": "[" * 50_000,
            "maps in depth": "{{a: " * 50_000,
        }  # fmt: skip
        readers = {**self._readers(), "report": ("benchmark", "report", "LOGS", "-o", "OUT")}
        for reader, words in readers.items():
            for tag, text in texts.items():
                for name in ("config.yml", "args.yml"):

                    def change(place: Path, name: str = name, text: str = text) -> None:
                        path = place / ENV_ID / name
                        marker = place.parents[2] / MARKER
                        lines = (
                            f"algo: {ALGO}\nenv: {ENV_ID}\nextra: "
                            if name == "args.yml"
                            else "policy: CnnPolicy\nextra: "
                        )
                        path.write_text(lines + text.format(marker=marker) + "\n")

                    method = "ssi" if reader == "merge" else "vanilla"
                    cases[f"{tag} in {name}, {reader}"] = self._run_case(change, *words, method=method)
        return cases

    def paths(self) -> dict[str, Case]:
        """Names that lead out of a folder, and to a network."""
        cases: dict[str, Case] = {}
        for place in ("../out", "/etc", "runs/../../x", "..\\x", "a/\0b"):
            for verb in ("export", "report"):
                cases[f"{place!r} in benchmark.json, {verb}"] = self._index(place, verb)
        for place in ("../../x", "/etc/passwd"):
            cases[f"{place} in hashes.json"] = self._bench_text(
                "hashes.json", json.dumps({"sha256": {place: "0" * 64}})
            )
        cases["texture above"] = self._scan(
            "o.obj",
            "mtllib m.mtl\nusemtl a\nv 0 0 0\nv 4 0 0\nv 0 0 4\nvt 0 0\nf 1/1 3/1 2/1\n",
            {"m.mtl": "newmtl a\nmap_Kd ../../../etc/passwd\n"},
        )
        for name in ("http:x.mp4", "rtsp:x.mp4", "concat:a|b.mp4", "tcp:localhost:9.mp4"):
            cases[f"video {name}"] = self._clips({f"train/{name}": b"\0" * 4000, f"eval/{name}": b"\1" * 4000})
        cases["encoder at http"] = lambda folder: command(
            "pretrain",
            "--objective",
            "abisim",
            "--data",
            str(self.inputs / "data"),
            "--base",
            "http://localhost:9/x.safetensors",
            "-o",
            str(folder / "o.safetensors"),
        )
        cases["lerobot at http"] = lambda folder: command(
            "data", "import", "lerobot", "http://localhost:9/x", "-o", str(folder / "o")
        )
        cases["link out of a dataset"] = self._dataset(
            lambda place, _: link(place / "actions-00000.npy", Path("/etc/passwd"))
        )
        return cases

    def arrays(self) -> dict[str, Case]:
        """Shapes that are declared and not there, and zeros that unpack to gigabytes."""
        cases: dict[str, Case] = {}
        for shape in ((HUGE,), (10**6, 10**6), (2**62,), (-1,), (HUGE, 0)):
            for dtype in ("|u1", "<f8"):
                data = npy(shape, dtype)
                what = f"{shape} {dtype}"
                cases[f"scan map, {what}"] = self._file(
                    "m.npz", lambda _, d=data, n=MAP_ARRAYS: archive({f"{k}.npy": d for k in n}), load_map
                )
                cases[f"evaluations.npz, {what}"] = self._bench(
                    "evaluations.npz", lambda _, d=data: archive({"timesteps.npy": d, "results.npy": d})
                )
                cases[f"arrays, {what}"] = self._imported(lambda _, d=data: {"observations": d, "actions": d})
                cases[f"dataset, {what}"] = self._dataset(
                    lambda place, _, d=data: (place / "actions-00000.npy").write_bytes(d)
                )
        cases["scan map of zeros"] = self._file("m.npz", lambda _: bomb(["orthophoto"]), load_map)
        cases["results of zeros"] = self._bench("evaluations.npz", lambda _: bomb(["timesteps", "results"], 1 << 30))
        cases["arrays of zeros"] = self._imported(lambda _: {"episode.npz": bomb(["observations"])})
        cases["a model of zeros"] = self._run_case(
            lambda place: (place / f"{ENV_ID}.zip").write_bytes(bomb(["data", "policy"])),
            *self._readers()["evaluate"],
            method="vanilla",
        )
        for key in ("shape", "low", "high", "dtype", "n"):
            for value in ([10**5] * 3, HUGE, "O", [[[]]], None):
                cases[f"meta.json, {key} {str(value)[:12]}"] = self._meta(key, value)
        return cases

    def weights(self) -> dict[str, Case]:
        """Encoder files and checkpoints."""
        tensor = {"dtype": "F32", "shape": [HUGE, HUGE], "data_offsets": [0, 4]}
        headers: dict[str, bytes] = {
            "a huge tensor": safetensors_file({"encoder.w": tensor}, bytes(4)),
            "offsets beyond": safetensors_file(
                {"encoder.w": {**tensor, "shape": [1], "data_offsets": [0, HUGE]}}, bytes(4)
            ),
            "negative offsets": safetensors_file(
                {"encoder.w": {**tensor, "shape": [1], "data_offsets": [-4, 0]}}, bytes(4)
            ),
            "a huge header": safetensors_file({}, n=2**60),
            "a header in depth": safetensors_file(b"[" * 1_000_000),
            "a long header": safetensors_file(b'{"a":' + b" " * 50_000_000 + b"1}"),
            "nothing": b"",
            "another type": safetensors_file({"encoder.w": {**tensor, "dtype": "X9", "shape": [1]}}, bytes(4)),
            "no run": safetensors_file({"__metadata__": {"run": "{}"}}),
            "metadata in depth": safetensors_file(
                {"__metadata__": {"run": "[" * 100_000, "sb3_abisim": "[" * 100_000}}
            ),
            "no metadata": safetensors_file({}),
        }
        cases: dict[str, Case] = {}
        for name, data in headers.items():
            cases[f"encoder, {name}"] = self._file("e.safetensors", lambda _, d=data: d, load_encoder)
            cases[f"checkpoint, {name}"] = self._file(
                CHECKPOINT, lambda _, d=data: with_hash(d), lambda p: checkpoint(p.parent)
            )
        for name in ("width", "hidden_dim", "features_dim", "depth", "n_channels"):
            cases[f"encoder, network kwargs {name}"] = self._forged_encoder(name)
        return cases

    def images(self) -> dict[str, Case]:
        """PNG and GIF as frames of clips and as textures."""
        cases: dict[str, Case] = {}
        sizes = ((60_000, 60_000), (2**31 - 1, 1), (1, 2**31 - 1), (30_000, 20_000), (8192, 8192))
        for size in sizes:
            data = png(*size)
            frames = {f"{side}/a/{k:03}.png": data + bytes([k]) for side in ("train", "eval") for k in range(16)}
            cases[f"PNG frames of {size}"] = self._clips(frames)
            cases[f"PNG texture of {size}"] = self._scan("s.glb", glb_triangle(image=data))
        for width, height, n in ((65_535, 65_535, 20), (10_000, 10_000, 400), (64, 64, 200_000), (1, 65_535, 1000)):
            data = gif(width, height, n)
            cases[f"GIF of {width}, {height}, {n}"] = self._clips({"train/a.gif": data, "eval/b.gif": data + b"\0"})
        return cases

    def videos(self) -> dict[str, Case]:
        """MP4 whose boxes say more than there is."""
        whole = mp4(self.inputs.parent / "one.mp4")
        cases: dict[str, Case] = {"whole": self._clips({"train/a.mp4": whole, "eval/b.mp4": whole + b"\0\0\0\x08free"})}
        for box in (b"tkhd", b"stsz", b"stts", b"stco", b"avc1", b"mp4v", b"mdhd", b"moov", b"stsc", b"mvhd", b"trak"):
            at = whole.find(box)
            if at < 0:
                continue
            for offset in (-4, 4, 8, 12, 16, 28):
                broken = bytearray(whole)
                broken[at + offset : at + offset + 4] = b"\x7f\xff\xff\xf0"
                data = bytes(broken)
                cases[f"{box.decode()} at {offset}"] = self._clips(
                    {"train/a.mp4": data, "eval/b.mp4": data + b"\0\0\0\x08free"}
                )
        return cases

    def scans(self) -> dict[str, Case]:
        """glTF, OBJ and PLY that declare more than there is."""
        sparse = {"count": 1000, "indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 0}}
        big = {"componentType": 5126, "count": HUGE, "type": "VEC3"}
        chain = [{"children": [k + 1]} for k in range(20_000)] + [{"mesh": 0}]
        tree = [{"children": [k + 1] * 2} for k in range(60)] + [{"mesh": 0}]
        polygon = "".join(f"v {k} 0 {k * k % 977}\n" for k in range(50_000))
        polygon += f"f {' '.join(map(str, range(1, 50_001)))}\n"
        options = f"newmtl a\nmap_Kd {'-o 1 ' * 200_000}\n"
        cases: dict[str, Case] = {
            "glb, count": self._scan("s.glb", glb_triangle(count=HUGE)),
            "glb, no view": self._scan("s.glb", glb_triangle(accessors=[big])),
            "glb, sparse": self._scan("s.glb", glb_triangle(accessors=[{**big, "sparse": sparse}])),
            "glb, nodes": self._scan("s.glb", glb_triangle(n_nodes=200_000)),
            "glb, chain": self._scan("s.glb", glb_triangle(nodes=chain, scenes=[{"nodes": [0]}])),
            "glb, tree": self._scan("s.glb", glb_triangle(nodes=tree, scenes=[{"nodes": [0]}])),
            "glb, circle": self._scan("s.glb", glb_triangle(nodes=[{"children": [0], "mesh": 0}])),
            "glb, instances": self._scan("s.glb", glb_triangle(extensionsUsed=["EXT_mesh_gpu_instancing"], nodes=[{
                "mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}}] * 100_000)),
            "glb, length": self._scan("s.glb", struct.pack("<III", 0x46546C67, 2, 2**32 - 1) + bytes(64)),
            "glb, depth": self._scan("s.glb", glb({"extras": 0}).replace(b": 0}", b": " + b"[" * 90_000)),
            "glb, scale": self._scan("s.glb", glb_triangle(nodes=[{"mesh": 0, "scale": [1e30, 1e30, 1e30]}])),
            "glb, NaN": self._scan("s.glb", glb_triangle(nodes=[{"mesh": 0, "translation": [1e308, 1e308, 1e308]}])),
            "obj, index": self._scan("s.obj", "v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 9999999999\n"),
            "obj, polygon": self._scan("s.obj", polygon),
            "obj, long line": self._scan("s.obj", "v " + "1" * 20_000_000 + "\n"),
            "obj, spaces": self._scan("s.obj", "v 0 0 0" + " " * 20_000_000 + "\n"),
            "obj, backslashes": self._scan("s.obj", "\\\n" * 3_000_000),
            "mtl, options": self._scan("s.obj", "mtllib m.mtl\nv 0 0 0\n", {"m.mtl": options}),
            "a room as large as a map may be": self._room(79.9),
            "a hundred floors upon each other": self._scan("s.obj", _floors(89, 100)),
            "as many floors as are read": self._scan("s.obj", _floors(79, 12)),
            "large in meters": self._scan("s.obj", "v 0 0 0\nv 9e9 0 0\nv 9e9 0 9e9\nv 0 0 9e9\nf 1 4 3 2\n"),
        }  # fmt: skip
        for text in (f"element vertex {HUGE}", "element vertex -5", "element vertex 99999999999999999999999"):
            cases[f"ply, {text}"] = self._ply(text)
        return cases

    def texts(self) -> dict[str, Case]:
        """Depths and regular expressions."""
        cases: dict[str, Case] = {}
        deep = "[" * 200_000
        for name in ("benchmark.json", "hashes.json", "jobs/run-0.json"):
            cases[f"{name} in depth"] = self._bench_text(name, deep, "export")
        cases["method.json in depth"] = self._bench(f"{ENV_ID}/method.json", lambda _: deep.encode())
        cases["meta.json in depth"] = self._dataset(lambda place, _: (place / "meta.json").write_text(deep))
        for number, text in enumerate(
            ("/a" * 30_000, "/" + "é" * 60_000, "/a b" * 30_000, "\\u00e9/" * 20_000, "/" * 200_000)
        ):
            cases[f"command.txt, {number}"] = self._bench(
                f"{ENV_ID}/command.txt", lambda _, t=text: t.encode(), "export"
            )
        kwargs = (
            "dict(" * 3000, "(" * 9000, "1" + "**9" * 3000, "9" * 9000, "dict(a=" + "-" * 9000 + "1)", "'" + "a" * 9000,
            "9**9**9**9", "dict(net_arch=[999999999])", "dict(net_arch=[4096, 999999, 999999])",
            "dict(features_extractor_class=os.system)",
        )  # fmt: skip
        for number, text in enumerate(kwargs):
            for reader in ("evaluate", "enjoy", "train"):

                def change(place: Path, text: str = text) -> None:
                    (place / ENV_ID / "config.yml").write_text(
                        json.dumps({"policy": "CnnPolicy", "policy_kwargs": text, "normalize": text})
                    )

                cases[f"policy_kwargs {number}, {reader}"] = self._run_case(
                    change, *self._readers()[reader], method="vanilla"
                )
        rows = "r,l,t\n" + "1,1,1\n" * 2_000_000
        cases["monitor of a large line"] = self._bench(
            "0.monitor.csv", lambda _: b'#{"t_start": 0}\nr,l,t\n' + b"9" * 30_000_000, "export"
        )
        cases["monitor in depth"] = self._bench(
            "0.monitor.csv", lambda _: b"#" + deep.encode() + b"\n" + rows[:100].encode(), "export"
        )
        return cases

    def names(self) -> dict[str, Case]:
        """What a terminal, a spreadsheet or a browser would execute, as labels of runs."""
        cases: dict[str, Case] = {}
        for number, label in enumerate(
            ("=cmd|' /C calc'!A0", "<script>x</script>", "\x1b]0;x\x07", "@SUM(1)", "a\nb", "+1+1")
        ):
            cases[f"label {number}"] = self._label(label)
        return cases
