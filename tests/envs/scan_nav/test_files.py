"""Scan files that are refused before trimesh reads them, and files beside them."""

import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image
from scan_inputs import empty_cache, file_of_the_house, floor, map_of_the_house, pixel, write  # noqa: F401

from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap


def glb_with(**header):
    data = json.dumps({"asset": {"version": "2.0"}, **header}).encode()
    data += b" " * (-len(data) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(data), len(data), b"JSON") + data


def cloud(path):
    trimesh.PointCloud(np.random.default_rng(0).random((50, 3)) * 4).export(path)


BROKEN = {
    "lfs.glb": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
    "empty.glb": (b"", "is empty"),
    "text.glb": (b"<html>not found, but long enough to be a header</html>", "not a binary glTF"),
    "bad.gltf": (b"{", "cannot be read"),
    "bad.ply": (b"ply\nformat ascii 1.0\nelement vertex 5\n", "cannot be read"),
    "scan.fbx": (b"x", r"suffix must be one of \.glb"),
    "draco.glb": (glb_with(extensionsRequired=["KHR_draco_mesh_compression"]), "Draco.*gltf-transform"),
    "ktx.glb": (glb_with(extensionsRequired=["KHR_texture_basisu"]), "KTX2.*gltf-transform"),
    "nothing.glb": (glb_with(), "empty|cannot be read"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_refuses_broken_files(tmp_path, name):
    content, message = BROKEN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=message) as error:
        ScanMap.from_mesh(tmp_path / name)
    assert name in str(error.value)


def test_refuses_missing_truncated_and_pointless_files(tmp_path, house_file):
    with pytest.raises(SceneError, match=r"there is no scan file .*absent\.glb"):
        ScanMap.from_mesh(tmp_path / "absent.glb")
    (tmp_path / "half.glb").write_bytes(house_file.read_bytes()[:5000])
    with pytest.raises(SceneError, match=r"half.glb is truncated: it has 5000 of \d+ bytes"):
        ScanMap.from_mesh(tmp_path / "half.glb")
    cloud(tmp_path / "cloud.ply")
    with pytest.raises(SceneError, match=r"cloud.ply is a point cloud"):
        ScanMap.from_mesh(tmp_path / "cloud.ply")


def test_a_missing_texture_is_one_warning_and_gray(tmp_path):
    path = write(trimesh.Scene([floor()]), tmp_path / "scan.obj")
    next(file for file in tmp_path.iterdir() if file.suffix == ".png").unlink()
    with pytest.warns(UserWarning, match=r"scan.obj refers to \S+\.png, which is not there") as warned:
        scan = ScanMap.from_mesh(path)
    assert len(warned) == 1
    assert scan.orthophoto[pixel(scan, 3.5, 3.5)].tolist() == [160, 160, 160]
    with pytest.warns(UserWarning, match=r"scan.obj refers to \S+\.png, which is not there"):
        ScanMap.from_mesh(path)  # from the cache


@pytest.mark.parametrize("line", ["/home/me/scans/{}", "..\\{}", "textures/{}", "my%20{}", "a%20b/{}"])
def test_textures_under_another_machines_path(tmp_path, line, scan):
    path = write(trimesh.Scene([floor()]), tmp_path / "scan.obj")
    (material,) = tmp_path.glob("*.mtl")
    (image,) = tmp_path.glob("*.png")
    name = f"my {image.name}" if line.startswith("my") else image.name
    name = f"a b/{name}" if line.startswith("a%20b") else name
    (tmp_path / "a b").mkdir()
    image.rename(tmp_path / name)
    material.write_text(material.read_text().replace(image.name, line.format(image.name)))
    textured = ScanMap.from_mesh(path)
    assert textured.orthophoto[pixel(textured, 0.2, 3.8)].tolist() == [30, 200, 30]
    # The cache knows the file that was read.
    Image.new("RGB", (64, 64), (1, 2, 3)).save(tmp_path / name)
    assert ScanMap.from_mesh(path).orthophoto[pixel(textured, 0.2, 3.8)].tolist() == [1, 2, 3]


def test_nothing_outside_of_the_scans_folder_is_read(tmp_path):
    (tmp_path / "scan").mkdir()
    path = write(trimesh.Scene([floor()]), tmp_path / "scan" / "scan.obj")
    (material,) = path.parent.glob("*.mtl")
    (image,) = path.parent.glob("*.png")
    image.rename(tmp_path / image.name)
    material.write_text(material.read_text().replace(image.name, f"../{image.name}"))
    with pytest.warns(UserWarning, match=r"which is not there \(in the scan's folder\)"):
        ScanMap.from_mesh(path)
