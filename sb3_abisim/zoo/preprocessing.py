"""What stands between an environment and an encoder: as hyperparameters name it, and as files have recorded it.

What a dataset was collected with is recorded in it and in the encoder files that are pretrained on it. Whoever shows an
encoder observations makes them by the record (:func:`recorded_preprocessing`) or compares what it makes with the record
(:func:`check_preprocessing`). A file only names wrappers: they are looked up in packages that are imported already, and
no module is imported because a file names it.
"""

import re
import shlex
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecMonitor, VecTransposeImage

from sb3_abisim.data.environments import VEC_ENV_KEY, Preprocessing
from sb3_abisim.envs.plain_actions import PLAIN_ACTIONS
from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.rl.vec_encode import VecEncodeObservations
from sb3_abisim.zoo.named import named_class

PREPROCESSING_KEYS = ("env_wrapper", "frame_stack", "normalize")


def items(value: Any) -> list[Any]:
    """The items of a zoo entry's ``env_wrapper``, ``vec_env_wrapper`` or ``callback``: one, several or None.

    :param value: of the entry
    """
    return list(value) if isinstance(value, list | tuple) else [] if value is None else [value]


def class_name(item: Any) -> str:
    """The name of the class that one of :func:`items` names, with or without arguments.

    :param item: a dotted path, a class, or either with arguments in a dictionary
    """
    name = next(iter(item), "") if isinstance(item, Mapping) else item
    return str(getattr(name, "__name__", name)).rpartition(".")[2]


def frame_stack_of(file: EncoderFile) -> int:
    """How many observations an encoder sees together, 1 where nothing is recorded.

    :param file: of the encoder
    """
    return int(file.metadata["preprocessing"].get("frame_stack", 1))


def check_preprocessing(file: EncoderFile, settings: Mapping[str, Any], frozen: bool = False) -> None:
    """Refuse hyperparameters that show an encoder something else than it was pretrained on.

    :param file: of the encoder; one that records nothing, as those of environments that run as one batch and of data
        from elsewhere, is left to the check of spaces
    :param settings: a zoo entry's hyperparameters
    :param frozen: whether ``VecEncodeObservations`` stacks observations, so that ``frame_stack`` would stack embeddings
    :raises ValueError: naming both sides
    """
    recorded = file.metadata["preprocessing"]
    _refuse_vec_env(recorded, str(file.path))
    there: dict[str, Any] = {"env_wrapper": items(recorded.get("env_wrapper")), "frame_stack": frame_stack_of(file)}
    here: dict[str, Any] = {
        "env_wrapper": items(settings.get("env_wrapper")),
        "frame_stack": settings.get("frame_stack") or 1,
    }
    # It changes no observation.
    plain = [item for item in here["env_wrapper"] if item == PLAIN_ACTIONS]
    for side in (there, here):
        side["env_wrapper"] = [item for item in side["env_wrapper"] if item != PLAIN_ACTIONS]
    different = [name for name in there if there[name] != here[name]] if recorded else []
    if frozen:
        # The wrapper stacks by itself, whether hyperparameters say so or not.
        different = [name for name in different if name != "frame_stack"]
        if here["frame_stack"] > 1:
            different.append("frame_stack")
    if not different:
        return
    sides = "; ".join(f"{name}: {there[name]} in pretraining, {here[name]} now" for name in different)
    wanted: dict[str, Any] = {name: there[name] or None for name in different}
    if plain and "env_wrapper" in wanted:
        wanted["env_wrapper"] = [*there["env_wrapper"], *plain]
    if frozen and "frame_stack" in wanted:
        sides += ", which would stack embeddings"
        wanted["frame_stack"] = None
    words = " ".join(shlex.quote(f"{name}:{value}") for name, value in wanted.items())
    raise ValueError(
        f"{file.path} was pretrained on other observations ({sides}); add -params {words}, or collect and pretrain as "
        "now (collect takes --env-wrapper and --frame-stack)"
    )


def normalizes_observations(normalize: Any) -> bool:
    """Whether the zoo's ``normalize`` makes VecNormalize change observations.

    :param normalize: of a zoo entry: a bool, a dictionary, or the text of either
    """
    if isinstance(normalize, dict):
        return bool(normalize.get("norm_obs", True))
    text = str(normalize or False)
    return text not in ("False", "None") and re.search(r"norm_obs['\"]?\s*[=:]\s*False", text) is None


def other_vec_wrappers(settings: Mapping[str, Any]) -> list[str]:
    """What ``vec_env_wrapper`` puts between the environments and a frozen encoder or the agent.

    :param settings: of a zoo entry or a run
    :return: names, without those that change no observation and ``VecEncodeObservations``
    """
    names = [next(iter(item)) if isinstance(item, Mapping) else item for item in items(settings.get("vec_env_wrapper"))]
    kept = {VecEncodeObservations.__name__, VecTransposeImage.__name__, VecMonitor.__name__}
    return [str(name) for name in names if class_name(name) not in kept]


def recorded_wrapper(recorded: Any, kind: type = gym.Wrapper, where: str = "") -> Callable[[Any], Any] | None:
    """The wrappers that a file names, see :func:`wrapper_classes`.

    :param recorded: ``env_wrapper`` or ``vec_env_wrapper`` as a file holds it
    :param kind: what they must be subclasses of
    :param where: the file, for messages
    :return: wraps one environment; None for no wrapper
    :raises ValueError: as :func:`wrapper_classes`
    """
    found = wrapper_classes(recorded, kind, where)
    if not found:
        return None

    def wrap(env: Any) -> Any:
        for wrapper_class, kwargs in found:
            env = wrapper_class(env, **kwargs)
        return env

    return wrap


def wrapper_classes(recorded: Any, kind: type, where: str) -> list[tuple[Any, dict[str, Any]]]:
    """The wrappers that a file names, of packages that are imported already.

    :param recorded: ``env_wrapper`` or ``vec_env_wrapper`` as a file holds it
    :param kind: what they must be subclasses of
    :param where: the file, for messages
    :return: each class with its arguments
    :raises ValueError: for a wrapper of a package that nobody has imported, or something that is no wrapper
    """
    found = []
    for item in items(recorded):
        path, kwargs = next(iter(item.items())) if isinstance(item, Mapping) and len(item) == 1 else (item, {})
        wrapper_class = named_class(path, kind, where, "wrapper")
        if not isinstance(kwargs, Mapping):
            raise ValueError(f"{where} gives the wrapper {path!r} the arguments {kwargs!r}, which are no mapping")
        found.append((wrapper_class, dict(kwargs)))
    return found


def recorded_preprocessing(recorded: Mapping[str, Any], where: str) -> Preprocessing:
    """What a file has recorded, ready to be applied.

    :param recorded: of an encoder file or a dataset
    :param where: the file, for messages
    :raises ValueError: as :func:`recorded_wrapper`
    """
    _refuse_vec_env(recorded, where)
    return Preprocessing(
        frame_stack=recorded.get("frame_stack", 1),
        image_key=recorded.get("image_key"),
        env_wrapper=recorded.get("env_wrapper"),
        wrapper=recorded_wrapper(recorded.get("env_wrapper"), where=where),
    )


def _refuse_vec_env(recorded: Mapping[str, Any], where: str) -> None:
    if VEC_ENV_KEY in recorded:
        raise ValueError(
            f"{where} was pretrained on what {' of '.join(recorded[VEC_ENV_KEY])} shows, which the zoo cannot make; "
            "train in Python on such an environment, or collect by the environment's id and pretrain again"
        )
