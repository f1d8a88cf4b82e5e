"""Scan files as triangles with colors: everything that can be wrong with a file is found here.

A :class:`ScanMesh` is z-up, in meters. Files are read by our own readers, which take what they know
and refuse everything else (docs/scan_files.md); trimesh is a second reader in the tests.
"""

import os
import struct
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import Budget, ScanFiles, SceneError, check_file
from sb3_abisim.envs.scan_nav.gltf import GltfScene
from sb3_abisim.envs.scan_nav.gltf_file import GltfFile
from sb3_abisim.envs.scan_nav.images import Images
from sb3_abisim.envs.scan_nav.obj import ObjFile
from sb3_abisim.envs.scan_nav.ply import PlyFile
from sb3_abisim.envs.scan_nav.surfaces import Part, Surface, turned_over, without_nothing
from sb3_abisim.envs.scan_nav.upright import UP_AXES, turn_upright

_EXTENT = (1.0, 200.0)  # m
# What reading a damaged file may end in, by where the damage is.
_DAMAGE = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, OSError, struct.error)


@dataclass(frozen=True)
class ScanMesh:
    """Triangles with colors, z up, in meters.

    :param vertices: float64 (n, 3)
    :param faces: int64 (m, 3), counter-clockwise seen from outside
    :param surfaces: how the faces are colored, in their order
    :param files: what was read: path relative to the scan's folder, to its sha256, or to "" for a missing file
    :param notes: what was understood and done, JSON types: ``up``, ``lean`` in degrees, ``textures``,
        ``texture_factor``, ``transparent_faces``
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    surfaces: tuple[Surface, ...]
    files: dict[str, str]
    notes: dict[str, str | float | int] = field(default_factory=dict)

    def corners(self) -> NDArray[np.float64]:
        """The corners of each face, shape (m, 3, 3)."""
        return self.vertices[self.faces]


def load_mesh(
    path: str | os.PathLike[str], up: str = "auto", meters_per_unit: float = 1.0, flip_faces: bool = False
) -> ScanMesh:
    """Read a scan.

    :param path: a .glb, .gltf, .obj or .ply file with textures or vertex colors
    :param up: the file's upward axis, "x", "y", "z", or one of these with a minus; "auto" takes "y" or "z", by the
        larger horizontal floor
    :param meters_per_unit: the file's unit
    :param flip_faces: whether the faces show their backs, as those of a mirrored scan do
    :raises SceneError: for whatever is wrong with the file
    """
    path = Path(path)
    if up not in UP_AXES:
        raise ValueError(f"up must be one of {', '.join(UP_AXES)}, got {up!r}")
    check_file(path)
    files = ScanFiles(path)
    try:
        parts, notes = _read(path, files)
    except SceneError:
        raise
    except RecursionError as error:
        raise SceneError(f"{path} cannot be read: it is nested too deeply; export it again") from error
    except MemoryError as error:
        raise SceneError(f"{path} needs more memory than there is; decimate the scan") from error
    except _DAMAGE as error:
        raise SceneError(f"{path} cannot be read ({type(error).__name__}: {error}); export it again") from error
    files.warn_missing()
    mesh = _joined(path, parts, files, notes)
    if not np.isfinite(mesh.vertices).all():
        raise SceneError(f"{path} has vertices that are not finite; export it again from its source")
    vertices = mesh.vertices if meters_per_unit == 1 else mesh.vertices * meters_per_unit
    extent = np.ptp(vertices, axis=0).max()
    if not _EXTENT[0] <= extent <= _EXTENT[1]:
        raise SceneError(
            f"{path} is {extent:.3g} m wide, not between {_EXTENT[0]:g} and {_EXTENT[1]:g} m; its units are probably "
            "not meters: rescale it, or give meters_per_unit"
        )
    if flip_faces:
        mesh = _flipped(mesh)
    vertices, chosen, lean = turn_upright(path, vertices, mesh.faces, up)
    return ScanMesh(vertices, mesh.faces, mesh.surfaces, mesh.files, {**mesh.notes, "up": chosen, "lean": lean})


@dataclass
class _Reading:
    """A scan as its format's reader gives it.

    :param images: its textures
    :param parts: its parts
    :param n_points: points and lines, which are no surface
    :param n_bare: parts without any color
    :param unknown: properties whose meaning is not known
    """

    images: Images
    parts: list[Part]
    n_points: int
    n_bare: int
    unknown: list[str]


def _read(path: Path, files: ScanFiles) -> tuple[list[Part], dict[str, str | float | int]]:
    reading = _read_once(path, files, 1)
    if (factor := reading.images.least_factor()) > 1:
        # Its textures are smaller this time. Nothing of the first reading is kept meanwhile.
        del reading
        files.missing.clear()
        reading = _read_once(path, files, factor)
        assert reading.images.least_factor() == 1
    parts, n_bare, unknown = reading.parts, reading.n_bare, reading.unknown
    if not parts:
        found = "a point cloud" if reading.n_points else "empty"
        raise SceneError(f"{path} is {found}: it has no faces; export the scan as a mesh of triangles")
    if n_bare:
        hint = f" (it has {', '.join(unknown)}, whose meaning is not known)" if unknown else ""
        warnings.warn(f"{path}: {n_bare} of {len(parts)} parts have no color and are shown gray{hint}", stacklevel=5)
    return parts, {"textures": reading.images.n_decoded, "texture_factor": factor}


def _read_once(path: Path, files: ScanFiles, factor: int) -> _Reading:
    budget = Budget(path)
    images = Images(files, budget, factor)
    suffix = path.suffix.lower()
    if suffix == ".obj":
        obj = ObjFile(path, files, images, budget)
        return _Reading(images, obj.parts(), 1, obj.n_bare, [])
    if suffix == ".ply":
        ply = PlyFile(path, files, images, budget)
        return _Reading(images, ply.parts(), 1, ply.n_bare, ply.unknown)
    gltf = GltfScene(GltfFile(path, files, budget), images)
    return _Reading(images, gltf.parts(), gltf.n_points, gltf.n_bare, [])


def _joined(path: Path, parts: list[Part], files: ScanFiles, notes: dict[str, str | float | int]) -> ScanMesh:
    """All parts but what one sees through everywhere."""
    n_faces = sum(len(faces) for _, faces, _ in parts)
    solid = [part for each in parts if (part := without_nothing(each)) is not None]
    if not solid:
        raise SceneError(f"{path} is transparent everywhere; make its materials opaque and export it again")
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in solid)])
    faces = np.concatenate([faces + start for (_, faces, _), start in zip(solid, starts[:-1], strict=True)])
    kept: dict[str, str | float | int] = {**notes, "faces": len(faces), "transparent_faces": n_faces - len(faces)}
    vertices = np.concatenate([vertices for vertices, _, _ in solid])
    return ScanMesh(vertices, faces, tuple(surface for _, _, surface in solid), files.hashes, kept)


def _flipped(mesh: ScanMesh) -> ScanMesh:
    return ScanMesh(mesh.vertices, mesh.faces[:, ::-1], tuple(map(turned_over, mesh.surfaces)), mesh.files, mesh.notes)
