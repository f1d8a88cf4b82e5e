"""Maps as files, in the cache, and from elsewhere."""

import zipfile

import numpy as np
import pytest
import trimesh
from PIL import Image
from scan_inputs import empty_cache, file_of_the_house, floor, map_of_the_house, write  # noqa: F401

from sb3_abisim.common.paths import cache_folder
from sb3_abisim.envs.scan_nav import map as scan_map
from sb3_abisim.envs.scan_nav.files import SceneError
from sb3_abisim.envs.scan_nav.map import ScanMap


def test_npz_round_trip(scan, tmp_path):
    scan.save(tmp_path / "map.npz")
    again = ScanMap.load(tmp_path / "map.npz")
    assert again.content_hash == scan.content_hash and again.settings == scan.settings and again.origin == scan.origin


def test_damage_anywhere_in_a_map_is_one_kind_of_error(scan, tmp_path):
    scan.save(tmp_path / "map.npz")
    whole = (tmp_path / "map.npz").read_bytes()
    generator, refused = np.random.default_rng(0), 0
    for _ in range(300):
        place, length = int(generator.integers(len(whole))), int(generator.integers(1, 200))
        noise = generator.bytes(length) if generator.random() < 0.5 else bytes(length)
        (tmp_path / "bad.npz").write_bytes((whole[:place] + noise + whole[place + length :])[: len(whole)])
        try:
            ScanMap.load(tmp_path / "bad.npz")
        except SceneError as error:
            refused += "bad.npz" in str(error)
    assert refused > 200


def test_the_cache_is_used_and_notices_changes(tmp_path, monkeypatch):
    path = write(trimesh.Scene([floor()]), tmp_path / "scan.obj")
    first = ScanMap.from_mesh(path)
    calls = []
    build = scan_map.map_fields
    monkeypatch.setattr(scan_map, "map_fields", lambda *args: calls.append(args) or build(*args))
    assert ScanMap.from_mesh(path).content_hash == first.content_hash and not calls
    ScanMap.from_mesh(path, meters_per_pixel=0.03)
    assert len(calls) == 1, "other settings, another map"
    image = next(file for file in tmp_path.iterdir() if file.suffix == ".png")
    Image.new("RGB", (8, 8), (1, 2, 3)).save(image)
    assert ScanMap.from_mesh(path).content_hash != first.content_hash and len(calls) == 2, "another texture"
    for kept in cache_folder("scans").iterdir():
        kept.write_bytes(b"damaged")
    ScanMap.from_mesh(path)
    assert len(calls) == 3


def test_a_map_with_earlier_names_is_read(scan, tmp_path):
    """Its bytes stay, and so does its hash."""
    scan.save(tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as arrays:
        fields = dict(arrays)
    fields["metres_per_pixel"] = fields.pop("meters_per_pixel")
    fields["settings"] = np.array(str(fields["settings"]).replace("meters_per_pixel", "metres_per_pixel"))
    np.savez(tmp_path / "earlier.npz", **fields)
    earlier = ScanMap.load(tmp_path / "earlier.npz")
    assert earlier.content_hash == scan.content_hash and earlier.settings == scan.settings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "something"}, "format 'something'"),
        ({"walkable": np.zeros((60, 60), bool)}, "only 0.00 m2"),
        ({"walkable": np.zeros((60, 60))}, "walkable must be bool"),
        ({"height": np.zeros((60, 61), np.float32)}, "height must be float32 of shape"),
        ({"height": np.full((60, 60), np.inf, np.float32)}, "infinite"),
        ({"orthophoto": np.zeros((60, 60), np.uint8)}, "orthophoto must be uint8"),
        ({"meters_per_pixel": -1.0}, "meters_per_pixel"),
        ({"origin": np.array([np.nan, 0])}, "origin"),
        ({"settings": "{"}, "not a scan map"),
    ],
)
def test_refuses_wrong_maps_from_elsewhere(tmp_path, changes, message):
    good = {
        "format": scan_map.FORMAT,
        "orthophoto": np.zeros((60, 60, 3), np.uint8),
        "height": np.zeros((60, 60), np.float32),
        "walkable": np.ones((60, 60), bool),
        "meters_per_pixel": 0.05,
        "origin": np.zeros(2),
        "source": "elsewhere",
        "settings": "{}",
    }
    np.savez(tmp_path / "good.npz", **good)
    assert ScanMap.load(tmp_path / "good.npz").walkable.all()
    np.savez(tmp_path / "map.npz", **(good | changes))
    with pytest.raises(SceneError, match=message):
        ScanMap.load(tmp_path / "map.npz")
    (tmp_path / "map.npz").write_bytes((tmp_path / "good.npz").read_bytes()[:900])
    with pytest.raises(SceneError, match=r"map\.npz is not a scan map"):
        ScanMap.load(tmp_path / "map.npz")
    with pytest.raises(SceneError, match=r"no scan map .*absent"):
        ScanMap.load(tmp_path / "absent.npz")


def member(shape, descr, data=b""):
    header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode() + data


@pytest.mark.parametrize(("shape", "descr"), [((10**6, 10**6), "|u1"), ((), "<U99999999"), ((10**9, 3), "|u1")])
def test_a_file_that_declares_more_than_a_map_is_refused_before_it_is_unpacked(tmp_path, shape, descr):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in scan_map._KEYS:
            archive.writestr(f"{name}.npy", member(shape, descr, bytes(10**6)))
    with pytest.raises(SceneError, match=r"bomb\.npz is not a scan map \(.* does not have 1000000 bytes"):
        ScanMap.load(tmp_path / "bomb.npz")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"meters_per_pixel": 0}, "meters_per_pixel must be a number of meters above 0, got 0"),
        ({"floor": -1}, "floor must be"),
        ({"up": "w"}, "up must be one of"),
        ({"flip_faces": "no"}, "flip_faces must be True or False, got 'no'"),
        ({"meters_per_pixel": 30.0}, "meters_per_pixel must lie between 0.0005 and 1.0, got 30.0"),
        ({"agent_height": 3.0}, "agent_height 3.0 <= cut_height 2.0"),
        ({"color": 1}, "settings of a map are meters_per_pixel"),
    ],
    ids=str,
)
def test_refuses_settings(house_file, settings, message):
    with pytest.raises(ValueError, match=message):
        ScanMap.from_mesh(house_file, **settings)
