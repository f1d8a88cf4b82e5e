"""How the triangles of a scan are colored, and where one sees through them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

REPEAT, CLAMP, MIRROR = "repeat", "clamp", "mirror"
# Of light that a thing lets through by halves, more than half counts as nothing there.
HALF_SEEN = 0.5


@dataclass(frozen=True)
class Opacity:
    """Where a surface is solid: where its alpha, interpolated, times the texture's, is at least the cutoff.

    :param cutoff: 0..1
    :param alpha: of the three corners of each face, float32 (n_faces, 3) in 0..1
    :param texture: alpha of the surface's texture, uint8 (height, width), or None
    """

    cutoff: float
    alpha: NDArray[np.float32]
    texture: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Surface:
    """A run of faces that share one kind of coloring.

    :param n_faces: their number
    :param texture: uint8 (height, width, 3), or None
    :param coordinates: with a texture, (n_faces, 3, 2) of its u to the right and v upwards, 1 being its whole size, for
        the three corners of each face; without one, their colors (n_faces, 3, 3) in 0..255
    :param tint: what a texture's colors are multiplied by, (n_faces, 3, 3) in 0..1, or None
    :param wrap: how a texture goes on beyond 0..1 in u and v: "repeat", "clamp" or "mirror"
    :param opacity: None for solid everywhere
    """

    n_faces: int
    texture: NDArray[np.uint8] | None
    coordinates: NDArray[np.float32]
    tint: NDArray[np.float32] | None = None
    wrap: tuple[str, str] = (REPEAT, REPEAT)
    opacity: Opacity | None = None


# Vertices float64 (n, 3), faces int64 (m, 3), and how the faces are colored.
Part = tuple[NDArray[np.float64], NDArray[np.int64], Surface]


def without_nothing(part: Part) -> Part | None:
    """A part without the faces that one sees through everywhere.

    :param part: as it was read
    :return: the part itself where it is solid; None where nothing of it is
    """
    vertices, faces, surface = part
    opacity = surface.opacity
    if opacity is None:
        return part
    clearest, densest = (
        (0, 255) if opacity.texture is None else (int(opacity.texture.min()), int(opacity.texture.max()))
    )
    if opacity.texture is None:
        clearest = 255
    seen = opacity.alpha.max(axis=1) * (densest / 255) >= opacity.cutoff
    if not seen.any():
        return None
    if seen.all() and opacity.alpha.min() * (clearest / 255) >= opacity.cutoff:
        return vertices, faces, replace(surface, opacity=None)
    used, kept = np.unique(faces[seen], return_inverse=True)
    left = Surface(
        int(seen.sum()),
        surface.texture,
        surface.coordinates[seen],
        None if surface.tint is None else surface.tint[seen],
        surface.wrap,
        Opacity(opacity.cutoff, opacity.alpha[seen], opacity.texture),
    )
    return vertices[used], kept.reshape(-1, 3), left


def turned_over(surface: Surface) -> Surface:
    """The coloring of the same faces, their corners in the opposite order.

    :param surface: that of the faces as they were
    """
    opacity = surface.opacity
    return replace(
        surface,
        coordinates=surface.coordinates[:, ::-1],
        tint=None if surface.tint is None else surface.tint[:, ::-1],
        opacity=None if opacity is None else replace(opacity, alpha=opacity.alpha[:, ::-1]),
    )


def each_number(numbers: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each different number, ascending, and its places; in one pass, however many there are.

    :param numbers: (n,)
    """
    order = np.argsort(numbers, kind="stable")
    values, starts = np.unique(numbers[order], return_index=True)
    if len(values):
        yield from zip(values.tolist(), np.split(order, starts[1:]), strict=True)


def surface_runs(surfaces: tuple[Surface, ...]) -> NDArray[np.int64]:
    """Where each surface's faces end.

    :param surfaces: in their order
    """
    return np.cumsum([surface.n_faces for surface in surfaces], dtype=np.int64)


def colors_at(
    surfaces: tuple[Surface, ...], face: NDArray[np.int64], weights: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """The colors of points on triangles.

    :param surfaces: the triangles' coloring, in their order
    :param face: triangle of each point, (n,)
    :param weights: of its corners at each point, (n, 3)
    :return: (n, 3), RGB
    """
    colors = np.zeros((len(face), 3), dtype=np.uint8)
    ends = surface_runs(surfaces)
    owner = np.searchsorted(ends, face, side="right")
    for k, mine in each_number(owner):
        surface = surfaces[k]
        local = face[mine] - (ends[k] - surface.n_faces)
        values = np.einsum("nk,nkd->nd", weights[mine], surface.coordinates[local])
        rgb = values if surface.texture is None else _sample(surface.texture, values, surface.wrap)
        if surface.tint is not None:
            rgb = rgb * np.einsum("nk,nkd->nd", weights[mine], surface.tint[local])
        colors[mine] = np.rint(np.clip(rgb, 0, 255)).astype(np.uint8)
    return colors


def solid_at(surfaces: tuple[Surface, ...], face: NDArray[np.int64], weights: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether there is something at points on triangles.

    :param surfaces: the triangles' coloring, in their order
    :param face: triangle of each point, (n,)
    :param weights: of its corners at each point, (n, 3)
    """
    solid = np.ones(len(face), dtype=bool)
    ends = surface_runs(surfaces)
    owner = np.searchsorted(ends, face, side="right")
    for k, mine in each_number(owner):
        surface = surfaces[k]
        if surface.opacity is None:
            continue
        local = face[mine] - (ends[k] - surface.n_faces)
        alpha = np.einsum("nk,nk->n", weights[mine], surface.opacity.alpha[local])
        if surface.opacity.texture is not None:
            places = np.einsum("nk,nkd->nd", weights[mine], surface.coordinates[local])
            alpha = alpha * _sample(surface.opacity.texture[..., None], places, surface.wrap)[:, 0] / 255
        # A hair's breadth for the rounding of weights.
        solid[mine] = alpha >= surface.opacity.cutoff - 1e-6
    return solid


def see_through(surfaces: tuple[Surface, ...]) -> NDArray[np.bool_]:
    """Which faces are not solid everywhere, (n_faces,).

    :param surfaces: in the faces' order
    """
    return np.repeat([s.opacity is not None for s in surfaces], [s.n_faces for s in surfaces])


def _sample(texture: NDArray[np.uint8], uv: NDArray[np.float64], wrap: tuple[str, str]) -> NDArray[np.float64]:
    """Bilinear interpolation."""
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, down = (x - left)[:, None], (y - top)[:, None]
    columns = _within(left, width, wrap[0]), _within(left + 1, width, wrap[0])
    rows = _within(top, height, wrap[1]), _within(top + 1, height, wrap[1])
    upper = texture[rows[0], columns[0]] * (1 - right) + texture[rows[0], columns[1]] * right
    lower = texture[rows[1], columns[0]] * (1 - right) + texture[rows[1], columns[1]] * right
    mixed: NDArray[np.float64] = upper * (1 - down) + lower * down
    return mixed


def _within(index: NDArray[np.int64], n: int, wrap: str) -> NDArray[np.int64]:
    if wrap == REPEAT:
        return index % n
    if wrap == CLAMP:
        return np.clip(index, 0, n - 1)
    there = index % (2 * n)
    return np.minimum(there, 2 * n - 1 - there)
