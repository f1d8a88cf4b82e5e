"""Fixtures of the two files about Minari."""

from pathlib import Path

import gymnasium as gym
import pytest

from sb3_abisim.data import chains


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Minari's folder, and exports of several shards."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setattr(chains, "SHARD_TRANSITIONS", 48)
    return tmp_path / "minari"


@pytest.fixture
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exchange with Minari must not make an environment."""

    def refuse(*args: object, **kwargs: object) -> None:
        pytest.fail(f"gymnasium.make({args}, {kwargs})")

    monkeypatch.setattr(gym, "make", refuse)
