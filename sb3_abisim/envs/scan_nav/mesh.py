"""Scan files as triangles with colors: everything that can be wrong with a file is found here.

A :class:`ScanMesh` is z-up, in meters. Files are read by trimesh (``pip install 'sb3_abisim[scan]'``).
"""

import io
import os
import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.files import file_hash
from sb3_abisim.envs.scan_nav.files import SceneError, bare_name, check_file, lost_materials, primitives, texture_uri

UP_AXES = ("auto", "y", "z")
MISSING_COLOR = (160, 160, 160)
# Heights are counted in bins of this many meters.
LEVEL_BIN = 0.05
MIN_LEVEL_AREA = 1.5  # m2
MIN_UP_RATIO = 1.25
# A face is level where its unit normal's vertical part is above this.
_LEVEL_NORMAL = 0.9
_EXTENT = (1.0, 200.0)  # m
_REEXPORT = "export it again with PNG or JPEG textures of at most 8192 x 8192 pixels"  # Pillow refuses far larger ones
_COLORED_VERTEX = re.compile(rb"^v(?:[ \t]+[-+.\deE]+){6}[ \t\r]*$", re.MULTILINE)  # of an OBJ file
_TEXTURE_VERTEX = re.compile(rb"^vt[ \t].*$", re.MULTILINE)


@dataclass(frozen=True)
class Surface:
    """A run of faces that share one kind of coloring.

    :param n_faces: their number
    :param texture: uint8 (height, width, 3), or None
    :param coordinates: with a texture, (n_faces, 3, 2) of its u to the right and v upwards, 1 being its whole size, for
        the three corners of each face; without one, their colors (n_faces, 3, 3) in 0..255
    """

    n_faces: int
    texture: NDArray[np.uint8] | None
    coordinates: NDArray[np.float32]


