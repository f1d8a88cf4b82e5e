"""Models of zoo runs, made again from the run's YAML; of the zip only the weights and a few numbers are read.

``load`` of Stable-Baselines3 unpickles what a zip holds, and a pickle can execute anything. Here ``config.yml`` says
what to build, by an allow-list (:mod:`sb3_abisim.zoo.named`), and ``torch.load(weights_only=True)`` reads the weights.
Of the pickles, those of the two spaces alone are opened, by an unpickler that makes spaces and arrays and nothing else
(:mod:`sb3_abisim.zoo.saved_spaces`): DQN takes random actions from its action space, which keeps where they go on.
Memory is bounded by the size of the zip before it is taken.
"""

import contextlib
import importlib
import inspect
import io
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file, recursive_setattr
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_abisim.common.files import is_of_system
from sb3_abisim.common.pickle_size import check_pickle_size
from sb3_abisim.networks.bounded import BoundedTensors
from sb3_abisim.rl.unfreeze import unfreeze_encoder
from sb3_abisim.zoo.named import named_class, named_policy_kwargs
from sb3_abisim.zoo.run_files import read_yaml
from sb3_abisim.zoo.runs import Run, read_run
from sb3_abisim.zoo.saved_spaces import read_space

# Attributes that go on with the weights: plain numbers in the zip.
_NUMBERS = (
    "num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates", "_n_calls",
    "_current_progress_remaining", "exploration_rate",
)  # fmt: skip
# Of the algorithms' arguments: what a saved model is built without.
_LEFT_OUT = {
    "env", "device", "verbose", "tensorboard_log", "_init_setup_model", "seed", "policy", "policy_kwargs",
    "replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage",
}  # fmt: skip
# Of these, those that name classes or sizes: of a model that is trained on, the command's hold.
_OF_BUFFERS = ("replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage")
_DATA_NAME = "data"


def read_model_run(path: Path) -> Run:
    """The run that a saved model lies in.

    :param path: the zip
    :raises ValueError: if it lies in none, naming the flag that unpickles it
    """
    try:
        return read_run(path.parent)
    except ValueError as error:
        raise ValueError(
            f"{path} lies in no folder of a run, whose YAML would say how to build it ({error}); if you made it "
            "or trust whoever did, --trust unpickles it"
        ) from error


def load_model(path: Path, run: Run, trust: bool = False) -> BaseAlgorithm:
    """A saved model of a run, on the CPU.

    It has no environment and no replay buffer. Built from the YAML, it acts as the unpickled one, bit for bit.

    :param path: the zip
    :param run: whose ``config.yml`` says what to build
    :param trust: unpickle the zip, which executes whatever it holds; False builds the model from the YAML and takes the
        weights alone
    :raises ValueError: for a damaged zip, or a model that is not trusted and cannot be built from the YAML
    """
    if trust:
        return unpickled_model(path, run.algo)
    where = run.folder / run.env_name / "config.yml"
    data, size = _checked_data(path)
    with _one_sentence(path, where):
        spaces = read_space(data.get("observation_space")), read_space(data.get("action_space"))
        arguments = model_arguments(run.algo, read_yaml(where), spaces[1], str(where))
        with BoundedTensors(size):
            model = _build(run.algo, arguments, *spaces, seed=data.get("seed"))
        _restore(model, path, data)
    return model


def _checked_data(path: Path) -> tuple[dict[str, Any], int]:
    try:
        return _read_data(path)
    except Exception as error:
        if is_of_system(error):
            raise
        raise ValueError(f"{path} is damaged or no model of Stable-Baselines3 ({error}); copy it again") from error


@contextlib.contextmanager
def _one_sentence(path: Path, where: Path) -> Iterator[None]:
    """A foreign file can be wrong in any way."""
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            f"{path} cannot be built from {where.name} and its weights alone: {reason}; if you made it or trust "
            "whoever did, --trust unpickles it"
        ) from error


