"""The jobs of a benchmark: what there is to collect, pretrain, train and evaluate, each named by what determines it.

A job's key is a hash over its kind, the package's version, its settings and the keys of its inputs. Two benchmarks
that need the same dataset therefore find the same folder, and a changed setting gives new names to what depends on it
and to nothing else. Changes of code without a change of version do not change the names; the jobs' manifests tell them
(:mod:`sb3_abisim.benchmark.jobs.source_hash`).
"""

import dataclasses
import hashlib
import inspect
import json
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import gymnasium as gym
import stable_baselines3

from sb3_abisim._version import __version__
from sb3_abisim.common.cli import parse_pairs
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.trainer import FOLLOWING
from sb3_abisim.registry import get_method, get_objective, get_traits, methods
from sb3_abisim.zoo.evaluate import not_rebuilt
from sb3_abisim.zoo.methods import MethodSpec, hyperparameters_entry

ALGOS = ("ppo", "dqn", "sac")
# What rl-zoo3 reads besides the algorithm's own arguments, and what has a flag of its own. Without env_wrapper and
# frame_stack: pretraining and the final evaluation make environments that have neither.
ZOO_PARAMS = {
    "callback", "env_kwargs", "monitor_kwargs", "n_envs", "noise_std", "noise_type", "normalize", "vec_env_wrapper",
}  # fmt: skip
FLAGS = {"device": "--device", "n_timesteps": "--n-timesteps", "seed": "--seeds"}
# "Steps per eval", given for Pointmass alone.
PAPER_EVAL_FREQ = 16_384


