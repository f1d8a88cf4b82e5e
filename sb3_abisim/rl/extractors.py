"""Features extractors for Stable-Baselines3: a pretrained encoder behind ``features_extractor_class``.

Each registered method has one (:func:`~sb3_abisim.rl.extractor_classes.extractor_class`), importable from here by its
name, such as ``SSIExtractor``.

What SB3 does to any extractor with its default settings, and where that is stopped here:

* ``ortho_init`` draws the weights of every submodule anew: :meth:`PretrainedExtractor.apply`, which lets it do so to
  task features alone.
* ``set_training_mode(True)`` wakes batch norm: :meth:`PretrainedExtractor.train`.
* Target networks are averaged over ``parameters()``, which rounds even where both sides are equal, and optimizers with
  weight decay move what has no gradient: frozen weights are buffers, not parameters.
* ``load`` builds the extractor before it restores the weights: without its file it is built empty, and
  ``weights_ready`` says whether weights have come since.
"""

import math
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_abisim.common.images import ImageCheck
from sb3_abisim.common.spaces import is_float_image_space
from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.networks.encoder_file import EncoderFile, load_encoder
from sb3_abisim.networks.encoder_name import EncoderNotFoundError
from sb3_abisim.rl.augment import Augment
from sb3_abisim.rl.auxiliary_state import AuxiliarySlot
from sb3_abisim.rl.file_network import build_network, check_objective, read_network
from sb3_abisim.rl.frozen_weights import buffers_to_parameters, parameters_to_buffers
from sb3_abisim.rl.task_features import make_task_network


