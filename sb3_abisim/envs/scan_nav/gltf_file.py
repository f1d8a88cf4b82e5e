"""glTF 2.0 as a container: its JSON part, the extensions that it uses, its buffers, and the numbers in them.

What is read follows the specification (Khronos Group, glTF 2.0, sections 3.6 and 4.4). A file that asks for anything
else is refused.
"""

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import Budget, FileSpan, ScanFiles, SceneError

# Extensions that are read.
_READ = {
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_transmission",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
# Extensions that change no shape and no color of a surface in even light: gloss, light sources, notes about the file.
_HARMLESS = {
    "EXT_instance_features",
    "EXT_lights_ies",
    "EXT_lights_image_based",
    "EXT_mesh_features",
    "EXT_structural_metadata",
    "FB_ngon_encoding",
    "KHR_lights_punctual",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_diffuse_transmission",
    "KHR_materials_dispersion",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_unlit",
    "KHR_materials_variants",
    "KHR_materials_volume",
    "KHR_xmp",
    "KHR_xmp_json_ld",
}
# Other forms of a texture; without being required, they stand beside an ordinary one, which is read.
_OTHER_TEXTURES = {"EXT_texture_avif", "KHR_texture_basisu", "MSFT_texture_dds"}
_REMEDIES = {
    "KHR_draco_mesh_compression": "Draco compression (undo it: `npx @gltf-transform/cli copy IN OUT`)",
    "EXT_meshopt_compression": "meshopt compression (undo it: `npx @gltf-transform/cli copy IN OUT`)",
    "KHR_meshopt_compression": "meshopt compression (undo it: `npx @gltf-transform/cli copy IN OUT`)",
    "KHR_texture_basisu": "KTX2 textures (convert them: `npx @gltf-transform/cli ktxdecompress IN OUT`)",
}
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class GltfFile:
    """The JSON part of a .glb or .gltf file, and its accessors as arrays.

    :param path: of the scan
    :param files: those beside it
    :param budget: counts what is declared
    :raises SceneError: for a damaged file, another version, or an extension that is not known here
    """

    def __init__(self, path: Path, files: ScanFiles, budget: Budget) -> None:
        self.path, self.files, self.budget = path, files, budget
        self._binary: bytes | FileSpan = b""
        self.header = json.loads(self._open_glb() if path.suffix.lower() == ".glb" else path.read_bytes())
        if not isinstance(self.header, dict):
            raise SceneError(f"{path} is not glTF: its JSON part is no object; download or export it again")
        version = str(self.header.get("asset", {}).get("version", ""))
        least = str(self.header.get("asset", {}).get("minVersion", "2.0"))
        if not version.startswith("2.") or least != "2.0":
            raise SceneError(f"{path} is of glTF version {version or 'none'}, not 2.0; export it again as glTF 2.0")
        self._check_extensions()
        # Then coordinates of textures may be whole numbers, which a transform scales.
        self.quantized = "KHR_mesh_quantization" in self.header.get("extensionsUsed", [])
        self._buffers: dict[int, bytes | FileSpan] = {}

    def _open_glb(self) -> bytes:
        data = FileSpan(self.path, 0, self.path.stat().st_size)
        if len(data) < 20 or data[:4] != b"glTF":
            raise SceneError(
                f"{self.path} is not a binary glTF file; download it again, or give it the suffix of its format"
            )
        version, total, n_json = struct.unpack("<III", data[4:16])
        if version != 2:
            raise SceneError(f"{self.path} is of glTF version {version}, not 2; export it again as glTF 2.0")
        if len(data) < total or 20 + n_json > total:
            raise SceneError(f"{self.path} is truncated: it has {len(data)} of {total} bytes; download it again")
        if data[16:20] != b"JSON":
            raise SceneError(f"{self.path} does not begin with its JSON part; download or export it again")
        begin = 20 + n_json
        if total - begin >= 8:
            length, kind = struct.unpack("<I4s", data[begin : begin + 8])
            if begin + 8 + length > total:
                raise SceneError(f"{self.path} is truncated: its binary part is not whole; download it again")
            if kind == b"BIN\0":
                self._binary = FileSpan(self.path, begin + 8, length)
        return data[20:begin]

    def _check_extensions(self) -> None:
        """Refuse what is not known to be read, or to change nothing."""
        header = self.header
        required = set(header.get("extensionsRequired", []))
        for name in sorted({*required, *header.get("extensionsUsed", []), *_extensions(header)}, key=str):
            if name in _READ or name in _HARMLESS or (name in _OTHER_TEXTURES and name not in required):
                continue
            if name in _REMEDIES:
                raise SceneError(f"{self.path} uses {_REMEDIES[name]}, which is not supported")
            raise SceneError(f"{self.path} uses the glTF extension {name}, which is not supported; export it without")

    def bad(self, what: str, remedy: str = "export it again") -> SceneError:
        """An error about this file.

        :param what: is wrong
        :param remedy: what to do
        """
        return SceneError(f"{self.path} {what}; {remedy}")

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """An entry of one of the file's lists.

        :param kind: such as "meshes"
        :param index: as another entry gives it
        :raises SceneError: for one that is not there
        """
        entries = self.header.get(kind, [])
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(entries):
            raise self.bad(f"refers to {kind} {index!r}, of which it has {len(entries)}")
        entry: dict[str, Any] = entries[index]
        return entry

    def view(self, index: Any) -> bytes | FileSpan:
        """The bytes of a buffer view, or where they lie.

        :param index: of it
        """
        view = self.item("bufferViews", index)
        begin, length = _whole(view.get("byteOffset", 0)), _whole(view["byteLength"])
        data = self._buffer(view["buffer"])
        if begin + length > _whole(self.item("buffers", view["buffer"])["byteLength"]):
            raise self.bad("is damaged: a buffer view reaches beyond its buffer", "download or export it again")
        return data.span(begin, length) if isinstance(data, FileSpan) else data[begin : begin + length]

    def _buffer(self, index: Any) -> bytes | FileSpan:
        if index not in self._buffers:
            buffer = self.item("buffers", index)
            uri, length = buffer.get("uri"), _whole(buffer["byteLength"])
            data = self._binary if uri is None and index == 0 else self.uri(uri, "a buffer")
            if data is None:
                raise self.bad(f"refers to {uri}, which is not there", "put it beside the scan, or export a .glb file")
            if len(data) < length:
                raise self.bad(f"is truncated: a buffer has {len(data)} of {length} bytes", "download it again")
            self._buffers[index] = data
        return self._buffers[index]

    def uri(self, uri: Any, what: str) -> bytes | None:
        """What a URI stands for.

        :param uri: base64 data, or the name of a file
        :param what: it is, for messages
        :return: None for a file that is not there
        """
        if not isinstance(uri, str):
            raise self.bad(f"says nowhere where {what} is")
        if uri.startswith("data:"):
            kind, _, text = uri.partition(",")
            if not kind.endswith(";base64"):
                raise self.bad(f"holds {what} in another form than base64")
            try:
                return base64.b64decode(unquote(text), validate=True)
            except binascii.Error as error:
                raise self.bad(f"holds {what} in damaged base64") from error
        found = self.files.find(uri)
        return None if found is None else self.files.read(found)

    def numbers(self, index: Any, *types: str) -> NDArray[Any]:
        """An accessor's numbers as they are stored, sparse ones put in place.

        :param index: of it
        :param types: of which it must be, such as "VEC3"
        :return: (count, columns)
        """
        accessor = self.item("accessors", index)
        if accessor.get("type") not in types or accessor.get("componentType") not in _DTYPES:
            raise self.bad(f"has an accessor of type {accessor.get('type')!r} where {' or '.join(types)} must be")
        count, columns = _whole(accessor["count"]), _COLUMNS[accessor["type"]]
        dtype = np.dtype(_DTYPES[accessor["componentType"]])
        self.budget.add("vertices", 0 if "bufferView" in accessor else count)
        if "bufferView" in accessor:
            values = self._strided(
                accessor["bufferView"], _whole(accessor.get("byteOffset", 0)), count, columns, dtype, strided=True
            )
        else:
            values = np.zeros((count, columns), dtype=dtype)
        if (sparse := accessor.get("sparse")) is None:
            return values
        n, where, what = _whole(sparse["count"]), sparse["indices"], sparse["values"]
        places = self._strided(
            where["bufferView"], _whole(where.get("byteOffset", 0)), n, 1, np.dtype(_DTYPES[where["componentType"]])
        )[:, 0]
        if where["componentType"] not in (5121, 5123, 5125) or (n and int(places.max()) >= count):
            raise self.bad("is damaged: a sparse accessor replaces what is not there")
        values = values.copy()
        values[places] = self._strided(what["bufferView"], _whole(what.get("byteOffset", 0)), n, columns, dtype)
        return values

    def _strided(
        self, view: Any, offset: int, count: int, columns: int, dtype: np.dtype[Any], strided: bool = False
    ) -> NDArray[Any]:
        data = self.view(view)
        width = columns * dtype.itemsize
        stride = _whole(self.item("bufferViews", view).get("byteStride", width)) if strided else width
        if stride < width or (count and offset + (count - 1) * stride + width > len(data)):
            raise self.bad("is damaged: an accessor reaches beyond its buffer view", "download or export it again")
        part = data[offset : offset + (count - 1) * stride + width if count else offset]
        return np.ndarray((count, columns), dtype, part, 0, (stride, dtype.itemsize))

    def fractions(self, index: Any, *types: str) -> NDArray[np.float32]:
        """An accessor's numbers, where integers stand for fractions if they are normalized.

        :param index: of it
        :param types: of which it must be
        """
        values = self.numbers(index, *types)
        if values.dtype.kind == "f" or not self.item("accessors", index).get("normalized", False):
            return values.astype(np.float32)
        return np.maximum(values / np.float32(np.iinfo(values.dtype).max), -1).astype(np.float32)


def _whole(number: Any) -> int:
    """A count or an offset."""
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise ValueError(f"{number!r} where a whole number must be")
    return number


def _extensions(header: dict[str, Any]) -> Iterator[str]:
    """The names under all "extensions", wherever they are; a program's own notes ("extras") are left out."""
    stack: list[Any] = [header]
    while stack:
        entry = stack.pop()
        if isinstance(entry, list):
            stack += entry
        elif isinstance(entry, dict):
            if isinstance(entry.get("extensions"), dict):
                yield from entry["extensions"]
            stack += [value for key, value in entry.items() if key != "extras"]
