"""rl-zoo3's experiment manager with our hyperparameters, methods and evaluation splits.

For the environments of this package:

* without ``--conf-file``, the hyperparameters are those of ``hyperparams/*.yml``;
* evaluation is in the environment of training, on the evaluation split where there are splits (moving backgrounds),
  unless ``--eval-env-kwargs`` gives another one.

For every environment:

* ``--conf-file METHOD[=ENCODER][,frozen][,option=value]`` keeps the hyperparameters and replaces the features
  extractor; frozen and without options, it puts ``VecEncodeObservations`` in its place. Of a ``Dict`` of observations,
  it is for one image, which the encoder file names, else ``,image_key=KEY``;
* ``,auxiliary=OBJECTIVE`` behind any of these, a file or nothing adds an ``AuxiliaryObjective`` to the callbacks;
* ``policy_kwargs`` of a YAML file may be a mapping that names classes by their dotted paths;
* copies of one batched environment in one process are stepped as one batch (``BatchedVecEnv``);
* a run's folder says in ``method.json`` what it used, and that of a run on a frozen encoder holds a copy of the file;
* ``-optimize`` keeps a features extractor of this package, which rl-zoo3 alone would drop (rl-zoo3#431).
"""

import copy
import dataclasses
import functools
import importlib
import inspect
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_abisim.envs import ENV_IDS
from sb3_abisim.envs.base import batch_class
from sb3_abisim.envs.sb3_vec_env import BatchedVecEnv
from sb3_abisim.networks.encoder_file import RUN_COPY, load_encoder
from sb3_abisim.networks.encoder_name import EncoderNotFoundError, resolve_encoder
from sb3_abisim.registry import get_method, get_traits
from sb3_abisim.rl.checks import check_trained_with, encoders_of, find_extractors, is_extractor
from sb3_abisim.rl.extractor_classes import method_of
from sb3_abisim.zoo.auxiliary import auxiliary_of, with_auxiliary
from sb3_abisim.zoo.entries import (
    encoding_kwargs,
    hyperparameters_entry,
    hyperparameters_file,
    policy_of,
    resolve_classes,
    unfreezes,
    zoo_hyperparams,
)
from sb3_abisim.zoo.method_record import MethodRecord
from sb3_abisim.zoo.methods import MethodSpec, split_options
from sb3_abisim.zoo.models import continued_model, read_model_run
from sb3_abisim.zoo.preprocessing import PREPROCESSING_KEYS, check_preprocessing, normalizes_observations
from sb3_abisim.zoo.run_files import MEANS_NAME, hash_run
from sb3_abisim.zoo.saved_spaces import read_vec_normalize
from sb3_abisim.zoo.spaces import check_image_key, check_replayed, check_spaces

rl_utils: Any = importlib.import_module("rl_zoo3.utils")
exp_manager: Any = importlib.import_module("rl_zoo3.exp_manager")
if not hasattr(exp_manager, "ExperimentManager"):
    # We run inside the import of that module, through its import of custom_envs. Importing it afresh completes it now,
    # and the outer import returns what sys.modules holds in the end.
    del sys.modules["rl_zoo3.exp_manager"]
    exp_manager = importlib.import_module("rl_zoo3.exp_manager")


