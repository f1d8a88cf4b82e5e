"""Read the run folders of rl-zoo3, whoever made them, without executing anything that they hold."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.files import find
from sb3_abisim.common.hashes import check_hashes
from sb3_abisim.common.vocabulary import current_result
from sb3_abisim.zoo.entries import encoding_kwargs
from sb3_abisim.zoo.method_record import MethodRecord
from sb3_abisim.zoo.run_files import (
    TRAINING_CURVE,
    Curve,
    read_curve,
    read_episodes,
    read_final,
    read_yaml,
    result_names,
)

INDEX_NAME = "benchmark.json"


@dataclasses.dataclass(frozen=True)
class Run:
    """A zoo run.

    :param folder: where it lies
    :param label: the method, such as "abisim,frozen", or the algorithm without one
    :param record: what it used; None for a run of plain rl-zoo3
    :param env_id: trained in
    :param env_name: what rl-zoo3 makes of it in the names of files (my-Toy-v0 for my/Toy-v0)
    :param algo: rl-zoo3's name
    :param seed: of RL
    :param n_timesteps: budget that was asked for
    :param env_kwargs: of training
    :param settings: all that two runs which differ only in seeds and encoder files have in common
    :param command: that made it
    :param n_eval_episodes: of each evaluation during training
    """

    folder: Path
    label: str
    record: MethodRecord | None
    env_id: str
    env_name: str
    algo: str
    seed: int
    n_timesteps: int
    env_kwargs: dict[str, Any]
    settings: dict[str, Any]
    command: str
    n_eval_episodes: int

    def evaluations(self) -> Curve:
        """The zoo's evaluations during training.

        :raises ValueError: if there are none
        """
        path = self.folder / "evaluations.npz"
        if not path.is_file():
            raise ValueError(f"{self.folder} holds no evaluations.npz; train with an --eval-freq above 0")
        return read_curve(path)

    def training(self, n_points: int = 50) -> Curve:
        """The episodes of training itself, with the exploring policy, averaged over equal bins of steps.

        Exported runs hold this curve instead of the episodes, with the default number of bins.

        :param n_points: number of bins; those in which no episode ended are left out
        :raises ValueError: if there are neither episodes nor their curve
        """
        if not find(self.folder, "*.monitor.csv"):
            if (self.folder / TRAINING_CURVE).is_file():
                return read_curve(self.folder / TRAINING_CURVE)
            what = f"{self.folder} holds neither *.monitor.csv nor {TRAINING_CURVE}"
            raise ValueError(f"{what}; take --source evaluations, or the folder that it was exported from")
        episodes = read_episodes(self.folder)
        # Of copies that step together, the episodes' lengths in the order of their ends add up to the steps.
        ends = episodes["l"].cumsum().to_numpy()
        bin_index = np.minimum((ends - 1) * n_points // max(self.n_timesteps, int(ends[-1])), n_points - 1)
        width = max(self.n_timesteps, int(ends[-1])) / n_points
        kept = np.unique(bin_index)
        columns = [episodes[name].to_numpy(float) for name in ("r", "is_success") if name in episodes]
        means = [np.array([column[bin_index == k].mean() for k in kept]) for column in columns]
        return Curve(((kept + 1) * width).astype(np.int64), means[0], means[1] if len(means) == 2 else None)

    def final(self) -> dict[str, NDArray[Any]] | None:
        """What :mod:`sb3_abisim.zoo.evaluate` wrote: ``<mode>/<split>/results`` and so on; None if it did not."""
        path = self.folder / "final_evaluations.npz"
        if not path.is_file():
            return None
        return {current_result(name): array for name, array in read_final(path).items()}


def read_run(folder: str | Path, remade: Sequence[str] = ()) -> Run:
    """Read a run folder.

    :param folder: ``.../<algo>/<Env-vN>_<id>``
    :param remade: files in it that the caller makes again, whatever they are
    :raises ValueError: if it is none, or a file in it is not what it was
    """
    folder = Path(folder)
    found = find(folder, "*/args.yml")
    if len(found) != 1:
        raise ValueError(f"{folder} is no run folder of rl-zoo3 (no <Env>/args.yml in it)")
    check_hashes(folder, result_names(folder), remade)
    args, config = read_yaml(found[0]), read_yaml(found[0].with_name("config.yml"))
    record = MethodRecord.read(found[0].parent)
    try:
        n_timesteps = int(args["n_timesteps"] if args["n_timesteps"] > 0 else config["n_timesteps"])
        command = found[0].with_name("command.txt")
        # What names the encoder's file differs between encoder seeds; the label says whatever else is in there.
        plain = {name: value for name, value in config.items() if name not in ("policy_kwargs", "n_timesteps")}
        (encoding_kwargs(plain) or {}).pop("encoder", None)
        plain["policy_kwargs"] = _without_encoder(config.get("policy_kwargs"), record)
        names = ("algo", "env", "env_kwargs", "eval_env_kwargs", "eval_freq", "eval_episodes")
        return Run(
            folder=folder,
            label=(record and record.label) or _name(args["algo"]),
            record=record,
            env_id=_name(args["env"]),
            env_name=found[0].parent.name,
            algo=_name(args["algo"]),
            seed=int(args["seed"]),
            n_timesteps=n_timesteps,
            env_kwargs=_of_kind(config.get("env_kwargs") or args["env_kwargs"] or {}, dict),
            settings={**{name: args[name] for name in names}, "n_timesteps": n_timesteps, **plain},
            command=command.read_text(encoding="utf-8", errors="replace") if command.is_file() else "",
            n_eval_episodes=int(args["eval_episodes"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, StopIteration) as error:
        raise ValueError(f"{found[0]} was not written by rl_zoo3.train ({error!r})") from error


def _name(value: Any) -> str:
    if not _is_name(value):
        raise TypeError(f"{value!r} is no name")
    return str(value)


def _is_name(value: Any) -> bool:
    """A text that can be shown anywhere: no control characters."""
    return isinstance(value, str) and value.isprintable() and bool(value)


def _of_kind(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise TypeError(f"{value!r} is no {kind.__name__}")
    return value


def find_runs(folder: str | Path) -> list[Run]:
    """All runs below a folder, or those of the last command of a benchmark's folder.

    :param folder: a benchmark's folder, a zoo's log folder, or the folder of a run
    :raises ValueError: if there are none, or one is damaged
    """
    folder = Path(folder)
    entries = read_index(folder)
    if entries is not None:
        runs = [
            dataclasses.replace(read_run(folder / entry["folder"]), label=entry["label"])
            for entry in entries
            if (folder / entry["folder"]).is_dir()
        ]
    else:
        paths = sorted(path.parent.parent for path in find(folder, "**/args.yml"))
        # Where a benchmark's jobs work, nothing has ended.
        runs = [read_run(path) for path in paths if not path.relative_to(folder).as_posix().startswith("work/run-")]
    if not runs:
        raise ValueError(f"no run folders of rl-zoo3 below {folder}; train first, or give its log folder")
    return runs


def missing_runs(folder: str | Path) -> list[str]:
    """The runs that a benchmark's last command asked for, and whose folders are not there.

    :param folder: of a benchmark; any other has none
    """
    entries = read_index(Path(folder)) or []
    return [entry["folder"] for entry in entries if not (Path(folder) / entry["folder"]).is_dir()]


def read_index(folder: Path) -> list[dict[str, str]] | None:
    """What ``benchmark.json`` says of the runs: their folders below it, and their labels.

    :param folder: of a benchmark
    :return: None where there is no such file
    :raises ValueError: for a damaged file, or one that names folders elsewhere
    """
    path = folder / INDEX_NAME
    check_hashes(folder, [INDEX_NAME] if path.is_file() else [])
    if not path.is_file():
        return None
    try:
        entries = json.loads(path.read_bytes())["runs"]
        for entry in entries:
            if {*entry} != {"folder", "label"} or not all(_is_name(value) for value in entry.values()):
                raise ValueError(f"{entry!r} is no run with its label")
            place = PurePosixPath(entry["folder"])
            if place.is_absolute() or ".." in place.parts or "\\" in entry["folder"]:
                raise ValueError(f"the run {entry['folder']!r} does not lie below it")
        folders = [entry["folder"] for entry in entries]
        if len(set(folders)) < len(folders):
            raise ValueError("it names a run twice")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged ({error}); run the benchmark's command again, or copy it again") from error
    return list(entries)


def is_deterministic(env_id: str) -> bool | None:
    """Whether the zoo's evaluations during training are deterministic.

    :param env_id: trained in
    :return: None where the environment is not registered here
    """
    import gymnasium as gym
    from rl_zoo3.exp_manager import ExperimentManager

    if env_id not in gym.registry:
        return None
    return not (ExperimentManager.is_atari(env_id) or ExperimentManager.is_minigrid(env_id))


def _without_encoder(policy_kwargs: Any, record: MethodRecord | None) -> Any:
    """What two runs that differ in their encoder files alone have in common."""
    if isinstance(policy_kwargs, str) and record is not None and record.encoder is not None:
        return policy_kwargs.replace(record.encoder, "...")
    if not isinstance(policy_kwargs, dict):
        return policy_kwargs
    kwargs = {**policy_kwargs}
    if isinstance(kwargs.get("features_extractor_kwargs"), dict):
        inner = kwargs["features_extractor_kwargs"]
        kwargs["features_extractor_kwargs"] = {name: value for name, value in inner.items() if name != "encoder"}
        if isinstance(inner.get("encoders"), dict):
            # Of a Dict: which images have one.
            there = {key: file is not None for key, file in inner["encoders"].items()}
            kwargs["features_extractor_kwargs"]["encoders"] = there
    return kwargs
