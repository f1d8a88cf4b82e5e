"""What an RL run reports of its encoder."""

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import unwrap_vec_wrapper

from sb3_abisim.common.malloc import keep_freed_memory
from sb3_abisim.rl.checks import check_eval_envs, find_extractors, require_weights
from sb3_abisim.rl.vec_encode import EncodedBox, VecEncodeObservations


class EncoderCallback(BaseCallback):
    """Prints the encoders when training starts, refuses to train without their weights, and logs how they change.

    ``encoder/relative_weight_change`` is logged at the end of each rollout: the distance of the weights from those that
    training started with, relative to the norm of the latter. Where actor and critic have separate encoders, it is the
    largest value.

    Training stops at the first reward, observation, action, loss or weight that is NaN or infinite: some algorithms
    would train to the end with it, and save a model that knows nothing.

    Also prints the content hash of the clips or scans that the training environment shows, if it has one, and lets
    torch reuse memory (:mod:`sb3_abisim.common.malloc`).

    :raises FileNotFoundError: when training starts, if an encoder has no weights because its file was not found
    :raises ValueError: when training starts, if the model was trained on the embeddings of another encoder, or an
        ``EvalCallback`` beside this one has another encoder or preprocessing
    :raises FloatingPointError: during training, for a number that is not finite
    """

    def _on_training_start(self) -> None:
        keep_freed_memory()
        require_weights(self.model)
        check_eval_envs(self.training_env, self.locals.get("callback"))
        self._extractors = [extractor for _, extractor in find_extractors(self.model.policy)]
        for name, extractor in find_extractors(self.model.policy):
            origin = f"hash {extractor.hash}" if extractor.hash else "random weights"
            state = "frozen" if extractor.frozen else "fine-tuned" if extractor.hash else "trained from scratch"
            print(
                f"Encoder {name}: {type(extractor).__name__}, source {extractor.source}, {origin}, "
                f"{extractor.n_parameters} parameters, {state}"
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
        if self.training_env.has_attr("content_hash"):
            (content_hash,) = self.training_env.get_attr("content_hash", indices=0)
            print(f"Content hash of the training environment: {content_hash}")

    def _on_rollout_end(self) -> None:
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