class MethodExperimentManager(exp_manager.ExperimentManager):  # type: ignore[misc]
    """``rl_zoo3.exp_manager.ExperimentManager`` that knows methods; parameters as there."""

    algo: str
    callbacks: list[BaseCallback]
    config: str
    custom_hyperparams: dict[str, Any] | None
    env_kwargs: dict[str, Any]
    env_wrapper: Any
    frame_stack: int | None
    normalize: bool
    eval_env_kwargs: dict[str, Any]
    vec_env_class: type
    save_path: str
    _hyperparams: dict[str, Any]
    _spec: MethodSpec | None = None
    # Whether a run of this process has begun to train: errors before that are mistakes of the command.
    has_begun = False
    # Whether saved models are built from the YAML of their runs, so that no pickle is opened.
    builds_from_yaml = False

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """As rl-zoo3 does, from our files and with a method's values.

        :return: the hyperparameters, and a sorted copy to save
        :raises ValueError: for an unknown method, or hyperparameters that do not fit together
        """
        env_id = self.env_name.gym_id
        self._spec = MethodSpec.of_conf_file(self.config)
        self.config, options = split_options(self.config)
        is_default = not self.config or Path(self.config).parent == zoo_hyperparams()
        if self.trial_id is not None and (self._spec is not None or env_id in ENV_IDS):
            raise ValueError(
                "--trial-id would replace policy_kwargs, the encoder included (rl-zoo3#431); "
                "give the trial's values with -params instead"
            )
        if is_default or self._spec is not None:
            self.config = str(hyperparameters_file(self.algo, env_id) or zoo_hyperparams() / f"{self.algo}.yml")
        if self._spec is not None:
            custom = self.custom_hyperparams or {}
            entry = hyperparameters_entry(self.algo, env_id)
            replaced = self._spec.hyperparameters(entry, custom)
            if "policy" in replaced:
                replaced["policy"] = policy_of(self.algo, replaced["policy"])
            self.custom_hyperparams = {**custom, **replaced}
        hyperparams, saved_hyperparams = super().read_hyperparameters()
        if "auxiliary" in options:
            for each in (hyperparams, saved_hyperparams):
                each["callback"] = with_auxiliary(each.get("callback"), options["auxiliary"])
        self._check_normalize(hyperparams)
        self._set_batched_vec_env(hyperparams)
        self._set_eval_env_kwargs(hyperparams)
        return hyperparams, saved_hyperparams

    def _check_normalize(self, hyperparams: dict[str, Any]) -> None:
        """Refuse what would change images or embeddings; make embeddings on the device of ``--device``."""
        encoding = encoding_kwargs(hyperparams)
        if encoding is None and self._spec is None:
            return
        if normalizes_observations(hyperparams.get("normalize", False)):
            what = "images" if encoding is None else "embeddings of the frozen encoder"
            raise ValueError(
                f"normalize={hyperparams['normalize']!r} would change the {what}; give "
                '"dict(norm_obs=False, norm_reward=True)": -params "normalize:{norm_obs: false, norm_reward: true}"'
            )
        if encoding is not None:
            # A copy: config.yml names the device as little as it does for the rest of the run.
            hyperparams["vec_env_wrapper"] = copy.deepcopy(hyperparams["vec_env_wrapper"])
            (encoding_kwargs(hyperparams) or {}).setdefault("device", str(self.device))

    def _set_batched_vec_env(self, hyperparams: dict[str, Any]) -> None:
        """Step copies as one batch where that gives the same as ``DummyVecEnv``; any other choice stays."""
        # One copy gains, too: its wrappers are called at the ends of episodes alone.
        is_plain = "env_wrapper" not in hyperparams
        if is_plain and self.vec_env_class is DummyVecEnv and batch_class(self.env_name.gym_id) is not None:
            self.vec_env_class = BatchedVecEnv

    def _set_eval_env_kwargs(self, hyperparams: dict[str, Any]) -> None:
        env_id = self.env_name.gym_id
        traits = get_traits(env_id)
        shared = hyperparams.get("env_kwargs", self.env_kwargs)
        # Hyperparameters are selected on what training sees, so that the evaluation split stays unseen.
        if traits.eval_split is not None and not self.optimize_hyperparameters:
            shared = {name: value for name, value in shared.items() if name not in traits.split_kwargs}
            self.eval_env_kwargs = {"split": traits.eval_split, **shared, **(self._eval_env_kwargs_args or {})}
        elif not self._eval_env_kwargs_args and (self._spec is not None or env_id in ENV_IDS):
            # rl-zoo3 takes those of --env-kwargs alone, and an environment with other arguments may be another task.
            self.eval_env_kwargs = shared

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        """As rl-zoo3 does; ``policy_kwargs`` may name classes by their dotted path.

        :param hyperparams: of :meth:`read_hyperparameters`
        """
        self._used = dict(hyperparams)
        processed, *rest = super()._preprocess_hyperparams(hyperparams)
        if processed.get("policy_kwargs") is not None:
            processed["policy_kwargs"] = resolve_classes(processed["policy_kwargs"])
        self._policy_kwargs: dict[str, Any] = dict(processed.get("policy_kwargs") or {})
        return processed, *rest

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> Any:
        """As rl-zoo3 does; what Stable-Baselines3 does not take is refused.

        :param n_envs: number of copies
        :param eval_env: whether they are for evaluation
        :param no_log: whether to write no monitor files
        :raises ValueError: see :mod:`sb3_abisim.zoo.spaces`
        """
        outer, stack = self.env_wrapper, self.frame_stack
        algorithm = exp_manager.ALGOS[self.algo]

        def wrap(env: Any) -> Any:
            env = env if outer is None else outer(env)
            try:
                check_spaces(env, stack)
                if self._spec is not None:
                    check_image_key(env.observation_space, self._image_key)
                if self.normalize and encoding_kwargs(self._used) is None and issubclass(algorithm, OffPolicyAlgorithm):
                    check_replayed(env, self.algo)
            except ValueError:
                env.close()
                raise
            return env

        self.env_wrapper = wrap
        try:
            return super().create_envs(n_envs, eval_env, no_log)
        finally:
            self.env_wrapper = outer

    @property
    def _image_key(self) -> str | None:
        """Which image of a Dict has the method's encoder; None for observations that are one image."""
        kwargs = self._policy_kwargs.get("features_extractor_kwargs") or {}
        return ", ".join(kwargs.get("encoders") or {}) or None

    def create_log_folder(self) -> None:
        """As rl-zoo3 does, unless the encoder is missing."""
        self._record = self._make_record()
        self._claim_folder()
        super().create_log_folder()

    def _claim_folder(self) -> None:
        """Make the run's folder, or the next one: rl-zoo3 counts first, and runs started together count the same."""
        os.makedirs(self.log_path, exist_ok=True)
        while True:
            try:
                os.mkdir(self.save_path)
                return
            except FileExistsError:
                number = rl_utils.get_latest_run_id(self.log_path, self.env_name) + 1
                self.save_path = os.path.join(self.log_path, f"{self.env_name}_{number}")
                self.params_path = f"{self.save_path}/{self.env_name}"

    def _make_record(self) -> MethodRecord:
        return dataclasses.replace(self._record_encoder(), auxiliary=auxiliary_of(self._used))

    def _record_encoder(self) -> MethodRecord:
        preprocessing = {key: self._used[key] for key in PREPROCESSING_KEYS if key in self._used}
        encoding = encoding_kwargs(self._used)
        if encoding is not None:
            file = load_encoder(encoding["encoder"])
            check_preprocessing(file, self._used, frozen=True)
            return MethodRecord(file.metadata["objective"], True, str(encoding["encoder"]), file.hash, preprocessing)
        extractor: Any = self._policy_kwargs.get("features_extractor_class")
        if not is_extractor(extractor):
            return MethodRecord(None, False, None, None, preprocessing)
        kwargs = self._policy_kwargs.get("features_extractor_kwargs") or {}
        if self._image_key is not None:
            preprocessing["image_key"] = self._image_key
        # The extractor of a Dict belongs to no method.
        method = method_of(extractor) or (None if self._spec is None else self._spec.name)
        names, hashes = [], []
        for encoder, network in encoders_of(extractor, kwargs):
            names.append(str(encoder))
            try:
                file = load_encoder(encoder, network)
                check_preprocessing(file, self._used)
                hashes.append(file.hash)
                method = method or str(file.metadata["objective"])
            except EncoderNotFoundError:
                # A saved model is complete without it.
                if not self.continue_training:
                    raise
        frozen = bool(kwargs.get("freeze", False)) and not unfreezes(self._used)
        options = {name: kwargs[name] for name in ("task_features_dim", "augment") if kwargs.get(name)}
        if self._spec is not None and options.get("augment") == get_method(self._spec.name).augment:
            # The extractor of a Dict has to be told that of the method.
            options.pop("augment", None)
        return MethodRecord(
            method, frozen, ", ".join(names) or None, ", ".join(hashes) or None, preprocessing, **options
        )

    def learn(self, model: BaseAlgorithm) -> None:
        """As rl-zoo3 does.

        :param model: to train
        """
        # Behind all others, which look first whether they can do what they are asked to.
        self.callbacks.append(_HasBegun())
        super().learn(model)

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """As rl-zoo3 does; the run is complete then, and its results get their hashes.

        :param model: that training ended with
        """
        super().save_trained_model(model)
        hash_run(Path(self.save_path))

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        super()._save_config(saved_hyperparams)
        self._record.write(self.params_path)
        encoding = encoding_kwargs(saved_hyperparams)
        if encoding is not None:
            shutil.copyfile(resolve_encoder(encoding["encoder"]), Path(self.params_path) / RUN_COPY)

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: Any) -> BaseAlgorithm:
        """Refuse ``-i`` with another extractor: rl-zoo3 keeps the model's, and would record the one asked for."""
        asked = hyperparams.get("policy_kwargs") or {}
        try:
            model = self._saved_agent(hyperparams, env)
        except BaseException:
            env.close()
            raise
        try:
            check_trained_with(model, asked, unfreezes(self._used))
        except ValueError as error:
            env.close()
            raise ValueError(f"cannot continue {self.trained_agent}: {error}; give the same --conf-file") from error
        if self._record.encoder is not None and self._record.encoder_hash is None:
            # The file is gone, and the model knows which one it was.
            _, extractor = find_extractors(model.policy)[0]
            self._record = dataclasses.replace(self._record, encoder_hash=extractor.hash)
        return model

    def _saved_agent(self, hyperparams: dict[str, Any], env: Any) -> BaseAlgorithm:
        if not self.builds_from_yaml:
            unpickled: BaseAlgorithm = super()._load_pretrained_agent(hyperparams, env)
            return unpickled
        path = Path(self.trained_agent)
        buffer = path.with_name("replay_buffer.pkl")
        if buffer.is_file():
            raise ValueError(
                f"{buffer} is a pickle, which executes whatever it holds; add --trust for yours, or move it elsewhere"
            )
        run = read_model_run(path)
        if run.algo != self.algo:
            raise ValueError(f"{path} is a model of {run.algo}, not {self.algo}; give --algo {run.algo}")
        kept = {name: value for name, value in hyperparams.items() if name not in ("policy", "policy_kwargs")}
        kept |= {"seed": self.seed, "tensorboard_log": self.tensorboard_log, "verbose": self.verbose}
        return continued_model(path, run, env, self.device, kept)

    def _maybe_normalize(self, env: Any, eval_env: bool) -> Any:
        """As rl-zoo3 does; saved means are read by an unpickler that makes nothing else."""
        path = Path(self.trained_agent).parent / self.env_name / MEANS_NAME
        if not (self.builds_from_yaml and path.is_file()):
            return super()._maybe_normalize(env, eval_env)
        try:
            normalize = read_vec_normalize(path)
        except ValueError:
            env.close()
            raise
        normalize.set_venv(env)
        if eval_env:
            normalize.training, normalize.norm_reward = False, False
        return normalize

    def hyperparameters_optimization(self) -> None:
        """As rl-zoo3 does, except that an extractor of ours survives a trial's ``policy_kwargs``."""
        extractor = (self._hyperparams.get("policy_kwargs") or {}).get("features_extractor_class")
        if is_extractor(extractor):
            self._hyperparams = _KeepExtractor(self._hyperparams)
        MethodExperimentManager.has_begun = True
        super().hyperparameters_optimization()


