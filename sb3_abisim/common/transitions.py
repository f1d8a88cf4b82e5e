"""A batch of transitions, of NumPy arrays as datasets give it, or of tensors as objectives take it."""

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

# numpy.ndarray or torch.Tensor; torch is not imported here, since data collection needs none.
ArrayT = TypeVar("ArrayT", bound=Any)


@dataclass(frozen=True)
class TransitionBatch(Generic[ArrayT]):
    """B transitions (s_t, a_t, s_{t+k}).

    :param frames: the observations, (m, C, H, W); uint8 in 0..255, or float in 0..1 after SB3's ``preprocess_obs``.
        One that several transitions share stands there once
    :param actions: a_t, (B, *shape of an action), in the action space; int64 for ``Discrete``. Sequences a_t to
        a_{t+k-1} have a second dimension k
    :param obs_index: where s_t stands among the frames, int64 (B,) or a slice
    :param next_obs_index: where s_{t+k} stands among them
    """

    frames: ArrayT
    actions: ArrayT
    obs_index: ArrayT | slice
    next_obs_index: ArrayT | slice

    @classmethod
    def of(cls, obs: ArrayT, actions: ArrayT, next_obs: ArrayT) -> "TransitionBatch[ArrayT]":
        """A batch of tensors, of transitions that share no frame.

        :param obs: s_t, (B, C, H, W)
        :param actions: see the class
        :param next_obs: s_{t+k}, (B, C, H, W)
        """
        import torch as th

        frames: Any = th.cat([obs, next_obs])
        return cls(frames, actions, slice(None, len(obs)), slice(len(obs), None))

    @property
    def obs(self) -> ArrayT:
        """s_t, (B, C, H, W)."""
        obs: ArrayT = _rows(self.frames, self.obs_index)
        return obs

    @property
    def next_obs(self) -> ArrayT:
        """s_{t+k}, (B, C, H, W)."""
        next_obs: ArrayT = _rows(self.frames, self.next_obs_index)
        return next_obs

    def split_pair(self, embeddings: ArrayT) -> tuple[ArrayT, ArrayT]:
        """Embeddings of s_t and of s_{t+k}.

        :param embeddings: of the frames, (m, features_dim)
        :return: two arrays (B, features_dim)
        """
        return _rows(embeddings, self.obs_index), _rows(embeddings, self.next_obs_index)


def _rows(array: Any, index: Any) -> Any:
    if isinstance(index, slice) or isinstance(array, np.ndarray):
        return array[index]
    # Unlike tensor[index], the gradient of index_select adds up in a fixed order on several threads, too.
    return array.index_select(0, index)
