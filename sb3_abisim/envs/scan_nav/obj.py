"""Wavefront OBJ files: polygons with texture coordinates, and colors of vertices behind their coordinates."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import Budget, ScanFiles, SceneError
from sb3_abisim.envs.scan_nav.images import Images
from sb3_abisim.envs.scan_nav.mtl import Material, Texture, material_name, read_library
from sb3_abisim.envs.scan_nav.polygons import PolygonError, triangulate
from sb3_abisim.envs.scan_nav.surfaces import HALF_SEEN, Opacity, Part, Surface, each_number
from sb3_abisim.envs.scan_nav.vertex_colors import MISSING_COLOR, to_bytes

# Statements that change neither shapes nor colors: names of groups, normals, smoothing, rendering.
_HARMLESS = set(b"g o s mg vn l p bevel c_interp d_interp lod shadow_obj trace_obj".split())


class ObjFile:
    """Reads an OBJ file.

    :param path: of the scan
    :param files: those beside it
    :param images: decodes its textures
    :param budget: counts what is declared
    """

    def __init__(self, path: Path, files: ScanFiles, images: Images, budget: Budget) -> None:
        self._path, self._files, self._images, self._budget = path, files, images, budget
        self._positions: list[bytes] = []
        self._textured: list[bytes] = []
        self._faces: list[bytes] = []
        # Material of each face, and the numbers of vertices so far, from which negative ones are counted back.
        self._materials: list[int] = []
        self._so_far: list[tuple[int, int]] = []
        self._names: dict[str | None, int] = {None: 0}
        self._libraries: list[str] = []
        self.n_bare = 0
        self._any_gray = False
        self._lost_libraries: list[str] = []

    def parts(self) -> list[Part]:
        """The scan's parts, one per material, in the file's unit and axes.

        :raises SceneError: for what is not known to be read right
        """
        self._take_lines()
        materials = self._read_libraries()
        self._budget.add("vertices", len(self._positions) + len(self._textured))
        vertices, colors = self._vertices()
        coordinates = self._numbers(self._textured, (1, 2, 3), "texture coordinates")
        if not self._faces:
            return []
        corners, lengths = self._corners(len(vertices), len(coordinates))
        self._budget.add("faces", max(len(corners) - 2 * len(lengths), 0))
        names = {number: name for name, number in self._names.items()}
        # The last material first: of two faces in one plane, the one that is added last is seen.
        order = list(dict.fromkeys(self._materials))[::-1]
        rank = np.empty(len(names), dtype=np.int64)
        rank[order] = np.arange(len(order))
        starts = np.cumsum(lengths) - lengths
        textured = np.minimum.reduceat(corners[:, 1], starts) >= 0
        parts = []
        for key, faces in each_number(2 * rank[self._materials] + textured):
            n = lengths[faces]
            # Corners of the faces, one after the other.
            taken = np.arange(n.sum()) + np.repeat(starts[faces] - (np.cumsum(n) - n), n)
            material = self._material(names[order[key // 2]], materials)
            parts.append(self._part(corners[taken], n, vertices, colors, coordinates, material))
        if not self._any_gray:
            # Vertices have all the colors that there are; nobody misses a library.
            self._files.missing[:] = [name for name in self._files.missing if name not in self._lost_libraries]
        return parts

    def _bad(self, what: str) -> SceneError:
        return SceneError(f"{self._path} {what}")

    def _take_lines(self) -> None:
        data = self._path.read_bytes().removeprefix(b"\xef\xbb\xbf")
        if b"\0" in data[:4096]:
            raise self._bad("is not a text in UTF-8; download or export it again")
        if b"\r" in data:
            data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        if b"\\\n" in data:
            data = data.replace(b"\\\n", b" ")
        current = 0
        for line in data.split(b"\n"):
            if b"#" in line and not line.lstrip().startswith((b"mtllib", b"usemtl", b"g", b"o")):
                line = line[: line.index(b"#")]
            words = line.split(None, 1)
            if not words or words[0].startswith(b"#"):
                continue
            key, rest = words[0], words[1] if len(words) > 1 else b""
            if key == b"v":
                self._positions.append(rest)
            elif key == b"f":
                self._faces.append(rest)
                self._materials.append(current)
                self._so_far.append((len(self._positions), len(self._textured)))
            elif key == b"vt":
                self._textured.append(rest)
            elif key == b"usemtl":
                name = material_name(rest.decode("utf-8", errors="surrogateescape"))
                current = self._names.setdefault(name, len(self._names))
            elif key == b"mtllib":
                self._libraries.append(rest.decode("utf-8", errors="surrogateescape").strip())
            elif key not in _HARMLESS:
                raise self._bad(
                    f"has the statement {key[:40].decode(errors='replace')!r}, which is not supported; export it again "
                    "as polygons"
                )

    def _read_libraries(self) -> dict[str, Material]:
        """The materials of all libraries; one line may name several, and a name may hold blanks."""
        found: list[str] = []
        for text in self._libraries:
            for whole in ([text], text.split()):
                before = len(self._files.missing)
                whole = [name.strip("\"'") for name in whole]
                places = [self._files.find(name) for name in whole]
                if None not in places or len(whole) > 1 or len(text.split()) < 2:
                    break
                del self._files.missing[before:]
            found += [place for place in places if place is not None]
            self._lost_libraries += [name for name, place in zip(whole, places, strict=True) if place is None]
        materials: dict[str, Material] = {}
        for place in dict.fromkeys(found):
            for name, material in read_library(self._files, place).items():
                if name in materials:
                    raise self._bad(f"has two libraries with a material {name!r}; rename one")
                materials[name] = material
        return materials

    def _material(self, name: str | None, materials: dict[str, Material]) -> Material | None:
        """The material of that name. Without any name a single material is meant, MeshLab's habit."""
        if name is None:
            return next(iter(materials.values())) if len(materials) == 1 else None
        return materials.get(name)

    def _numbers(self, lines: list[bytes], allowed: tuple[int, ...], what: str) -> NDArray[np.float64]:
        """Lines of equally many numbers each as an array; lines with less are filled with nan."""
        if not lines:
            return np.zeros((0, max(allowed)))
        counts = np.fromiter(map(len, map(bytes.split, lines)), dtype=np.int64, count=len(lines))
        present = np.unique(counts).tolist()
        if not set(present) <= set(allowed):
            raise self._bad(
                f"has {what} of {present[-1]} numbers, not {' or '.join(map(str, allowed))}; export it again"
            )
        values = np.full((len(lines), max(present)), np.nan)
        for count in present:
            chosen = np.flatnonzero(counts == count)
            rows = lines if len(present) == 1 else [lines[k] for k in chosen.tolist()]
            try:
                values[chosen, :count] = np.array(_numerals(rows), dtype=np.float64).reshape(-1, count)
            except ValueError as error:
                raise self._bad(f"has {what} that are not numbers ({error}); export it again") from error
        return values

    def _vertices(self) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
        """Positions, and colors in 0..255 with nan where a vertex has none."""
        values = self._numbers(self._positions, (3, 4, 6), "vertices")
        # A fourth number is a weight; of six, three are a color.
        weights = values[np.isnan(values[:, 4:]).all(axis=1), 3] if values.shape[1] > 3 else np.ones(0)
        if (weights[~np.isnan(weights)] != 1).any():
            raise self._bad("has vertices with a weight other than 1, which programs read in two ways; export it again")
        if values.shape[1] < 6:
            return values[:, :3], None
        colors = values[:, 3:]
        colors[np.isnan(colors).any(axis=1)] = np.nan
        return values[:, :3], to_bytes(colors, f"{self._path}: the colors of vertices")

    def _corners(self, n_vertices: int, n_coordinates: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Vertex and texture coordinate (or -1) of every corner, (n, 2), and the number of each face's corners."""
        lengths = np.fromiter(map(len, map(bytes.split, self._faces)), dtype=np.int64, count=len(self._faces))
        if lengths.min() < 3:
            raise self._bad(f"has a face of {lengths.min()} corners; export it again")
        corners = np.zeros((int(lengths.sum()), 2), dtype=np.int64)
        try:
            tokens = _numerals(self._faces)
            slashes = {token.count(b"/") for token in tokens}
            if max(slashes) > 2:
                raise ValueError("a corner of more than three")
            if slashes == {0}:
                corners[:, 0] = np.array(tokens, dtype=np.int64)
            elif len(slashes) == 1 and slashes <= {1, 2} and not any(token.endswith(b"/") for token in tokens):
                text = b" ".join(tokens).replace(b"//", b"/0/").replace(b"/", b" ")
                corners = np.array(text.split(), dtype=np.int64).reshape(len(tokens), -1)[:, :2].copy()
            else:
                for k, token in enumerate(tokens):
                    numbers = token.split(b"/")[:2]
                    corners[k, : len(numbers)] = [int(number or b"0") for number in numbers]
        except ValueError as error:
            raise self._bad(f"has a face that is not whole numbers ({error}); export it again") from error
        if (corners < 0).any():
            so_far = np.repeat(np.array(self._so_far), lengths, axis=0)
            corners = np.where(corners < 0, so_far + corners + 1, corners)
        if corners[:, 0].min() < 1 or (corners.max(axis=0) > (n_vertices, n_coordinates)).any() or corners.min() < 0:
            raise self._bad(
                f"has a face with a corner that is not there; it has {n_vertices} vertices and {n_coordinates} texture "
                "coordinates; download or export it again"
            )
        return corners - 1, lengths

    def _part(
        self,
        corners: NDArray[np.int64],
        lengths: NDArray[np.int64],
        vertices: NDArray[np.float64],
        colors: NDArray[np.float32] | None,
        coordinates: NDArray[np.float64],
        material: Material | None,
    ) -> Part:
        try:
            triangles, _ = triangulate(vertices[corners[:, 0]], lengths)
        except PolygonError as error:
            raise SceneError(f"{self._path}: {error}") from error
        faces, n = corners[triangles, 0], len(triangles)
        used, kept = np.unique(faces, return_inverse=True)
        part = vertices[used], kept.reshape(-1, 3)
        alpha = np.full((n, 3), 1.0 if material is None else material.alpha, dtype=np.float32)
        cutoff = HALF_SEEN if material is not None and (material.alpha < 1 or material.alpha_texture) else None
        opacity = None if cutoff is None else Opacity(cutoff, alpha)
        texture = None if material is None else material.texture
        uv = corners[triangles, 1]
        if texture is not None and texture.found is not None and (uv >= 0).any():
            if (uv < 0).any():
                raise self._bad("has faces with texture coordinates at some of their corners; export it again")
            return (*part, self._textured_surface(texture, material, coordinates[uv][..., :2], opacity))
        return (*part, Surface(n, None, self._plain(faces, colors, material), opacity=opacity))

    def _textured_surface(
        self, texture: Texture, material: Any, where: NDArray[np.float64], opacity: Opacity | None
    ) -> Surface:
        assert texture.found is not None
        if np.isnan(where).any():
            raise self._bad("has a texture whose coordinates are no pairs of numbers; export it again")
        rgb, _ = self._images.read(texture.found)
        if opacity is not None and material.alpha_texture is not None:
            opacity = Opacity(opacity.cutoff, opacity.alpha, self._veil(material.alpha_texture, texture, rgb.shape[:2]))
        if texture.scale != (1.0, 1.0) or texture.offset != (0.0, 0.0):
            where = where * texture.scale + texture.offset
        # Many OBJ exporters write a gray or black Kd beside the texture and mean the texture alone.
        return Surface(len(where), rgb, where.astype(np.float32), wrap=texture.wrap, opacity=opacity)

    def _veil(self, veil: Texture, texture: Texture, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """The alpha of a texture by its map_d, which mostly is the same file."""
        if veil.found is None:
            raise self._bad(f"refers to {veil.name}, its transparency, which is not there; put it beside the scan")
        rgb, alpha = self._images.read(veil.found)
        if (veil.offset, veil.scale, veil.wrap) != (texture.offset, texture.scale, texture.wrap) or rgb.shape[
            :2
        ] != shape:
            raise self._bad(f"has a map_d {veil.name} of another size or place than its texture; save them alike")
        if veil.found == texture.found and alpha is None:
            return np.broadcast_to(np.uint8(255), shape)
        return self._images.veil(veil.found)

    def _plain(
        self, faces: NDArray[np.int64], colors: NDArray[np.float32] | None, material: Material | None
    ) -> NDArray[np.float32]:
        """Colors of the corners of faces without a texture: those of vertices, else the material's, else gray."""
        lost = material is not None and material.texture is not None and material.texture.found is None
        # A face without coordinates shows no texture; the color beside one is mostly a leftover.
        base = None if material is None or material.texture is not None else material.color
        known = None if colors is None or lost else ~np.isnan(colors[faces][..., 0])
        if base is None and not lost and (known is None or not known.any()):
            # What has a library that is not there has been said already.
            self.n_bare += not self._lost_libraries
        plain = np.array(MISSING_COLOR, dtype=np.float32) if base is None else base
        self._any_gray |= base is None and (known is None or not known.all())
        shown = np.broadcast_to(plain, (*faces.shape, 3))
        return shown if known is None else np.where(known[..., None], colors[faces], shown)  # type: ignore[index]


def _numerals(lines: list[bytes]) -> list[bytes]:
    """The words of all lines. Python takes 1_0 for ten, other programs for one."""
    text = b" ".join(lines)
    if b"_" in text:
        raise ValueError("a '_' within one")
    return text.split()
