"""Textures that together would take too much memory are reduced, and nothing else about the scan changes."""

import io
import tracemalloc

import numpy as np
import pytest
from gltf_inputs import FLOOR, UV, Gltf
from PIL import Image
from scan_inputs import empty_cache  # noqa: F401

from sb3_abisim.envs.scan_nav import files, images
from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap
from sb3_abisim.envs.scan_nav.mesh import load_mesh

SIDE = 64
QUADRANTS = np.array([[[255, 0, 0, 255], [0, 255, 0, 255]], [[0, 0, 255, 255], [240, 240, 240, 255]]], np.uint8)
CORNERS = "v 0 0 0\nv 6 0 0\nv 6 5 0\nv 0 5 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def quadrants(k, side=SIDE):
    """A texture of four colors, which differs from others by the number alone."""
    pixels = QUADRANTS.repeat(side // 2, axis=0).repeat(side // 2, axis=1)
    pixels[0, 0] = k
    return pixels


def obj(folder, n, suffix="png", library=""):
    """Floors side by side, each with a texture of its own."""
    faces = ""
    for k in range(n):
        image = Image.fromarray(quadrants(k)[..., : 3 if suffix == "jpg" else 4])
        image.save(folder / f"{k}.{suffix}", **({"quality": 95} if suffix == "jpg" else {}))
        library += f"newmtl {k}\nmap_Kd {k}.{suffix}\n"
        faces += CORNERS.replace("v 0", f"v {6 * k}").replace("v 6", f"v {6 * k + 6}")
        faces += f"usemtl {k}\nf -4/-4 -3/-3 -2/-2 -1/-1\n"
    (folder / "scan.mtl").write_text(library)
    (folder / "scan.obj").write_text("mtllib scan.mtl\n" + faces)
    return folder / "scan.obj"


def kept_bytes(mesh):
    """Of all different arrays of the surfaces' textures."""
    arrays = [s.texture for s in mesh.surfaces] + [s.opacity.texture for s in mesh.surfaces if s.opacity is not None]
    return sum({id(array): array.nbytes for array in arrays if array is not None and array.strides[0]}.values())


def shaded(path, n=6):
    """One texture in many shades."""
    gltf = Gltf()
    texture = {"index": gltf.texture(quadrants(0))}
    for k in range(n):
        rough = {"baseColorFactor": [0.1 * k, 1, 1, 1], "baseColorTexture": texture}
        gltf.node(gltf.primitive(FLOOR, {"alphaMode": "MASK", "pbrMetallicRoughness": rough}, uv=UV))
    return gltf.save(path)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_textures_are_reduced_to_what_may_be_kept(tmp_path, monkeypatch, capsys, suffix):
    path, channels = obj(tmp_path, 5, suffix), 3 if suffix == "jpg" else 4
    whole = ScanMap.from_mesh(path, cache=False, up="z")
    assert "divided" not in capsys.readouterr().err and "texture_factor" not in whole.settings["report"]
    assert load_mesh(path, "z").notes["texture_factor"] == 1
    # Two of five at their full size; half of their width and height is a fourth.
    monkeypatch.setattr(images, "MAX_KEPT_BYTES", 2 * SIDE * SIDE * channels)
    mesh = load_mesh(path, "z")
    assert mesh.notes["texture_factor"] == 2 and mesh.notes["textures"] == 5
    assert {surface.texture.shape for surface in mesh.surfaces} == {(SIDE // 2, SIDE // 2, 3)}
    assert kept_bytes(mesh) <= images.MAX_KEPT_BYTES
    made = ScanMap.from_mesh(path, cache=False, up="z")
    assert "the width and height of its textures were divided by 2, since together they would take more than" in (
        capsys.readouterr().err
    )
    assert made.settings["report"]["texture_factor"] == 2
    assert np.array_equal(made.walkable, whole.walkable)
    different = abs(made.orthophoto.astype(int) - whole.orthophoto).max(axis=2) > 40
    assert different.mean() < 0.05  # at the edges of colors, which are 12 cm wide instead of 9


def test_a_texture_is_decoded_while_it_may_be_kept_alone(tmp_path, monkeypatch):
    path, decoded = obj(tmp_path, 6), []
    decode = images._channels
    monkeypatch.setattr(images, "_channels", lambda *args: decoded.append(args[1:3]) or decode(*args))
    monkeypatch.setattr(images, "MAX_KEPT_BYTES", 2 * SIDE * SIDE * 4)
    load_mesh(path, "z")
    assert decoded == [(SIDE, SIDE)] * 2 + [(SIDE // 2, SIDE // 2)] * 6


def test_shades_and_alpha_count(tmp_path, monkeypatch):
    path = shaded(tmp_path / "scan.glb")
    full = SIDE * SIDE * (4 + 6 * 3)
    monkeypatch.setattr(images, "MAX_KEPT_BYTES", full)
    assert load_mesh(path).notes["texture_factor"] == 1
    monkeypatch.setattr(images, "MAX_KEPT_BYTES", full - 1)
    mesh = load_mesh(path)
    assert mesh.notes["texture_factor"] == 2 and kept_bytes(mesh) < full // 4


def test_a_map_of_transparency_is_kept_once_and_has_its_textures_size(tmp_path, monkeypatch):
    path = obj(tmp_path, 2)
    library = "".join(f"newmtl {k}\nmap_Kd {k}.png\nmap_d veil.png\n" for k in range(2))
    (tmp_path / "scan.mtl").write_text(library)
    veil = Image.fromarray(np.arange(SIDE * SIDE, dtype=np.uint32).reshape(SIDE, SIDE).astype(np.uint8)).convert("RGB")
    veil.save(tmp_path / "veil.png")
    full = SIDE * SIDE * (4 + 4 + 3 + 1)
    monkeypatch.setattr(images, "MAX_KEPT_BYTES", full)
    surfaces = load_mesh(path, "z").surfaces
    assert surfaces[0].opacity.texture is surfaces[1].opacity.texture
    assert np.array_equal(surfaces[0].opacity.texture, np.asarray(veil)[..., 0])
    monkeypatch.setattr(images, "MAX_KEPT_BYTES", full - 1)
    assert {s.opacity.texture.shape for s in load_mesh(path, "z").surfaces} == {(SIDE // 2, SIDE // 2)}
    # Halves of 64 and of 65 are the same, and the file says which it is.
    veil.resize((SIDE + 1, SIDE)).save(tmp_path / "veil.png")
    with pytest.raises(SceneError, match=r"a map_d veil.png of another size or place than its texture"):
        load_mesh(path, "z")


def test_what_is_reduced_lies_where_it_lay(tmp_path):
    """Sides that the factor does not divide, and the last strip of rows."""
    ramp = np.broadcast_to(np.linspace(0, 255, 1001)[:, None], (1001, 997)).astype(np.uint8)
    (tmp_path / "a.obj").touch()
    for turned in (ramp, ramp[:997].T):
        file = io.BytesIO()
        Image.fromarray(turned).save(file, "PNG")
        made = images.Images(files.ScanFiles(tmp_path / "a.obj"), files.Budget(tmp_path / "a.obj"), 3)
        rgb, alpha = made.decode(file.getvalue(), "t")
        assert alpha is None and rgb.shape == (turned.shape[0] // 3, turned.shape[1] // 3, 3)
        places = [(np.arange(n) + 0.5) / n * full for n, full in zip(rgb.shape[:2], turned.shape, strict=True)]
        expected = turned[places[0].astype(int)[:, None], places[1].astype(int)]
        assert abs(rgb[..., 0].astype(int) - expected).max() <= 1


def test_what_is_lost_is_warned_of_once_when_a_scan_is_read_again(tmp_path, monkeypatch):
    path = obj(tmp_path, 3)
    (tmp_path / "1.png").unlink()
    monkeypatch.setattr(files, "_MAX_MISSING", 1)  # it counts once
    monkeypatch.setattr(images, "MAX_KEPT_BYTES", SIDE * SIDE * 4)
    with pytest.warns(UserWarning, match=r"refers to 1\.png, which is not there") as warned:
        assert load_mesh(path, "z").notes["texture_factor"] == 2
    assert len(warned) == 1


def test_textures_in_files_larger_than_any_texture_are_not_read(tmp_path, monkeypatch):
    path = obj(tmp_path, 1)
    monkeypatch.setattr(files, "MAX_IMAGE_FILE_BYTES", 100)
    monkeypatch.setattr(
        files.ScanFiles, "read", lambda self, found: b"" if found == "0.png" else (path.parent / found).read_bytes()
    )
    with pytest.raises(SceneError, match=r"the texture 0\.png has \d+ bytes, more than 100; export it again"):
        load_mesh(path, "z")
    with pytest.raises(SceneError, match=r"the texture image 0 has \d+ bytes, more than 100; export it again"):
        load_mesh(shaded(tmp_path / "scan.glb"))


def test_webp_has_a_bound_of_its_own(tmp_path, monkeypatch):
    path = obj(tmp_path, 1, "webp")
    load_mesh(path, "z")
    monkeypatch.setattr(images, "MAX_WEBP_PIXELS", SIDE * SIDE - 1)
    with pytest.raises(
        SceneError, match=r"the texture 0\.webp has 64 x 64 pixels, and one of WebP may have .* save it as PNG"
    ):
        load_mesh(path, "z")


def test_textures_inside_a_file_are_read_one_at_a_time(tmp_path):
    gltf = Gltf()
    noise = np.random.default_rng(0).integers(0, 255, (1000, 1000, 3), dtype=np.uint8)
    for k in range(12):
        texture = {"index": gltf.texture(noise[: 20 * k + 20])}
        gltf.node(gltf.primitive(FLOOR, {"pbrMetallicRoughness": {"baseColorTexture": texture}}, uv=UV))
    gltf.view(bytes(40_000_000))  # what nobody asks for
    path = gltf.save(tmp_path / "scan.glb")
    del gltf
    tracemalloc.start()
    load_mesh(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20_000_000
