"""The jobs of a benchmark: what there is to collect, pretrain, train and evaluate for a plan."""

import dataclasses
import inspect
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
from rl_zoo3.utils import ALGOS, get_wrapper_class

from sb3_abisim.benchmark.jobs.job import Job, job_key
from sb3_abisim.benchmark.plan import Plan
from sb3_abisim.common.cli import parse_pairs
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.networks.encoder_name import pinned_name
from sb3_abisim.pretraining.config import FOLLOWING, load_config
from sb3_abisim.registry import get_method, get_objective, get_traits, methods
from sb3_abisim.zoo.collect import preprocessing_entry
from sb3_abisim.zoo.entries import hyperparameters_entry
from sb3_abisim.zoo.methods import MethodSpec
from sb3_abisim.zoo.preprocessing import check_preprocessing, items, normalizes_observations, other_vec_wrappers
from sb3_abisim.zoo.spaces import check_image_key

# What rl-zoo3 reads besides the algorithm's arguments, and what another flag sets.
ZOO_PARAMS = {
    "callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "noise_std", "noise_type",
    "normalize", "vec_env_wrapper",
}  # fmt: skip
FLAGS = {"device": "--device", "n_timesteps": "--n-timesteps", "seed": "--seeds"}
# "Steps per eval", given for Pointmass alone.
PAPER_EVAL_FREQ = 16_384


def build(plan: Plan) -> list[Job]:
    """All jobs of a plan, each once, inputs before what needs them.

    :param plan: what to compare
    :raises ValueError: for an unknown method or setting, or an environment without hyperparameters
    """
    jobs: dict[str, Job] = {}
    for word in plan.pretrain_params:
        if word.startswith("base."):
            raise ValueError(
                f"--pretrain-params {word}: here base encoders are jobs of their own; give the method's name in "
                "place of base, such as ssi"
            )

    def add(job: Job) -> None:
        for source in job.inputs:
            add(source)
        jobs.setdefault(job.name, job)

    for env_id in plan.env_ids:
        _check_observations(plan, env_id)
    # Seeds outermost: a benchmark that is stopped early has whole comparisons with fewer seeds.
    for i, seed in enumerate(plan.seeds):
        for env_id in plan.env_ids:
            for method in plan.methods:
                encoder_seed = plan.encoder_seeds[i % len(plan.encoder_seeds)]
                named = _spec(plan, method.replace("{seed}", str(encoder_seed)))
                run = dataclasses.replace(run_job(plan, env_id, named, seed, encoder_seed), method=method)
                add(final_job(plan, run) if plan.final_episodes else run)
    _check_owners(plan, list(jobs.values()))
    return list(jobs.values())


def _spec(plan: Plan, method: str) -> MethodSpec:
    spec = MethodSpec.parse(method)
    if spec.image_key is not None:
        raise ValueError(f"{method}: the image is the same for all methods; give --image-key {spec.image_key}")
    return dataclasses.replace(spec, image_key=plan.image_key)


def _check_observations(plan: Plan, env_id: str) -> None:
    """Refuse now what runs of a method without a file would refuse after all of pretraining: a Dict, and no image."""
    named = (MethodSpec.parse(method).name for method in plan.methods)
    if plan.image_key is not None or env_id in ENV_IDS or all(get_method(name).has_encoder_file for name in named):
        return
    used = _hyperparams(plan, env_id)[-1]
    try:
        wrapper = get_wrapper_class(used)
        env = gym.make(env_id, **(used.get("env_kwargs") or {}))
    except Exception:
        # The first job says so, too, with its log.
        return
    try:
        space = (env if wrapper is None else wrapper(env)).observation_space
    except Exception:
        return
    finally:
        env.close()
    check_image_key(space, None)


def _check_owners(plan: Plan, jobs: list[Job]) -> None:
    """Refuse settings for an algorithm or objective that no job has."""
    for option, words, field, owners in (
        ("--params", plan.params, "algo", tuple(ALGOS)),
        ("--pretrain-params", plan.pretrain_params, "objective", tuple(methods())),
    ):
        used = {job.settings[field] for job in jobs if field in job.settings}
        for word in words:
            head, dot, _ = word.partition(".")
            if dot and head in owners and head not in used:
                raise ValueError(f"{option} {word} is for {head}, but here is only {', '.join(sorted(used)) or 'none'}")


