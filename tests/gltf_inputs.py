"""A writer of small glTF files, for what other writers do not write."""

import io
import json
import struct

import numpy as np
from PIL import Image

# A floor of 6 m x 5 m, y up: x to the east, z to the south; a lower table of 3 m x 2 m on it.
FLOOR = np.array([[0, 0, 5], [6, 0, 5], [6, 0, 0], [0, 0, 0]], np.float32)
TABLE = np.array([[1, 0.5, 4], [4, 0.5, 4], [4, 0.5, 2], [1, 0.5, 2]], np.float32)
CORNERS = np.array([0, 1, 2, 0, 2, 3], np.uint16)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
GREEN = {"pbrMetallicRoughness": {"baseColorFactor": [0, 1, 0, 1]}}
_TYPES = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125, "int16": 5122, "int8": 5120}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


def png(pixels):
    file = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(file, "PNG")
    return file.getvalue()


class Gltf:
    """Collects what a file holds; every method returns the index of what it has added."""

    def __init__(self):
        self.header = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.data = b""

    def add(self, kind, **entry):
        self.header.setdefault(kind, []).append(entry)
        return len(self.header[kind]) - 1

    def view(self, data, **entry):
        self.data += b"\0" * (-len(self.data) % 4)
        self.data += data
        return self.add("bufferViews", buffer=0, byteOffset=len(self.data) - len(data), byteLength=len(data), **entry)

    def accessor(self, array, normalized=False, **entry):
        array = np.ascontiguousarray(array)
        columns = 1 if array.ndim == 1 else array.shape[1]
        if normalized:
            entry["normalized"] = True
        described = {"componentType": _TYPES[array.dtype.name], "count": len(array), "type": _SHAPES[columns]}
        return self.add("accessors", bufferView=self.view(array.tobytes()), **described, **entry)

    def texture(self, pixels, **sampler):
        image = self.add("images", bufferView=self.view(png(pixels)), mimeType="image/png")
        return self.add("textures", source=image, sampler=self.add("samplers", **sampler))

    def primitive(self, points=FLOOR, material=None, colors=None, uv=None, **entry):
        attributes = {"POSITION": self.accessor(points)}
        if colors is not None:
            attributes["COLOR_0"] = colors
        if uv is not None:
            attributes["TEXCOORD_0"] = self.accessor(uv)
        entry = {"attributes": attributes, "indices": self.accessor(CORNERS), **entry}
        if material is not None:
            entry["material"] = self.add("materials", **material)
        return entry

    def node(self, *primitives, mesh=None, root=True, **entry):
        if primitives:
            entry["mesh"] = self.add("meshes", primitives=list(primitives), **(mesh or {}))
        index = self.add("nodes", **entry)
        if root:
            self.header["scenes"][0]["nodes"].append(index)
        return index

    def save(self, path):
        data = self.data + b"\0" * (-len(self.data) % 4)
        text = json.dumps({**self.header, "buffers": [{"byteLength": len(data)}]}).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
        return path
