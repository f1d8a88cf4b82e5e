"""Where files lie that come with the package, and those that it keeps."""

from pathlib import Path

import pytest

from sb3_abisim.common import paths
from sb3_abisim.common.paths import cache_folder, resource_path


def test_resource_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert resource_path("encoders") == Path(paths.__file__).resolve().parents[2] / "encoders"
    package = tmp_path / "site" / "sb3_abisim"
    (package / "hyperparams").mkdir(parents=True)
    monkeypatch.setattr(paths, "_PACKAGE", package)
    assert resource_path("hyperparams") == package / "hyperparams"
    assert resource_path("encoders") == tmp_path / "site" / "encoders"
    with pytest.raises(ValueError, match="'models'"):
        resource_path("models")  # type: ignore[arg-type]


def test_cache_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/kept/here")
    for empty in (True, False):
        monkeypatch.setenv("SB3_ABISIM_CACHE", "") if empty else monkeypatch.delenv("SB3_ABISIM_CACHE")
        assert cache_folder("scans") == Path("/kept/here/sb3_abisim/scans") and cache_folder().name == "sb3_abisim"
    monkeypatch.setenv("SB3_ABISIM_CACHE", "/chosen")
    assert cache_folder("scans") == cache_folder() == Path("/chosen")