@dataclasses.dataclass(frozen=True)
class Job:
    """One command whose output depends on its settings and inputs alone.

    :param kind: "data", "encoder", "run" or "final"
    :param title: what the display calls it
    :param settings: all that determines the output besides the inputs; JSON types
    :param inputs: jobs that must be done first
    :param command: words after ``python -m``, to be run in the benchmark's folder
    :param output: what it makes, relative to the benchmark's folder
    :param output_file: a file of the output whose digest is kept; "" for the output itself
    :param cost: transitions, updates, steps or episodes, whichever it counts in
    :param method: of a run, the plan's word that asked for it
    """

    kind: str
    title: str
    settings: dict[str, Any]
    inputs: tuple["Job", ...]
    command: tuple[str, ...]
    output: str
    output_file: str = ""
    cost: int = 1
    method: str = ""

    @property
    def key(self) -> str:
        """16 hexadecimal digits."""
        return _key(self.kind, self.settings, self.inputs)

    @property
    def name(self) -> str:
        """Kind and key."""
        return f"{self.kind}-{self.key}"

    def to_json(self) -> dict[str, Any]:
        """The fields and the key, in JSON types; inputs by name."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {**fields, "name": self.name, "inputs": [job.name for job in self.inputs]}


@dataclasses.dataclass(frozen=True)
class Plan:
    """What to compare, and with which budget.

    :param methods: as ``--conf-file`` of :mod:`sb3_abisim.zoo.manager` takes them; without ``=ENCODER``, one is pretrained;
        ``{seed}`` in it becomes the seed of pretraining, for files of several
    :param env_ids: environments of this package
    :param seeds: of RL, one run each
    :param encoder_seeds: of pretraining; the runs take the encoders in turn, so that five of each are paired
    :param algo: rl-zoo3's name; None takes the paper's, DQN for Nav2D and PPO else
    :param n_transitions: random-action transitions per environment; None for the paper's
    :param n_timesteps: RL steps of a run; None for the hyperparameter file's, which are the paper's
    :param eval_freq: RL steps between evaluations; None for the paper's, but at least 100 evaluations in a run
    :param eval_episodes: of each evaluation during training
    :param n_eval_envs: evaluated side by side
    :param final_episodes: of the final model on each split and in each mode of acting; 0 for no final evaluation
    :param params: more of rl-zoo3's ``-params``, ``name:value``, or ``algo.name:value`` for one algorithm
    :param pretrain_params: settings of pretraining, ``name:value``, or ``objective.name:value`` for one objective
    :param device: of pretraining and RL
    :param threads: of each job
    :param packages: modules that register environments and methods, imported by each job
    :raises ValueError: for what does not fit together
    """

    methods: tuple[str, ...]
    env_ids: tuple[str, ...]
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    encoder_seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    algo: str | None = None
    n_transitions: int | None = None
    n_timesteps: int | None = None
    eval_freq: int | None = None
    eval_episodes: int = 20
    n_eval_envs: int = 5
    final_episodes: int = 100
    params: tuple[str, ...] = ()
    pretrain_params: tuple[str, ...] = ()
    device: str = "auto"
    threads: int = 1
    packages: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("methods", "env_ids", "seeds", "encoder_seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise ValueError(f"{name} must be given, and each once, got {' '.join(map(str, values)) or 'none'}")
        for name, least in (
            ("n_transitions", 1), ("n_timesteps", 1), ("eval_freq", 1), ("eval_episodes", 1), ("n_eval_envs", 1),
            ("final_episodes", 0), ("threads", 1),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        for seed in (*self.seeds, *self.encoder_seeds):
            if seed < 0:
                raise ValueError(f"seeds must be at least 0, got {seed}")
        for env_id in self.env_ids:
            if env_id not in gym.registry:
                raise ValueError(
                    f"unknown environment {env_id!r}; ours are {', '.join(ENV_IDS)} (--packages imports what registers "
                    "others)"
                )
        for word in (*self.params, *self.pretrain_params):
            if not word.partition(":")[1]:
                raise ValueError(f"settings are given as name:value, got {word!r}")


def build(plan: Plan) -> list[Job]:
    """All jobs of a plan, each once, inputs before what needs them.

    :param plan: what to compare
    :raises ValueError: for an unknown method or setting, or an environment without hyperparameters
    """
    jobs: dict[str, Job] = {}

    def add(job: Job) -> None:
        for source in job.inputs:
            add(source)
        jobs.setdefault(job.name, job)

    # Seeds outermost: a benchmark that is stopped early has whole comparisons with fewer seeds.
    for i, seed in enumerate(plan.seeds):
        for env_id in plan.env_ids:
            for method in plan.methods:
                encoder_seed = plan.encoder_seeds[i % len(plan.encoder_seeds)]
                named = MethodSpec.parse(method.replace("{seed}", str(encoder_seed)))
                run = dataclasses.replace(run_job(plan, env_id, named, seed, encoder_seed), method=method)
                add(final_job(plan, run) if plan.final_episodes else run)
    _check_owners(plan, list(jobs.values()))
    return list(jobs.values())


def _check_owners(plan: Plan, jobs: list[Job]) -> None:
    """Refuse settings for an algorithm or objective that no job has."""
    for option, words, field, owners in (
        ("--params", plan.params, "algo", ALGOS),
        ("--pretrain-params", plan.pretrain_params, "objective", tuple(methods())),
    ):
        used = {job.settings[field] for job in jobs if field in job.settings}
        for word in words:
            head, dot, _ = word.partition(".")
            if dot and head in owners and head not in used:
                raise ValueError(f"{option} {word} is for {head}, but here is only {', '.join(sorted(used)) or 'none'}")
    for word in plan.params:
        if re.match(r"(\w+\.)?env_kwargs:", word) and any(job.kind == "data" for job in jobs):
            raise ValueError(
                f"--params {word} would hold for RL, but not for the data that encoders are pretrained on; collect and "
                "pretrain with the same arguments yourself, and give the files: METHOD=FILE"
            )


def data_job(plan: Plan, env_id: str) -> Job:
    """The dataset of an environment."""
    traits = get_traits(env_id)
    n, env_kwargs = plan.n_transitions or traits.n_transitions, dict(traits.collect_kwargs)
    settings: dict[str, Any] = {"env_id": env_id, "n_transitions": n, "seed": 0}
    # Only where there are any, so that the names of the other environments' jobs stay.
    settings |= {"env_kwargs": env_kwargs} if env_kwargs else {}
    output = f"data/{env_id}-{_key('data', settings)[:8]}"
    command = ["sb3_abisim", "collect", "--env", env_id, "-n", str(n), "-o", output]
    command += ["--env-kwargs", *(f"{name}:{value!r}" for name, value in env_kwargs.items())] if env_kwargs else []
    command += _packages(plan)
    return Job("data", f"collect {env_id}", settings, (), tuple(command), output, "meta.json", n)


def encoder_job(plan: Plan, env_id: str, objective: str, seed: int) -> Job:
    """An encoder; one that builds on another method's starts from that one's with the same seed.

    :param objective: name of a method that has one
    """
    objective_class = get_objective(objective)
    base = get_method(objective).base
    inputs: tuple[Job, ...] = (data_job(plan, env_id),)
    if base is not None:
        inputs += (encoder_job(plan, env_id, base, seed),)
    words = _params_of(plan.pretrain_params, objective, tuple(methods()))
    config = load_config(objective, env_id, parse_pairs(words, "--pretrain-params"))
    settable = inspect.signature(objective_class).parameters.keys() - FOLLOWING
    for unknown in sorted(config.objective_kwargs.keys() - settable):
        raise ValueError(
            f"{objective} has no objective_kwargs.{unknown}, only {', '.join(sorted(settable))}; a setting of another "
            f"objective has its name in front: --pretrain-params OBJECTIVE.objective_kwargs.{unknown}:VALUE"
        )
    settings = {"objective": objective, "env_id": env_id, "seed": seed, **config.as_settings()}
    output = f"encoders/{env_id}/{objective}-{_key('encoder', settings, inputs)[:8]}.safetensors"
    command = ["sb3_abisim", "pretrain", "--objective", objective, "--env", env_id, "--data", inputs[0].output]
    command += ["-o", output, "--seed", str(seed), "--device", plan.device, "--verbose", "0"]
    command += ["--base", inputs[1].output] if len(inputs) == 2 else []
    command += ["-params", *words] if words else []
    command += _packages(plan)
    title = f"pretrain {objective} {env_id} seed {seed}"
    return Job("encoder", title, settings, inputs, tuple(command), output, cost=config.n_updates)


def run_job(plan: Plan, env_id: str, method: MethodSpec, seed: int, encoder_seed: int) -> Job:
    """A zoo run; its folder lies where ``rl_zoo3.plots`` looks for it.

    :param method: which features extractor
    :param seed: of RL
    :param encoder_seed: of pretraining; of no effect where nothing is pretrained
    """
    algo = plan.algo or get_traits(env_id).algo
    words = _params_of(plan.params, algo, ALGOS)
    entry = hyperparameters_entry(algo, env_id)
    given = dict(_name_and_value(word) for word in words)
    _check_params(algo, given)
    method.hyperparameters(entry, given)
    missing = not_rebuilt(given) if plan.final_episodes else []
    if missing:
        raise ValueError(
            f"the final evaluation is made without {', '.join(missing)}; leave it out of --params, or give "
            "--final-episodes 0"
        )
    n = plan.n_timesteps or int(entry["n_timesteps"])
    eval_freq = plan.eval_freq or min(PAPER_EVAL_FREQ, max(n // 100, 1))
    inputs: tuple[Job, ...] = ()
    settings = {"env_id": env_id, "algo": algo, "seed": seed, "method": method.name, "frozen": method.frozen}
    conf_file, label = method.name, method.name
    if method.encoder is not None:
        file = load_encoder(method.encoder)
        settings["encoder_digest"] = file.hash
        label += f"-{file.hash[:6]}"
        path = Path(method.encoder)
        conf_file += f"={path.resolve() if path.is_file() else method.encoder}"
    elif get_method(method.name).is_pretrained:
        inputs = (encoder_job(plan, env_id, method.name, encoder_seed),)
        conf_file += f"={inputs[0].output}"
    settings |= {
        "hyperparams": {**entry, "n_timesteps": n, **given},
        "eval_freq": eval_freq, "eval_episodes": plan.eval_episodes, "n_eval_envs": plan.n_eval_envs,
    }  # fmt: skip
    frozen = ",frozen" if method.frozen else ""
    label += "-frozen" if method.frozen else ""
    key = _key("run", settings, inputs)
    # Runs that differ in nothing but seeds share a folder. A number, since the zoo's --exp-id takes one.
    family = f"runs/{env_id}/{label}-{_key('run', settings, inputs, family=True)[:8]}"
    command = ["sb3_abisim", "train", "--algo", algo, "--env", env_id, "--conf-file", conf_file + frozen]
    command += ["-f", f"work/run-{key}", "-n", str(n), "--seed", str(seed), "--eval-freq", str(eval_freq)]
    command += ["--eval-episodes", str(plan.eval_episodes), "--n-eval-envs", str(plan.n_eval_envs)]
    command += ["--num-threads", str(plan.threads), "--device", plan.device, "--verbose", "0"]
    command += ["-params", *words] if words else []
    command += _packages(plan)
    output = f"{family}/{algo}/{env_id}_{int(key[:10], 16)}"
    title = f"{algo} {method.name}{frozen} {env_id} seed {seed}"
    return Job("run", title, settings, inputs, tuple(command), output, f"{env_id}.zip", n)


def _check_params(algo: str, names: Collection[str]) -> None:
    """Refuse now what the zoo would refuse when the run begins, after all of pretraining."""
    own = set(inspect.signature(getattr(stable_baselines3, algo.upper())).parameters)
    known = (own | ZOO_PARAMS) - {*FLAGS, "env", "tensorboard_log", "verbose", "_init_setup_model"}
    for name in names:
        if name in FLAGS:
            raise ValueError(f"--params {name} would not hold; give {FLAGS[name]}")
        if name not in known:
            raise ValueError(f"{algo} has no hyperparameter {name!r}, only {', '.join(sorted(known))}")


def run_labels(jobs: list[Job]) -> dict[str, str]:
    """What a report calls the runs: their method, and the end of the encoder's path where a method is given several.

    :param jobs: what :func:`build` made
    :return: name of each run's job to its label
    """
    runs = [job for job in jobs if job.kind == "run"]
    labels = dict.fromkeys((run.method for run in runs), "")
    for word in labels:
        method = MethodSpec.parse(word)
        alike = [m for m in map(MethodSpec.parse, labels) if (m.name, m.frozen) == (method.name, method.frozen)]
        paths = [_parts(m.encoder) for m in alike if m.encoder]
        end: tuple[str, ...] = ()
        if method.encoder and len(alike) > 1:
            parts = _parts(method.encoder)
            ends = (parts[-n:] for n in range(1, len(parts) + 1))
            end = next((end for end in ends if sum(p[-len(end) :] == end for p in paths) == 1), (method.encoder,))
        labels[word] = method.name + "=" * bool(end) + "/".join(end) + ",frozen" * method.frozen
    return {run.name: labels[run.method] for run in runs}


def _parts(encoder: str) -> tuple[str, ...]:
    """Of a path, without what is the same for all files or differs between seeds alone."""
    return Path(re.sub(r"[-_.]?\{seed\}", "", encoder.removesuffix(".safetensors"))).parts


def final_job(plan: Plan, run: Job) -> Job:
    """The evaluation of a run's final model: on each split of the distractors, where there are any."""
    splits = get_traits(run.settings["env_id"]).splits
    settings = {"n_episodes": plan.final_episodes, "splits": list(splits)}
    command = ["sb3_abisim", "benchmark", "evaluate", run.output, "--episodes", str(plan.final_episodes)]
    command += _packages(plan)
    cost = plan.final_episodes * max(1, len(splits))
    title = run.title.replace(" ", " final ", 1)
    return Job("final", title, settings, (run,), tuple(command), run.output, "final_evaluations.npz", cost)


def _key(kind: str, settings: dict[str, Any], inputs: tuple[Job, ...] = (), family: bool = False) -> str:
    """The hash of all that determines a job; with ``family``, of all but seeds."""
    if family:
        settings = {name: value for name, value in settings.items() if name != "seed"}
    sources = [_key(job.kind, job.settings, job.inputs, family) for job in inputs]
    content = {"kind": kind, "version": __version__, "settings": settings, "inputs": sources}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _packages(plan: Plan) -> list[str]:
    return ["--packages", *plan.packages] if plan.packages else []


def _name_and_value(word: str) -> tuple[str, str]:
    name, _, value = word.partition(":")
    return name, value


def _params_of(words: tuple[str, ...], owner: str, owners: tuple[str, ...]) -> list[str]:
    """The words that hold for ``owner``, without their prefixes."""
    result = []
    for word in words:
        head, dot, rest = word.partition(".")
        named = bool(dot) and re.fullmatch(r"\w+", head) is not None and head in owners
        if not named or head == owner:
            result.append(rest if named else word)
    return result
