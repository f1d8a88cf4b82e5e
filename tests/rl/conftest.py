"""Encoder files that the tests of the extractors share."""

from pathlib import Path

import pytest
from extractor_inputs import register_batch_norm, write


@pytest.fixture
def batch_norm_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    register_batch_norm(monkeypatch)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "e.safetensors")


@pytest.fixture
def batch_norm_path(tmp_path: Path) -> Path:
    return write(tmp_path / "bn.safetensors", "BatchNorm")
