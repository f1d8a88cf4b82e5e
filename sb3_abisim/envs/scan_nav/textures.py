"""Textures for :mod:`~sb3_abisim.envs.scan_nav.apartment`: those of walls and furniture, and those of floors."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_TEXTURE_PIXELS = 200
# A texture covers a square of this side; then it repeats.
TEXTURE_SIZE = 1.0  # m
FLOOR_PIXELS = 50  # per m


def texture(kind: str, color: tuple[int, int, int], generator: np.random.Generator) -> NDArray[np.uint8]:
    """A texture that repeats without a seam.

    :param kind: "plain", "wood", "fabric", "stripes" or "stone"
    :param color: its mean color
    :param generator: samples its details
    :return: uint8 (200, 200, 3)
    """
    n = _TEXTURE_PIXELS
    smooth: dict[str, tuple[float, ...]] = {"wood": (1.2, 25), "stone": (6, 6), "fabric": (0.6, 0.6)}
    noise = ndimage.gaussian_filter(generator.standard_normal((n, n)), smooth.get(kind, (2, 2)), mode="wrap")
    strength = {"wood": 15, "stone": 12, "fabric": 12}.get(kind, 4)
    light = noise / noise.std() * strength
    if kind == "fabric":
        light += 5 * ((np.arange(n)[:, None] // 2 + np.arange(n) // 2) % 2)
    if kind == "stripes":
        light += np.where((np.arange(n) // 20) % 2, 22, -22)
    return np.asarray(np.clip(np.array(color) + light[..., None], 0, 255).astype(np.uint8))


# Texture name: (kind, colors to choose from).
TEXTURES: dict[str, tuple[str, tuple[tuple[int, int, int], ...]]] = {
    "wall": ("plain", ((86, 82, 80),)),
    "sill": ("stone", ((222, 220, 214),)),
    "door": ("wood", ((232, 228, 220), (150, 104, 66), (110, 74, 48))),
    "wood": ("wood", ((104, 66, 44), (84, 56, 42), (214, 206, 190))),
    "dark": ("wood", ((70, 52, 42), (58, 58, 62))),
    "white": ("plain", ((236, 236, 232),)),
    "steel": ("plain", ((172, 176, 180),)),
    "black": ("plain", ((34, 34, 38),)),
    "screen": ("plain", ((22, 28, 40),)),
    "water": ("plain", ((196, 216, 226),)),
    "stone": ("stone", ((110, 108, 106), (60, 62, 64), (206, 200, 190))),
    "sofa": ("fabric", ((92, 112, 130), (150, 76, 62), (104, 120, 84), (168, 160, 148), (70, 72, 84))),
    "cushion": ("stripes", ((212, 170, 80), (200, 206, 210), (180, 90, 80))),
    "sheet": ("fabric", ((240, 238, 232),)),
    "duvet": ("stripes", ((104, 132, 168), (182, 130, 130), (134, 150, 120), (196, 186, 170))),
    "seat": ("fabric", ((60, 76, 96), (120, 60, 52), (200, 190, 172), (48, 50, 54))),
    "leaf": ("plain", ((58, 118, 58), (78, 132, 64))),
    "pot": ("stone", ((172, 96, 64), (214, 210, 204))),
    "paper": ("plain", ((244, 240, 226),)),
    "red": ("plain", ((176, 58, 50),)),
    "blue": ("plain", ((60, 90, 150),)),
}


def planks(rng: np.random.Generator, shape: tuple[int, int], color: tuple[int, int, int]) -> NDArray[np.float64]:
    """Boards 16 cm wide and 1.2 m long, each row shifted.

    :param rng: samples their tones and grain
    :param shape: height and width in pixels
    :param color: mean color
    :return: (height, width, 3), about 0..255
    """
    board = round(0.16 * FLOOR_PIXELS)
    long = round(1.2 * FLOOR_PIXELS)
    y, x = np.mgrid[: shape[0], : shape[1]]
    row = y // board
    column = (x + (row * 47) % long) // long
    tone = rng.normal(0, 10, (row.max() + 1, column.max() + 1))[row, column]
    grain = ndimage.gaussian_filter(rng.standard_normal(shape), (0.6, 6))
    light = tone + grain / grain.std() * 6
    light = light - 20.0 * ((y % board == 0) | ((x + (row * 47) % long) % long == 0))
    return np.asarray(np.array(color) + light[..., None])


def tiles(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Square tiles of 30 cm, of one color or two.

    :param rng: samples their colors and tones
    :param shape: height and width in pixels
    :return: (height, width, 3), about 0..255
    """
    side = round(0.3 * FLOOR_PIXELS)
    y, x = np.mgrid[: shape[0], : shape[1]]
    pairs = [((206, 206, 200), (206, 206, 200)), ((220, 220, 216), (120, 132, 140)), ((196, 176, 150), (184, 160, 132))]
    colors = np.array(pairs[rng.integers(len(pairs))], dtype=np.float64)
    plain = colors[(y // side + x // side) % 2]
    tone = rng.normal(0, 5, (shape[0] // side + 1, shape[1] // side + 1))[y // side, x // side]
    joint = (y % side == 0) | (x % side == 0)
    tiled: NDArray[np.float64] = np.where(joint[..., None], 150.0, plain + tone[..., None])
    return tiled


def rug(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float64]:
    """A border and a pattern of lozenges or stripes.

    :param rng: samples colors and pattern
    :param shape: height and width in pixels
    :return: (height, width, 3), about 0..255
    """
    colors = np.array([(150, 52, 48), (52, 76, 110), (176, 168, 150), (92, 110, 92), (120, 84, 120)], dtype=np.float64)
    ground, figure = colors[rng.permutation(len(colors))[:2]]
    y, x = np.mgrid[: shape[0], : shape[1]]
    pattern = (abs(y % 20 - 10) + abs(x % 20 - 10)) < 6 if rng.random() < 0.6 else (x // 6) % 2 == 0
    woven = np.where(pattern[..., None], figure, ground)
    edge = np.minimum(np.minimum(y, shape[0] - 1 - y), np.minimum(x, shape[1] - 1 - x))
    woven[(edge > 2) & (edge < 6)] = figure
    return np.asarray(woven + rng.normal(0, 5, shape)[..., None])
