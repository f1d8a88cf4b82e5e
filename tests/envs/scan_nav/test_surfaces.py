"""Parts of a scan, of which there may be very many."""

import io
import time

import numpy as np
import pytest
from PIL import Image

from sb3_abisim.envs.scan_nav.files import Budget, ScanFiles
from sb3_abisim.envs.scan_nav.images import Images
from sb3_abisim.envs.scan_nav.mesh import load_mesh
from sb3_abisim.envs.scan_nav.surfaces import each_number


def test_each_number_and_its_places():
    numbers = np.random.default_rng(0).integers(-3, 9, 200)
    found = dict(each_number(numbers))
    assert list(found) == sorted(set(numbers.tolist()))
    assert all(np.array_equal(places, np.flatnonzero(numbers == number)) for number, places in found.items())
    assert not list(each_number(np.zeros(0, np.int64)))


def test_materials_take_time_in_proportion_to_their_number(tmp_path):
    def seconds(n):
        faces = "".join(f"usemtl m{k}\nf 1 2 3\nf 1 2 3 4\n" for k in range(n))
        (tmp_path / "a.obj").write_text("v 0 0 0 1 1 1\nv 6 0 0 1 1 1\nv 6 5 0 1 1 1\nv 0 5 0 1 1 1\n" + faces)
        start = time.process_time()
        mesh = load_mesh(tmp_path / "a.obj", "z")
        assert len(mesh.faces) == 3 * n and len(mesh.surfaces) == n
        return time.process_time() - start

    assert seconds(16_000) < 8 * seconds(4_000)  # 16 times where each material goes through all faces


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_strips_of_a_texture_are_the_texture(tmp_path, mode):
    pixels = np.random.default_rng(0).integers(0, 255, (600, 40, 4), dtype=np.uint8)
    image = Image.fromarray(pixels).convert(mode)
    file = io.BytesIO()
    image.save(file, "PNG", **({"transparency": 3} if mode == "P" else {}))
    (tmp_path / "a.obj").touch()
    rgb, alpha = Images(ScanFiles(tmp_path / "a.obj"), Budget(tmp_path / "a.obj")).decode(file.getvalue(), "t")
    file.seek(0)
    again = Image.open(file)
    assert np.array_equal(rgb, again.convert("RGB"))
    assert (alpha is None) == (mode in ("1", "L", "RGB"))
    assert alpha is None or np.array_equal(alpha, again.convert("RGBA").getchannel("A"))
