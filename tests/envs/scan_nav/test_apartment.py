"""The built-in apartments: rooms that can be reached, furniture, textures."""

import numpy as np
import pytest

from sb3_abisim.envs.scan_nav.apartment import SEEDS, apartment_mesh
from sb3_abisim.envs.scan_nav.map import ScanMap


@pytest.mark.parametrize("seed", SEEDS)
def test_an_apartment_has_rooms_furniture_and_textures(seed):
    scan = ScanMap.apartment(seed)
    height, scale = scan.height, scan.meters_per_pixel
    area = {
        "floor": (abs(height) < 0.01).sum() * scale**2,
        "furniture": ((height > 0.2) & (height < 2.0)).sum() * scale**2,
        "walls": (height > 2.5).sum() * scale**2,
    }
    assert 70 < area["floor"] < 130 and 10 < area["furniture"] < 40 and 12 < area["walls"] < 30
    # Every room is reached: hardly any floor further than furniture could keep one from it is left over.
    assert scan.walkable.sum() * scale**2 > 0.65 * area["floor"]
    assert len(np.unique(scan.orthophoto.reshape(-1, 3), axis=0)) > 5000, "textures"


def test_an_apartment_takes_no_axis():
    with pytest.raises(ValueError, match="an apartment stands upright, it takes no up; got 'y'"):
        ScanMap.apartment(0, up="y")


def test_seeds_determine_apartments():
    one, again, other = (apartment_mesh(seed) for seed in (0, 0, 1))
    assert np.array_equal(one.vertices, again.vertices) and one.vertices.shape != other.vertices.shape
    assert all(np.array_equal(a.texture, b.texture) for a, b in zip(one.surfaces, again.surfaces, strict=True))


@pytest.mark.parametrize("seed", [-1, 1.5, True], ids=str)
def test_refuses_seeds(seed):
    with pytest.raises(ValueError, match=f"seed of an apartment .* got {seed}"):
        apartment_mesh(seed)
