"""Everything that rl-zoo3 needs to know; importing this module tells it.

``custom_envs.py`` imports it when a zoo command starts in a checkout; elsewhere ``--gym-packages sb3_abisim.zoo`` or
``python -m sb3_abisim.zoo train ...`` does. For the environment ids of this package, and for no others:

* without ``--conf-file``, the hyperparameters are those of this package;
* ``--conf-file METHOD[=ENCODER][,frozen]`` takes the same hyperparameters with another method's features extractor, or
  frozen with ``VecEncodeObservations`` in its place;
* several environments in one process are stepped as one batch (``LockstepVecEnv``);
* evaluation of the Distractor environments is on unseen clips unless ``--eval-env-kwargs`` gives another split.

The folder of a run on ``VecEncodeObservations`` holds a copy of the encoder file, which ``enjoy`` and ``record_video``
use. ``-optimize`` keeps a features extractor of this package, which rl-zoo3 alone would drop (rl-zoo3#431).
"""

import argparse
import ast
import copy
import functools
import importlib
import importlib.util
import inspect
import re
import runpy
import shutil
import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sb3_abisim.envs import ENV_IDS
from sb3_abisim.resources import resource_path

# Method: its class in sb3_abisim.extractors.
EXTRACTORS = {
    "abisim": "ActionBisimExtractor",
    "ssi": "SSIExtractor",
    "acro": "ACROExtractor",
    "beta_vae": "BetaVAEExtractor",
    "curl": "CURLExtractor",
    "info_nce": "InfoNCEExtractor",
    "vanilla": "VanillaExtractor",
}
UNTRAINED = ("vanilla",)
ENCODING_WRAPPER = "sb3_abisim.vec_env.VecEncodeObservations"
DISTRACTOR_IDS = tuple(env_id for env_id in ENV_IDS if "Distractor" in env_id)

_SCRIPTS = {
    "train": "rl_zoo3.train",
    "enjoy": "rl_zoo3.enjoy",
    "record_video": "rl_zoo3.record_video",
    "plot_train": "rl_zoo3.plots.plot_train",
    "all_plots": "rl_zoo3.plots.all_plots",
    "plot_from_file": "rl_zoo3.plots.plot_from_file",
}
_GRAMMAR = f"METHOD[=ENCODER][,frozen] with METHOD one of {', '.join(EXTRACTORS)}"


@dataclass(frozen=True)
class Method:
    """Which features extractor a run uses.

    :param name: a key of :data:`EXTRACTORS`
    :param encoder: a file, a shipped encoder's name or ``hf://owner/repository/file``; None for the shipped encoder of
        this method and the environment
    :param frozen: whether the weights stay as they are during RL
    :raises ValueError: for an unknown method, or an encoder or ``frozen`` for an untrained one
    """

    name: str
    encoder: str | None = None
    frozen: bool = False

    def __post_init__(self) -> None:
        if self.name not in EXTRACTORS:
            raise ValueError(f"unknown method {self.name!r}; give {_GRAMMAR}")
        if self.encoder == "":
            raise ValueError(f"no encoder after '{self.name}='; give {_GRAMMAR}")
        if self.name in UNTRAINED and (self.encoder is not None or self.frozen):
            raise ValueError(
                f"{self.name!r} trains its network from scratch: it takes neither an encoder nor ',frozen'"
            )

    @classmethod
    def parse(cls, text: str) -> "Method":
        """Read ``METHOD[=ENCODER][,frozen]``.

        :param text: e.g. "ssi", "abisim,frozen" or "abisim=runs/mine.safetensors"
        :raises ValueError: for anything else
        """
        head, equals, encoder = text.removesuffix(",frozen").partition("=")
        return cls(head, encoder if equals else None, frozen=text.endswith(",frozen"))

    def hyperparameters(self, entry: dict[str, Any], given: Collection[str] = ()) -> dict[str, Any]:
        """What this method puts in place of a YAML entry's values; all else stays.

        :param entry: with ``policy_kwargs`` that read ``dict(...)``, as rl-zoo3 evaluates them, and name a shipped
            encoder ("Nav2D-v0/abisim")
        :param given: names of hyperparameters that the user sets
        :return: ``policy_kwargs``, and for a frozen encoder ``policy`` and ``vec_env_wrapper``
        :raises ValueError: when ``policy_kwargs`` have another form, or the method sets what is given
        """
        text = str(entry["policy_kwargs"])
        try:
            call = ast.parse(text.strip(), mode="eval").body
            assert isinstance(call, ast.Call) and ast.unparse(call.func) == "dict" and not call.args
            values = {str(keyword.arg): ast.unparse(keyword.value) for keyword in call.keywords}
            shipped = ast.literal_eval(values.pop("features_extractor_kwargs"))["encoder"]
            del values["features_extractor_class"]
        except (SyntaxError, AssertionError, KeyError, TypeError, ValueError) as error:
            form = "dict(features_extractor_class=..., features_extractor_kwargs={'encoder': ...}, ...)"
            raise ValueError(f"policy_kwargs must read {form}, got {text!r}") from error
        encoder = self.encoder or f"{shipped.rpartition('/')[0]}/{self.name}"
        others: dict[str, Any] = {}
        if self.frozen:
            wrapper = {ENCODING_WRAPPER: {"encoder": encoder, "objective": self.name}}
            others = {"policy": entry["policy"].replace("Cnn", "Mlp"), "vec_env_wrapper": [wrapper]}
        else:
            values["features_extractor_class"] = f"get_class_by_name('sb3_abisim.extractors.{EXTRACTORS[self.name]}')"
            if self.name not in UNTRAINED:
                values["features_extractor_kwargs"] = repr({"encoder": encoder})
        policy_kwargs = f"dict({', '.join(f'{name}={value}' for name, value in values.items())})"
        replaced = {"policy_kwargs": policy_kwargs, **others}
        for name in sorted(replaced.keys() & set(given)):
            raise ValueError(f"-params {name} would undo --conf-file {self.name}; give one of the two")
        return replaced


