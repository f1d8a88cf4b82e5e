"""A vectorized environment that gives a frozen encoder's embeddings instead of image observations.

With ``freeze=True`` a features extractor embeds each observation again in every epoch and every update. Here each is
embedded once, when the environment returns it, and rollouts, replay buffers and updates hold the embeddings.
``merge_encoder`` makes the trained model into one that acts on image observations.
"""

import warnings

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecTransposeImage
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_abisim.common.images import ImageCheck
from sb3_abisim.common.malloc import keep_freed_memory
from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.encoder_file import embed, load_encoder
from sb3_abisim.rl.file_network import check_objective


class EncodedBox(spaces.Box):
    """The space of the embeddings by one encoder: float32 (features_dim,), unbounded.

    Two are equal only if the encoder is the same, so that Stable-Baselines3 refuses to go on with a saved model on the
    embeddings of another one.

    :param features_dim: size of the embedding
    :param hash: sha256 (hexadecimal) of the encoder file
    """

    def __init__(self, features_dim: int, hash: str) -> None:
        super().__init__(-np.inf, np.inf, (features_dim,), np.float32)
        self.hash = hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, EncodedBox) and self.hash == other.hash and super().__eq__(other)

    def __repr__(self) -> str:
        return f"EncodedBox({self.shape[0]}, hash={self.hash!r})"


class VecEncodeObservations(VecEnvWrapper):
    """Embeds every observation by a frozen encoder, those at the ends of episodes included.

    Put it under ``VecNormalize`` (which may scale rewards, ``norm_obs=False``); use it with ``MlpPolicy``. In a zoo
    YAML::

        vec_env_wrapper:
          - sb3_abisim.VecEncodeObservations:
              encoder: Nav2D-v0/abisim

    :param venv: gives uint8 images in 0..255, as the encoder saw in pretraining; channels last are put first, as
        Stable-Baselines3 does for features extractors. Single observations are stacked for an encoder of stacks
    :param encoder: path of an encoder file, name of a shipped one such as "Nav2D-v0/abisim", or
        ``hf://owner/repository``
    :param objective: refuse an encoder that another objective has trained; None takes any
    :param device: where to run the encoder, as in Stable-Baselines3
    :raises FileNotFoundError: if there is no such encoder
    :raises ValueError: for a damaged file, or one of another objective or other observations
    """

    observation_space: EncodedBox

    def __init__(
        self, venv: VecEnv, encoder: str, objective: str | None = None, device: th.device | str = "auto"
    ) -> None:
        space = venv.observation_space
        if is_image_space(space) and not is_image_space_channels_first(space):  # type: ignore[arg-type]
            venv = VecTransposeImage(venv)
        file = load_encoder(encoder)
        if objective is not None:
            check_objective(file, objective)
        n_stack = file.metadata["preprocessing"].get("frame_stack", 1)
        if n_stack > 1 and _n_channels(venv) * n_stack == file.metadata["observation_space"]["shape"][0]:
            # rl-zoo3 would stack what comes out here; the encoder needs stacks of what goes in.
            venv = VecFrameStack(venv, n_stack, "first")
        file.check(venv.observation_space)
        super().__init__(venv, observation_space=EncodedBox(file.encoder.features_dim, file.hash))
        # Every step embeds, and the layers' memory is the same each time.
        keep_freed_memory()
        self.encoder_file = file
        self.source = encoder
        self._input_checked, self._image_check = False, ImageCheck()
        self._device = get_device(device)
        self._encoder: Encoder = file.encoder.to(self._device).requires_grad_(False)

    @property
    def n_parameters(self) -> int:
        """Number of the encoder's weights."""
        return sum(parameter.numel() for parameter in self._encoder.parameters())

    def encode(self, observations: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Embed observations.

        :param observations: uint8 (batch, channels, height, width)
        :return: float32 (batch, features_dim)
        :raises ValueError: for observations of another dtype or shape, which may hold NaN or numbers out of range
        """
        space = self.venv.observation_space
        if observations.dtype != np.uint8 or observations.shape[1:] != space.shape:
            raise ValueError(
                f"VecEncodeObservations ({self.source}) got observations {observations.dtype} {observations.shape[1:]} "
                f"from an environment that declares {space}; make them what it declares"
            )
        if not self._input_checked:
            self._image_check.add(observations)
            if problem := self._image_check.problem():
                warnings.warn(f"VecEncodeObservations ({self.source}): {problem}", stacklevel=3)
            self._input_checked = self._image_check.is_settled or problem is not None
        tensor = th.from_numpy(observations).to(self._device)
        embeddings: NDArray[np.float32] = embed(self._encoder, self.venv.observation_space, tensor).cpu().numpy()
        return embeddings

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes anew.

        :return: float32 (n_envs, features_dim)
        """
        observations = self.venv.reset()
        assert isinstance(observations, np.ndarray)
        return self.encode(observations)

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step that ``step_async`` began.

        :return: as from any ``VecEnv``, with embeddings for observations and for each ``terminal_observation``
        """
        observations, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(observations, np.ndarray)
        ended = [info for info in infos if "terminal_observation" in info]
        if ended:
            # One forward for all: the terminal observations go behind the n_envs current ones.
            observations = np.concatenate([observations, np.stack([info["terminal_observation"] for info in ended])])
        embeddings = self.encode(observations)
        for info, embedding in zip(ended, embeddings[self.num_envs :], strict=True):
            info["terminal_observation"] = embedding
        return embeddings[: self.num_envs], rewards, dones, infos


def _n_channels(venv: VecEnv) -> int:
    shape = venv.observation_space.shape
    return 0 if shape is None or len(shape) != 3 else int(shape[0])
