"""``pkg.module:Factory``: imported because the user names it, never because a file does."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from extractor_inputs import SPACE, write

import sb3_abisim
from sb3_abisim import registry
from sb3_abisim.common.cli import import_packages
from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import EncoderFileError, load_encoder
from sb3_abisim.registry import import_network, networks

NAME = "user_networks:Pooled"


@pytest.fixture(autouse=True)
def nothing_is_named(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As in a fresh process."""
    monkeypatch.setattr(registry, "_IMPORTED_NETWORKS", {})
    yield
    sys.modules.pop("user_networks", None)


def forget() -> None:
    registry._IMPORTED_NETWORKS.clear()
    sys.modules.pop("user_networks", None)


def test_naming_it_imports_it() -> None:
    encoder = make_encoder(SPACE, NAME, width=3)
    assert encoder.features_dim == 6 and encoder.spec() == {"name": NAME, "kwargs": {"width": 3}}
    assert encoder.layers.conv.out_channels == 3 and NAME in networks()


def test_a_file_is_refused_until_the_user_names_its_network(tmp_path: Path) -> None:
    path = write(tmp_path / "e.safetensors", NAME, width=3)
    ways: dict[str, Any] = {
        "the command": lambda: (import_packages([NAME]), load_encoder(path))[1],
        "load_encoder": lambda: load_encoder(path, network=NAME),
        "an extractor": lambda: sb3_abisim.ActionBisimExtractor(
            SPACE, str(path), network=NAME, network_kwargs={"width": 3}
        ),
        "any extractor": lambda: sb3_abisim.EncoderExtractor(SPACE, str(path), network=NAME),
        "policy_kwargs": lambda: sb3_abisim.policy_kwargs(path, network=NAME),
    }
    for way, load in ways.items():
        forget()
        with pytest.raises(EncoderFileError, match=rf"{NAME}.*--packages {NAME} .*network='{NAME}'"):
            load_encoder(path)
        assert "user_networks" not in sys.modules, way
        load()
        assert load_encoder(path).encoder.spec()["name"] == NAME, way


def test_importing_the_module_is_not_naming_its_attributes(tmp_path: Path) -> None:
    """A file could name any function of any module that is there."""
    path = write(tmp_path / "e.safetensors", NAME)
    forget()
    import_packages(["user_networks"])
    with pytest.raises(EncoderFileError, match="imported only if you name it"):
        load_encoder(path)
    with pytest.raises(EncoderFileError, match="imported only if you name it"):
        load_encoder(path, network="user_networks:tiny")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_module:Net", "cannot import.*No module named 'no_such_module'.*PYTHONPATH"),
        ("user_networks:Missing", "cannot import.*Missing"),
        ("user_networks:", "cannot import"),
        (":Pooled", "cannot import"),
        ("user_networks:NOT_A_FACTORY", "no factory but 3"),
    ],
)
def test_names_that_lead_nowhere(name: str, message: str) -> None:
    for call in (lambda: import_network(name), lambda: import_packages([name]), lambda: make_encoder(SPACE, name)):
        with pytest.raises(ValueError, match=message):
            call()