def data_job(plan: Plan, env_id: str, hyperparams: Mapping[str, Any]) -> Job:
    """The dataset of an environment, which is shown as the runs see it.

    :param hyperparams: of the runs
    """
    traits = get_traits(env_id)
    n = plan.n_transitions or traits.n_transitions
    env_kwargs = {**(hyperparams.get("env_kwargs") or {}), **traits.collect_kwargs}
    chosen = sorted(set(hyperparams.get("env_kwargs") or {}) & set(traits.split_kwargs))
    if chosen:
        raise ValueError(
            f"env_kwargs {', '.join(chosen)} would choose what data for pretraining is collected in, too; collect and "
            "pretrain as you mean it, and give the files: METHOD=FILE"
        )
    wrappers, n_stack = items(hyperparams.get("env_wrapper")), hyperparams.get("frame_stack") or 1
    settings: dict[str, Any] = {"env_id": env_id, "n_transitions": n, "seed": 0, "env_kwargs": env_kwargs}
    # Left out where there is nothing, as in benchmarks of before.
    settings |= ({"env_wrapper": wrappers} if wrappers else {}) | ({"frame_stack": n_stack} if n_stack > 1 else {})
    settings |= {} if plan.image_key is None else {"image_key": plan.image_key}
    output = f"data/{_folder(env_id)}-{job_key('data', settings)[:8]}"
    command = ["sb3_abisim", "collect", "--env", env_id, "-n", str(n), "-o", output]
    command += ["--env-kwargs", *(f"{name}:{value!r}" for name, value in env_kwargs.items())] if env_kwargs else []
    by_default = preprocessing_entry(env_id)
    if wrappers or by_default.get("env_wrapper"):
        command += ["--env-wrapper", *(map(str, wrappers) if wrappers else ["none"])]
    if n_stack > 1 or by_default.get("frame_stack"):
        command += ["--frame-stack", str(n_stack)]
    command += _image_key(plan) + _packages(plan)
    return Job("data", f"collect {env_id}", settings, (), tuple(command), output, "meta.json", n)


def encoder_job(plan: Plan, env_id: str, objective: str, seed: int, hyperparams: Mapping[str, Any]) -> Job:
    """An encoder; one that builds on another method's starts from that one's with the same seed.

    :param objective: name of a method that has one
    :param hyperparams: of the runs
    """
    objective_class = get_objective(objective)
    base = get_method(objective).base
    inputs: tuple[Job, ...] = (data_job(plan, env_id, hyperparams),)
    if base is not None:
        inputs += (encoder_job(plan, env_id, base, seed, hyperparams),)
    words = _params_of(plan.pretrain_params, objective, tuple(methods()))
    config = load_config(objective, env_id, parse_pairs(words, "--pretrain-params"))
    settable = inspect.signature(objective_class).parameters.keys() - FOLLOWING
    for unknown in sorted(config.objective_kwargs.keys() - settable):
        raise ValueError(
            f"{objective} has no objective_kwargs.{unknown}, only {', '.join(sorted(settable))}; a setting of another "
            f"objective has its name in front: --pretrain-params OBJECTIVE.objective_kwargs.{unknown}:VALUE"
        )
    settings = {"objective": objective, "env_id": env_id, "seed": seed, **config.as_settings()}
    output = f"encoders/{_folder(env_id)}/{objective}-{job_key('encoder', settings, inputs)[:8]}.safetensors"
    command = ["sb3_abisim", "pretrain", "--objective", objective, "--env", env_id, "--data", inputs[0].output]
    command += ["-o", output, "--seed", str(seed), "--device", plan.device, "--verbose", "0"]
    command += ["--base", inputs[1].output] if len(inputs) == 2 else []
    command += ["-params", *words] if words else []
    command += _packages(plan)
    title = f"pretrain {objective} {env_id} seed {seed}"
    return Job("encoder", title, settings, inputs, tuple(command), output, cost=config.n_updates)


