"""A network that finds a few points in the image and looks closely at the first, for agents that are small in it.

Points are where maps of a small convolutional network are large: the mean position under a softmax over each map
(spatial soft-argmax, Levine et al. 2016). The close look is a part of the image around the first point at full
resolution, cut out by bilinear interpolation, so that gradients reach the point (spatial transformer, Jaderberg et al.
2015). Nothing says what the points are: the objective of pretraining moves them. With an inverse model the agent is
what tells actions apart, so a point goes there.
"""

from typing import Any

import gymnasium as gym
import torch as th
from torch import nn

from sb3_abisim.networks.base import require_size
from sb3_abisim.networks.resnet import small_layers
from sb3_abisim.registry import register_network

MIN_SIZE = 16
# Of the standardized maps before the softmax: the larger, the smaller the part of a map that a point is the mean of.
SHARPNESS = 3.0
# Coordinates lie in -1..1 and change little in a step; the other numbers are of the order of 1.
COORDINATE_SCALE = 5.0


def _pixel_centers(n: int) -> th.Tensor:
    """Of n pixels in a row, in the coordinates of ``grid_sample``: -1 and 1 are the outer edges."""
    return (th.arange(n) + 0.5) * 2 / n - 1


class Glimpse(nn.Module):
    """Points, the part of the image around the first of them, and the whole image, coarsely.

    :param shape: (channels, height, width)
    :param n_points: number of points
    :param glimpse_size: height and width of the part, in pixels
    """

    def __init__(self, shape: tuple[int, int, int], n_points: int, glimpse_size: int) -> None:
        super().__init__()
        n_channels, height, width = shape
        self.maps = nn.Sequential(
            nn.Conv2d(n_channels, 16, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(16, 16, 3, stride=2, padding=1),
            nn.ReLU(),
            # Standardized below, where a bias would cancel out.
            nn.Conv2d(16, n_points, 3, padding=1, bias=False),
        )
        self.near = small_layers(n_channels, stride=2)
        self.wide = small_layers(n_channels, n_channels=16)
        steps = th.arange(glimpse_size) - (glimpse_size - 1) / 2
        rows, columns = th.meshgrid(steps * 2 / height, steps * 2 / width, indexing="ij")
        # Follows from the arguments, so no file holds it.
        self.offsets: th.Tensor
        self.register_buffer("offsets", th.stack([columns, rows], dim=-1), persistent=False)

    def points(self, images: th.Tensor) -> th.Tensor:
        """Where the points are.

        :param images: float (batch, channels, height, width) in -1..1
        :return: x and y in -1..1, from the left and upper edge, (batch, n_points, 2)
        """
        maps = self.maps(images)
        values = maps.flatten(2)
        # However large the values are, a point is the mean of about as large a part of its map.
        values = values - values.mean(dim=2, keepdim=True)
        values = values / (values.square().mean(dim=2, keepdim=True).sqrt() + 1e-5)
        weights = (SHARPNESS * values).softmax(dim=2).view_as(maps)
        height, width = maps.shape[2:]
        x = weights.sum(dim=2) @ _pixel_centers(width).to(weights)
        y = weights.sum(dim=3) @ _pixel_centers(height).to(weights)
        return th.stack([x, y], dim=2)

    def glimpses(self, images: th.Tensor, centers: th.Tensor) -> th.Tensor:
        """The parts of images around points; what lies outside of an image is as its edge.

        :param images: float (batch, channels, height, width)
        :param centers: x and y in -1..1, (batch, 2)
        :return: (batch, channels, glimpse_size, glimpse_size)
        """
        grid = centers[:, None, None] + self.offsets
        return nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Embed images.

        :param observations: float (batch, channels, height, width) in 0..1
        :return: float (batch, features_dim)
        """
        images = 2 * observations - 1
        points = self.points(images)
        near = self.near(self.glimpses(images, points[:, 0]))
        return th.cat([COORDINATE_SCALE * points.flatten(1), near, self.wide(images)], dim=1)


def make_glimpse(observation_space: gym.Space[Any], n_points: int = 8, glimpse_size: int | None = None) -> nn.Module:
    """Points, a close look at the first, and the whole image at a sixteenth of its sides.

    :param observation_space: images of at least 16 pixels, channels first
    :param n_points: number of points
    :param glimpse_size: height and width of the close look, in pixels; None takes 5 / 16 of the shorter side
    :raises ValueError: for smaller images, no point, or a close look under 8 pixels or larger than the image
    """
    shape = require_size("glimpse", observation_space, MIN_SIZE)
    shorter = min(shape[1:])
    if glimpse_size is None:
        glimpse_size = max(8, round(5 / 16 * shorter))
    if not isinstance(n_points, int) or n_points < 1:
        raise ValueError(f"n_points must be a whole number of at least 1, got {n_points!r}")
    if not isinstance(glimpse_size, int) or not 8 <= glimpse_size <= shorter:
        raise ValueError(f"glimpse_size must be a whole number from 8 to {shorter}, got {glimpse_size!r}")
    return Glimpse(shape, n_points, glimpse_size)


register_network("glimpse", make_glimpse)