@dataclass(frozen=True)
class ScanMesh:
    """Triangles with colors, z up, in meters.

    :param vertices: float64 (n, 3)
    :param faces: int64 (m, 3), counter-clockwise seen from outside
    :param surfaces: how the faces are colored, in their order
    :param files: what was read: path relative to the scan's folder, to its sha256, or to "" for a missing file
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    surfaces: tuple[Surface, ...]
    files: dict[str, str]

    def corners(self) -> NDArray[np.float64]:
        """The corners of each face, shape (m, 3, 3)."""
        return self.vertices[self.faces]


def load_mesh(path: str | os.PathLike[str], up: str = "auto") -> ScanMesh:
    """Read a scan.

    :param path: a .glb, .gltf, .obj or .ply file with textures or vertex colors
    :param up: the file's upward axis, "y" or "z"; "auto" takes the one with the larger horizontal floor
    :raises SceneError: for whatever is wrong with the file
    :raises ImportError: without trimesh
    """
    path = Path(path)
    if up not in UP_AXES:
        raise ValueError(f"up must be one of {UP_AXES}, got {up!r}")
    parts, files = _read(path, check_file(path))
    vertices, faces, surfaces = [], [], []
    n_vertices = 0
    for part_vertices, part_faces, surface in parts:
        vertices.append(part_vertices)
        faces.append(part_faces + n_vertices)
        surfaces.append(surface)
        n_vertices += len(part_vertices)
    mesh = ScanMesh(np.concatenate(vertices), np.concatenate(faces), tuple(surfaces), files)
    if not np.isfinite(mesh.vertices).all():
        raise SceneError(f"{path} has vertices that are not finite; export it again from its source")
    extent = np.ptp(mesh.vertices, axis=0).max()
    if not _EXTENT[0] <= extent <= _EXTENT[1]:
        raise SceneError(
            f"{path} is {extent:.3g} m wide, not between {_EXTENT[0]:g} and {_EXTENT[1]:g} m; its units are probably "
            "not meters: rescale it"
        )
    return _turn_upright(path, mesh, up)


_Part = tuple[NDArray[np.float64], NDArray[np.int64], Surface]


def _read(path: Path, header: Any) -> tuple[list[_Part], dict[str, str]]:
    try:
        import trimesh
    except ImportError as error:
        raise ImportError("reading scans needs trimesh: pip install 'sb3_abisim[scan]'") from error

    kind = path.suffix[1:].lower()
    files = {path.name: file_hash(path)}
    missing: list[str] = []
    damaged: list[str] = []
    libraries: list[bytes] = []  # of an OBJ file's materials

    class Recorder(trimesh.resolvers.FilePathResolver):  # type: ignore[misc, unused-ignore]
        def get(self, name: str) -> bytes:
            # glTF writes a space as %20. Exporters write paths of another machine: then the file beside the scan.
            # Nothing outside of the scan's folder is read.
            folder = path.parent.resolve()
            candidates = [name.strip(), unquote(name.strip()), bare_name(name)]
            candidates = [each for each in candidates if (folder / each).resolve().is_relative_to(folder)]
            for candidate in candidates:
                file = folder / candidate
                if file.is_file():
                    files[candidate] = file_hash(file)
                    data = file.read_bytes()
                    if file.suffix.lower() == ".mtl":
                        libraries.append(data)
                    if kind in ("obj", "ply") and file.suffix.lower() != ".mtl" and not _is_image(data):
                        damaged.append(candidate)
                    return data
            # Wherever it appears, it is noticed.
            files.update(dict.fromkeys(candidates, ""))
            missing.append(name)
            raise FileNotFoundError(name)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            load = partial(trimesh.load_scene, file_type=kind, resolver=Recorder(str(path)), process=False)
            scene = _load(path.read_bytes(), kind, load, missing)
            lost = lost_materials(kind, header, libraries, missing)
            parts = _parts(scene, trimesh, lost)
    except Exception as error:  # what trimesh raises for a damaged file depends on where the damage is
        absent = f"; it refers to {missing[0]}, which is not there" if missing else ""
        raise SceneError(f"{path} cannot be read ({type(error).__name__}: {error}){absent}; export it again") from error
    warn_missing(path, missing)
    if damaged:
        raise SceneError(f"{path}: the texture {damaged[0]} cannot be decoded; {_REEXPORT}")
    _check_colors(path, header, _visuals(scene), lost, missing)
    if not parts:
        found = "a point cloud" if any(len(getattr(g, "vertices", ())) for g in scene.geometry.values()) else "empty"
        raise SceneError(f"{path} is {found}: it has no faces; export the scan as a mesh of triangles")
    return parts, files


def _check_colors(path: Path, header: Any, visuals: list[Any], lost: Callable[[Any], bool], missing: list[str]) -> None:
    """Refuse textures that trimesh has passed over in silence, and warn of parts without any color."""
    n_textured = sum(
        bool(texture) and "TEXCOORD_0" in primitive["attributes"] and texture_uri(header, texture) not in missing
        for primitive, texture in primitives(header)
    )
    if (n_damaged := n_textured - sum(map(_shows_texture, visuals))) > 0:
        raise SceneError(f"{path}: the textures of {n_damaged} of {n_textured} parts cannot be decoded; {_REEXPORT}")
    if n_bare := sum(_is_bare(visual) and not _has_lost(visual, lost) for visual in visuals):
        warnings.warn(f"{path}: {n_bare} of {len(visuals)} parts have no color and are shown gray", stacklevel=4)


def _is_image(data: bytes) -> bool:
    from PIL import Image

    try:
        Image.open(io.BytesIO(data))
    except (OSError, Image.DecompressionBombError):
        return False
    return True


def _load(data: bytes, kind: str, load: Callable[..., Any], missing: list[str]) -> Any:
    """trimesh's scene, in which an OBJ file's vertices keep their colors unless it shows a texture."""
    if kind != "obj" or not _COLORED_VERTEX.search(data):
        return load(io.BytesIO(data))
    # trimesh takes materials and texture coordinates for all there is; MeshLab writes them beside vertices' colors.
    bare = _TEXTURE_VERTEX.sub(b"", data)
    if bare != data:
        scene = load(io.BytesIO(data))
        if missing or any(map(_shows_texture, _visuals(scene))):
            return scene
    return load(io.BytesIO(bare), skip_materials=True)


def _visuals(scene: Any) -> list[Any]:
    return [geometry.visual for geometry in scene.geometry.values() if hasattr(geometry, "faces")]


def _shows_texture(visual: Any) -> bool:
    return visual.kind == "texture" and visual.uv is not None and _material(visual.material)[0] is not None


def _is_bare(visual: Any) -> bool:
    if visual.kind != "texture" or hasattr(visual.material, "baseColorFactor"):
        return visual.kind is None
    return _material(visual.material)[0] is None and "kd" not in visual.material.kwargs


def _has_lost(visual: Any, lost: Callable[[Any], bool]) -> bool:
    return visual.kind == "texture" and lost(visual.material)


def warn_missing(source: str | os.PathLike[str], names: Iterable[str]) -> None:
    """Warn which files of a scan are not there, if any.

    :param source: the scan
    :param names: of the files that it refers to
    """
    # One file may have been looked for in several places.
    if missing := sorted(set(map(bare_name, names))):
        warnings.warn(
            f"{source} refers to {', '.join(missing)}, which is not there (in the scan's folder); what it covers gets "
            "a plain color",
            stacklevel=4,
        )


def _parts(scene: Any, trimesh: Any, lost: Callable[[Any], bool]) -> list[_Part]:
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        vertices = trimesh.transform_points(geometry.vertices, transform)
        faces = np.asarray(geometry.faces, dtype=np.int64)
        # A mirrored part would be seen from the inside.
        if np.linalg.det(transform[:3, :3]) < 0:
            faces = faces[:, ::-1]
        parts.append((np.asarray(vertices, dtype=np.float64), faces, _surface(geometry.visual, faces, lost)))
    return parts


def _surface(visual: Any, faces: NDArray[np.int64], lost: Callable[[Any], bool]) -> Surface:
    if visual.kind == "texture":
        image, factor = _material(visual.material)
        if image is not None and visual.uv is not None:
            pixels = np.asarray(image.convert("RGB"), dtype=np.float32) * (factor / 255)
            texture = np.rint(pixels).astype(np.uint8)
            return Surface(len(faces), texture, np.asarray(visual.uv, dtype=np.float32)[faces])
        # An untextured material has a color, unless it has lost its texture.
        # glTF multiplies it by the vertices' colors.
        colors = visual.vertex_attributes.get("color")
        if colors is not None and not lost(visual.material):
            largest = np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1.0
            shown = np.asarray(colors, dtype=np.float32)[:, :3] / np.float32(largest) * factor
            return Surface(len(faces), None, shown[faces])
        plain = np.array(MISSING_COLOR if lost(visual.material) else factor, dtype=np.float32)
        return Surface(len(faces), None, np.broadcast_to(plain, (len(faces), 3, 3)))
    if visual.kind == "vertex":
        return Surface(len(faces), None, np.asarray(visual.vertex_colors, dtype=np.float32)[faces][..., :3])
    if visual.kind == "face":
        colors = np.asarray(visual.face_colors, dtype=np.float32)[:, None, :3]
        return Surface(len(faces), None, np.broadcast_to(colors, (len(faces), 3, 3)))
    plain = np.array(MISSING_COLOR, dtype=np.float32)
    return Surface(len(faces), None, np.broadcast_to(plain, (len(faces), 3, 3)))


def _material(material: Any) -> tuple[Any, NDArray[np.float32]]:
    """Image and base color (0..255, as shown on a screen) of a glTF or OBJ material."""
    if hasattr(material, "baseColorFactor"):
        factor, image = material.baseColorFactor, material.baseColorTexture
        if factor is None:
            return image, np.full(3, 255, dtype=np.float32)
        linear = np.asarray(factor, dtype=np.float32)[:3] / 255
        # glTF's factors are linear light.
        return image, (255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.float32)
    # trimesh gives coordinates without a material a gray image, which has no file format.
    if material.image is not None and material.image.format:
        # Many OBJ exporters write a gray or black Kd beside the texture and mean the texture alone.
        return material.image, np.full(3, 255, dtype=np.float32)
    # trimesh's diffuse color is another gray where the file has none.
    return None, np.array(material.diffuse[:3] if "kd" in material.kwargs else MISSING_COLOR, dtype=np.float32)


def level_areas(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How much level, up-facing area there is at which height.

    :param corners: of the faces, (m, 3, 3), z up
    :return: the bins' middle heights in m, and areas in m2 of each bin together with its two neighbors
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    level = normals[:, 2] > _LEVEL_NORMAL * length
    heights = corners[level, :, 2].mean(axis=1)
    if not len(heights):
        return np.zeros(1), np.zeros(1)
    bins = np.floor(heights / LEVEL_BIN).astype(np.int64)
    first = bins.min() - 1
    areas = np.bincount(bins - first, normals[level, 2] / 2, minlength=bins.max() - first + 2)
    return (np.arange(len(areas)) + first + 0.5) * LEVEL_BIN, np.convolve(areas, np.ones(3), mode="same")


def _turn_upright(path: Path, mesh: ScanMesh, up: str) -> ScanMesh:
    turned = {"z": mesh.vertices, "y": mesh.vertices[:, [0, 2, 1]] * (1, -1, 1)}
    if up == "auto":
        areas = {axis: level_areas(vertices[mesh.faces])[1].max() for axis, vertices in turned.items()}
        up, other = sorted(areas, key=lambda axis: -areas[axis])
        if areas[up] >= MIN_LEVEL_AREA and areas[up] < MIN_UP_RATIO * areas[other]:
            raise SceneError(
                f"{path} could stand on either side: level areas of {areas['y']:.1f} m2 with y up and "
                f"{areas['z']:.1f} m2 with z up; give up='y' or up='z'"
            )
    area = level_areas(turned[up][mesh.faces])[1].max()
    if area < MIN_LEVEL_AREA:
        raise SceneError(
            f"{path} has no floor: its largest horizontal level has {area:.2f} m2 with {up} up, less than "
            f"{MIN_LEVEL_AREA} m2; turn it so that gravity points along an axis, and check its units (meters)"
        )
    return ScanMesh(turned[up], mesh.faces, mesh.surfaces, mesh.files)
