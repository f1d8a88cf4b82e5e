"""Goes on pretraining while RL runs: an objective that trains the policy's encoder on the transitions that RL meets."""

import math
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_wrapper

from sb3_abisim.common.arguments import checked_arguments
from sb3_abisim.common.method_settings import settings_entry
from sb3_abisim.envs.plain_actions import require_plain
from sb3_abisim.registry import get_method, get_objective
from sb3_abisim.rl.auxiliary_data import ReplaySteps, RolloutHistory, RolloutSteps, Steps, read_rollout
from sb3_abisim.rl.auxiliary_trainer import N_PREPARE, AuxiliarySettings, AuxiliaryTrainer
from sb3_abisim.rl.checks import (
    find_extractors,
    image_keys,
    nested_callbacks,
    require_every_event,
    require_weights,
)
from sb3_abisim.rl.extractors import BaseEncoderExtractor
from sb3_abisim.rl.vec_encode import VecEncodeObservations

# Extractors of actor-critic policies by the head that they belong to; others have the name of their network.
_HEADS = {"features_extractor": "actor", "pi_features_extractor": "actor", "vf_features_extractor": "critic"}
_HISTORY = "history."


class AuxiliaryObjective(BaseCallback):
    """Trains the policy's encoder by an objective of pretraining, too, on the transitions that RL meets.

    Each extractor of the online networks has an objective with heads of its own; target networks follow as they follow
    RL. The first line printed says which ones are trained. The encoder goes on from the weights that it has: random
    ones with ``VanillaExtractor``, else those of its file. An objective that builds on a base (``abisim``,
    ``goal_progress``) gets one that begins with the encoder's weights and learns beside it, by its own loss.

    Updates are made when a rollout ends, before RL trains on it. On-policy algorithms give the rollout, and where it is
    short the newest rollouts that hold 512 steps, or twice ``batch_size``. Off-policy ones give the replay buffer, once
    they learn themselves. Heads, targets, Adam's averages and random numbers are saved with the model. A run that is
    continued with this callback goes on exactly; one without it keeps them.

    What is None comes from the objective's settings for pretraining (``hyperparams/pretrain/``), where those have it.

    In a zoo YAML::

        callback:
          - sb3_abisim.AuxiliaryObjective: {objective: ssi}

    :param objective: name of a method that has one, such as "ssi"
    :param weight: the encoder's learning rate divided by ``learning_rate``, at least 0. It is no factor of the loss,
        which Adam would divide out again. With 0, RL is as without the callback, bit for bit; heads learn, so that the
        terms show what the encoder holds
    :param learning_rate: of Adam, for the heads (and the base)
    :param update_interval: environment steps, over all environments, for each update
    :param batch_size: transitions per update
    :param k: steps between the two observations, or ``[fewest, most]``
    :param objective_kwargs: arguments of the objective; those that are not there are as in pretraining
    :param base_kwargs: arguments of its base's objective, likewise
    :param seed: of heads and batches; None for the model's, where it has one, else 0
    :param verbose: as in Stable-Baselines3
    :raises ValueError: for settings that do not fit; when training starts, if there is no encoder to train
    :raises FileNotFoundError: when training starts, if an encoder has no weights because its file was not found
    :raises FloatingPointError: during training, for a loss or a term that is not finite
    """

    @checked_arguments
    def __init__(
        self,
        objective: str = "ssi",
        weight: float = 1.0,
        learning_rate: float = 1e-3,
        update_interval: int = 256,
        batch_size: int = 128,
        k: int | list[int] | None = None,
        objective_kwargs: dict[str, Any] | None = None,
        base_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        get_objective(objective)
        for name, number, least in (
            ("update_interval", update_interval, 1), ("batch_size", batch_size, 2), ("seed", seed or 0, 0),
        ):  # fmt: skip
            if number < least:
                raise ValueError(f"{name} must be at least {least}, got {number}")
        if not 0 <= weight < math.inf:
            raise ValueError(f"weight must be a number of at least 0, got {weight}")
        if not 0 < learning_rate < math.inf:
            raise ValueError(f"learning_rate must be a number above 0, got {learning_rate}")
        self.objective, self.weight, self.learning_rate = objective, weight, learning_rate
        self.update_interval, self.batch_size, self.k, self.seed = update_interval, batch_size, k, seed
        self.objective_kwargs, self.base_kwargs = objective_kwargs or {}, base_kwargs or {}
        self._trainers: dict[str, AuxiliaryTrainer] = {}

    def _init_callback(self) -> None:
        require_every_event(self)

    def _on_training_start(self) -> None:
        # A list tells its callbacks their parent after their init.
        require_every_event(self)
        require_weights(self.model)
        require_plain(self.model.action_space)
        self._refuse_another(self.locals.get("callback"))
        extractors = trained_extractors(self.model, self.training_env, self.weight)
        seed = self.model.seed if self.seed is None else self.seed
        entry, settings = self._settings(_env_id(self.training_env), seed or 0)
        self._trainers = {
            name: AuxiliaryTrainer(extractor, self.model.action_space, settings, key, index)
            for index, (name, (extractor, key)) in enumerate(extractors.items())
        }
        first = self._first
        # Environment steps since the last update, and on-policy what the newest short rollouts showed.
        self._pending = int(first.extra.get("pending", 0))
        self._history = RolloutHistory(max(2 * self.batch_size, N_PREPARE))
        saved: dict[int, dict[str, th.Tensor]] = {}
        for name, tensor in first.extra_tensors.items():
            if name.startswith(_HISTORY):
                number, _, rest = name.removeprefix(_HISTORY).partition(".")
                saved.setdefault(int(number), {})[rest] = tensor
        self._history.parts = [RolloutSteps.from_tensors(saved[number]) for number in sorted(saved)]
        self._n_new = 0
        self._begin_rollout()
        print(
            f"Auxiliary objective {self.objective}: {'trains' if self.weight else 'measures'} the encoder of "
            f"{' and of '.join(self._trainers)}, weight {self.weight:g}, {self.batch_size} transitions per "
            f"{self.update_interval} environment steps, settings of pretraining for {entry or 'none'}"
        )

    @property
    def _first(self) -> AuxiliaryTrainer:
        return next(iter(self._trainers.values()))

    def _settings(self, env_id: str | None, seed: int = 0) -> tuple[str | None, AuxiliarySettings]:
        entry, known = settings_entry(self.objective, env_id)
        base = get_method(self.objective).base
        base_known = {} if base is None else settings_entry(base, env_id)[1].get("objective_kwargs", {})
        return entry, AuxiliarySettings(
            objective=self.objective,
            weight=self.weight,
            learning_rate=self.learning_rate,
            batch_size=self.batch_size,
            k=known.get("k", 1) if self.k is None else self.k,
            seed=seed,
            objective_kwargs={**known.get("objective_kwargs", {}), **self.objective_kwargs},
            base_kwargs={**base_known, **self.base_kwargs},
        )

    @staticmethod
    def _refuse_another(callback: Any) -> None:
        given = [found for found in nested_callbacks(callback) if isinstance(found, AuxiliaryObjective)]
        if len(given) > 1:
            raise ValueError(
                f"there are two auxiliary objectives, {given[0].objective} and {given[1].objective}, for the same "
                "encoder; give one"
            )

    def _begin_rollout(self) -> None:
        self._dones: list[Any] = []
        keys = dict.fromkeys(trainer.key for trainer in self._trainers.values())
        self._terminal: dict[str | None, dict[tuple[int, int], Any]] = {key: {} for key in keys}

    def _on_rollout_start(self) -> None:
        self._begin_rollout()

    def _on_step(self) -> bool:
        self._n_new += self.training_env.num_envs
        if isinstance(self.model, OnPolicyAlgorithm):
            dones, infos = self.locals["dones"], self.locals["infos"]
            for env in np.flatnonzero(dones).tolist():
                observation = infos[env].get("terminal_observation")
                if observation is not None:
                    for key, terminal in self._terminal.items():
                        # A copy: an environment may write the next observation into the same array.
                        terminal[len(self._dones), env] = np.array(observation if key is None else observation[key])
            self._dones.append(np.array(dones, bool))
        return True

    def _on_rollout_end(self) -> None:
        for trainer in self._trainers.values():
            trainer.attach()
        n_updates, self._pending = divmod(self._pending + self._n_new, self.update_interval)
        self._n_new = 0
        steps = self._steps(n_updates)
        if steps is not None:
            for _ in range(n_updates):
                self._update(steps)
        self._history.release()
        self._keep()

    def _update(self, steps: Steps) -> None:
        for name, trainer in self._trainers.items():
            terms = trainer.update(steps)
            prefix = "auxiliary/" if len(self._trainers) == 1 else f"auxiliary/{name}/"
            for term, value in (terms or {}).items():
                self.logger.record_mean(prefix + term, float(value))
        self.logger.record("auxiliary/n_updates", self._first.n_updates)

    def _steps(self, n_updates: int) -> Steps | None:
        """What to sample from; None where nothing is to be done."""
        model: Any = self.model
        if isinstance(model, OffPolicyAlgorithm):
            assert model.replay_buffer is not None
            learns = n_updates and model.num_timesteps > model.learning_starts
            return ReplaySteps(model.replay_buffer) if learns else None
        keys = list(self._terminal)
        rollout = read_rollout(
            model.rollout_buffer, keys, model.action_space, model.policy.squash_output,
            self._dones, self._terminal, model._last_obs,
        )  # fmt: skip
        self._history.add(rollout)
        return RolloutSteps.join(self._history.parts) if n_updates else None

    def _keep(self) -> None:
        """Put what is known beside the trainers into the first one's state."""
        first = self._first
        first.extra = {"pending": self._pending}
        first.keep_later(self._history_tensors)

    def _history_tensors(self) -> dict[str, th.Tensor]:
        # Each by itself: they are dropped one by one.
        return {
            f"{_HISTORY}{number}.{name}": tensor
            for number, part in enumerate(self._history.parts)
            for name, tensor in part.to_tensors().items()
        }


def trained_extractors(
    model: BaseAlgorithm, env: VecEnv, weight: float
) -> dict[str, tuple[BaseEncoderExtractor, str | None]]:
    """The extractors of the online networks that an auxiliary objective trains, each once.

    :param model: any algorithm of Stable-Baselines3 or sb3-contrib
    :param env: that it is trained in
    :param weight: of the objective
    :return: by a short name, with the key of the image in a ``Dict``, None for observations that are one image
    :raises ValueError: if there is none, or one that is frozen is to be trained
    """
    if unwrap_vec_wrapper(env, VecEncodeObservations) is not None:
        raise ValueError(
            "the encoder stands in the environment (VecEncodeObservations), where nothing can train it; give it as a "
            "features extractor instead: in the zoo, leave ,frozen out"
        )
    if not isinstance(model, OnPolicyAlgorithm | OffPolicyAlgorithm):
        raise ValueError(f"{type(model).__name__} has neither a rollout buffer nor a replay buffer to learn from")
    found: dict[str, tuple[BaseEncoderExtractor, str | None]] = {}
    keys = image_keys(model.policy)
    for name, extractor in find_extractors(model.policy):
        head, key = _HEADS.get(name.split(".")[0], name.split(".")[0]), keys.get(id(extractor))
        found[head if key is None else f"{head}.{key}"] = extractor, key
    if not found:
        extractor_class = model.policy.features_extractor_class
        raise ValueError(
            f"the policy's features extractor is {extractor_class.__name__}, but an auxiliary objective trains those "
            "of sb3_abisim; the same network is VanillaExtractor with features_extractor_kwargs {'network': 'nature'}"
        )
    frozen = [name for name, (extractor, _) in found.items() if extractor.frozen]
    if frozen and weight > 0:
        raise ValueError(
            f"the encoder of {' and of '.join(frozen)} is frozen, so weight={weight:g} would not hold; leave freeze "
            "(in the zoo ,frozen) out, or give weight=0, which measures only"
        )
    return found


def _env_id(env: VecEnv) -> str | None:
    """The id that the environments are registered under; None where they do not say."""
    try:
        spec = env.get_attr("spec", indices=0)[0]
    except (AttributeError, NotImplementedError):
        spec = getattr(env.unwrapped, "spec", None)
    return getattr(spec, "id", None)