def continued_model(path: Path, run: Run, env: VecEnv, device: str, hyperparams: Mapping[str, Any]) -> BaseAlgorithm:
    """A saved model of a run that is to be trained on: to the bit what ``load(path, env=env, **hyperparams)`` gives.

    :param path: the zip
    :param run: whose ``config.yml`` says what to build
    :param env: to train in
    :param device: to train on
    :param hyperparams: take the place of those of the run; as rl-zoo3 has made them
    :raises ValueError: for a damaged zip, a model that cannot be built from the YAML, or other spaces
    """
    where = run.folder / run.env_name / "config.yml"
    data, size = _checked_data(path)
    with _one_sentence(path, where):
        saved = read_space(data.get("observation_space")), read_space(data.get("action_space"))
        config = read_yaml(where)
        arguments = model_arguments(run.algo, config, saved[1], str(where))
        del arguments["n_envs"]
        for name in _OF_BUFFERS:
            if name in config and name not in hyperparams:
                raise ValueError(f"it was trained with {name}, which is not given now")
        algorithm = algorithm_class(run.algo)
    env = algorithm._wrap_env(env, 0)
    try:
        check_for_correct_spaces(env, *saved)
    except ValueError as error:
        raise ValueError(f"{path} was trained in another environment: {error}") from error
    with _one_sentence(path, where):
        with BoundedTensors(size):
            model: Any = algorithm(env=env, device=device, _init_setup_model=False, **arguments)  # type: ignore[call-arg]
            model.observation_space, model.action_space = saved
        # The buffers are as large as this command says, whatever the zip holds.
        vars(model).update(hyperparams)
        model._setup_model()
        _restore(model, path, data, device)
    continued: BaseAlgorithm = model
    return continued


def unpickled_model(path: Path, algo: str) -> BaseAlgorithm:
    """A saved model as Stable-Baselines3 loads it, on the CPU: whatever the zip holds is executed.

    :param path: the zip, which the user trusts
    :param algo: rl-zoo3's name
    """
    model: BaseAlgorithm = algorithm_class(algo).load(path, device="cpu")
    return model


def algorithm_class(algo: str) -> type[BaseAlgorithm]:
    """The algorithm of a name.

    :param algo: rl-zoo3's name, such as "ppo"
    :raises ValueError: for an unknown one
    """
    # This name stands for itself where another one has been put in place of rl-zoo3's (:mod:`sb3_abisim.zoo.guard`).
    algos = importlib.import_module("rl_zoo3.exp_manager").ALGOS
    if algo not in algos:
        raise ValueError(f"unknown algorithm {algo!r}; rl-zoo3 knows {', '.join(sorted(algos))}")
    found: type[BaseAlgorithm] = algos[algo]
    return found


def model_arguments(algo: str, config: Mapping[str, Any], action_space: gym.Space[Any], where: str) -> dict[str, Any]:
    """The arguments of an algorithm that a run's configuration gives, as rl-zoo3 makes them.

    :param algo: rl-zoo3's name
    :param config: of ``config.yml``
    :param action_space: of the environment, for the noise of actions
    :param where: the file, for messages
    :raises ValueError: for what only evaluating the file could tell
    """
    manager: Any = importlib.import_module("rl_zoo3.exp_manager").ExperimentManager
    algorithm = algorithm_class(algo)
    known = set(inspect.signature(algorithm).parameters) - _LEFT_OUT
    given = {name: value for name, value in config.items() if name in known | {"noise_type", "noise_std"}}
    given = manager._preprocess_schedules(given)
    if isinstance(given.get("train_freq"), list):
        given["train_freq"] = tuple(given["train_freq"])
    # Of an environment, rl-zoo3 reads this alone.
    env = SimpleNamespace(action_space=action_space)
    given = manager._preprocess_action_noise(SimpleNamespace(n_actions=0), given, {}, env)
    if "target_entropy" in known and given.get("target_entropy", "auto") == "auto":
        # Found out from the environment, which a saved model is built without.
        given["target_entropy"] = float(-np.prod(action_space.shape or ()).astype(np.float32))
    policy = config.get("policy")
    if not isinstance(policy, str) or policy not in algorithm.policy_aliases:
        policy = named_class(policy, BasePolicy, where, "policy")
    return {**given, "policy": policy, "policy_kwargs": named_policy_kwargs(config.get("policy_kwargs"), where),
            "n_envs": int(config.get("n_envs", 1))}  # fmt: skip