def _hyperparams(plan: Plan, env_id: str) -> tuple[str, list[str], dict[str, Any], dict[str, Any]]:
    """Of the runs: the algorithm, the words that are given for it, its entry, and both together."""
    algo = plan.algo or get_traits(env_id).algo
    words = _params_of(plan.params, algo, tuple(ALGOS))
    entry = hyperparameters_entry(algo, env_id)
    _check_params(algo, [word.partition(":")[0] for word in words])
    used = {**entry, **parse_pairs(words, "--params")}
    if not isinstance(used.get("env_kwargs") or {}, Mapping):
        raise ValueError(f"env_kwargs must be a mapping such as {{max_episode_steps: 20}}, got {used['env_kwargs']!r}")
    return algo, words, entry, used


def run_job(plan: Plan, env_id: str, method: MethodSpec, seed: int, encoder_seed: int) -> Job:
    """A zoo run; its folder lies where ``rl_zoo3.plots`` looks for it.

    :param method: which features extractor
    :param seed: of RL
    :param encoder_seed: of pretraining; of no effect where nothing is pretrained
    """
    algo, words, entry, used = _hyperparams(plan, env_id)
    given = {name: value for name, _, value in (word.partition(":") for word in words)}
    inputs: tuple[Job, ...] = ()
    if method.encoder is None and get_method(method.name).has_encoder_file:
        inputs = (encoder_job(plan, env_id, method.name, encoder_seed, used),)
    spec = dataclasses.replace(method, encoder=inputs[0].output if inputs else method.encoder)
    replaced = spec.hyperparameters(entry, parse_pairs(words, "--params"))
    _check_wrappers(env_id, used, bool(inputs))
    n = plan.n_timesteps or int(entry["n_timesteps"])
    eval_freq = plan.eval_freq or min(PAPER_EVAL_FREQ, max(n // 100, 1))
    settings = {"env_id": env_id, "algo": algo, "seed": seed, "method": method.name, "frozen": method.frozen}
    # Only what is given, as in benchmarks of before.
    settings |= method.options
    settings |= {} if method.image_key is None else {"image_key": method.image_key}
    conf_file, label = method.name, method.name
    if method.encoder is not None:
        encoder = pinned_name(method.encoder)
        file = load_encoder(encoder)
        check_preprocessing(file, {**used, **replaced}, "vec_env_wrapper" in replaced)
        settings["encoder_hash"] = file.hash
        label += f"-{file.hash[:6]}"
        path = Path(encoder)
        conf_file += f"={path.resolve() if path.is_file() else encoder}"
    elif inputs:
        conf_file += f"={inputs[0].output}"
    settings |= {
        "hyperparams": {**entry, "n_timesteps": n, **given},
        "eval_freq": eval_freq, "eval_episodes": plan.eval_episodes, "n_eval_envs": plan.n_eval_envs,
    }  # fmt: skip
    label += re.sub(r"[^\w.]+", "-", method.suffix)
    key = job_key("run", settings, inputs)
    # Runs that differ in nothing but seeds share a folder. A number, since the zoo's --exp-id takes one.
    family = f"runs/{_folder(env_id)}/{label}-{job_key('run', settings, inputs, without_seeds=True)[:8]}"
    command = ["sb3_abisim", "train", "--algo", algo, "--env", env_id, "--conf-file", conf_file + method.suffix]
    command += ["-f", f"work/run-{key}", "-n", str(n), "--seed", str(seed), "--eval-freq", str(eval_freq)]
    command += ["--eval-episodes", str(plan.eval_episodes), "--n-eval-envs", str(plan.n_eval_envs)]
    command += ["--num-threads", str(plan.threads), "--device", plan.device, "--verbose", "0"]
    command += ["-params", *words] if words else []
    command += _image_key(plan) + _packages(plan)
    output = f"{family}/{algo}/{_folder(env_id)}_{int(key[:10], 16)}"
    title = f"{algo} {method.name}{method.suffix} {env_id} seed {seed}"
    return Job("run", title, settings, inputs, tuple(command), output, f"{_folder(env_id)}.zip", n)


def _check_params(algo: str, names: Collection[str]) -> None:
    """Refuse now what the zoo would refuse when the run begins, after all of pretraining."""
    if algo not in ALGOS:
        raise ValueError(f"rl-zoo3 has no algorithm {algo!r}, only {', '.join(ALGOS)}")
    arguments = set(inspect.signature(ALGOS[algo]).parameters)
    known = (arguments | ZOO_PARAMS) - {*FLAGS, "env", "tensorboard_log", "verbose", "_init_setup_model"}
    for name in names:
        if name in FLAGS:
            raise ValueError(f"--params {name} would not hold; give {FLAGS[name]}")
        if name not in known:
            raise ValueError(f"{algo} has no hyperparameter {name!r}, only {', '.join(sorted(known))}")


def _check_wrappers(env_id: str, hyperparams: Mapping[str, Any], pretrains: bool) -> None:
    """Refuse what stands between the environment and the agent, but cannot stand before an encoder or pretraining."""
    if normalizes_observations(hyperparams.get("normalize")):
        raise ValueError(
            f"the hyperparameters for {env_id} normalize observations ({hyperparams['normalize']!r}), which would no "
            "longer be images; give --params \"normalize:{'norm_obs': False, 'norm_reward': True}\""
        )
    others = other_vec_wrappers(hyperparams)
    if others and pretrains:
        raise ValueError(
            f"the hyperparameters for {env_id} have the vec_env_wrapper {', '.join(others)}, and data for pretraining "
            "is collected without; give what it does as env_wrapper, or encoder files: METHOD=FILE"
        )


def run_labels(jobs: list[Job]) -> dict[str, str]:
    """What a report calls the runs: their method, and the end of the encoder's path where a method is given several.

    :param jobs: what :func:`build` made
    :return: name of each run's job to its label
    """
    runs = [job for job in jobs if job.kind == "run"]
    labels = dict.fromkeys((run.method for run in runs), "")
    for word in labels:
        method = MethodSpec.parse(word)
        alike = [m for m in map(MethodSpec.parse, labels) if (m.name, m.suffix) == (method.name, method.suffix)]
        paths = [_parts(m.encoder) for m in alike if m.encoder]
        end: tuple[str, ...] = ()
        if method.encoder and len(alike) > 1:
            parts = _parts(method.encoder)
            ends = (parts[-n:] for n in range(1, len(parts) + 1))
            end = next((end for end in ends if sum(p[-len(end) :] == end for p in paths) == 1), (method.encoder,))
        labels[word] = method.name + "=" * bool(end) + "/".join(end) + method.suffix
    return {run.name: labels[run.method] for run in runs}


def _parts(encoder: str) -> tuple[str, ...]:
    """Of a path, without what is the same for all files or differs between seeds alone."""
    return Path(re.sub(r"[-_.]?\{seed\}", "", encoder.removesuffix(".safetensors"))).parts


def final_job(plan: Plan, run: Job) -> Job:
    """The evaluation of a run's final model, on each split of the environment where there are any."""
    splits = get_traits(run.settings["env_id"]).splits
    settings = {"n_episodes": plan.final_episodes, "splits": list(splits)}
    command = ["sb3_abisim", "benchmark", "evaluate", run.output, "--episodes", str(plan.final_episodes)]
    command += _packages(plan)
    cost = plan.final_episodes * max(1, len(splits))
    title = run.title.replace(" ", " final ", 1)
    return Job("final", title, settings, (run,), tuple(command), run.output, "final_evaluations.npz", cost)


def _image_key(plan: Plan) -> list[str]:
    return [] if plan.image_key is None else ["--image-key", plan.image_key]


def _packages(plan: Plan) -> list[str]:
    return ["--packages", *plan.packages] if plan.packages else []


def _folder(env_id: str) -> str:
    """What rl-zoo3 makes of an id in names of files: ids may have a namespace, as in my/Toy-v0."""
    return env_id.replace("/", "-")


def _params_of(words: tuple[str, ...], owner: str, owners: tuple[str, ...]) -> list[str]:
    """The words that hold for ``owner``, without their prefixes."""
    result = []
    for word in words:
        head, dot, rest = word.partition(".")
        named = bool(dot) and re.fullmatch(r"\w+", head) is not None and head in owners
        if not named or head == owner:
            result.append(rest if named else word)
    return result
