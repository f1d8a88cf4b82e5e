"""Checks of loaded models: what a model holds, compared with what was asked for."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecNormalize
from torch import nn

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.networks.encoder_name import EncoderNotFoundError
from sb3_abisim.rl.combined import CombinedEncoderExtractor
from sb3_abisim.rl.extractors import BaseEncoderExtractor, EncoderExtractor, PretrainedExtractor, VanillaExtractor
from sb3_abisim.rl.vec_encode import VecEncodeObservations


def find_extractors(policy: nn.Module) -> list[tuple[str, BaseEncoderExtractor]]:
    """The extractors of a policy by name, each object once, without those of target networks.

    :param policy: ``model.policy``
    """
    return [
        (name, module)
        for name, module in policy.named_modules()
        if isinstance(module, BaseEncoderExtractor) and not name.split(".")[0].endswith("_target")
    ]


def require_weights(model: BaseAlgorithm) -> None:
    """Raise if the model has an extractor whose encoder file was not found; call it before training.

    The first ``forward`` would raise as well, but off-policy algorithms first act at random for a while.

    :param model: an SB3 model
    :raises EncoderNotFoundError: (a ``FileNotFoundError``) listing the places searched
    """
    for _, extractor in find_extractors(model.policy):
        if isinstance(extractor, PretrainedExtractor):
            extractor.require_weights()


def is_extractor(extractor: Any) -> bool:
    """Whether something is a features extractor class of ours, for one image or for a dictionary.

    :param extractor: ``features_extractor_class``
    """
    return isinstance(extractor, type) and issubclass(extractor, BaseEncoderExtractor | CombinedEncoderExtractor)


def encoders_of(extractor: type, kwargs: Mapping[str, Any]) -> list[tuple[str, str | None]]:
    """The encoder files that a features extractor of ours is given, and the network that each is to have.

    :param extractor: its class
    :param kwargs: ``features_extractor_kwargs``
    """
    return [(file, network) for _, _, file, network in _parts(extractor, kwargs) if file is not None]


def image_keys(policy: nn.Module) -> dict[int, str]:
    """Which image of a ``Dict`` of observations an extractor is for.

    :param policy: ``model.policy``
    :return: the keys, by ``id`` of the extractor; none of those for observations that are one image
    """
    return {
        id(part): key
        for module in policy.modules()
        if isinstance(module, CombinedEncoderExtractor)
        for key, part in module.extractors.items()
    }


_Part = tuple[str | None, type[BaseEncoderExtractor], str | None, str | None]


def _parts(extractor: Any, kwargs: Mapping[str, Any]) -> list[_Part]:
    """The extractors of one image that one of ours is made of: key, class, file (None without one) and network."""
    if not issubclass(extractor, CombinedEncoderExtractor):
        return [(None, extractor, kwargs.get("encoder"), kwargs.get("network"))]
    networks = kwargs.get("networks") or {}
    return [
        (key, VanillaExtractor if file is None else EncoderExtractor, file, networks.get(key, {}).get("network"))
        for key, file in kwargs["encoders"].items()
    ]


def nested_callbacks(callback: Any) -> list[Any]:
    """A callback and all within it; one that is given twice is there twice.

    :param callback: of ``learn``
    """
    inner = getattr(callback, "callbacks", None) or [getattr(callback, "callback", None)]
    return [callback, *(found for child in inner if child is not None for found in nested_callbacks(child))]


def require_every_event(callback: BaseCallback) -> None:
    """Refuse a callback within one that passes on some steps, and no beginning and end of a rollout.

    :param callback: that needs all of them
    :raises ValueError: naming the other one
    """
    if isinstance(callback.parent, EventCallback):
        raise ValueError(
            f"{type(callback).__name__} within {type(callback.parent).__name__} would see some steps only; give both "
            "to learn in one list"
        )


def check_eval_envs(training_env: VecEnv, callback: Any) -> None:
    """Refuse evaluation environments whose observations were made in another way than those of training.

    Compared are what ``VecEncodeObservations``, ``VecFrameStack``, ``VecNormalize`` and Gymnasium's wrappers of
    observations do; of environments in other processes, the former only.

    :param training_env: of the model
    :param callback: of ``learn``; those within it are looked at, too
    :raises ValueError: with both sides
    """
    for each in nested_callbacks(callback):
        eval_env = getattr(each, "eval_env", None)
        if isinstance(eval_env, VecEnv):
            _check_eval_env(training_env, each, eval_env)


def _check_eval_env(training_env: VecEnv, callback: Any, eval_env: VecEnv) -> None:
    (layers, wrappers), (their_layers, their_wrappers) = _preprocessing(training_env), _preprocessing(eval_env)
    differ = wrappers is not None and their_wrappers is not None and wrappers != their_wrappers
    if layers != their_layers or differ:
        here, there = (
            ", ".join([*names, *(inner or [])]) or "nothing"
            for names, inner in ((layers, wrappers), (their_layers, their_wrappers))
        )
        raise ValueError(
            f"{type(callback).__name__} evaluates on observations made by {there}, but training makes them by {here}; "
            "give its eval_env the same encoder file and wrappers"
        )


def _preprocessing(venv: VecEnv) -> tuple[list[str], list[str] | None]:
    """What makes the observations of an environment, the outermost first: in the VecEnv, and in its first copy."""
    layers: list[str] = []
    while isinstance(venv, VecEnvWrapper):
        if isinstance(venv, VecEncodeObservations):
            layers.append(f"VecEncodeObservations(hash {venv.encoder_file.hash})")
        elif isinstance(venv, VecFrameStack):
            layers.append(f"VecFrameStack({venv.stacked_obs.n_stack})")
        elif isinstance(venv, VecNormalize) and venv.norm_obs:
            layers.append("VecNormalize")
        venv = venv.venv
    copies = getattr(venv, "envs", None)
    if not copies:
        return layers, None
    wrappers, env = [], copies[0]
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.ObservationWrapper):
            wrappers.append(f"{type(env).__module__}.{type(env).__qualname__}")
        env = env.env
    return layers, wrappers


def check_trained_with(model: BaseAlgorithm, policy_kwargs: dict[str, Any], unfreezes: bool = False) -> None:
    """Refuse a model whose extractors are not those that ``policy_kwargs`` would build.

    An encoder file that is not there is taken for the model's: a saved model is complete without it. A custom extractor
    has to check what it holds by itself.

    :param model: an SB3 model
    :param policy_kwargs: as for a new model
    :param unfreezes: whether a frozen encoder is unfrozen at some step, so that the model may be on either side of it
    :raises ValueError: with both sides
    """
    asked_class = policy_kwargs.get("features_extractor_class")
    kwargs = policy_kwargs.get("features_extractor_kwargs") or {}
    here, absent = set(), False
    if asked_class is not None:
        if not is_extractor(asked_class):
            return
        parts = [
            (key, each_class, None if file is None else _hash_of(file, network))
            for key, each_class, file, network in _parts(asked_class, kwargs)
        ]
        absent = any(hash is None and issubclass(each_class, PretrainedExtractor) for _, each_class, hash in parts)
        frozen = bool(kwargs.get("freeze", False)) and not unfreezes
        here = {
            _name(
                each_class,
                frozen and issubclass(each_class, PretrainedExtractor),
                None if absent else hash,
                each_class.asked_extras(kwargs),
                key,
            )
            for key, each_class, hash in parts
        }
    keys = image_keys(model.policy)
    there = {
        _name(type(each), each.frozen and not unfreezes, None if absent else each.hash, each.extras, keys.get(id(each)))
        for _, each in find_extractors(model.policy)
    }
    if there != here:
        sides = (" and ".join(sorted(side)) or "none of our extractors" for side in (there, here))
        raise ValueError("it was trained with {}, not with {}".format(*sides))


def _hash_of(encoder: str, network: str | None) -> str | None:
    try:
        return load_encoder(encoder, network).hash
    except EncoderNotFoundError:
        return None


def _name(extractor: type[BaseEncoderExtractor], frozen: bool, hash: str | None, extras: str, key: str | None) -> str:
    of_key = "" if key is None else f" of {key}"
    return extractor.__name__ + of_key + f", hash {hash}" * (hash is not None) + ", frozen" * frozen + extras
