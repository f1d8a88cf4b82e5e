"""Every objective pretrains ScanNav's small encoder, and action-bisimulation its residual network."""

import pytest

from sb3_abisim.data.collect import collect
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import pretrain
from sb3_abisim.registry import get_method, methods

SETTINGS = {"n_updates": 4, "batch_size": 16, "log_interval": 2, "checkpoint_interval": 4, "eval_fraction": 0}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scan") / "apartment"
    collect("ScanNav-v0", 400, folder, n_envs=8, env_kwargs={"stop": "auto", "scenes": 0})
    return folder


@pytest.mark.parametrize("objective", [name for name, method in methods().items() if method.is_pretrained])
def test_objectives_of_the_small_encoder(data, tmp_path, objective):
    base = "ScanNav-v0/ssi" if get_method(objective).base else None
    config = load_config(objective, "ScanNav-v0", SETTINGS)
    output = pretrain(objective, data, tmp_path / "x.safetensors", config, base, progress_bar=False, verbose=0)
    file = load_encoder(str(output))
    assert file.encoder.spec()["name"] == "ScanNavEncoder" and file.metadata["objective"] == objective
    assert file.encoder.features_dim == config.network_kwargs.get("hidden_dim", 2048)


def test_the_residual_network(tmp_path):
    folder = tmp_path / "apartment"
    collect("ScanNav-v0", 64, folder, n_envs=8, env_kwargs={"stop": "auto", "scenes": 0, "image_size": 64})
    settings = {**SETTINGS, "n_updates": 2, "batch_size": 8, "chunk_length": 1}
    settings |= {"network": "ScanNavResNet18", "network_kwargs": {"image_size": 64}}
    base = None
    for objective in ("ssi", "abisim"):
        config = load_config(objective, "ScanNav-v0", settings)
        output = pretrain(objective, folder, tmp_path / f"{objective}.safetensors", config, base, verbose=0)
        base = str(output)
        encoder = load_encoder(base).encoder
        assert encoder.spec()["name"] == "ScanNavResNet18" and encoder.input_shape == (4, 64, 64)
