"""Furniture for :mod:`~sb3_abisim.envs.scan_nav.apartment`.

A piece is a list of solids in coordinates of the piece: u along the wall that it stands at, v away from the wall, z up,
in meters. ``(u0, v0, u1, v1, z0, z1, texture)`` is a box; ``(u, v, radius, z0, z1, texture)`` an upright cylinder.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Solid = tuple[float | str, ...]


@dataclass(frozen=True)
class Piece:
    """A piece of furniture.

    :param width: along the wall, in m
    :param depth: away from the wall, in m
    :param solids: what it is made of
    :param front: free space that it needs before it, in m
    """

    width: float
    depth: float
    solids: list[Solid]
    front: float = 0.5


def _chair(u: float, v: float, towards: tuple[int, int]) -> list[Solid]:
    """A chair around (u, v) whose back is away from ``towards``."""
    a, b = -0.2 * towards[0], -0.2 * towards[1]
    back_u, back_v = (0.03, 0.2) if a else (0.2, 0.03)
    seat: Solid = (u - 0.21, v - 0.21, u + 0.21, v + 0.21, 0.41, 0.46, "seat")
    back: Solid = (u + a - back_u, v + b - back_v, u + a + back_u, v + b + back_v, 0.0, 0.9, "wood")
    return [seat, back]


def double_bed(rng: np.random.Generator) -> Piece:
    """With two bedside tables."""
    solids: list[Solid] = [
        (0.0, 0.05, 0.42, 0.45, 0.0, 0.5, "wood"),
        (2.18, 0.05, 2.6, 0.45, 0.0, 0.5, "wood"),
        (0.21, 0.25, 0.1, 0.5, 0.75, "paper"),
        (2.3, 0.15, 2.5, 0.3, 0.5, 0.54, "red"),
        (0.46, 0.0, 2.14, 2.1, 0.0, 0.32, "wood"),
        (0.46, 0.0, 2.14, 0.08, 0.0, 1.0, "wood"),
        (0.5, 0.1, 2.1, 2.06, 0.32, 0.52, "sheet"),
        (0.5, 0.68, 2.1, 2.08, 0.52, 0.58, "duvet"),
    ]
    solids += [(u, 0.16, u + 0.66, 0.58, 0.52, 0.62, "cushion") for u in (0.58, 1.36)]
    return Piece(2.6, 2.12, solids)


def single_bed(rng: np.random.Generator) -> Piece:
    """A bed for one."""
    return Piece(
        1.0,
        2.1,
        [
            (0.0, 0.0, 1.0, 2.08, 0.0, 0.3, "wood"),
            (0.04, 0.06, 0.96, 2.04, 0.3, 0.48, "sheet"),
            (0.04, 0.66, 0.96, 2.05, 0.48, 0.53, "duvet"),
            (0.18, 0.12, 0.82, 0.52, 0.48, 0.58, "cushion"),
        ],
    )


def wardrobe(rng: np.random.Generator) -> Piece:
    """Reaches through the cut: only its top can be seen."""
    width = float(rng.choice([1.2, 1.8, 2.0]))
    return Piece(width, 0.6, [(0, 0, width, 0.6, 0, 2.2, "wood")], 0.7)


def bookshelf(rng: np.random.Generator) -> Piece:
    """A little lower than the cut, with things on top."""
    solids: list[Solid] = [(0, 0, 1.1, 0.32, 0, 1.75, "wood")]
    for k, name in enumerate(rng.permutation(["red", "blue", "paper", "pot"])):
        solids.append((0.1 + 0.25 * k, 0.06, 0.28 + 0.25 * k, 0.26, 1.75, 1.85 + 0.02 * k, str(name)))
    return Piece(1.1, 0.32, solids, 0.6)


def desk(rng: np.random.Generator) -> Piece:
    """With a screen, papers and a round office chair."""
    solids: list[Solid] = [
        (0, 0, 1.4, 0.7, 0.7, 0.74, "wood"),
        (0.05, 0.05, 0.4, 0.65, 0.0, 0.7, "wood"),
        (0.45, 0.1, 1.0, 0.16, 0.8, 1.2, "screen"),
        (0.5, 0.35, 0.95, 0.5, 0.74, 0.76, "black"),
        (1.08, 0.2, 1.3, 0.5, 0.74, 0.75, "paper"),
        (0.15, 0.15, 0.05, 0.74, 0.84, "blue"),
        (0.72, 0.98, 0.26, 0.42, 0.5, "seat"),
        (0.5, 1.2, 0.94, 1.26, 0.5, 1.0, "seat"),
    ]
    return Piece(1.4, 1.28, solids, 0.4)


def sofa(rng: np.random.Generator) -> Piece:
    """With a rugless low table before it."""
    width = float(rng.choice([1.9, 2.3]))
    arm = 0.2
    solids: list[Solid] = [
        (0, 0, width, 0.92, 0.0, 0.36, "sofa"),
        (0, 0, width, 0.25, 0.36, 0.8, "sofa"),
        (0, 0, arm, 0.92, 0.36, 0.6, "sofa"),
        (width - arm, 0, width, 0.92, 0.36, 0.6, "sofa"),
        (arm + 0.02, 0.25, width / 2 - 0.01, 0.9, 0.36, 0.46, "sofa"),
        (width / 2 + 0.01, 0.25, width - arm - 0.02, 0.9, 0.36, 0.46, "sofa"),
        (arm + 0.05, 0.26, arm + 0.48, 0.42, 0.46, 0.75, "cushion"),
        (width - arm - 0.48, 0.26, width - arm - 0.05, 0.42, 0.46, 0.75, "cushion"),
        (width / 2 - 0.5, 1.4, width / 2 + 0.5, 1.95, 0.36, 0.42, "wood"),
        (width / 2 - 0.3, 1.5, width / 2 - 0.05, 1.7, 0.42, 0.45, "red"),
        (width / 2 + 0.25, 1.7, 0.09, 0.42, 0.5, "water"),
    ]
    return Piece(width, 1.95, solids, 0.4)


def armchair(rng: np.random.Generator) -> Piece:
    """For one."""
    return Piece(
        0.9,
        0.85,
        [
            (0, 0, 0.9, 0.85, 0, 0.4, "seat"),
            (0, 0, 0.9, 0.22, 0.4, 0.85, "seat"),
            (0, 0.2, 0.16, 0.85, 0.4, 0.6, "seat"),
            (0.74, 0.2, 0.9, 0.85, 0.4, 0.6, "seat"),
            (0.25, 0.24, 0.65, 0.36, 0.4, 0.7, "cushion"),
        ],
    )


def tv_unit(rng: np.random.Generator) -> Piece:
    """A low board with a screen on it."""
    return Piece(
        1.7,
        0.42,
        [
            (0, 0, 1.7, 0.42, 0.0, 0.48, "dark"),
            (0.25, 0.14, 1.45, 0.22, 0.5, 1.2, "screen"),
            (0.04, 0.08, 0.2, 0.34, 0.48, 0.7, "black"),
            (1.58, 0.22, 0.07, 0.48, 0.7, "pot"),
        ],
        0.8,
    )


def dining_table(rng: np.random.Generator) -> Piece:
    """With four chairs; also stands alone."""
    solids: list[Solid] = [(0.45, 0.55, 1.95, 1.4, 0.7, 0.75, "wood"), (1.2, 0.97, 0.12, 0.75, 0.85, "pot")]
    for u in (0.85, 1.55):
        solids += _chair(u, 0.42, (0, 1)) + _chair(u, 1.53, (0, -1))
        solids += [(u, v, 0.12, 0.75, 0.77, "white") for v in (0.76, 1.19)]
    solids += _chair(0.3, 0.97, (1, 0)) if rng.random() < 0.5 else []
    return Piece(2.4, 1.95, solids, 0.3)


def kitchen(rng: np.random.Generator) -> Piece:
    """Counter with sink and hob, and a refrigerator."""
    width = float(rng.choice([2.4, 3.0]))
    solids: list[Solid] = [
        (0, 0, 0.65, 0.65, 0, 1.9, "white"),
        (0.67, 0, width, 0.62, 0, 0.86, "wood"),
        (0.67, 0, width, 0.62, 0.86, 0.9, "stone"),
        (0.9, 0.12, 1.4, 0.5, 0.9, 0.905, "steel"),
        (0.95, 0.16, 1.35, 0.46, 0.905, 0.91, "water"),
        (width - 0.75, 0.06, width - 0.17, 0.56, 0.9, 0.91, "black"),
    ]
    for u in (width - 0.6, width - 0.32):
        solids += [(u, v, 0.09, 0.91, 0.92, "steel") for v in (0.18, 0.43)]
    solids.append((width - 0.6, 0.43, 0.1, 0.92, 1.05, "red"))
    return Piece(width, 0.65, solids, 0.9)


def bathtub(rng: np.random.Generator) -> Piece:
    """Filled."""
    return Piece(
        1.65,
        0.75,
        [
            (0, 0, 1.65, 0.75, 0, 0.5, "water"),
            (0, 0, 1.65, 0.1, 0.5, 0.56, "white"),
            (0, 0.65, 1.65, 0.75, 0.5, 0.56, "white"),
            (0, 0, 0.12, 0.75, 0.5, 0.56, "white"),
            (1.5, 0, 1.65, 0.75, 0.5, 0.56, "white"),
            (0.14, 0.375, 0.04, 0.56, 0.62, "steel"),
        ],
    )


def toilet(rng: np.random.Generator) -> Piece:
    """Cistern and bowl."""
    return Piece(
        0.42,
        0.68,
        [
            (0.02, 0, 0.4, 0.18, 0, 0.8, "white"),
            (0.21, 0.44, 0.2, 0.0, 0.4, "white"),
            (0.06, 0.18, 0.36, 0.44, 0.0, 0.39, "white"),
            (0.21, 0.44, 0.12, 0.4, 0.405, "water"),
        ],
        0.6,
    )


def washbasin(rng: np.random.Generator) -> Piece:
    """On a cupboard."""
    return Piece(
        0.8,
        0.48,
        [
            (0, 0, 0.8, 0.48, 0, 0.82, "wood"),
            (0.05, 0.04, 0.75, 0.46, 0.82, 0.86, "white"),
            (0.4, 0.26, 0.16, 0.86, 0.865, "water"),
            (0.37, 0.04, 0.43, 0.1, 0.86, 1.0, "steel"),
        ],
        0.6,
    )


def washing_machine(rng: np.random.Generator) -> Piece:
    """With a basket on it."""
    return Piece(0.6, 0.6, [(0, 0, 0.6, 0.6, 0, 0.85, "white"), (0.32, 0.3, 0.18, 0.85, 1.1, "cushion")], 0.6)


def cabinet(rng: np.random.Generator) -> Piece:
    """A low one, for shoes."""
    return Piece(0.9, 0.3, [(0, 0, 0.9, 0.3, 0, 0.9, "wood"), (0.2, 0.15, 0.09, 0.9, 1.0, "pot")], 0.4)


def plant(rng: np.random.Generator) -> Piece:
    """Leaves of several sizes over a pot."""
    solids: list[Solid] = [(0.25, 0.25, 0.16, 0, 0.4, "pot")]
    for k in range(9):
        angle, away = k * 2.4, 0.05 + 0.015 * k
        u, v = 0.25 + away * np.cos(angle), 0.25 + away * np.sin(angle)
        solids.append((float(u), float(v), 0.11 - 0.005 * k, 1.0 - 0.05 * k, 1.02 - 0.05 * k, "leaf"))
    return Piece(0.5, 0.5, solids, 0.2)


# What may stand in a room of each kind, the most important first.
ROOMS: dict[str, tuple[Callable[[np.random.Generator], Piece], ...]] = {
    "living room": (
        sofa,
        dining_table,
        tv_unit,
        bookshelf,
        armchair,
        cabinet,
        plant,
        armchair,
        bookshelf,
        plant,
        plant,
    ),
    "kitchen": (kitchen, dining_table, cabinet, bookshelf, plant),
    "bedroom": (double_bed, wardrobe, desk, cabinet, plant, armchair),
    "child's room": (single_bed, desk, wardrobe, armchair, plant),
    "study": (desk, bookshelf, sofa, armchair, plant),
    "bathroom": (bathtub, toilet, washbasin, washing_machine),
    "hall": (cabinet, plant),
}