class _HasBegun(BaseCallback):
    """Notes that training has begun: errors from then on are no mistakes of the command."""

    def _on_training_start(self) -> None:
        MethodExperimentManager.has_begun = True

    def _on_step(self) -> bool:
        return True


class _KeepExtractor(dict[str, Any]):
    """Hyperparameters whose ``policy_kwargs`` are merged with those of a trial instead of replaced by them."""

    def copy(self) -> "_KeepExtractor":
        # Stable-Baselines3 writes into policy_kwargs, so each trial needs its own.
        return _KeepExtractor(self | {"policy_kwargs": copy.deepcopy(self["policy_kwargs"])})

    def update(self, sampled: dict[str, Any]) -> None:  # type: ignore[override]
        super().update(sampled | {"policy_kwargs": self["policy_kwargs"] | sampled.get("policy_kwargs", {})})


def with_eval_split(make_env: Callable[..., Any]) -> Callable[..., Any]:
    """``create_test_env`` on the evaluation split, and on the copy of the encoder that a run's folder holds.

    :param make_env: ``rl_zoo3.utils.create_test_env``
    """
    signature = inspect.signature(make_env)

    @functools.wraps(make_env)
    def create_test_env(*args: Any, **kwargs: Any) -> Any:
        given = signature.bind(*args, **kwargs).arguments
        traits = get_traits(given["env_id"])
        env_kwargs = given.get("env_kwargs") or {}
        if traits.eval_split is not None and not set(traits.split_kwargs) & set(env_kwargs):
            given["env_kwargs"] = {"split": traits.eval_split, **env_kwargs}
        run_copy = Path(given.get("stats_path") or "") / RUN_COPY
        if run_copy.is_file() and encoding_kwargs(given.get("hyperparams") or {}) is not None:
            hyperparams = given["hyperparams"]
            hyperparams["vec_env_wrapper"] = copy.deepcopy(hyperparams["vec_env_wrapper"])
            (encoding_kwargs(hyperparams) or {})["encoder"] = str(run_copy)
        return make_env(**given)

    return create_test_env


# What rl-zoo3 has, and what stands in its place.
_REPLACED = {
    "ExperimentManager": (exp_manager.ExperimentManager, MethodExperimentManager),
    "create_test_env": (rl_utils.create_test_env, with_eval_split(rl_utils.create_test_env)),
}


def install() -> None:
    """Make rl-zoo3's commands use this manager; a second call does nothing."""
    # Everywhere: with --gym-packages, the command has copied the names by `from ... import` before it imports us.
    for module in list(sys.modules.values()):
        for name, (plain, ours) in _REPLACED.items():
            if getattr(module, "__dict__", {}).get(name) is plain:
                setattr(module, name, ours)
