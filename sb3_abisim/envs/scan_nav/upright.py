"""Which way is up in a scan: its axis, and a lean of a few degrees."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.scan_nav.files import SceneError

AXES = ("x", "-x", "y", "-y", "z", "-z")
UP_AXES = ("auto", *AXES)
# Heights are counted in bins of this many meters.
LEVEL_BIN = 0.05
MIN_LEVEL_AREA = 1.5  # m2
MIN_UP_RATIO = 1.25
# A face is level where its unit normal's vertical part is above this.
LEVEL_NORMAL = 0.9
# A lean of less is none; one of more is refused. In degrees.
LEAST_LEAN, LARGEST_LEAN = 0.3, 15.0
# Turning a scan upright makes its largest level larger by this factor, or it was no lean.
_LEAN_GAIN = 1.1
# Of the area that looks in one direction to three degrees, this share does so exactly where nothing is noisy.
_EXACT_SHARE = 0.25
# Rows of the turns that bring each axis up; y to the north is what glTF calls the back.
_TURNS = {
    "z": ((0, 1), (1, 1), (2, 1)),
    "-z": ((0, 1), (1, -1), (2, -1)),
    "y": ((0, 1), (2, -1), (1, 1)),
    "-y": ((0, 1), (2, 1), (1, -1)),
    "x": ((2, -1), (1, 1), (0, 1)),
    "-x": ((2, 1), (1, 1), (0, -1)),
}


def turned(vertices: NDArray[np.float64], up: str) -> NDArray[np.float64]:
    """Points turned so that an axis points up; nothing is mirrored.

    :param vertices: (n, 3)
    :param up: one of :data:`AXES`
    """
    if up == "z":
        return vertices
    columns, signs = zip(*_TURNS[up], strict=True)
    return np.asarray(vertices[:, columns] * signs)


def level_areas(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How much level, up-facing area there is at which height.

    :param corners: of the faces, (m, 3, 3), z up
    :return: the bins' middle heights in m, and areas in m2 of each bin together with its two neighbors
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    level = normals[:, 2] > LEVEL_NORMAL * length
    heights = corners[level, :, 2].mean(axis=1)
    if not len(heights):
        return np.zeros(1), np.zeros(1)
    bins = np.floor(heights / LEVEL_BIN).astype(np.int64)
    first = bins.min() - 1
    areas = np.bincount(bins - first, normals[level, 2] / 2, minlength=bins.max() - first + 2)
    return (np.arange(len(areas)) + first + 0.5) * LEVEL_BIN, np.convolve(areas, np.ones(3), mode="same")


def turn_upright(
    path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64], up: str
) -> tuple[NDArray[np.float64], str, float]:
    """Turn a scan so that z points up and its floor is level.

    :param path: for messages
    :param vertices: (n, 3), in m
    :param faces: (m, 3)
    :param up: one of :data:`UP_AXES`
    :return: the vertices, the axis, and the lean in degrees that was taken away
    :raises SceneError: where no axis, or more than one, could point up, or for a large lean
    """
    tried = {axis: _level(turned(vertices, axis), faces) for axis in (("y", "z") if up == "auto" else (up,))}
    areas = {axis: area for axis, (_, area, _) in tried.items()}
    if up == "auto":
        up, other = sorted(areas, key=lambda axis: -areas[axis])
        if areas[up] >= MIN_LEVEL_AREA and areas[up] < MIN_UP_RATIO * areas[other]:
            raise SceneError(
                f"{path} could stand on either side: level areas of {areas['y']:.1f} m2 with y up and "
                f"{areas['z']:.1f} m2 with z up; give up='y' or up='z'"
            )
    upright, area, lean = tried[up]
    if area < MIN_LEVEL_AREA:
        others = {axis: level_areas(turned(vertices, axis)[faces])[1].max() for axis in AXES if axis != up}
        hint = "turn it so that gravity points along an axis, and check its units (meters)"
        if (best := max(others, key=lambda axis: others[axis])) and others[best] >= MIN_LEVEL_AREA:
            hint = (
                f"with {best} up it has {others[best]:.1f} m2: give up='{best}', or flip_faces=True where its faces "
                "show their backs"
            )
        raise SceneError(
            f"{path} has no floor: its largest horizontal level has {area:.2f} m2 with {up} up, less than "
            f"{MIN_LEVEL_AREA} m2; {hint}"
        )
    if lean > LARGEST_LEAN:
        raise SceneError(
            f"{path} leans by {lean:.1f} degrees with {up} up, more than {LARGEST_LEAN:g}; turn it upright, or give "
            "another up"
        )
    return upright, up, lean


def _level(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], float, float]:
    """The vertices without their lean, the area of the largest level then, and the lean in degrees."""
    corners = vertices[faces]
    area = float(level_areas(corners)[1].max())
    axis, sharp = _floor_normal(corners)
    lean = float(np.rad2deg(np.arccos(np.clip(axis[2], -1, 1))))
    if lean < LEAST_LEAN:
        return vertices, area, 0.0
    upright = vertices @ _rotation(axis).T
    leveled = float(level_areas(upright[faces])[1].max())
    # Where floors of a few large triangles lean a little, each is in one bin anyway.
    if leveled < (0.99 if sharp else _LEAN_GAIN) * area:
        return vertices, area, 0.0
    return upright, leveled, lean


def _floor_normal(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """The direction that most of the level faces look to, (3,), straight up if many do; and whether they do exactly."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    level = normals[:, 2] > LEVEL_NORMAL * length
    straight = np.array([0.0, 0.0, 1.0])
    if not level.any():
        return straight, True
    weight, unit = length[level], normals[level] / length[level, None]
    degrees = np.rad2deg(np.arcsin(np.clip(unit[:, :2], -1, 1)))
    edges = np.arange(-27.5, 28.5)
    counts = np.histogram2d(degrees[:, 0], degrees[:, 1], bins=(edges, edges), weights=weight)[0]
    around = sum(np.roll(counts, (i, j), axis=(0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))
    assert not isinstance(around, int)
    enough = _EXACT_SHARE * around.max()
    if weight[np.hypot(*degrees.T) <= LEAST_LEAN].sum() >= enough:
        return straight, True
    row, column = np.unravel_index(int(np.argmax(around)), around.shape)
    middle = np.array([edges[row] + 0.5, edges[column] + 0.5])
    for _ in range(3):
        near = np.hypot(*(degrees - middle).T) <= 3
        if not near.any():
            return straight, True
        mean = (unit[near] * weight[near, None]).sum(axis=0)
        mean /= np.linalg.norm(mean)
        middle = np.rad2deg(np.arcsin(mean[:2]))
    exactly = np.hypot(*(degrees - middle).T) <= LEAST_LEAN
    return np.asarray(mean), bool(weight[exactly].sum() >= enough)


def _rotation(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """The shortest turn that brings a direction to z."""
    cross = np.array([axis[1], -axis[0], 0.0])  # axis x z
    skew = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    matrix: NDArray[np.float64] = np.eye(3) + skew + skew @ skew / (1 + axis[2])
    return matrix
