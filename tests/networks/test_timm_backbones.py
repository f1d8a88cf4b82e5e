"""Backbones of timm: transforms within the encoder, weights from safetensors alone, files that need no more."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import safetensors.torch
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from torch import nn

from sb3_abisim import collect, policy_kwargs
from sb3_abisim.__main__ import main
from sb3_abisim.networks import timm_backbones
from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.networks.encoder_file import embed, load_encoder, save_encoder
from sb3_abisim.registry import get_network

# The smallest networks of timm: one with batch norm and convolutions, one transformer for one size.
CONVOLUTIONS, TRANSFORMER = "test_resnet", "test_vit"


@pytest.fixture
def timm() -> Any:
    try:
        import timm
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"needs the extra [timm], and the torchvision that belongs to torch ({error})")
    return timm


def images(*shape: int) -> spaces.Box:
    return spaces.Box(0, 255, shape, np.uint8)


def save(path: Path, encoder: Encoder, space: spaces.Box) -> Path:
    observations = np.random.default_rng(0).integers(0, 256, (3, *space.shape), dtype=np.uint8)
    save_encoder(
        path,
        encoder,
        observation_space=space,
        action_space=spaces.Discrete(2),
        env_id="Any-v0",
        env_kwargs={},
        objective="ssi",
        settings={},
        dataset_hash="",
        reference_observations=observations,
    )
    return path


@pytest.mark.parametrize("member", [CONVOLUTIONS, TRANSFORMER, f"{CONVOLUTIONS}.r160_in1k"])
@pytest.mark.parametrize("n_channels", [1, 3, 4, 6])
def test_any_number_of_channels_through_a_file(tmp_path: Path, timm: Any, member: str, n_channels: int) -> None:
    space = images(n_channels, 40, 50)
    encoder = make_encoder(space, f"timm/{member}")
    config = timm.get_pretrained_cfg(member)
    rgb = {"mean": list(config.mean), "std": list(config.std)}
    numbers = {k: v * (n_channels // 3) if n_channels % 3 == 0 else [sum(v) / 3] * n_channels for k, v in rgb.items()}
    assert encoder.spec() == {
        "name": f"timm/{member}",
        "kwargs": {"input_size": list(config.input_size[1:]), **numbers},
    }
    file = load_encoder(save(tmp_path / "e.safetensors", encoder, space))
    assert file.encoder.spec() == encoder.spec()
    observations = th.randint(0, 256, (2, *space.shape), dtype=th.uint8)
    actual = embed(file.encoder, space, observations)
    assert actual.shape == (2, encoder.features_dim)
    th.testing.assert_close(actual, embed(encoder.eval(), space, observations))


@pytest.mark.parametrize("size", [(40, 50), (20, 25), (80, 60)])
def test_observations_are_resized_and_normalized_within(timm: Any, size: tuple[int, int]) -> None:
    mean, std = [0.1, 0.2, 0.3], [0.4, 0.5, 0.6]
    encoder = make_encoder(images(3, 40, 50), f"timm/{CONVOLUTIONS}", input_size=size, mean=mean, std=std).eval()
    inputs = th.rand(2, 3, 40, 50)
    resized = nn.functional.interpolate(inputs, size, mode="bilinear", antialias=True)
    normalized = th.stack([(resized[:, c] - mean[c]) / std[c] for c in range(3)], dim=1)
    backbone = encoder.layers.network
    th.testing.assert_close(encoder(inputs), backbone(normalized))
    assert encoder.spec()["kwargs"] == {"input_size": list(size), "mean": mean, "std": std}


def test_a_transformer_for_another_size(timm: Any) -> None:
    """It has a position for each patch."""
    encoder = make_encoder(images(3, 40, 40), f"timm/{TRANSFORMER}", input_size=[96, 64])
    assert encoder(th.rand(2, 3, 40, 40)).shape == (2, encoder.features_dim)


def test_a_file_does_not_depend_on_what_timm_says_later(
    tmp_path: Path, timm: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = images(3, 40, 40)
    path = save(tmp_path / "e.safetensors", make_encoder(space, f"timm/{CONVOLUTIONS}"), space)
    other = timm.get_pretrained_cfg(CONVOLUTIONS)
    other.mean, other.std, other.input_size = (0, 0, 0), (1, 1, 1), (3, 64, 64)
    monkeypatch.setattr(timm, "get_pretrained_cfg", lambda name: other)
    load_encoder(path)  # its reference batch is embedded as it was


def write_weights(timm: Any, path: Path, member: str = CONVOLUTIONS) -> nn.Module:
    network: nn.Module = timm.create_model(member, pretrained=False).eval()
    for name, buffer in network.named_buffers():
        if "running" in name:
            buffer.uniform_(0.5, 1.5)
    safetensors.torch.save_file(network.state_dict(), path)
    return network


def test_weights_of_a_file(tmp_path: Path, timm: Any) -> None:
    network = write_weights(timm, tmp_path / "w.safetensors")
    kwargs = {"weights": str(tmp_path / "w.safetensors"), "mean": [0.0] * 3, "std": [1.0] * 3, "input_size": [64, 64]}
    encoder = make_encoder(images(3, 64, 64), f"timm/{CONVOLUTIONS}", **kwargs).eval()
    inputs = th.rand(2, 3, 64, 64)
    expected = network.forward_head(network.forward_features(inputs), pre_logits=True)
    th.testing.assert_close(encoder(inputs), expected)
    # The file of the encoder has them, and needs that one no more.
    path = save(tmp_path / "e.safetensors", encoder, images(3, 64, 64))
    (tmp_path / "w.safetensors").unlink()
    th.testing.assert_close(load_encoder(path).encoder(inputs), expected)


def test_weights_for_other_channels(tmp_path: Path, timm: Any) -> None:
    """A stack of the same frame twice gives what one frame gives."""
    write_weights(timm, tmp_path / "w.safetensors")
    kwargs = {"weights": str(tmp_path / "w.safetensors"), "input_size": [64, 64]}
    one, two = (make_encoder(images(n, 64, 64), f"timm/{CONVOLUTIONS}", **kwargs).eval() for n in (3, 6))
    inputs = th.rand(2, 3, 64, 64)
    th.testing.assert_close(one(inputs), two(inputs.repeat(1, 2, 1, 1)), atol=1e-5, rtol=1e-4)


def test_no_other_weights_are_read(tmp_path: Path, timm: Any) -> None:
    space, name = images(3, 64, 64), f"timm/{CONVOLUTIONS}"
    th.save(timm.create_model(CONVOLUTIONS, pretrained=False).state_dict(), tmp_path / "w.pth")
    for file in ("w.pth", "absent.safetensors"):
        with pytest.raises(ValueError, match=r"cannot be read as safetensors .* no other format is read"):
            make_encoder(space, name, weights=str(tmp_path / file))
    write_weights(timm, tmp_path / "w.safetensors", TRANSFORMER)
    with pytest.raises(ValueError, match=r"w.safetensors are not those of this backbone: .*conv1"):
        make_encoder(space, name, weights=str(tmp_path / "w.safetensors"))


@pytest.mark.parametrize(
    ("name", "kwargs", "message"),
    [
        ("timm/no_such_model", {}, r"timm .* has no model 'no_such_model'; timm.list_models"),
        ("timm/hf-hub", {}, "has no model 'hf-hub'"),
        ("timm/local-dir/tmp", {}, "has no model 'local-dir/tmp'"),
        (f"timm/{CONVOLUTIONS}", {"input_size": [64]}, "input_size must be a height and a width"),
        (f"timm/{CONVOLUTIONS}", {"input_size": [10**6, 64]}, "of at most 2048"),
        (f"timm/{CONVOLUTIONS}", {"mean": [0.1, 0.2]}, r"mean must have 4 numbers, .* or 3, got \[0.1, 0.2\]"),
        (f"timm/{CONVOLUTIONS}", {"std": [0, 0, 0, 0]}, "std must be above 0"),
        (f"timm/{CONVOLUTIONS}", {"checkpoint_path": "x"}, "does not take these arguments .*checkpoint_path"),
    ],
)
def test_what_cannot_be_built_is_refused(timm: Any, name: str, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_encoder(images(4, 64, 64), name, **kwargs)


def test_pretrained_and_fine_tuned(tmp_path: Path, timm: Any) -> None:
    collect("Nav2D-v0", 200, tmp_path / "d", n_envs=4)
    words = ["--objective", "ssi", "--data", str(tmp_path / "d"), "-o", str(tmp_path / "e.safetensors")]
    numbers = ["n_updates:2", "batch_size:16", "log_interval:1", "checkpoint_interval:2"]
    network = [f"network:timm/{CONVOLUTIONS}", "network_kwargs.input_size:[32, 32]"]
    main(["pretrain", *words, "--device", "cpu", "-params", *network, *numbers])
    file = load_encoder(tmp_path / "e.safetensors")
    assert file.encoder.spec()["kwargs"]["input_size"] == [32, 32]
    kwargs = policy_kwargs(tmp_path / "e.safetensors", net_arch=[8])
    model = PPO("CnnPolicy", gym.make("Nav2D-v0"), n_steps=8, batch_size=8, n_epochs=1, policy_kwargs=kwargs)
    model.learn(8)
    model.save(tmp_path / "m.zip")
    (tmp_path / "e.safetensors").unlink()
    observation = gym.make("Nav2D-v0").reset(seed=0)[0]
    again = PPO.load(tmp_path / "m.zip", device="cpu")
    assert again.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (None, r"the network timm/resnet18 needs more packages .*pip install 'sb3_abisim\[timm\]'"),
        (RuntimeError("operator torchvision::nms does not exist"), "install the torchvision that belongs to torch"),
    ],
)
def test_without_timm_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch, module: Any, message: str) -> None:
    monkeypatch.setitem(sys.modules, "timm", None)
    if module is not None:
        real = timm_backbones.__builtins__["__import__"]

        def fails(name: str, *args: Any) -> Any:
            if name == "timm":
                raise module
            return real(name, *args)

        monkeypatch.setitem(timm_backbones.__builtins__, "__import__", fails)
    with pytest.raises(ImportError, match=message):
        make_encoder(images(3, 64, 64), "timm/resnet18")


def test_an_unknown_family_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown family of networks 'timn'; known are timm"):
        get_network("timn/resnet18")
