"""The network that reconstructs observations from embeddings."""

import math

import torch as th
from torch import nn

# Channels of the smallest map; each doubling of the side halves them, down to the least.
MOST_CHANNELS, LEAST_CHANNELS = 32, 8
# Side of the smallest map, at most.
SMALLEST = 8


class Decoder(nn.Module):
    """Embeddings to images of any size: a linear layer to a small map, then 3x3 convolutions and nearest-neighbor
    upsampling, doubling the side until it is that of the observation.

    The paper gives no decoder. Upsampling, unlike transposed convolutions, reaches odd sides such as 15 exactly.

    :param features_dim: size of the embedding
    :param shape: (channels, height, width) of the observation
    """

    def __init__(self, features_dim: int, shape: tuple[int, ...]) -> None:
        super().__init__()
        n_channels, height, width = shape
        n_doublings = max(0, math.ceil(math.log2(max(height, width) / SMALLEST)))
        sizes = [(math.ceil(height / 2**i), math.ceil(width / 2**i)) for i in range(n_doublings, -1, -1)]
        widths = [max(LEAST_CHANNELS, MOST_CHANNELS // 2**i) for i in range(n_doublings + 1)]
        smallest = (MOST_CHANNELS, *sizes[0])
        layers: list[nn.Module] = [nn.Linear(features_dim, math.prod(smallest)), nn.Unflatten(1, smallest), nn.ReLU()]
        for i, size in enumerate(sizes[1:]):
            layers += [nn.Conv2d(widths[i], widths[i + 1], 3, padding=1), nn.ReLU(), nn.Upsample(size)]
        self.layers = nn.Sequential(*layers, nn.Conv2d(widths[-1], n_channels, 3, padding=1))

    def forward(self, features: th.Tensor) -> th.Tensor:
        """Reconstruct, as logits of intensities in 0..1.

        :param features: float (batch, features_dim)
        :return: float (batch, channels, height, width)
        """
        logits: th.Tensor = self.layers(features)
        return logits
