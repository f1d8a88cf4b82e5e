"""PLY files: polygons, with colors on vertices or faces, or with textures and their coordinates on either.

An alpha beside the colors is not read: programs write anything there, and show the surface as solid.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import Budget, ScanFiles, SceneError
from sb3_abisim.envs.scan_nav.images import Images
from sb3_abisim.envs.scan_nav.ply_elements import Element, read_ply
from sb3_abisim.envs.scan_nav.polygons import PolygonError, triangulate
from sb3_abisim.envs.scan_nav.surfaces import Part, Surface, each_number
from sb3_abisim.envs.scan_nav.vertex_colors import MISSING_COLOR, to_bytes

_INDICES = ("vertex_indices", "vertex_index")
# Usual names of colors and of texture coordinates.
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("tx", "ty"))
# Elements without surfaces.
_HARMLESS = ("edge", "camera")


class PlyFile:
    """Reads a PLY file.

    :param path: of the scan
    :param files: those beside it
    :param images: decodes its textures
    :param budget: counts what is declared
    """

    def __init__(self, path: Path, files: ScanFiles, images: Images, budget: Budget) -> None:
        self._path, self._files, self._images, self._budget = path, files, images, budget
        self.n_bare = 0
        # Names of properties whose meaning is not known here, for the message about a scan without colors.
        self.unknown: list[str] = []

    def parts(self) -> list[Part]:
        """The scan's parts, one per texture, in the file's unit and axes.

        :raises SceneError: for what is not known to be read right
        """
        comments, elements = read_ply(self._path, self._path.read_bytes(), self._budget)
        names = [c.split(None, 1)[1] for c in comments if c.lower().startswith("texturefile ")]
        if other := [name for name, e in elements.items() if e.count and name not in ("vertex", "face", *_HARMLESS)]:
            raise self._bad(f"has the element {other[0]!r}, which is not supported; export it again as faces")
        vertex, face = elements.get("vertex"), elements.get("face")
        if vertex is None or face is None or not face.count:
            return []
        if missing := [axis for axis in "xyz" if axis not in vertex.columns]:
            raise self._bad(f"has vertices without {', '.join(missing)}; export it again")
        vertices = np.stack([vertex.columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        key = next((name for name in _INDICES if name in face.lists), None)
        if key is None:
            raise self._bad(f"has faces without {' or '.join(_INDICES)}; export it again")
        corners, lengths = face.lists[key]
        corners = self._whole(corners, len(vertices))
        self._budget.add("faces", max(len(corners) - 2 * len(lengths), 0))
        try:
            triangles, owners = triangulate(vertices[corners], lengths)
        except PolygonError as error:
            raise SceneError(f"{self._path}: {error}") from error
        if not len(triangles):
            return []
        faces = corners[triangles]
        colors = self._colors(vertex, face, faces, owners)
        where = self._coordinates(vertex, face, corners, lengths, triangles) if names else None
        if where is None:
            return [(vertices, faces, self._plain(colors, vertex, face, len(faces)))]
        return self._textured(names, vertices, faces, owners, where, colors, face)

    def _bad(self, what: str) -> SceneError:
        return SceneError(f"{self._path} {what}")

    def _whole(self, corners: NDArray[Any], n_vertices: int) -> NDArray[np.int64]:
        if corners.dtype.kind not in "iu":
            raise self._bad("has faces whose corners are not whole numbers; export it again")
        indices = corners.astype(np.int64)
        if len(indices) and not 0 <= indices.min() <= indices.max() < n_vertices:
            raise self._bad(
                f"has a face with a corner that is not there, of {n_vertices} vertices; download or export it again"
            )
        return indices

    def _colors(
        self, vertex: Element, face: Element, faces: NDArray[np.int64], owners: NDArray[np.int64]
    ) -> NDArray[np.float32] | None:
        """Colors in 0..255 of the corners of triangles, or None.

        Of vertices and faces, those count that differ from one another; both cannot be shown.
        """
        of_vertices, of_faces = self._channels(vertex, "vertices"), self._channels(face, "faces")
        if of_vertices is not None and of_faces is not None:
            vary = [bool((each != each[:1]).any()) for each in (of_vertices, of_faces)]
            if all(vary):
                raise self._bad(
                    "has different colors on its vertices and on its faces, and which are meant is not known; delete "
                    "one of them (MeshLab: Filters, Color)"
                )
            if vary[1]:
                of_vertices = None
        if of_vertices is not None:
            return of_vertices[faces]
        return None if of_faces is None else np.broadcast_to(of_faces[owners][:, None], (len(faces), 3, 3))

    def _channels(self, element: Element, what: str) -> NDArray[np.float32] | None:
        for names in _COLORS:
            if all(name in element.columns for name in names):
                columns = [element.columns[name] for name in names]
                if len({column.dtype for column in columns}) > 1:
                    raise self._bad(f"has colors of {what} of several types; export it again")
                if not all(np.isfinite(column).all() for column in columns):
                    raise self._bad(f"has colors of {what} that are not finite; export it again")
                return to_bytes(np.stack(columns, axis=1), f"{self._path}: the colors of {what}")
        return None

    def _coordinates(
        self,
        vertex: Element,
        face: Element,
        corners: NDArray[np.int64],
        lengths: NDArray[np.int64],
        triangles: NDArray[np.int64],
    ) -> NDArray[np.float32] | None:
        """Texture coordinates of the corners of triangles, nan where a face has none; None without any."""
        if "texcoord" in face.lists:
            values, counts = face.lists["texcoord"]
            self._fractions(values)
            if ((counts != 2 * lengths) & (counts != 0)).any():
                raise self._bad("has faces with other numbers of texture coordinates than corners; export it again")
            filled = np.full((len(corners), 2), np.nan, dtype=np.float32)
            filled[np.repeat(counts > 0, lengths)] = values.reshape(-1, 2)
            return filled[triangles]
        for u, v in _COORDINATES:
            if u in vertex.columns and v in vertex.columns:
                self._fractions(vertex.columns[u])
                self._fractions(vertex.columns[v])
                of_vertices = np.stack([vertex.columns[u], vertex.columns[v]], axis=1).astype(np.float32)
                return of_vertices[corners[triangles]]
        return None

    def _fractions(self, coordinates: NDArray[Any]) -> None:
        """Whole numbers may be pixels, or shares of their largest number."""
        if coordinates.dtype.kind != "f":
            raise self._bad(
                f"has coordinates of a texture of the type {coordinates.dtype.name}, and their unit is not known; "
                "export them as floats in 0..1"
            )

    def _textured(
        self,
        names: list[str],
        vertices: NDArray[np.float64],
        faces: NDArray[np.int64],
        owners: NDArray[np.int64],
        where: NDArray[np.float32],
        colors: NDArray[np.float32] | None,
        face: Element,
    ) -> list[Part]:
        """One part per texture; faces without one (texnumber -1) keep their colors."""
        if "texnumber" in face.columns:
            given = face.columns["texnumber"][owners]
            number = given.astype(np.int64)
            if (number != given).any():
                raise self._bad("has faces whose texnumber is not whole; export it again")
        elif len(names) == 1:
            number = np.zeros(len(faces), dtype=np.int64)
        else:
            raise self._bad(f"has {len(names)} textures and does not say which face has which; export it again")
        if number.max() >= len(names):
            raise self._bad(f"has a face with the texture {number.max()} of {len(names)}; export it again")
        number = np.where(np.isnan(where).any(axis=(1, 2)), -1, number)
        parts: list[Part] = []
        for k, mine in each_number(np.maximum(number, -1)):
            found = self._files.find(names[k].strip("\"' ")) if k >= 0 else None
            if found is not None:
                surface = Surface(len(mine), self._images.read(found)[0], where[mine])
            elif k >= 0 or colors is None:
                self.n_bare += k < 0
                surface = Surface(len(mine), None, _gray(len(mine)))
            else:
                surface = Surface(len(mine), None, colors[mine])
            parts.append((vertices, faces[mine], surface))
        return parts

    def _plain(self, colors: NDArray[np.float32] | None, vertex: Element, face: Element, n: int) -> Surface:
        if colors is not None:
            return Surface(n, None, colors)
        self.n_bare += 1
        known = {
            *"xyz",
            "nx",
            "ny",
            "nz",
            "texnumber",
            "flags",
            "quality",
            "confidence",
            "alpha",
            *sum(_COORDINATES, ()),
        }
        self.unknown = [name for e in (vertex, face) for name in e.columns if name not in known]
        return Surface(n, None, _gray(n))


def _gray(n: int) -> NDArray[np.float32]:
    return np.broadcast_to(np.array(MISSING_COLOR, dtype=np.float32), (n, 3, 3))
