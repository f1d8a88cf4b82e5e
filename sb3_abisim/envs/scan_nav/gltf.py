"""glTF 2.0 scenes as triangles: nodes, instances, and the parts of meshes in any of the forms that hold triangles."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.gltf_file import GltfFile
from sb3_abisim.envs.scan_nav.gltf_material import Look, plain_look, read_look, read_texture
from sb3_abisim.envs.scan_nav.images import Image, Images
from sb3_abisim.envs.scan_nav.polygons import fan, strip
from sb3_abisim.envs.scan_nav.surfaces import Opacity, Part, Surface, turned_over

MISSING_COLOR = (160, 160, 160)
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


class GltfScene:
    """Reads the parts of a scene.

    :param file: the scan
    :param images: decodes its textures
    """

    def __init__(self, file: GltfFile, images: Images) -> None:
        self._file, self._images = file, images
        self._looks: dict[int, Look] = {}
        self._textures: dict[int, tuple[tuple[str, Image] | None, tuple[str, str]]] = {}
        self._meshes: dict[int, list[Part]] = {}
        self._moved = self._moved_nodes()
        self.n_bare = self.n_points = 0

    def parts(self) -> list[Part]:
        """The scene's parts in the file's unit and axes.

        :raises SceneError: for what is not known to be read right
        """
        parts: list[Part] = []
        nodes = self._file.header.get("nodes", [])
        stack = [(node, np.eye(4), False) for node in self._roots()]
        seen: set[int] = set()
        while stack:
            index, above, moves = stack.pop()
            node = self._file.item("nodes", index)
            if index in seen:
                raise self._file.bad(f"is damaged: its node {index} has several parents, or is its own")
            seen.add(index)
            matrix, moves = above @ self._matrix(node), moves or index in self._moved
            stack += [(child, matrix, moves) for child in node.get("children", [])]
            if "mesh" not in node:
                continue
            if moves:
                raise self._file.bad(
                    "moves its meshes by an animation, and which moment is meant is not known", "export it without"
                )
            if "skin" in node:
                raise self._file.bad(
                    f"bends the mesh of node {index} of {len(nodes)} by a skeleton (skin), which is not supported",
                    "apply the pose and export it again without",
                )
            for instance in self._instances(node):
                parts += [placed(part, matrix @ instance) for part in self._mesh(node)]
        return parts

    def _roots(self) -> list[Any]:
        header = self._file.header
        scenes = header.get("scenes", [])
        if "scene" in header:
            return list(self._file.item("scenes", header["scene"]).get("nodes", []))
        if len(scenes) > 1:
            raise self._file.bad(f"has {len(scenes)} scenes and does not say which to show", "export one of them")
        if scenes:
            return list(scenes[0].get("nodes", []))
        nodes = header.get("nodes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in children]

    def _moved_nodes(self) -> set[int]:
        channels = [c for animation in self._file.header.get("animations", []) for c in animation["channels"]]
        return {channel["target"]["node"] for channel in channels if "node" in channel["target"]}

    def _matrix(self, node: dict[str, Any]) -> NDArray[np.float64]:
        parts = {"translation": 3, "rotation": 4, "scale": 3}
        if "matrix" in node:
            if parts.keys() & node.keys():
                raise self._file.bad("is damaged: a node has both a matrix and a translation, rotation or scale")
            return self._array(node["matrix"], 16).reshape(4, 4).T
        values = {name: self._array(node[name], n) for name, n in parts.items() if name in node}
        matrix = np.eye(4)
        if "translation" in values:
            matrix[:3, 3] = values["translation"]
        if "rotation" in values:
            matrix = matrix @ rotation(values["rotation"])
        if "scale" in values:
            matrix = matrix @ np.diag([*values["scale"], 1.0])
        return matrix

    def _array(self, values: Any, n: int) -> NDArray[np.float64]:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != (n,) or not np.isfinite(array).all():
            raise self._file.bad(f"is damaged: a node has {values!r} where {n} numbers must be")
        return array

    def _instances(self, node: dict[str, Any]) -> list[NDArray[np.float64]]:
        """The places of a node's copies, relative to it (EXT_mesh_gpu_instancing)."""
        given = node.get("extensions", {}).get("EXT_mesh_gpu_instancing", {}).get("attributes")
        if given is None:
            self._file.budget.add("instances", 1)
            return [np.eye(4)]
        named = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
        counts = {self._file.item("accessors", index)["count"] for name, index in given.items()}
        if len(counts) != 1 or not named.keys() & given.keys():
            raise self._file.bad(f"is damaged: copies of a mesh have {sorted(map(str, counts))} places")
        if unknown := [name for name in given if name not in named and not name.startswith("_")]:
            raise self._file.bad(f"has copies of a mesh with {', '.join(unknown)}, which is not supported")
        (count,) = counts
        self._file.budget.add("instances", count)
        values = {n: self._file.fractions(given[n], t).astype(np.float64) for n, t in named.items() if n in given}
        places = []
        for k in range(count):
            matrix = np.eye(4)
            if "TRANSLATION" in values:
                matrix[:3, 3] = values["TRANSLATION"][k]
            if "ROTATION" in values:
                matrix = matrix @ rotation(values["ROTATION"][k])
            if "SCALE" in values:
                matrix = matrix @ np.diag([*values["SCALE"][k], 1.0])
            places.append(matrix)
        return places

    def _mesh(self, node: dict[str, Any]) -> list[Part]:
        """The parts of a node's mesh; they are counted each time, and read once unless they are morphed."""
        index = node["mesh"]
        mesh = self._file.item("meshes", index)
        weights = node.get("weights", mesh.get("weights", []))
        for primitive in mesh["primitives"]:
            self._count(primitive)
        if any(weights):
            return [p for primitive in mesh["primitives"] if (p := self._part(primitive, weights)) is not None]
        if index not in self._meshes:
            made = (self._part(primitive, []) for primitive in mesh["primitives"])
            self._meshes[index] = [part for part in made if part is not None]
        return self._meshes[index]

    def _count(self, primitive: dict[str, Any]) -> None:
        vertices = self._file.item("accessors", primitive["attributes"].get("POSITION"))["count"]
        corners = self._file.item("accessors", primitive["indices"])["count"] if "indices" in primitive else vertices
        self._file.budget.add("vertices", int(vertices))
        self._file.budget.add("faces", int(corners) // 3 if primitive.get("mode", 4) == _TRIANGLES else int(corners))

    def _part(self, primitive: dict[str, Any], weights: list[float]) -> Part | None:
        """None for points and lines, which are no surface."""
        file, attributes, mode = self._file, primitive["attributes"], primitive.get("mode", _TRIANGLES)
        if mode in (0, 1, 2, 3):
            self.n_points += 1
            return None
        vertices = file.fractions(attributes["POSITION"], "VEC3").astype(np.float64)
        vertices = self._morphed(vertices, primitive, weights)
        if "indices" in primitive:
            indices = file.numbers(primitive["indices"], "SCALAR")[:, 0]
            if indices.dtype.kind != "u":
                raise file.bad("is damaged: corners of faces are not whole numbers")
            indices = indices.astype(np.int64)
        else:
            indices = np.arange(len(vertices))
        if len(indices) and indices.max() >= len(vertices):
            raise file.bad(f"is damaged: a face has the corner {indices.max()} of {len(vertices)} vertices")
        if mode == _TRIANGLES:
            if len(indices) % 3:
                raise file.bad(f"is damaged: {len(indices)} corners are no whole number of triangles")
            faces = indices.reshape(-1, 3)
        elif mode in (_STRIP, _FAN):
            faces = (strip if mode == _STRIP else fan)(indices)
        else:
            raise file.bad(f"has faces of the unknown mode {mode!r}")
        if not len(faces):
            return None
        return vertices, faces, self._surface(primitive, faces, len(vertices))

    def _morphed(
        self, vertices: NDArray[np.float64], primitive: dict[str, Any], weights: list[float]
    ) -> NDArray[np.float64]:
        targets = primitive.get("targets", [])
        if len(weights) > len(targets) and any(weights[len(targets) :]):
            raise self._file.bad("is damaged: a mesh has more weights than morph targets")
        for weight, target in zip(weights, targets, strict=False):
            if weight == 0:
                continue
            self._file.budget.add("morph targets", 1)
            if other := sorted(name for name in target if name not in ("POSITION", "NORMAL", "TANGENT")):
                raise self._file.bad(
                    f"morphs {', '.join(other)}, which is not supported", "apply the shape and export it again without"
                )
            if "POSITION" in target:
                moved = self._file.fractions(target["POSITION"], "VEC3").astype(np.float64)
                vertices = vertices + float(weight) * moved
        return vertices

    def _surface(self, primitive: dict[str, Any], faces: NDArray[np.int64], n_vertices: int) -> Surface:
        file, attributes, n = self._file, primitive["attributes"], len(faces)
        material = primitive.get("material")
        look = plain_look() if material is None else self._look(material)
        colors = self._vertex_colors(attributes.get("COLOR_0"), n_vertices)
        alpha, opacity = np.full((n, 3), look.alpha, dtype=np.float32), None
        if colors is not None and colors.shape[1] == 4:
            alpha = alpha * colors[faces, 3]
        if look.cutoff is not None:
            opacity = Opacity(look.cutoff, alpha)
        tint = colors[faces][..., :3] if colors is not None and look.tinted else None
        uv = self._coordinates(attributes.get(f"TEXCOORD_{look.tex_coord}"), look, n_vertices)
        shown = look.factor
        if look.texture is not None and uv is None:
            # Where the texture lies is not said; the factor beside it is mostly left at white.
            self.n_bare += tint is None
            shown = np.array(MISSING_COLOR, dtype=np.float32) if tint is None else shown
        elif look.texture is not None:
            assert uv is not None
            if look.texture not in self._textures:
                self._textures[look.texture] = read_texture(file, self._images, look.texture)
            image, wrap = self._textures[look.texture]
            if image is not None:
                if opacity is not None and look.veiled:
                    opacity = Opacity(opacity.cutoff, opacity.alpha, image[1][1])
                return Surface(n, self._images.shaded(image[0], look.factor), uv[faces], tint, wrap, opacity)
            shown, tint = np.array(MISSING_COLOR, dtype=np.float32), None
        elif tint is None and material is None:
            self.n_bare += 1
            shown = np.array(MISSING_COLOR, dtype=np.float32)
        if tint is None:
            return Surface(n, None, np.broadcast_to(shown, (n, 3, 3)), opacity=opacity)
        return Surface(n, None, np.rint(tint * 255) if material is None else tint * shown, opacity=opacity)

    def _look(self, material: Any) -> Look:
        if material not in self._looks:
            entry = self._file.item("materials", material)
            self._looks[material] = read_look(self._file, entry)
        return self._looks[material]

    def _vertex_colors(self, accessor: Any, n_vertices: int) -> NDArray[np.float32] | None:
        """In 0..1, (n, 3 or 4); integers are fractions of their largest number, whether they say so or not."""
        if accessor is None:
            return None
        values = self._file.numbers(accessor, "VEC3", "VEC4")
        if len(values) != n_vertices or values.dtype.kind not in "uf" or values.dtype.itemsize > 4:
            raise self._file.bad(f"has {len(values)} colors of {n_vertices} vertices as {values.dtype}")
        if values.dtype.kind == "u":
            return values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
        if not np.isfinite(values).all() or values.min(initial=0) < -1e-3 or values.max(initial=0) > 1.001:
            raise self._file.bad(
                f"has colors of vertices from {values.min():g} to {values.max():g}, not 0 to 1", "rescale them"
            )
        return np.asarray(np.clip(values, 0, 1), dtype=np.float32)

    def _coordinates(self, accessor: Any, look: Look, n_vertices: int) -> NDArray[np.float32] | None:
        """Of a texture, v upwards."""
        if accessor is None or look.texture is None:
            return None
        entry = self._file.item("accessors", accessor)
        if entry.get("componentType") != 5126 and not entry.get("normalized") and not self._file.quantized:
            raise self._file.bad("has coordinates of a texture as whole numbers that are not normalized")
        uv = self._file.fractions(accessor, "VEC2")
        if len(uv) != n_vertices or not np.isfinite(uv).all():
            raise self._file.bad("is damaged: the coordinates of a texture are not those of its vertices")
        if look.scale != (1.0, 1.0) or look.offset != (0.0, 0.0):
            uv = uv * np.array(look.scale, dtype=np.float32) + np.array(look.offset, dtype=np.float32)
        return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)


def rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 4 x 4 matrix of a quaternion (x, y, z, w), which need not have unit length.

    :param quaternion: (4,)
    """
    length = float(quaternion @ quaternion)
    matrix = np.eye(4)
    if length < 1e-12:
        return matrix
    x, y, z, w = quaternion * np.sqrt(2 / length)
    matrix[:3, :3] = [
        [1 - y * y - z * z, x * y - z * w, x * z + y * w],
        [x * y + z * w, 1 - x * x - z * z, y * z - x * w],
        [x * z - y * w, y * z + x * w, 1 - x * x - y * y],
    ]
    return matrix


def placed(part: Part, matrix: NDArray[np.float64]) -> Part:
    """A part moved by a matrix; a mirrored part is not turned inside out.

    :param part: as it was read
    :param matrix: (4, 4)
    """
    vertices, faces, surface = part
    if abs(matrix - np.eye(4)).max() < 1e-8:
        return part
    stacked = np.column_stack((vertices, np.ones(len(vertices))))
    moved = np.dot(matrix, stacked.T).T[:, :3]
    if np.linalg.det(matrix[:3, :3]) >= 0:
        return moved, faces, surface
    return moved, faces[:, ::-1], turned_over(surface)
