"""What scan files declare, before and beside what trimesh makes of them."""

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
_UNSUPPORTED = {
    "KHR_draco_mesh_compression": "Draco compression (undo it: `npx @gltf-transform/cli copy IN OUT`)",
    "EXT_meshopt_compression": "meshopt compression (undo it: `npx @gltf-transform/cli copy IN OUT`)",
    "KHR_texture_basisu": "KTX2 textures (convert them: `npx @gltf-transform/cli ktxdecompress IN OUT`)",
    "KHR_mesh_quantization": "quantized vertices (undo it: `npx @gltf-transform/cli dequantize IN OUT`)",
}
# Extensions that a file may require and that change nothing seen from above, or that trimesh knows.
_HARMLESS = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")
_FLOAT = 5126  # glTF's component type
_TRIANGLES = (4, 5)  # glTF's modes that trimesh reads
_UNMOVED = {"offset": [0, 0], "rotation": 0, "scale": [1, 1]}


class SceneError(ValueError):
    """A scan that cannot be used; the message names the file and the remedy."""


def check_file(path: Path) -> Any:
    """Refuse what is visibly wrong without reading all of it.

    :param path: of the scan
    :return: a glTF file's JSON part, else {}
    :raises SceneError: for what is wrong
    """
    if path.suffix.lower() not in SUFFIXES:
        raise SceneError(f"{path} is no scan file: its suffix must be one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise SceneError(f"there is no scan file {path}; check the path")
    with open(path, "rb") as file:
        head = file.read(64)
    if not head:
        raise SceneError(f"{path} is empty; download or copy it again")
    if head.startswith(b"version https://git-lfs"):
        raise SceneError(f"{path} is a Git LFS pointer, not the scan itself; run `git lfs pull` in its repository")
    if path.suffix.lower() not in (".glb", ".gltf"):
        return {}
    try:
        header = _glb_header(path, head) if path.suffix.lower() == ".glb" else json.loads(path.read_bytes())
        _check_extensions(path, header)
    except SceneError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise SceneError(f"{path} cannot be read ({error}); download or export it again") from error
    return header


def _glb_header(path: Path, head: bytes) -> Any:
    if len(head) < 20 or head[:4] != b"glTF":
        raise SceneError(f"{path} is not a binary glTF file; download it again, or give it the suffix of its format")
    total, n_json = struct.unpack("<I", head[8:12])[0], struct.unpack("<I", head[12:16])[0]
    if path.stat().st_size < total:
        raise SceneError(f"{path} is truncated: it has {path.stat().st_size} of {total} bytes; download it again")
    with open(path, "rb") as file:
        file.seek(20)
        return json.loads(file.read(n_json))


def _check_extensions(path: Path, header: dict[str, Any]) -> None:
    """Refuse what trimesh passes over and would show as something else."""
    for name in header.get("extensionsRequired", []):
        if name in _UNSUPPORTED:
            raise SceneError(f"{path} uses {_UNSUPPORTED[name]}, which is not supported")
        if not name.startswith(_HARMLESS):
            raise SceneError(f"{path} needs the glTF extension {name}, which is not supported; export it without")
    for primitive, texture in primitives(header):
        names = {"POSITION", "TEXCOORD_0"} if texture else {"POSITION"}
        read = [header["accessors"][index] for name, index in primitive["attributes"].items() if name in names]
        if any(accessor["componentType"] != _FLOAT for accessor in read):
            raise SceneError(f"{path} uses {_UNSUPPORTED['KHR_mesh_quantization']}, which is not supported")
        moved = texture.get("extensions", {}).get("KHR_texture_transform", {})
        chosen = moved.get("texCoord", texture.get("texCoord", 0))
        if chosen or any(moved.get(k, v) != v for k, v in _UNMOVED.items()):
            raise SceneError(
                f"{path} has a color texture in a second set of coordinates, or moved or repeated by "
                "KHR_texture_transform, which is not supported; bake the texture (in Blender) and export it again"
            )


def primitives(header: dict[str, Any]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """A glTF file's runs of triangles, each with its material's reference to a color texture, or {}.

    :param header: its JSON part
    """
    found = []
    for primitive in (p for mesh in header.get("meshes", []) for p in mesh["primitives"]):
        if primitive.get("mode", 4) in _TRIANGLES:
            material = header["materials"][primitive["material"]] if "material" in primitive else {}
            found.append((primitive, _color_texture(material)))
    return found


def _color_texture(material: dict[str, Any]) -> dict[str, Any]:
    """A glTF material's reference to a color texture, or {}."""
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    metallic = material.get("pbrMetallicRoughness", {})
    reference: dict[str, Any] = glossy.get("diffuseTexture") or metallic.get("baseColorTexture") or {}
    return reference


def texture_uri(header: dict[str, Any], reference: dict[str, Any]) -> str | None:
    """Where the image of a glTF texture lies.

    :param header: a file's JSON part
    :param reference: to a texture, or {}
    :return: None for within the file, or where the file contradicts itself
    """
    try:
        texture = header["textures"][reference["index"]]
        others = [extension["source"] for extension in texture.get("extensions", {}).values() if "source" in extension]
        uri: str | None = header["images"][[*others, texture.get("source")][0]].get("uri")
    except (LookupError, TypeError):
        return None
    return uri


def lost_materials(kind: str, header: Any, libraries: list[bytes], missing: list[str]) -> Callable[[Any], bool]:
    """Whether a material shows no texture because the file of its texture is not there.

    :param kind: suffix of the scan, without its dot
    :param header: a glTF file's JSON part, else {}
    :param libraries: the contents of an OBJ file's material libraries
    :param missing: names of files that are not there, as the scan gives them
    :return: a function of trimesh's material
    """
    if not missing or kind == "ply" or any(name.lower().endswith(".mtl") for name in missing):
        return lambda material: bool(missing)
    names = {m.get("name") for m in header.get("materials", []) if texture_uri(header, _color_texture(m)) in missing}
    for line in b"\n".join(libraries).decode(errors="replace").splitlines():
        key, _, value = line.strip().partition(" ")
        if key.lower() == "newmtl":
            current = " ".join(value.split())
        elif key.lower() == "map_kd" and value.strip() in missing:
            names.add(current)
    return lambda material: material.name in names


def bare_name(name: str) -> str:
    """A file's name without folders, of this or another machine.

    :param name: as a scan gives it
    """
    return re.split(r"[/\\]", unquote(name.strip()))[-1]
