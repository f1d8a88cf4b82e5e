"""Encoder files of networks that were trained elsewhere."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import OBSERVATIONS, SPACE, RandomImages
from gymnasium import spaces
from torch import nn
from user_networks import Pooled, tiny

import sb3_abisim
from sb3_abisim import from_module, load_encoder
from sb3_abisim.networks.base import make_encoder
from sb3_abisim.registry import get_method, get_objective

X = th.from_numpy(OBSERVATIONS).float() / 255


def test_a_class_is_named_by_itself(tmp_path: Path) -> None:
    net = Pooled(SPACE, width=3)
    before = th.get_rng_state()
    hash = from_module(net, SPACE, tmp_path / "e.safetensors", network_kwargs={"width": 3})
    assert th.equal(th.get_rng_state(), before), "the caller's random numbers do not depend on it"
    file = load_encoder(tmp_path / "e.safetensors")
    assert file.hash == hash and th.allclose(file.encoder(X), net(X), atol=1e-6)
    assert file.encoder.spec() == {"name": "user_networks:Pooled", "kwargs": {"width": 3}}
    assert (file.metadata["objective"], file.metadata["env_id"]) == ("foreign", "unknown")
    file.check(SPACE, spaces.Discrete(9))
    with pytest.raises(ValueError, match="observation_space"):
        file.check(spaces.Box(0, 255, (3, 15, 16), np.uint8))


def test_a_factory_is_named_by_the_user(tmp_path: Path) -> None:
    """Batch norm keeps its statistics; the module is left as it was."""
    net = tiny(SPACE)
    for _ in range(3):
        net(X)
    settings = {"seed": 7}
    from_module(net, SPACE, tmp_path / "e.safetensors", network="user_networks:tiny", settings=settings, env_id="A-v0",
                action_space=spaces.Discrete(4), reference_observations=OBSERVATIONS)  # fmt: skip
    assert net.training
    file = load_encoder(tmp_path / "e.safetensors")
    assert th.allclose(file.encoder(X), net.eval()(X), atol=1e-6)
    assert file.metadata["settings"] == {"objective": "foreign", "seed": 7} and file.metadata["env_id"] == "A-v0"
    with pytest.raises(ValueError, match="action_space"):
        file.check(SPACE, spaces.Discrete(3))


def test_a_registered_network(tmp_path: Path) -> None:
    encoder = make_encoder(SPACE, "small", features_dim=9)
    kwargs: dict[str, Any] = {"network": "small", "network_kwargs": {"features_dim": 9}}
    for module in (encoder, encoder.layers):
        from_module(module, SPACE, tmp_path / "e.safetensors", **kwargs)
        assert th.allclose(load_encoder(tmp_path / "e.safetensors").encoder(X), encoder(X), atol=1e-6)
    with pytest.raises(ValueError, match="Encoder of network 'small'; give network="):
        from_module(encoder, SPACE, tmp_path / "x.safetensors")


class Other(Pooled):
    """The same weights by name, and another computation."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(1 - observations)


def make_local() -> nn.Module:
    class Local(Pooled):
        pass

    return Local(SPACE)


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        (make_local(), {}, "make_local.<locals>.Local can be imported by no other program; move the class"),
        (nn.Sequential(nn.Flatten()), {}, "cannot be built again by its name.*give network='pkg.module:factory'"),
        (Pooled(SPACE, width=3), {}, "builds another network than this one.*pkg.module:factory"),
        (Pooled(SPACE, stride=3), {}, "computes something else than the module; give its network_kwargs"),
        (Other(SPACE), {"network": "user_networks:Pooled"}, "computes something else"),
        (tiny(SPACE), {"network": "tyni"}, "unknown network 'tyni'"),
    ],
    ids=["local", "no factory", "weights", "stride", "computation", "mistyped"],
)
def test_what_cannot_be_built_again_is_refused(
    tmp_path: Path, module: nn.Module, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        from_module(module, SPACE, tmp_path / "e.safetensors", **arguments)
    assert not list(tmp_path.iterdir())


def test_main_is_no_module_to_import_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pooled, "__module__", "__main__")
    with pytest.raises(ValueError, match="__main__:Pooled can be imported by no other program"):
        from_module(Pooled(SPACE), SPACE, tmp_path / "e.safetensors")


@pytest.mark.parametrize("name", ["EncoderExtractor", "ForeignExtractor"])
def test_it_enters_extractors(tmp_path: Path, name: str) -> None:
    net, path = Pooled(SPACE), str(tmp_path / "e.safetensors")
    from_module(net, SPACE, path)
    kwargs = {"encoder": path, "network": "user_networks:Pooled", "freeze": True}
    policy_kwargs = {"features_extractor_class": getattr(sb3_abisim, name), "features_extractor_kwargs": kwargs}
    model = sb3.PPO("CnnPolicy", RandomImages(), n_steps=8, batch_size=8, policy_kwargs=policy_kwargs, device="cpu")
    model.learn(16)
    assert th.allclose(model.policy.features_extractor(X), net(X), atol=1e-6)
    with pytest.raises(ValueError, match=r"trained by 'foreign'.*use ForeignExtractor"):
        sb3_abisim.SSIExtractor(SPACE, path, network="user_networks:Pooled")


def test_the_method_pretrains_nothing_and_needs_a_file() -> None:
    method = get_method("foreign")
    assert method.has_encoder_file and not method.is_pretrained
    with pytest.raises(ValueError, match=r"no objective pretrains 'foreign', only .*; give a file: foreign=FILE"):
        get_objective("foreign")
