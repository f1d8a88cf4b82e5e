"""The bytes of hostile files."""

import io
import json
import pickle
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

# What a payload makes in the folder of its case.
MARKER = "executed"
HUGE = 10**10


class Payload:
    """A pickle that makes a folder when it is opened."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        import os

        return os.mkdir, (str(self.path),)


def pickled(folder: Path) -> bytes:
    return pickle.dumps(Payload(folder / MARKER))


def objects(folder: Path) -> bytes:
    """An .npy file of objects."""
    file = io.BytesIO()
    np.save(file, np.array([Payload(folder / MARKER)], dtype=object), allow_pickle=True)
    return file.getvalue()


def npy(shape: tuple[int, ...], dtype: str = "|u1", data: bytes = bytes(64)) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue() + data


def archive(members: dict[str, bytes], compress: bool = True) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


def bomb(names: list[str], n_bytes: int = 3 << 30) -> bytes:
    """An .npz of zeros that unpack to gigabytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in names:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(npy((n_bytes,), data=b""))
                for _ in range(n_bytes >> 24):
                    member.write(bytes(1 << 24))
    return file.getvalue()


def safetensors_file(header: Any, data: bytes = b"", n: int | None = None) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if n is None else n) + text + data


def png(width: int, height: int) -> bytes:
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    pixels = zlib.compress(bytes(1 << 20), 9)
    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
            + chunk(b"IDAT", pixels) + chunk(b"IEND", b""))  # fmt: skip


def gif(width: int, height: int, n_frames: int) -> bytes:
    head = b"GIF89a" + struct.pack("<HHBBB", width, height, 0xF0, 0, 0) + bytes(6)
    frame = b"\x21\xf9\x04\0\x01\0\0\0\x2c" + struct.pack("<HHHHB", 0, 0, width, height, 0) + b"\x02\x02\x44\x01\0"
    return head + frame * n_frames + b";"


def glb(header: dict[str, Any], data: bytes = b"") -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, **header}).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text
    if data:
        body += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def glb_triangle(count: int = 3, n_nodes: int = 1, image: bytes = b"", **more: Any) -> bytes:
    """A triangle with what is declared of it."""
    points = struct.pack("<9f", 0, 0, 0, 4, 0, 0, 0, 0, 4)
    header: dict[str, Any] = {
        "scene": 0, "scenes": [{"nodes": list(range(n_nodes))}], "nodes": [{"mesh": 0}] * n_nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(points)}],
        "buffers": [{"byteLength": len(points) + len(image)}], **more,
    }  # fmt: skip
    if image:
        header["bufferViews"].append({"buffer": 0, "byteOffset": len(points), "byteLength": len(image)})
        header |= {"images": [{"bufferView": 1, "mimeType": "image/png"}], "textures": [{"source": 0}],
                   "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]}  # fmt: skip
        header["meshes"][0]["primitives"][0]["material"] = 0
    return glb(header, points + image)


def with_hash(content: bytes) -> bytes:
    """A checkpoint's bytes, forged so that its hash is right."""
    import hashlib

    return content + hashlib.sha256(content).digest()


def mp4(path: Path) -> bytes:
    import av

    if not path.is_file():
        with av.open(str(path), "w") as container:
            stream: Any = container.add_stream("mpeg4", rate=25)
            stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
            for k in range(20):
                for packet in stream.encode(
                    av.VideoFrame.from_ndarray(np.full((64, 64, 3), 10 * k, np.uint8), "rgb24")
                ):
                    container.mux(packet)
            for packet in stream.encode():
                container.mux(packet)
    return path.read_bytes()
