"""The network that looks where its first point is."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_abisim import load_encoder
from sb3_abisim.networks import export as export_module
from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.export import export_encoder
from sb3_abisim.networks.from_module import from_module
from sb3_abisim.networks.glimpse import Glimpse, make_glimpse

SPACE = gym.spaces.Box(0, 255, (3, 48, 64), np.uint8)


def bright_point(n_points: int = 1) -> Glimpse:
    """A network whose points go where the image is bright."""
    module = make_glimpse(SPACE, n_points, 8)
    assert isinstance(module, Glimpse)
    for layer in module.maps:
        if isinstance(layer, nn.Conv2d):
            nn.init.constant_(layer.weight, 1.0)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return module


def spot(row: int, column: int) -> th.Tensor:
    """A dark image with a bright spot of 8 pixels that has a pattern of its own, in -1..1."""
    images = th.full((1, 3, 48, 64), -1.0)
    pattern = 0.5 + 0.5 * th.linspace(0, 1, 64).view(8, 8)
    images[0, :, row : row + 8, column : column + 8] = pattern
    return images


@th.no_grad()
def test_a_point_goes_where_its_map_is_large() -> None:
    module = bright_point()
    for row, column in ((4, 8), (20, 40), (36, 52)):
        x, y = module.points(spot(row, column))[0, 0].tolist()
        # To a cell of the maps, which is 4 pixels.
        assert (x + 1) * 32 == pytest.approx(column + 4, abs=4)
        assert (y + 1) * 24 == pytest.approx(row + 4, abs=4)


@th.no_grad()
def test_the_close_look_is_the_part_of_the_image_around_a_point() -> None:
    module = bright_point()
    images = th.rand(2, 3, 48, 64)
    # Edges between pixels, so that nothing is interpolated.
    centers = th.tensor([[20 / 32 - 1, 12 / 24 - 1], [40 / 32 - 1, 30 / 24 - 1]])
    parts = module.glimpses(images, centers)
    assert th.allclose(parts[0], images[0, :, 8:16, 16:24], atol=1e-5)
    assert th.allclose(parts[1], images[1, :, 26:34, 36:44], atol=1e-5)
    # Beyond the edge it goes on as the edge is.
    corner = module.glimpses(images, th.full((2, 2), -1.0))
    assert th.allclose(corner[:, :, :4, :4], images[:, :, :1, :1].expand(-1, -1, 4, 4), atol=1e-5)


@th.no_grad()
def test_the_close_look_goes_along_with_the_point() -> None:
    """Where the agent and what is around it stand elsewhere, the same numbers come out of the close look."""
    module = bright_point()
    looks = []
    # A shift by whole cells of the maps.
    for shift in (0, 8):
        images = spot(16 + shift, 24 + shift)
        looks.append(module.near(module.glimpses(images, module.points(images)[:, 0])))
    assert th.allclose(*looks, atol=0.05)
    stay = module.near(module.glimpses(spot(24, 32), module.points(spot(16, 24))[:, 0]))
    assert not th.allclose(looks[0], stay, atol=0.05)


@th.no_grad()
def test_an_embedding_is_points_the_close_look_and_the_image() -> None:
    module, images = bright_point(), spot(16, 24)
    points = module.points(images)
    near = module.near(module.glimpses(images, points[:, 0]))
    expected = th.cat([5 * points.flatten(1), near, module.wide(images)], dim=1)
    assert th.allclose(module((images + 1) / 2), expected, atol=1e-5)


def test_gradients_of_the_close_look_reach_the_point() -> None:
    module = bright_point()
    images = spot(20, 30)
    module.near(module.glimpses(images, module.points(images)[:, 0])).sum().backward()
    assert float(module.maps[0].weight.grad.abs().max()) > 0


def test_sizes_follow_from_the_image_and_the_arguments() -> None:
    # 8 points of 2 numbers, 5 / 16 of 48 pixels at an eighth of the sides, and the image at a sixteenth.
    assert make_encoder(SPACE, "glimpse").features_dim == 16 + 32 * 2 * 2 + 16 * 3 * 4
    small = make_encoder(SPACE, "glimpse", n_points=3, glimpse_size=48)
    assert small.features_dim == 6 + 32 * 6 * 6 + 16 * 3 * 4
    assert small.spec() == {"name": "glimpse", "kwargs": {"n_points": 3, "glimpse_size": 48}}
    assert make_encoder(SPACE, "glimpse", hidden_dim=7).features_dim == 7


@pytest.mark.parametrize("execute", ["_run_program", "_run_onnx"])
@pytest.mark.filterwarnings("ignore:The given buffer is not writable:UserWarning", "ignore::DeprecationWarning")
def test_it_is_exported(execute: str, tmp_path: Path) -> None:
    if execute == "_run_onnx":
        for name in ("onnx", "onnxruntime", "onnxscript"):
            pytest.importorskip(name)
    observations = np.random.default_rng(0).integers(0, 256, (5, *SPACE.shape), np.uint8)
    from_module(make_glimpse(SPACE), SPACE, tmp_path / "glimpse.safetensors", network="glimpse")
    encoder = load_encoder(tmp_path / "glimpse.safetensors").encoder
    path = tmp_path / ("glimpse.onnx" if execute == "_run_onnx" else "glimpse.pt2")
    export_encoder(str(tmp_path / "glimpse.safetensors"), path)
    with th.no_grad():
        expected = encoder(th.as_tensor(observations).float() / 255)
    embeddings = getattr(export_module, execute)(path.read_bytes(), observations)
    assert np.abs(embeddings - expected.numpy()).max() < 1e-3


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_points": 0}, "n_points must be a whole number of at least 1, got 0"),
        ({"n_points": 1.5}, "n_points must be a whole number of at least 1, got 1.5"),
        ({"glimpse_size": 7}, "glimpse_size must be a whole number from 8 to 48, got 7"),
        ({"glimpse_size": 49}, "glimpse_size must be a whole number from 8 to 48, got 49"),
        ({"features": "trunk"}, "features='trunk' needs a network that is an nn.Sequential.*glimpse is none"),
    ],
)
def test_what_does_not_fit_is_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_encoder(SPACE, "glimpse", **kwargs)
