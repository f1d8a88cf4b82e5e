"""The built wheel holds everything: our command runs from it, in an empty folder, on the encoder that ships."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from sb3_abisim.common.paths import resource_path
from sb3_abisim.networks.encoder_file import load_encoder

ROOT = Path(__file__).resolve().parent.parent
# All that a wheel is made of; copied, because a build leaves files behind.
SOURCES = ("setup.cfg", "pyproject.toml", "README.md", "LICENSE", "sb3_abisim", "hyperparams", "encoders")
BUILD = "import setuptools.build_meta as backend; backend.build_wheel('wheel')"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source / name)
    built = subprocess.run([sys.executable, "-c", BUILD], cwd=source, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    (wheel,) = (source / "wheel").glob("sb3_abisim-*-py3-none-any.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return folder / "site"


def test_wheel_holds_the_data_files(installed: Path) -> None:
    for kind, pattern in (("hyperparams", "*.yml"), ("encoders", "*.safetensors")):
        folder = resource_path(kind)
        expected = {path.relative_to(folder) for path in folder.rglob(pattern)}
        packaged = {path.relative_to(installed / "sb3_abisim" / kind) for path in installed.rglob(pattern)}
        assert expected and packaged == expected
    assert (installed / "sb3_abisim" / "py.typed").is_file()


def test_train_from_the_wheel_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    argv = ["train", "--algo", "ppo", "--env", "DistractorPointMaze-v0", "-n", "256", "--num-threads", "1"]
    argv += ["--eval-freq", "-1", "-params", "n_envs:2", "n_steps:32", "batch_size:32"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(installed)}
    done = subprocess.run(
        [sys.executable, "-m", "sb3_abisim", *argv],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert f"Loading hyperparameters from: {installed / 'sb3_abisim' / 'hyperparams' / 'ppo.yml'}" in done.stdout
    assert f"hash {load_encoder('DistractorPointMaze-v0/abisim').hash}" in done.stdout
    assert (tmp_path / "logs/ppo/DistractorPointMaze-v0_1/DistractorPointMaze-v0.zip").is_file()