def hyperparameters_file(algo: str, env_id: str) -> Path:
    """The YAML file of this package with the hyperparameters of an algorithm for an environment.

    :param algo: rl-zoo3's name of the algorithm, e.g. "ppo"
    :param env_id: an environment of this package
    :raises ValueError: when there are none, naming the algorithms that have some
    """
    files = [path for path in sorted(resource_path("hyperparams").glob("*.yml")) if env_id in _entries(path)]
    for path in files:
        if path.stem == algo:
            return path
    known = ", ".join(path.stem for path in files) or "none"
    raise ValueError(
        f"sb3_abisim has no hyperparameters of {algo} for {env_id}, only of: {known}; "
        "choose one of these with --algo, or give a YAML file of your own with --conf-file"
    )


def install() -> None:
    """Teach rl-zoo3 the hyperparameters, methods and evaluation splits of this package; a second call does nothing."""
    exp_manager = importlib.import_module("rl_zoo3.exp_manager")
    if not hasattr(exp_manager, "ExperimentManager"):
        # We run inside the import of that module, through its import of custom_envs. Importing it afresh completes it
        # now, and the outer import returns what sys.modules holds in the end.
        del sys.modules["rl_zoo3.exp_manager"]
        exp_manager = importlib.import_module("rl_zoo3.exp_manager")
    manager_class = exp_manager.ExperimentManager
    # Marked on the class: `python -m` may load this module twice.
    if getattr(manager_class, "sb3_abisim_installed", False):
        return
    manager_class.sb3_abisim_installed = True
    zoo_folder = Path(inspect.getfile(manager_class)).parent / "hyperparams"
    manager_class.read_hyperparameters = _reader(manager_class.read_hyperparameters, zoo_folder)
    manager_class.hyperparameters_optimization = _optimizer(manager_class.hyperparameters_optimization)
    manager_class._save_config = _config_saver(manager_class._save_config)
    manager_class._load_pretrained_agent = _agent_loader(manager_class._load_pretrained_agent)
    utils = importlib.import_module("rl_zoo3.utils")
    for name, wrap in (("create_test_env", _test_env_maker), ("get_saved_hyperparams", _saved_reader)):
        plain = getattr(utils, name)
        wrapped = wrap(plain)
        # `from ... import` has copied the name into several modules.
        for module in list(sys.modules.values()):
            if getattr(module, "__dict__", {}).get(name) is plain:
                setattr(module, name, wrapped)


def _entries(path: Path) -> dict[str, Any]:
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    return content if isinstance(content, dict) else {}


def _method(config: str) -> Method | None:
    """The method that ``--conf-file`` names; None when it names a file or a module, as in plain rl-zoo3."""
    if re.split("[=,]", config)[0] in EXTRACTORS:
        return Method.parse(config)
    if not config.endswith((".yml", ".yaml", ".py")) and importlib.util.find_spec(config.partition(".")[0]) is None:
        raise ValueError(f"--conf-file {config!r} is no YAML or Python file, module or method; a method is {_GRAMMAR}")
    return None