class BaseEncoderExtractor(BaseFeaturesExtractor):
    """Hands an encoder's embedding, as it is, to the policy. Base of all extractors of one image here.

    What is said of weights (``n_parameters``, ``initial_weights``, :meth:`relative_weight_change`) is said of the
    encoder's alone.

    :param observation_space: uint8 images in 0..255, channels first (SB3 transposes the others by itself)
    :param encoder: the network
    :param task_features_dim: size of a small network's output that is appended to the embedding; RL trains it from
        scratch, whether the encoder is frozen or not. 0 for none (:mod:`sb3_abisim.rl.task_features`)
    :param augment: what observations are augmented by while they are learned from: "random_shift" (DrQ),
        "random_crop", "color_jitter", another registered name or ``pkg.module:Function``
        (:mod:`sb3_abisim.rl.augment`)
    :param augment_kwargs: its keyword arguments
    """

    # Of the method; `augment` names another one.
    default_augment: ClassVar[str | None] = None

    # The weights that training started from, flat, float32; a buffer, so that it is saved with the model.
    initial_weights: th.Tensor

    source: str
    frozen: bool = False

    def __init__(
        self,
        observation_space: gym.Space[Any],
        encoder: Encoder,
        task_features_dim: int = 0,
        augment: str | None = None,
        augment_kwargs: dict[str, Any] | None = None,
    ) -> None:
        task_features = make_task_network(observation_space, task_features_dim)
        super().__init__(observation_space, encoder.features_dim + task_features_dim)
        self.encoder = encoder
        self.task_features, self.task_features_dim = task_features, task_features_dim
        augment = augment or self.default_augment
        if augment is None and augment_kwargs:
            raise ValueError(
                f"augment_kwargs={augment_kwargs} belong to no augmentation; give augment=, or leave them out"
            )
        self.augment = None if augment is None else Augment(observation_space, augment, augment_kwargs)
        self._weight_names = [name for name, _ in encoder.named_parameters()]
        self.register_buffer("initial_weights", self._flat_weights().clone())
        self._input_checked = False
        self._image_check = ImageCheck()
        self.auxiliary = AuxiliarySlot()

    @property
    def hash(self) -> str | None:
        """sha256 (hexadecimal) of the encoder file that the weights came from, None if they came from none."""
        return None

    @property
    def n_parameters(self) -> int:
        """Number of weights, whether frozen or not."""
        return self.initial_weights.numel()

    def relative_weight_change(self) -> float:
        """Distance of the weights from those training started with, relative to the norm of the latter."""
        with th.no_grad():
            distance = th.linalg.vector_norm(self._flat_weights() - self.initial_weights)
            return float(distance / th.linalg.vector_norm(self.initial_weights))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Embed observations.

        :param observations: float (batch, channels, height, width) in 0..1, as SB3 preprocesses images
        :return: the encoder's embedding, and behind it the task features, float (batch, features_dim)
        :raises ValueError: if observations are not in 0..1 or embeddings not finite
        """
        # Numbers are not known then.
        knows_numbers = not (th.compiler.is_exporting() or th.compiler.is_compiling())
        if not self._input_checked:
            self._check_input(observations)
        # Agents act without gradients. What they have seen is of the space's dtype when it is learned from.
        if knows_numbers and not (self._input_checked and th.is_grad_enabled()):
            self._require_range(observations)
        if self.augment is not None:
            observations = self.augment(observations)
        features: th.Tensor = self.encoder(observations)
        if self.task_features is not None:
            features = th.cat([features, self.task_features(observations)], dim=1)
        # One sum shows whether a number is not finite.
        if knows_numbers and not math.isfinite(float(features.detach().sum())):
            self._require_range(observations)
            if not bool(th.isfinite(features).all()):
                raise ValueError(
                    f"embeddings of {self._label} are NaN or infinite, though observations are in 0..1: its "
                    "weights are, or are far too large; lower the learning rate, or look for NaN in rewards"
                )
        return features

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        self.auxiliary.save(destination, prefix)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        self.auxiliary.load(state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    @property
    def extras(self) -> str:
        """What it does beside embedding, for messages; empty for nothing."""
        name, kwargs = (None, None) if self.augment is None else (self.augment.name, self.augment.kwargs)
        return describe_extras(self.task_features_dim, name, kwargs)

    @classmethod
    def asked_extras(cls, kwargs: Mapping[str, Any]) -> str:
        """:attr:`extras` of an extractor that is not there yet.

        :param kwargs: its arguments
        """
        augment = kwargs.get("augment") or cls.default_augment
        return describe_extras(kwargs.get("task_features_dim", 0), augment, kwargs.get("augment_kwargs"))

    @property
    def _label(self) -> str:
        return f"{type(self).__name__} ({self.source})"

    def _require_range(self, observations: th.Tensor) -> None:
        if not observations.numel():
            return
        low, high = (float(bound) for bound in observations.detach().aminmax())
        if low >= 0.0 and high <= 1.0:
            return
        remedy = (
            "the environment returned NaN or infinity; correct it"
            if not (math.isfinite(low) and math.isfinite(high))
            else "remove normalize_images=False from policy_kwargs, or correct the environment's observations"
        )
        extent = f"{high:g}" if low >= 0.0 else f"{low:g}..{high:g}"
        raise ValueError(f"observations reach {extent}, but {self._label} takes images in 0..1; {remedy}")

    def _check_input(self, observations: th.Tensor) -> None:
        if th.compiler.is_exporting() or th.compiler.is_compiling():
            return
        self._require_range(observations)
        self._image_check.add((observations.detach() * 255).round().to(th.uint8).cpu().numpy())
        if problem := self._image_check.problem():
            warnings.warn(f"{self._label}: {problem}", stacklevel=2)
        # A black observation proves nothing.
        self._input_checked = self._image_check.is_settled or problem is not None

    def _flat_weights(self) -> th.Tensor:
        weights = self.encoder.state_dict()
        return th.cat([weights[name].flatten().float() for name in self._weight_names])


class VanillaExtractor(BaseEncoderExtractor):
    """The network without pretraining, the baseline. SB3 initializes and trains it like its own extractors.

    :param observation_space: uint8 images in 0..255, channels first
    :param network: name of the network; None takes the one made for the observation's shape
    :param network_kwargs: its keyword arguments
    :param task_features_dim: see :class:`BaseEncoderExtractor`
    :param augment: see :class:`BaseEncoderExtractor`
    :param augment_kwargs: see :class:`BaseEncoderExtractor`
    :raises ValueError: for an observation space that is not of images or does not fit the network
    """

    source = "untrained"

    def __init__(
        self,
        observation_space: gym.Space[Any],
        network: str | None = None,
        network_kwargs: dict[str, Any] | None = None,
        task_features_dim: int = 0,
        augment: str | None = None,
        augment_kwargs: dict[str, Any] | None = None,
    ) -> None:
        _check_space(observation_space)
        encoder = make_encoder(observation_space, network, **(network_kwargs or {}))
        super().__init__(observation_space, encoder, task_features_dim, augment, augment_kwargs)

    def apply(self, fn: Any) -> "VanillaExtractor":
        """As in torch; SB3 initializes through this method, so the weight change is measured from the new weights.

        :param fn: called on every submodule
        """
        super().apply(fn)
        self.initial_weights.copy_(self._flat_weights())
        return self


class PretrainedExtractor(BaseEncoderExtractor):
    """An encoder from a file. Subclasses name the objective that must have trained it.

    The network follows from ``observation_space``, ``network`` and ``network_kwargs`` alone, never from the file, so
    that a saved model can be rebuilt where the file is absent; a file with another network is refused.
    :class:`EncoderExtractor` reads it from the file.

    :param observation_space: uint8 images in 0..255, channels first; equal to that of pretraining
    :param encoder: path of an encoder file, name of a shipped one such as "Nav2D-v0/abisim", or
        ``hf://owner/repository``. If there is none, ``forward`` raises until weights are restored by
        ``load`` or ``set_parameters``
    :param freeze: True keeps the weights as they are; False lets the RL algorithm train them
    :param network: name of the network; None takes the one made for the observation's shape
    :param network_kwargs: its keyword arguments
    :param task_features_dim: see :class:`BaseEncoderExtractor`
    :param augment: see :class:`BaseEncoderExtractor`
    :param augment_kwargs: see :class:`BaseEncoderExtractor`
    :raises ValueError: for a damaged file, or one of another objective, other observations or another network
    """

    # None takes an encoder of any objective, with the network that it has.
    objective: ClassVar[str | None] = None

    # 1 once the weights come from an encoder file, directly or through a saved model.
    weights_ready: th.Tensor
    encoder_hash: th.Tensor

    def __init__(
        self,
        observation_space: gym.Space[Any],
        encoder: str,
        freeze: bool = False,
        network: str | None = None,
        network_kwargs: dict[str, Any] | None = None,
        task_features_dim: int = 0,
        augment: str | None = None,
        augment_kwargs: dict[str, Any] | None = None,
    ) -> None:
        _check_space(observation_space)
        file: EncoderFile | None = None
        absence = ""
        try:
            file = load_encoder(encoder, network)
        except EncoderNotFoundError as error:
            absence = str(error)
        if file is not None:
            if self.objective is not None:
                check_objective(file, self.objective)
            else:
                network, network_kwargs = read_network(file, network, network_kwargs)
            file.check(observation_space)
        module = build_network(observation_space, network, network_kwargs or {}, file)
        super().__init__(observation_space, module, task_features_dim, augment, augment_kwargs)
        self.source = encoder
        self.frozen = freeze
        self.metadata = None if file is None else file.metadata
        self._absence = absence
        hash = bytes(32) if file is None else bytes.fromhex(file.hash)
        # The same as a number of Python, which is known during torch.export, too.
        self._has_weights = file is not None
        self.register_buffer("weights_ready", th.tensor(file is not None, dtype=th.uint8))
        self.register_buffer("encoder_hash", th.tensor(list(hash), dtype=th.uint8))
        if freeze:
            parameters_to_buffers(self.encoder)
            self.encoder.eval()

    @property
    def hash(self) -> str | None:
        """sha256 (hexadecimal) of the encoder file that the weights came from, None while there are no weights."""
        return bytes(self.encoder_hash.tolist()).hex() if bool(self.weights_ready) else None

    def require_weights(self) -> None:
        """Raise if the encoder file was absent and no saved model has brought the weights since.

        :raises EncoderNotFoundError: (a ``FileNotFoundError``) listing the places searched
        """
        if not self._has_weights:
            raise EncoderNotFoundError(f"{self._absence}. The extractor has no pretrained weights")

    def apply(self, fn: Any) -> "PretrainedExtractor":
        """Reach task features alone: SB3's ``ortho_init=True`` would overwrite the pretrained weights through here.

        :param fn: called on the submodules of ``task_features``, if there are some
        """
        if self.task_features is not None:
            self.task_features.apply(fn)
        return self

    def train(self, mode: bool = True) -> "PretrainedExtractor":
        """Switch between training and evaluation; a frozen encoder stays in evaluation mode.

        :param mode: True for training
        """
        super().train(mode)
        if self.frozen:
            self.encoder.eval()
        return self

    def _check_input(self, observations: th.Tensor) -> None:
        self.require_weights()
        super()._check_input(observations)

    def unfreeze(self) -> list[nn.Parameter]:
        """Make a frozen encoder's weights parameters again, so that they can be trained.

        Optimizers that were built before do not hold them. For a model of Stable-Baselines3,
        :func:`~sb3_abisim.rl.unfreeze.unfreeze_encoder` calls this and extends the optimizers.

        :return: the new parameters, none if the encoder was not frozen
        """
        if not self.frozen:
            return []
        parameters = buffers_to_parameters(self.encoder, self._weight_names)
        self.frozen = False
        self.encoder.train(self.training)
        return parameters

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        weights = state_dict.get(f"{prefix}initial_weights")
        if weights is not None and weights.shape != self.initial_weights.shape and not bool(self.weights_ready):
            raise ValueError(
                f"the saved model has another network ({weights.numel()} weights) than the extractor's arguments say "
                f"({self.n_parameters}), and the encoder file {self.source!r} is not there to tell; put it there, or "
                "make models with sb3_abisim.policy_kwargs(FILE), which keep the network"
            )
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        # The loaded model may be one that never had its weights.
        self._input_checked, self._image_check = False, ImageCheck()
        self._has_weights = bool(self.weights_ready)


class EncoderExtractor(PretrainedExtractor):
    """An encoder from a file, whatever objective has trained it, with the network that it has.

    A saved model keeps the arguments, not the file. Where the file is absent, ``load`` of Stable-Baselines3 can
    rebuild the extractor only if its network is given, as :func:`~sb3_abisim.rl.policy_kwargs.policy_kwargs` does, or
    is the default one.

    :param observation_space: uint8 images in 0..255, channels first; equal to that of pretraining
    :param encoder: path of an encoder file, name of a shipped one such as "Nav2D-v0/abisim", or
        ``hf://owner/repository``
    :param freeze: True keeps the weights as they are; False lets the RL algorithm train them
    :param network: name of the network; None reads it from the file, unless that is a ``pkg.module:Factory``, which is
        imported only if you name it
    :param network_kwargs: its keyword arguments; None reads them from the file
    :param task_features_dim: see :class:`BaseEncoderExtractor`
    :param augment: see :class:`BaseEncoderExtractor`
    :param augment_kwargs: see :class:`BaseEncoderExtractor`
    :raises ValueError: for a damaged file, or one of other observations or another network
    """


def describe_extras(task_features_dim: int, augment: str | None, augment_kwargs: Mapping[str, Any] | None) -> str:
    """What an extractor does beside embedding, in words; empty for nothing.

    :param task_features_dim: as of an extractor
    :param augment: as of an extractor
    :param augment_kwargs: as of an extractor
    """
    task = f", task_features_dim={task_features_dim}" * bool(task_features_dim)
    return task + f", augment={augment}" * bool(augment) + f" {dict(augment_kwargs or {})}" * bool(augment_kwargs)


def _check_space(observation_space: gym.Space[Any]) -> None:
    if isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f"an encoder takes one image, got {observation_space}; use CombinedEncoderExtractor with MultiInputPolicy"
        )
    if not is_image_space(observation_space):
        remedy = (
            "leave images unnormalized (VecNormalize(norm_obs=False), in a zoo YAML no `normalize: true`), SB3 divides "
            "them by 255"
        )
        # What VecNormalize declares goes from -clip_obs to clip_obs.
        if is_float_image_space(observation_space) and observation_space.low.min() >= 0:  # type: ignore[attr-defined]
            remedy = (
                "two wrappers of gymnasium 1.4 make bytes of these floats, in a zoo YAML `env_wrapper: "
                "[{gymnasium.wrappers.RescaleObservation: {min_obs: 0, max_obs: 255}}, "
                "{gymnasium.wrappers.DtypeObservation: {dtype: uint8}}]`"
            )
        raise ValueError(f"an encoder takes uint8 images in 0..255, got {observation_space}; {remedy}")


def __getattr__(name: str) -> Any:
    # The classes of methods, also for pickle, which finds a class by its module and name.
    if name.endswith("Extractor"):
        from sb3_abisim.rl.extractor_classes import find_extractor_class

        return find_extractor_class(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
