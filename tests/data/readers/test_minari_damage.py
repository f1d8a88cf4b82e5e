"""What a file of Minari may hold that its own reader would fail at, or follow."""

import io
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from minari_inputs import episode, make_frames, make_minari
from PIL import Image

from sb3_abisim.data.readers.minari import import_dataset

minari = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")


pytestmark = pytest.mark.usefixtures("store", "no_environment")


def data_file(dataset_id: str) -> Path:
    return Path(minari.load_dataset(dataset_id).storage.data_path) / "main_data.hdf5"


def damaged_minari(edit: object) -> None:
    make_minari("a-v0", [episode(make_frames(9, (3, 9, 9)))], gym.spaces.Box(0, 255, (3, 9, 9), np.uint8))
    with h5py.File(data_file("a-v0"), "a") as file:
        edit(file["episode_0"])


def huge(group: object) -> None:
    del group["observations"]
    group.create_dataset("observations", (10**9, 3, 9, 9), np.uint8, chunks=True)


def elsewhere(group: object) -> None:
    del group["actions"]
    group["actions"] = h5py.ExternalLink("other.hdf5", "/actions")


def in_another_file(group: object) -> None:
    del group["actions"]
    group.create_dataset("actions", (8,), np.int64, external=[("/etc/passwd", 0, 64)])


def without_rewards(group: object) -> None:
    del group["rewards"]


def another_kind(group: object) -> None:
    del group["actions"]
    group.create_group("actions")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (huge, r"main_data\.hdf5 is damaged .*/episode_0/observations declares 243000000000 bytes in 0"),
        (elsewhere, "/episode_0/actions is a link"),
        (in_another_file, "/episode_0/actions lies in another file"),
        (without_rewards, "cannot be read .KeyError"),
        (another_kind, "cannot be read .AssertionError"),
    ],
)
def test_what_minari_would_fail_at_or_follow_is_one_sentence(tmp_path: Path, edit: object, message: str) -> None:
    damaged_minari(edit)
    with pytest.raises(ValueError, match=message):
        import_dataset("a-v0", tmp_path / "out")


def test_images_of_minari_are_jpeg_alone(tmp_path: Path) -> None:
    """Pillow would start Ghostscript for an EPS."""
    space = gym.spaces.Box(0, 255, (40, 48, 3), np.uint8)
    make_minari("b-v0", [episode(make_frames(6, (40, 48, 3)))], space)
    with pytest.warns(UserWarning, match="JPEG"):
        import_dataset("b-v0", tmp_path / "jpeg")
    eps = io.BytesIO()
    Image.new("RGB", (48, 40)).save(eps, "EPS")
    with h5py.File(data_file("b-v0"), "a") as file:
        group = file["episode_0"]
        del group["observations"]
        group.create_dataset("observations", data=[np.frombuffer(eps.getvalue(), np.uint8)] * 6)
    with (
        pytest.warns(UserWarning, match="JPEG"),
        pytest.raises(ValueError, match=r"cannot be read \(UnidentifiedImage"),
    ):
        import_dataset("b-v0", tmp_path / "out")
