"""Encoder files whose hash is right and whose content is not, and networks that are not known."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch as th
from encoder_file_inputs import SPACE, forge, save, seeded_encoder, write_with_hash

from sb3_abisim import registry
from sb3_abisim.common.cli import import_packages
from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import (
    REFERENCE_TOLERANCE,
    EncoderFileError,
    load_encoder,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save(tmp_path / "encoder.safetensors")
    return tmp_path / "encoder.safetensors"


def test_a_forged_but_harmless_file_loads(path: Path) -> None:
    """The positive control of the tests below: forging itself breaks nothing."""
    forge(path, lambda tensors, document: document["contract"].update(env_id="Other-v0"))
    assert load_encoder(path).metadata["env_id"] == "Other-v0"


@pytest.mark.parametrize(
    "network",
    [
        {"name": None, "kwargs": {}},
        {"name": ["Nav2DEncoder"], "kwargs": {}},
        {"name": "Nav2DEncoder", "kwargs": {"unknown": 1}},
        {"name": "Nav2DEncoder", "kwargs": {"name": "PointMazeEncoder"}},
        {"name": "Nav2DEncoder", "kwargs": {"n_input_channels": "3"}},
        {"name": "Nav2DEncoder", "kwargs": {"n_input_channels": -3}},
        {"name": "Nav2DEncoder", "kwargs": {"n_input_channels": 10**13}},
        {"name": "Nav2DEncoder", "kwargs": []},
        {"name": "PointMazeEncoder", "kwargs": {}},
        {"name": "PointMazeEncoder", "kwargs": {"features_dim": 10**13}},
        {},
        "Nav2DEncoder",
    ],
)
def test_network_from_the_file_is_validated(path: Path, network: Any) -> None:
    forge(path, lambda tensors, document: document.update(network=network))
    with pytest.raises(EncoderFileError, match="not a valid encoder file"):
        load_encoder(path)


@pytest.mark.parametrize("network", [{"name": None, "kwargs": {}}, {"name": "Nav2DEncoder", "kwargs": []}])
def test_a_network_is_a_name_with_arguments(path: Path, network: Any) -> None:
    forge(path, lambda tensors, document: document.update(network=network))
    with pytest.raises(EncoderFileError, match=r"network must be a name with keyword arguments, got \{.*'name': "):
        load_encoder(path)


@pytest.mark.parametrize(
    ("name", "kwargs"),
    [("system", {}), ("os.system", {"command": "true"}), ("os:system", {"command": "true"}), ("__class__", {})],
)
def test_a_network_that_is_not_registered_is_refused(path: Path, name: str, kwargs: dict[str, Any]) -> None:
    forge(path, lambda tensors, document: document.update(network={"name": name, "kwargs": kwargs}))
    message = r"is not registered; known are (\w+, )*Nav2DEncoder, .* If you trust the .* command line, or import it$"
    if ":" in name:
        message = f"is imported only if you name it.*--packages {name} .*network='{name}'"
    with pytest.raises(EncoderFileError, match=rf"{path} names the network '{name}', which {message}"):
        load_encoder(path)


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of somebody else that registers a network; imported, it leaves a file."""
    name = "encoder_file_plugin"
    (tmp_path / f"{name}.py").write_text(
        "from pathlib import Path\n"
        "import torch\n"
        "from torch import nn\n"
        "from sb3_abisim import register_network\n"
        "Path(__file__).with_name('imported').touch()\n"
        "def factory(space, width=2):\n"
        "    width = torch.tensor(width).item()  # which a tensor without memory has not\n"
        "    return nn.Sequential(nn.Conv2d(space.shape[0], width, 3), nn.BatchNorm2d(width), nn.Flatten())\n"
        f"register_network('{name}.net', factory)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    registry.networks()
    monkeypatch.setattr(registry._NETWORKS, "by_name", dict(registry._NETWORKS.by_name))
    monkeypatch.delitem(sys.modules, name, raising=False)
    return name


def test_a_network_of_somebody_else_comes_back_once_its_package_is_imported(
    plugin: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import_packages([plugin])
    th.manual_seed(0)
    encoder = make_encoder(SPACE, f"{plugin}.net", width=3)
    encoder(th.rand(8, 3, 15, 15))  # moves the statistics of its batch norm
    save(tmp_path / "e", encoder)
    again = load_encoder(tmp_path / "e").encoder
    assert again.spec() == encoder.spec() == {"name": f"{plugin}.net", "kwargs": {"width": 3}}
    x = th.rand(2, 3, 15, 15)
    assert th.equal(again(x), encoder.eval()(x))
    key = "encoder.layers.0.bias"
    save(tmp_path / "f", encoder)
    forge(tmp_path / "f", lambda tensors, document: tensors.update({key: tensors[key].double()}))
    with pytest.raises(EncoderFileError, match="do not fit the network"):
        load_encoder(tmp_path / "f")
    # As in another process, that has not imported the package: refused, and nothing of it is run.
    registry._NETWORKS.by_name.pop(f"{plugin}.net")
    monkeypatch.delitem(sys.modules, plugin)
    (tmp_path / "imported").unlink()
    with pytest.raises(EncoderFileError, match=r"encoder_file_plugin\.net.* is not registered.*--packages"):
        load_encoder(tmp_path / "e")
    assert plugin not in sys.modules and not (tmp_path / "imported").exists()


def test_vast_network_is_refused_before_memory_is_taken(path: Path) -> None:
    def edit(tensors: dict[str, th.Tensor], document: dict[str, Any]) -> None:
        document["network"] = {"name": "PointMazeEncoder", "kwargs": {"features_dim": 10**10}}
        document["contract"]["observation_space"]["shape"] = [3, 64, 64]
        tensors["golden.observations"] = th.zeros(1, 3, 64, 64, dtype=th.uint8)

    forge(path, edit)
    with pytest.raises(EncoderFileError, match="do not fit the network"):
        load_encoder(path)


@pytest.mark.parametrize(
    "document", ["[]", "{}", "nonsense", "[" * 100_000, '{"format": 1}', '{"format": 1, "contract": 3}']
)
def test_malformed_metadata(path: Path, document: str) -> None:
    write_with_hash(path, safetensors.torch.load_file(path), document)
    with pytest.raises(EncoderFileError, match="not a valid encoder file"):
        load_encoder(path)


def test_other_format_and_metadata(path: Path) -> None:
    forge(path, lambda tensors, document: document["contract"].pop("objective"))
    with pytest.raises(EncoderFileError, match="the metadata have the keys"):
        load_encoder(path)
    forge(path, lambda tensors, document: document.update(format=2))
    with pytest.raises(EncoderFileError, match=r"format 2.*newer"):
        load_encoder(path)


@pytest.mark.parametrize(
    "name, value",
    [
        ("encoder.layers.0.bias", th.zeros(33)),
        ("encoder.layers.0.bias", th.zeros(32, dtype=th.float64)),
        ("encoder.extra", th.zeros(1)),
        ("golden.observations", th.zeros(5, 3, 15, 15)),
        ("golden.observations", th.zeros(5, 15, 15, 3, dtype=th.uint8)),
    ],
)
def test_tensors_that_do_not_fit(path: Path, name: str, value: th.Tensor) -> None:
    forge(path, lambda tensors, document: tensors.update({name: value}))
    with pytest.raises(EncoderFileError, match="not a valid encoder file"):
        load_encoder(path)


def test_reference_observations_of_another_space(path: Path) -> None:
    forge(path, lambda tensors, document: document["contract"]["observation_space"].update(shape=[3, 15, 16]))
    with pytest.raises(EncoderFileError, match=r"reference batch \(5, 3, 15, 15\) is not of \{.*\[3, 15, 16\]"):
        load_encoder(path)


def raw_embeddings(tensors: dict[str, th.Tensor], document: dict[str, Any]) -> None:
    """As if pretraining had not divided observations by 255."""
    with th.no_grad():
        tensors["golden.embeddings"] = seeded_encoder()(tensors["golden.observations"].float())


@pytest.mark.parametrize(
    "edit",
    [
        raw_embeddings,
        lambda tensors, document: tensors["golden.embeddings"].mul_(1.001),
        lambda tensors, document: tensors["golden.embeddings"].fill_(th.nan),
        lambda tensors, document: tensors["encoder.layers.0.weight"].mul_(1.01),
        lambda tensors, document: tensors["golden.observations"].add_(1),
    ],
)
def test_reference_batch_that_does_not_agree(path: Path, edit: Callable[..., object]) -> None:
    forge(path, edit)
    with pytest.raises(EncoderFileError, match=f"{path}: the network embeds the reference batch differently"):
        load_encoder(path)


def test_reference_batch_tolerates_rounding(path: Path) -> None:
    forge(path, lambda tensors, document: tensors["golden.embeddings"].mul_(1 + REFERENCE_TOLERANCE / 2))
    load_encoder(path)
