"""The small networks that objectives put on embeddings."""

import itertools

from torch import nn


class MLP(nn.Sequential):
    """A multilayer perceptron with ReLU between its linear layers.

    :param dims: sizes of input, hidden layers and output
    """

    def __init__(self, *dims: int) -> None:
        layers: list[nn.Module] = []
        for n_in, n_out in itertools.pairwise(dims):
            layers += [nn.Linear(n_in, n_out), nn.ReLU()]
        super().__init__(*layers[:-1])
