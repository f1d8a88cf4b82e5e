"""What an RL run reports of its encoder, and how it fine-tunes it."""

from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import unwrap_vec_wrapper

from sb3_abisim.common.malloc import keep_freed_memory
from sb3_abisim.rl.checks import (
    check_eval_envs,
    find_extractors,
    nested_callbacks,
    require_every_event,
    require_weights,
)
from sb3_abisim.rl.fine_tuning import FineTuning, Schedule
from sb3_abisim.rl.unfreeze import require_unfreezable, unfreeze_encoder
from sb3_abisim.rl.vec_encode import EncodedBox, VecEncodeObservations


class EncoderCallback(BaseCallback):
    """Prints the encoders when training starts, refuses to train without their weights, and logs how they change.

    Without arguments, it leaves training as it is. ``encoder/learning_rate`` is logged where an argument sets it.

    ``encoder/relative_weight_change`` is logged at the end of each rollout: the distance of the weights from those that
    training started with, relative to the norm of the latter. Where actor and critic have separate encoders, it is the
    largest value.

    Training stops at the first reward, observation, action, loss or weight that is NaN or infinite: some algorithms
    would train to the end with it, and save a model that knows nothing.

    Also prints the content hash of the clips or scans that the training environment shows, if it has one, and lets
    torch reuse memory (:mod:`sb3_abisim.common.malloc`).

    :param encoder_lr: learning rate of the encoder while it is trained: a number above 0, ``lin_NUMBER``, which falls
        to 0 in a straight line, or a function of the remaining progress (1 to 0); None for that of all else
    :param encoder_lr_factor: the same as a multiple of the learning rate of all else, of the same three forms
    :param unfreeze_at: environment step, 1 or more, from which on a frozen encoder is trained: the first update at or
        after it trains the encoder; None never unfreezes
    :param encoder_trained_by: "critic" lets the critic's loss train an encoder that actor and critic of SAC, TD3 or TQC
        share; None leaves it to the actor's, as Stable-Baselines3 does
    :raises ValueError: for an argument of another form, or within a callback that passes on some steps alone, such as
        ``EveryNTimesteps``
    :raises FileNotFoundError: when training starts, if an encoder has no weights because its file was not found
    :raises ValueError: when training starts, if the model was trained on the embeddings of another encoder, or an
        ``EvalCallback`` beside this one has another encoder or preprocessing, or the algorithm or its encoders do not
        allow what the arguments ask for
    :raises FloatingPointError: during training, for a number that is not finite
    """

    def __init__(
        self,
        encoder_lr: float | str | Schedule | None = None,
        encoder_lr_factor: float | str | Schedule | None = None,
        unfreeze_at: int | None = None,
        encoder_trained_by: str | None = None,
    ) -> None:
        super().__init__()
        if unfreeze_at is not None and (type(unfreeze_at) is not int or unfreeze_at < 1):
            raise ValueError(f"unfreeze_at must be a whole number of environment steps above 0, got {unfreeze_at!r}")
        self.unfreeze_at = unfreeze_at
        self._fine_tuning = FineTuning(encoder_lr, encoder_lr_factor, encoder_trained_by)

    def _init_callback(self) -> None:
        require_every_event(self)

    def _on_training_start(self) -> None:
        # A list tells its callbacks their parent after their init.
        require_every_event(self)
        keep_freed_memory()
        require_weights(self.model)
        self._require_alone()
        check_eval_envs(self.training_env, self.locals.get("callback"))
        self._extractors = [extractor for _, extractor in find_extractors(self.model.policy)]
        for name, extractor in find_extractors(self.model.policy):
            origin = f"hash {extractor.hash}" if extractor.hash else "random weights"
            state = "frozen" if extractor.frozen else "fine-tuned" if extractor.hash else "trained from scratch"
            print(
                f"Encoder {name}: {type(extractor).__name__}, source {extractor.source}, {origin}, "
                f"{extractor.n_parameters} parameters, {state}{extractor.extras}"
            )
        encoding = unwrap_vec_wrapper(self.training_env, VecEncodeObservations)
        if encoding is not None:
            # VecNormalize.load brings the space of the saved run, and Stable-Baselines3 compares the model's with that.
            space = self.model.observation_space
            # Of another kind where embeddings of several steps are stacked, which Stable-Baselines3 compares itself.
            if isinstance(space, EncodedBox) and space != encoding.observation_space:
                raise ValueError(
                    f"the model was trained on {space}, but {encoding.source} makes {encoding.observation_space}; give "
                    "the encoder file that it was trained on"
                )
            print(
                f"Encoder of the environment: {type(encoding).__name__}, source {encoding.source}, "
                f"hash {encoding.encoder_file.hash}, {encoding.n_parameters} parameters, frozen"
            )
        elif not self._extractors:
            print("Encoder: none of sb3_abisim's, policy_kwargs names another features extractor")
        self._start_fine_tuning()
        if self.training_env.has_attr("content_hash"):
            (content_hash,) = self.training_env.get_attr("content_hash", indices=0)
            print(f"Content hash of the training environment: {content_hash}")

    def check(self, model: BaseAlgorithm) -> None:
        """Refuse a model that the arguments are not for; training starts with it.

        :param model: with its environment
        :raises ValueError: with the reason
        """
        unfreezes = self._is_to_unfreeze(model)
        self._fine_tuning.check(model, unfreezes)
        if unfreezes:
            require_unfreezable(model)
        elif self.unfreeze_at is not None:
            env = model.get_env()
            encoding = None if env is None else unwrap_vec_wrapper(env, VecEncodeObservations)
            if encoding is not None:
                raise ValueError(
                    f"unfreeze_at={self.unfreeze_at}, but {encoding.source} embeds observations in the environment, "
                    "where it cannot be trained; give freeze: true in features_extractor_kwargs instead of ',frozen' "
                    "or VecEncodeObservations"
                )
            # A model that has been trained may have passed that step: rl-zoo3 counts anew when it continues a run.
            if not getattr(model, "_n_updates", 0):
                raise ValueError(
                    f"unfreeze_at={self.unfreeze_at}, but the policy holds no frozen encoder; give freeze=True in "
                    "features_extractor_kwargs, or remove unfreeze_at"
                )

    def _is_to_unfreeze(self, model: BaseAlgorithm) -> bool:
        return self.unfreeze_at is not None and any(encoder.frozen for _, encoder in find_extractors(model.policy))

    def _start_fine_tuning(self) -> None:
        self.check(self.model)
        self._unfreezes = self._is_to_unfreeze(self.model)
        if self._unfreezes:
            print(f"Encoder: frozen until step {self.unfreeze_at}, fine-tuned from then on")
        else:
            self._install()

    def _install(self) -> None:
        self._fine_tuning.install(self.model)
        if self._fine_tuning.encoder_trained_by is not None:
            print(f"Encoder: trained by the loss of the {self._fine_tuning.encoder_trained_by} alone")

    def _require_alone(self) -> None:
        """Refuse a second callback of this class: which one's arguments would hold?"""
        found = sum(isinstance(callback, EncoderCallback) for callback in nested_callbacks(self.locals.get("callback")))
        if found > 1:
            raise ValueError(f"{found} callbacks are {type(self).__name__}s; give one, with all arguments")

    def _on_rollout_end(self) -> None:
        if self._unfreezes and self.unfreeze_at is not None and self.num_timesteps >= self.unfreeze_at:
            # Before the update that comes next.
            unfreeze_encoder(self.model)
            self._install()
            self._unfreezes = False
            print(f"Encoder: fine-tuned from step {self.num_timesteps} on")
        if self._extractors:
            self.logger.record(
                "encoder/relative_weight_change",
                max(extractor.relative_weight_change() for extractor in self._extractors),
            )

    def _on_rollout_start(self) -> None:
        # The update before it has just been logged.
        self._check_logged()

    def _on_step(self) -> bool:
        for name in ("action", "reward"):
            self._require_finite(name, self.locals.get(f"{name}s"))
        self._require_finite_observations("observation", self.locals.get("new_obs"))
        for info in self.locals.get("infos") or ():
            # Where an episode has ended, the others are those of the next one.
            self._require_finite_observations("last observation of an episode", info.get("terminal_observation"))
        return True

    def _require_finite_observations(self, name: str, observations: Any) -> None:
        for key, array in observations.items() if isinstance(observations, dict) else [(name, observations)]:
            self._require_finite(key, array)

    def _on_training_end(self) -> None:
        self._fine_tuning.remove(self.model)
        self._check_logged()
        for name, parameter in self.model.policy.named_parameters():
            self._require_finite(f"weight {name}", parameter.detach().cpu().numpy())

    def _check_logged(self) -> None:
        for name, value in self.logger.name_to_value.items():
            # Of the others, explained_variance is NaN where all returns are equal.
            if name.startswith("train/") and "loss" in name:
                self._require_finite(name, np.asarray(value))

    def _require_finite(self, name: str, array: Any) -> None:
        if isinstance(array, np.ndarray) and array.dtype.kind == "f" and not np.isfinite(array).all():
            raise FloatingPointError(
                f"{name} is NaN or infinite at step {self.num_timesteps}, and training stops; look at the rewards and "
                "observations of the environment, or lower the learning rate"
            )