def _reader(original: Callable[..., Any], zoo_folder: Path) -> Callable[..., Any]:
    @functools.wraps(original)
    def read_hyperparameters(self: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        env_id = self.env_name.gym_id
        if env_id not in ENV_IDS:
            if re.split("[=,]", str(self.config))[0] in EXTRACTORS:
                raise ValueError(
                    f"--conf-file {self.config} needs hyperparameters of ours, which {env_id} has not; "
                    "write a YAML file for it, as docs/zoo.md shows"
                )
            hyperparams, saved_hyperparams = original(self)
            _prepare_embeddings(hyperparams, self.device)
            return hyperparams, saved_hyperparams
        if self.trial_id is not None:
            raise ValueError(
                "--trial-id would replace policy_kwargs, the encoder included (rl-zoo3#431); "
                "give the trial's values with -params instead"
            )
        unasked = Path(self.config).parent == zoo_folder
        method = None if unasked else _method(self.config)
        if unasked or method is not None:
            self.config = str(hyperparameters_file(self.algo, env_id))
        if method is not None:
            custom = self.custom_hyperparams or {}
            replaced = method.hyperparameters(_entries(Path(self.config))[env_id], custom)
            self.custom_hyperparams = {**custom, **replaced}
        hyperparams, saved_hyperparams = original(self)
        _prepare_embeddings(hyperparams, self.device)
        if hyperparams.get("n_envs", 1) > 1 and "env_wrapper" not in hyperparams:
            self.vec_env_class = _in_lockstep(self.vec_env_class)
        # Hyperparameters are selected on the training clips, so that evaluation clips stay unseen.
        if env_id in DISTRACTOR_IDS and not self.optimize_hyperparameters:
            # "split" and "clips" say what training sees; all else holds for evaluation too.
            shared = hyperparams.get("env_kwargs", self.env_kwargs)
            shared = {name: value for name, value in shared.items() if name not in ("split", "clips")}
            self.eval_env_kwargs = {"split": "eval", **shared, **(self._eval_env_kwargs_args or {})}
        elif not self._eval_env_kwargs_args:
            # rl-zoo3 takes those of --env-kwargs alone, and an environment with other arguments may be another task.
            self.eval_env_kwargs = hyperparams.get("env_kwargs", self.env_kwargs)
        return hyperparams, saved_hyperparams

    return read_hyperparameters


def _prepare_embeddings(hyperparams: dict[str, Any], device: Any) -> None:
    """Refuse what would change embeddings, and make them on the device of ``--device``."""
    if encoding_kwargs(hyperparams) is None:
        return
    # A copy: config.yml names the device as little as it does for the rest of the run.
    hyperparams["vec_env_wrapper"] = copy.deepcopy(hyperparams["vec_env_wrapper"])
    (encoding_kwargs(hyperparams) or {}).setdefault("device", str(device))
    if normalizes_observations(hyperparams.get("normalize", False)):
        raise ValueError(
            f"normalize={hyperparams['normalize']!r} would change the embeddings of the frozen encoder; give "
            '"dict(norm_obs=False, norm_reward=True)"'
        )


def _agent_loader(original: Callable[..., Any]) -> Callable[..., Any]:
    """Refuse ``-i`` with another extractor: rl-zoo3 keeps the model's policy, and would record the one asked for."""

    @functools.wraps(original)
    def _load_pretrained_agent(self: Any, hyperparams: dict[str, Any], env: Any) -> Any:
        asked = hyperparams.get("policy_kwargs") or {}
        model = original(self, hyperparams, env)
        try:
            importlib.import_module("sb3_abisim.extractors").check_trained_with(model, asked)
        except ValueError as error:
            env.close()
            raise ValueError(f"cannot continue {self.trained_agent}: {error}; give the same --conf-file") from error
        return model

    return _load_pretrained_agent


def normalizes_observations(normalize: Any) -> bool:
    """Whether the zoo's ``normalize`` makes VecNormalize change observations.

    :param normalize: of a zoo entry: a bool, a dictionary, or the text of either
    """
    if isinstance(normalize, dict):
        return bool(normalize.get("norm_obs", True))
    text = str(normalize or False)
    return text not in ("False", "None") and re.search(r"norm_obs['\"]?\s*[=:]\s*False", text) is None


def _test_env_maker(original: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(original)
    def create_test_env(env_id: str, *args: Any, **kwargs: Any) -> Any:
        given = kwargs.get("env_kwargs") or {}
        if env_id in DISTRACTOR_IDS and not {"split", "clips"} & set(given):
            kwargs["env_kwargs"] = {"split": "eval", **given}
        return original(env_id, *args, **kwargs)

    return create_test_env


def _in_lockstep(vec_env_class: type) -> type:
    """The faster equal of ``DummyVecEnv``; any other choice stays."""
    is_default = vec_env_class is importlib.import_module("stable_baselines3.common.vec_env").DummyVecEnv
    return importlib.import_module("sb3_abisim.lockstep").LockstepVecEnv if is_default else vec_env_class


def encoding_kwargs(hyperparams: dict[str, Any]) -> dict[str, Any] | None:
    """The arguments of ``VecEncodeObservations`` in a zoo entry, None where it is not used.

    :param hyperparams: of a zoo entry, or of a run's ``config.yml``
    """
    wrappers = hyperparams.get("vec_env_wrapper")
    for wrapper in wrappers if isinstance(wrappers, list) else [wrappers]:
        if isinstance(wrapper, dict) and ENCODING_WRAPPER in wrapper:
            kwargs: dict[str, Any] = wrapper[ENCODING_WRAPPER]
            return kwargs
    return None


def _config_saver(original: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(original)
    def _save_config(self: Any, saved_hyperparams: dict[str, Any]) -> None:
        original(self, saved_hyperparams)
        kwargs = encoding_kwargs(saved_hyperparams)
        if kwargs is not None:
            checkpoint = importlib.import_module("sb3_abisim.checkpoint")
            copied = Path(self.params_path) / checkpoint.RUN_COPY
            shutil.copyfile(checkpoint.resolve_encoder(kwargs["encoder"]), copied)

    return _save_config


def _saved_reader(original: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(original)
    def get_saved_hyperparams(stats_path: str, *args: Any, **kwargs: Any) -> Any:
        hyperparams, found = original(stats_path, *args, **kwargs)
        encoding = encoding_kwargs(hyperparams)
        if encoding is not None:
            copied = Path(stats_path) / importlib.import_module("sb3_abisim.checkpoint").RUN_COPY
            if copied.is_file():
                encoding["encoder"] = str(copied)
        return hyperparams, found

    return get_saved_hyperparams


def _optimizer(original: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(original)
    def hyperparameters_optimization(self: Any) -> None:
        extractor = (self._hyperparams.get("policy_kwargs") or {}).get("features_extractor_class")
        if extractor is not None and extractor.__module__.startswith("sb3_abisim."):
            self._hyperparams = _KeepExtractor(self._hyperparams)
        original(self)

    return hyperparameters_optimization


class _KeepExtractor(dict[str, Any]):
    """Hyperparameters whose ``policy_kwargs`` are merged with those of a trial instead of replaced by them."""

    def copy(self) -> "_KeepExtractor":
        # Stable-Baselines3 writes into policy_kwargs, so each trial needs its own.
        return _KeepExtractor(self | {"policy_kwargs": copy.deepcopy(self["policy_kwargs"])})

    def update(self, sampled: dict[str, Any]) -> None:  # type: ignore[override]
        super().update(sampled | {"policy_kwargs": self["policy_kwargs"] | sampled.get("policy_kwargs", {})})


def main(argv: list[str] | None = None) -> None:
    """Run a command of rl-zoo3 with this package installed into it.

    :param argv: the command's name, then its own flags; the program's arguments by default
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_abisim.zoo", description=f"rl-zoo3 with sb3_abisim; --conf-file also takes {_GRAMMAR}."
    )
    parser.add_argument("command", choices=_SCRIPTS, help="a command of rl-zoo3")
    parser.add_argument("flags", nargs=argparse.REMAINDER, help="its own flags; `train --help` lists those of train")
    args = parser.parse_args(argv)
    # The copy that the zoo's workers and custom_envs.py see, not __main__'s.
    importlib.import_module("sb3_abisim.zoo")
    sys.argv = [f"python -m sb3_abisim.zoo {args.command}", *args.flags]
    runpy.run_module(_SCRIPTS[args.command], run_name="__main__")


if __name__ == "__main__":
    main()
else:
    install()