def _build(
    algo: str, arguments: dict[str, Any], observation_space: gym.Space[Any], action_space: gym.Space[Any], seed: Any
) -> BaseAlgorithm:
    algorithm = algorithm_class(algo)
    # Sizes of buffers, which acting has no use for; they are as asked for again afterwards.
    small = {"buffer_size": 1, **({"n_steps": 2, "batch_size": 2} if issubclass(algorithm, OnPolicyAlgorithm) else {})}
    small = {name: size for name, size in small.items() if name in inspect.signature(algorithm).parameters}
    n_envs = arguments.pop("n_envs")
    model: Any = algorithm(env=None, device="cpu", _init_setup_model=False, **(arguments | small))  # type: ignore[call-arg]
    asked = {name: arguments[name] for name in small if name in arguments}
    defaults = {name: inspect.signature(algorithm).parameters[name].default for name in small}
    model.observation_space, model.action_space, model.n_envs = observation_space, action_space, n_envs
    # Random actions begin anew with the seed of training, where it had one.
    model.seed = seed if type(seed) is int else None
    model._setup_model()
    for name, value in (defaults | asked).items():
        setattr(model, name, value)
    built: BaseAlgorithm = model
    return built


def _read_data(path: Path) -> tuple[dict[str, Any], int]:
    """The JSON of a zip, of which no pickle is opened, and the size of the zip, which bounds all that it holds."""
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        _require_stored(archive, size)
        for name in archive.namelist():
            if name.endswith(".pth"):
                with zipfile.ZipFile(io.BytesIO(archive.read(name))) as inner:
                    _require_stored(inner, size)
                    for part in inner.namelist():
                        if part.endswith(".pkl"):
                            check_pickle_size(inner.read(part))
        data = json.loads(archive.read(_DATA_NAME))
    if not isinstance(data, dict):
        raise ValueError("its data are no mapping")
    return data, size


def _require_stored(archive: zipfile.ZipFile, size: int) -> None:
    if sum(info.file_size for info in archive.infolist()) > size:
        raise ValueError("it holds more than its size; Stable-Baselines3 compresses nothing")


def _restore(model: BaseAlgorithm, path: Path, data: Mapping[str, Any], device: str = "cpu") -> None:
    params, variables = _read_tensors(path)
    if _n_optimized(params) > _n_optimized(model.get_parameters()):
        # Saved after unfreeze_at, and built from a configuration that says freeze: true.
        unfreeze_encoder(model)
    model.set_parameters(params, exact_match=True, device=device)
    for name, value in (variables or {}).items():
        if value is not None and name in model._get_torch_save_params()[1]:
            recursive_setattr(model, f"{name}.data", value.data)
    for name in _NUMBERS:
        number = data.get(name, "")
        if hasattr(model, name) and isinstance(number, int | float) and math.isfinite(number):
            setattr(model, name, number)
    if model.use_sde:
        model.policy.reset_noise()  # type: ignore[operator]


def _read_tensors(path: Path) -> tuple[dict[str, Any], Any]:
    """The state dicts and the variables of a zip, as tensors that take no more memory than the zip."""
    _, params, variables = load_from_zip_file(path, load_data=False, device="cpu")
    for tensor in _tensors([params, variables]):
        # One number could stand for a tensor of any size.
        if tensor.layout != th.strided or tensor.nbytes > tensor.untyped_storage().nbytes():
            raise ValueError("its weights are no plain tensors")
    return params, variables


def _n_optimized(parameters: Mapping[str, Any]) -> int:
    """How many parameters the optimizers hold, of a model's ``get_parameters()``."""
    states = [state for state in parameters.values() if isinstance(state, Mapping)]
    return sum(len(group["params"]) for state in states for group in state.get("param_groups", ()))


def _tensors(value: Any) -> Iterator[th.Tensor]:
    if isinstance(value, th.Tensor):
        yield value
    elif isinstance(value, Mapping):
        yield from _tensors(list(value.values()))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _tensors(part)


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """What a saved model holds that can be read without unpickling.

    :param path: the zip
    :return: its JSON, in which pickled values are texts, and the weights of its policy by name
    :raises ValueError: for a damaged zip, or anything else
    """
    try:
        data, _ = _read_data(path)
        params, _ = _read_tensors(path)
        policy = params["policy"]
        if not all(isinstance(weights, th.Tensor) for weights in policy.values()):
            raise ValueError("its policy holds other things than tensors")
    except Exception as error:
        if is_of_system(error):
            raise
        raise ValueError(f"{path} is damaged or no model of Stable-Baselines3 ({error}); copy it again") from error
    return data, policy
