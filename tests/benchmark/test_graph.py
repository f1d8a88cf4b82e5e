"""The jobs of a plan: what names them, and what a changed setting changes."""

import dataclasses
import itertools
import re
from pathlib import Path

import gymnasium as gym
import index_env  # noqa: F401  (registers environments)
import pytest
import toy_env  # noqa: F401
from zoo_inputs import write_encoder

from sb3_abisim.benchmark import graph
from sb3_abisim.benchmark.graph import build, run_labels
from sb3_abisim.benchmark.jobs.job import Job
from sb3_abisim.benchmark.plan import Plan
from sb3_abisim.common.cli import parse_value

PLAN = Plan(methods=("abisim", "ssi", "vanilla"), env_ids=("Nav2D-v0", "DistractorPointMaze-v0"), seeds=(0, 1))


def names(jobs: list[Job]) -> set[str]:
    return {job.name for job in jobs}


def changed(**changes: object) -> list[str]:
    """Titles of the jobs that a plan with other settings has and the plan has not."""
    there = names(build(PLAN))
    return sorted(job.title for job in build(dataclasses.replace(PLAN, **changes)) if job.name not in there)


def test_every_job_once_and_after_its_inputs() -> None:
    jobs = build(PLAN)
    seen: set[str] = set()
    for job in jobs:
        assert job.name not in seen
        assert {source.name for source in job.inputs} <= seen
        seen.add(job.name)
    # One dataset per environment; two encoders per objective, environment and seed; a run and its evaluation for each.
    kinds = [job.kind for job in jobs]
    assert {kind: kinds.count(kind) for kind in kinds} == {"data": 2, "encoder": 8, "run": 12, "final": 12}
    assert len({job.output for job in jobs if job.kind == "run"}) == 12


def test_c_reruns_what_depends_on_it_and_nothing_else() -> None:
    found = changed(pretrain_params=("abisim.objective_kwargs.c:0.5",))
    expected = []
    for env_id, algo in (("Nav2D-v0", "dqn"), ("DistractorPointMaze-v0", "ppo")):
        for seed in (0, 1):
            expected.append(f"pretrain abisim {env_id} seed {seed}")
            expected += [f"{algo} abisim {env_id} seed {seed}", f"{algo} final abisim {env_id} seed {seed}"]
    assert found == sorted(expected)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"params": ("dqn.gamma:0.9",)}, {"dqn", "dqn final"}),
        ({"params": ("ppo.gamma:0.9",)}, {"ppo", "ppo final"}),
        ({"eval_episodes": 7}, {"dqn", "dqn final", "ppo", "ppo final"}),
        ({"final_episodes": 7}, {"dqn final", "ppo final"}),
        ({"device": "cpu"}, set()),
        ({"threads": 2}, set()),
        ({"seeds": (1, 0), "encoder_seeds": (1, 0)}, set()),
    ],
)
def test_what_a_setting_reaches(changes: dict[str, object], expected: set[str]) -> None:
    plan = {"methods": ("vanilla",)}
    there = names(build(dataclasses.replace(PLAN, **plan)))
    fresh = [job for job in build(dataclasses.replace(PLAN, **plan, **changes)) if job.name not in there]
    assert {job.title.partition(" vanilla")[0] for job in fresh} == expected


def test_the_base_encoder_reaches_those_that_rest_on_it() -> None:
    titles = changed(pretrain_params=("ssi.batch_size:128",))
    assert not [title for title in titles if "vanilla" in title or "collect" in title]
    assert len(titles) == 8 + 16, "both encoders of each seed and environment, their runs and the evaluations"


@pytest.mark.parametrize(
    "word", ["objective_kwargs.c:0.9", "abisim.objective_kwargs.cc:0.9", "ssi.objective_kwargs.k:3"]
)
def test_unknown_settings_of_an_objective_are_refused_before_anything_runs(word: str) -> None:
    with pytest.raises(ValueError, match=r"(ssi|abisim) has no objective_kwargs\.(c|cc|k), only .*l1_penalty"):
        build(dataclasses.replace(PLAN, pretrain_params=(word,)))


def test_the_commands_carry_the_settings() -> None:
    plan = dataclasses.replace(
        PLAN, methods=("abisim,frozen",), env_ids=("Nav2D-v0",), n_timesteps=500, eval_freq=50, params=("gamma:0.9",),
        pretrain_params=("n_updates:7", "ssi.batch_size:8"), n_transitions=300,
    )  # fmt: skip
    by_title = {job.title: job for job in build(plan)}
    run = " ".join(by_title["dqn abisim,frozen Nav2D-v0 seed 1"].command)
    encoder = by_title["pretrain abisim Nav2D-v0 seed 1"]
    assert f"--conf-file abisim={encoder.output},frozen " in run
    assert "-n 500 --seed 1 --eval-freq 50 --eval-episodes 20 --n-eval-envs 5" in run and run.endswith(
        "-params gamma:0.9"
    )
    base = by_title["pretrain ssi Nav2D-v0 seed 1"]
    assert base.command[-2:] == ("n_updates:7", "batch_size:8") and encoder.command[-1:] == ("n_updates:7",)
    assert encoder.command[encoder.command.index("--base") + 1] == base.output
    assert encoder.cost == 7 and "-n 300" in " ".join(by_title["collect Nav2D-v0"].command)


def test_runs_that_differ_in_seeds_share_a_folder_and_no_others_do() -> None:
    runs = [job for job in build(PLAN) if job.kind == "run"]
    folders = {job.output.rpartition("/")[0] for job in runs}
    assert len(folders) == len(PLAN.methods) * len(PLAN.env_ids)
    other = build(dataclasses.replace(PLAN, pretrain_params=("abisim.objective_kwargs.c:0.5",)))
    fresh = {job.output.rpartition("/")[0] for job in other if job.kind == "run"} - folders
    assert len(fresh) == 2 and all("/abisim-" in folder for folder in fresh)
    # rl_zoo3's --exp-id takes a number.
    assert all(job.output.rpartition("_")[2].isdigit() for job in runs)


def test_encoders_are_taken_in_turn() -> None:
    plan = dataclasses.replace(PLAN, methods=("ssi",), env_ids=("Nav2D-v0",), seeds=(0, 1, 2), encoder_seeds=(7, 8))
    seeds = [job.inputs[0].settings["seed"] for job in build(plan) if job.kind == "run"]
    assert seeds == [7, 8, 7]


def test_a_given_encoder_is_known_by_its_content() -> None:
    plan = dataclasses.replace(PLAN, methods=("ssi=Nav2D-v0/ssi",), env_ids=("Nav2D-v0",), seeds=(0,))
    (run,) = (job for job in build(plan) if job.kind == "run")
    assert run.inputs == () and len(run.settings["encoder_hash"]) == 64
    assert "ssi=Nav2D-v0/ssi" in run.command
    assert run_labels([run]) == {run.name: "ssi"}, "as the paper's table calls it"
    several = build(dataclasses.replace(plan, methods=("ssi", "ssi=Nav2D-v0/ssi", "ssi=Nav2D-v0/ssi,frozen")))
    labels = list(run_labels(several).values())
    assert labels == ["ssi", "ssi=ssi", "ssi,frozen"]


def test_labels_of_several_given_encoders(tmp_path: Path) -> None:
    words = []
    for name in ("a/x_{seed}.safetensors", "b/x_{seed}.safetensors", "b/y.safetensors", "b/y_{seed}.safetensors"):
        path = tmp_path / ("x" * (len(words) + 1))  # write_encoder draws by the length of the name
        write_encoder(path, "Nav2D-v0", "ssi")
        (tmp_path / name).parent.mkdir(exist_ok=True)
        path.rename(tmp_path / name.replace("{seed}", "7"))
        words.append(f"ssi={tmp_path / name}")
    plan = dataclasses.replace(
        PLAN, methods=(*words, "acro=Nav2D-v0/acro,frozen"), env_ids=("Nav2D-v0",), seeds=(0,), encoder_seeds=(7,)
    )
    # Where only {seed} tells two apart, they keep their whole names.
    alike = [f"ssi={tmp_path}/b/y.safetensors", f"ssi={tmp_path}/b/y_{{seed}}.safetensors"]
    assert list(run_labels(build(plan)).values()) == ["ssi=a/x", "ssi=b/x", *alike, "acro,frozen"]


def test_given_encoders_of_several_seeds(tmp_path: Path) -> None:
    for seed in (3, 4):
        path = tmp_path / ("x" * seed)  # write_encoder draws by the length of the name
        write_encoder(path, "Nav2D-v0", "ssi")
        path.rename(tmp_path / f"ssi{seed}")
    plan = dataclasses.replace(PLAN, env_ids=("Nav2D-v0",), seeds=(0, 1, 2), encoder_seeds=(3, 4))
    runs = [
        c for c in build(dataclasses.replace(plan, methods=(f"ssi={tmp_path}/ssi{{seed}},frozen",))) if c.kind == "run"
    ]
    files = [word for job in runs for word in job.command if word.startswith("ssi=")]
    assert files == [f"ssi={tmp_path}/ssi{seed},frozen" for seed in (3, 4, 3)]
    assert set(run_labels(runs).values()) == {"ssi,frozen"}, "one method, not one per file"
    with pytest.raises(FileNotFoundError, match="ssi5"):
        build(dataclasses.replace(plan, methods=(f"ssi={tmp_path}/ssi{{seed}}",), encoder_seeds=(5,)))


def test_random_agents_of_scan_nav_do_not_stop_at_once() -> None:
    jobs = {job.kind: job for job in build(Plan(methods=("ssi",), env_ids=("ScanNav-v0",), seeds=(0,)))}
    assert jobs["data"].command[-2:] == ("--env-kwargs", "stop:'auto'")
    assert jobs["data"].settings["env_kwargs"] == {"stop": "auto"} and jobs["data"].cost == 100_000
    assert jobs["run"].inputs[0].inputs == (jobs["data"],)


def test_distractors_are_evaluated_on_three_splits() -> None:
    for job in build(PLAN):
        if job.kind == "final":
            distracted = job.inputs[0].settings["env_id"] == "DistractorPointMaze-v0"
            assert job.settings["splits"] == (["eval", "train", "clean"] if distracted else [])


@pytest.mark.parametrize(
    "changes",
    [
        {"methods": ("abisim=Nav2D-v0/abisim", "vanilla"), "params": ("env_kwargs:{max_episode_steps: 20}",)},
        {"params": ("ppo.normalize:{norm_obs: false}",)},
    ],
)
def test_settings_that_nothing_else_would_miss(changes: dict[str, object]) -> None:
    """Arguments of environments, and normalized rewards."""
    assert build(dataclasses.replace(PLAN, **{"env_ids": ("Nav2D-v0",), "algo": "ppo", **changes}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methods": ("abisym",)}, "unknown method 'abisym'"),
        ({"methods": ("ssi", "ssi")}, "each once, got ssi ssi"),
        ({"env_ids": ("Nav3D-v0",)}, "unknown environment 'Nav3D-v0'"),
        ({"seeds": ()}, "seeds must be given"),
        ({"seeds": (-1,)}, "seeds must be at least 0, got -1"),
        ({"n_timesteps": 0}, "n_timesteps must be at least 1, got 0"),
        ({"algo": "sac"}, "no hyperparameters of sac for Nav2D-v0"),
        ({"params": ("sac.gamma:0.9",)}, "--params sac.gamma:0.9 is for sac, but here is only dqn, ppo"),
        ({"params": ("env_kwargs:dict(color_jitter=False)",)}, "env_kwargs must be a mapping such as"),
        ({"params": ("env_kwargs:{split: clean}",)}, "env_kwargs split would choose what data for pretraining"),
        ({"params": ("frame_stacks:2",)}, "dqn has no hyperparameter 'frame_stacks'"),
        ({"params": ("ppo.normalize:True",)}, r"normalize observations \(True\), .*'norm_obs': False"),
        ({"params": ("vec_env_wrapper:some.Stack",)}, "have the vec_env_wrapper some.Stack, and data .* METHOD=FILE"),
        ({"pretrain_params": ("curl.n_updates:3",)}, "curl.n_updates:3 is for curl, but here is only abisim, ssi"),
        ({"params": ("gamma",)}, "name:value, got 'gamma'"),
        ({"params": ("dqn.learning_rat:1e-4",)}, "dqn has no hyperparameter 'learning_rat', only .*learning_rate"),
        ({"params": ("ppo.seed:3",)}, "--params seed would not hold; give --seeds"),
        ({"params": ("policy_kwargs:dict()",)}, "-params policy_kwargs would undo --conf-file"),
        ({"pretrain_params": ("base.n_updates:3",)}, "base encoders are jobs of their own; give the method's name"),
        ({"pretrain_params": ("n_update:3",)}, "unknown pretraining setting n_update"),
    ],
)
def test_mistakes_are_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(dataclasses.replace(PLAN, **changes))


OTHERS = Plan(
    methods=("abisim", "ssi,frozen", "vanilla"), env_ids=("PlainEnv-v0",), seeds=(0,), packages=("index_env", "mine")
)


def test_any_registered_environment_and_packages_for_every_job() -> None:
    jobs = build(dataclasses.replace(OTHERS, algo="sac"))
    kinds = [job.kind for job in jobs]
    assert {kind: kinds.count(kind) for kind in kinds} == {"data": 1, "encoder": 2, "run": 3, "final": 3}
    assert all(job.command[-3:] == ("--packages", "index_env", "mine") for job in jobs)
    runs = {job.method: job for job in jobs if job.kind == "run"}
    # rl-zoo3 has a million steps in its default for sac.
    assert all("-n 1000000 " in " ".join(run.command) for run in runs.values())
    assert runs["ssi,frozen"].settings["hyperparams"]["policy"] == "MlpPolicy"
    # Modules are no settings: they say where something is registered.
    assert names(jobs) == names(build(dataclasses.replace(OTHERS, algo="sac", packages=())))


def test_ids_with_a_namespace_are_no_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gym.registry, "mine/Plain-v0", gym.spec("PlainEnv-v0"))
    jobs = build(dataclasses.replace(OTHERS, env_ids=("mine/Plain-v0",), algo="ppo"))
    assert {job.output.count("/") for job in jobs if job.kind == "data"} == {1}
    run = next(job for job in jobs if job.kind == "run")
    # As rl-zoo3 names the model and the folder.
    assert run.output_file == "mine-Plain-v0.zip" and re.fullmatch(
        r"runs/mine-Plain-v0/\S+/ppo/mine-Plain-v0_\d+", run.output
    )
    assert run.command[run.command.index("--env") + 1] == "mine/Plain-v0"


@pytest.mark.parametrize("algo", ["a2c", "qrdqn", "tqc"])
def test_algorithms_are_those_of_rl_zoo3(algo: str) -> None:
    plan = dataclasses.replace(OTHERS, methods=("vanilla",), algo=algo, params=(f"{algo}.gamma:0.9",))
    (run,) = (job for job in build(plan) if job.kind == "run")
    assert run.settings["hyperparams"]["gamma"] == "0.9"
    with pytest.raises(ValueError, match=f"{algo} has no hyperparameter 'gama'"):
        build(dataclasses.replace(plan, params=("gama:0.9",)))
    with pytest.raises(ValueError, match=f"--params ppo.gamma:0.9 is for ppo, but here is only {algo}"):
        build(dataclasses.replace(plan, params=("ppo.gamma:0.9",)))


def test_wrappers_and_stacks_of_the_runs_are_those_of_the_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """As rl-zoo3's entries have them for Atari."""
    plain = build(dataclasses.replace(OTHERS, env_ids=("PlainEnv-v0",)))
    skip = {"rl_zoo3.wrappers.FrameSkip": {"skip": 2}}
    entry = {"n_timesteps": 1e7, "policy": "CnnPolicy", "env_wrapper": ["a.Wrapper", skip], "frame_stack": 4}
    monkeypatch.setattr(graph, "hyperparameters_entry", lambda algo, env_id: dict(entry))
    jobs = build(OTHERS)
    (data,) = (job for job in jobs if job.kind == "data")
    assert {name: data.settings[name] for name in ("env_wrapper", "frame_stack", "env_kwargs")} == {
        "env_wrapper": ["a.Wrapper", skip],
        "frame_stack": 4,
        "env_kwargs": {},
    }
    words = data.command[data.command.index("--env-wrapper") :]
    assert words[:5] == ("--env-wrapper", "a.Wrapper", str(skip), "--frame-stack", "4")
    assert [parse_value(word) for word in words[1:3]] == ["a.Wrapper", skip]
    assert not names(jobs) & names(plain)
    # What --params says holds for both.
    jobs = build(dataclasses.replace(OTHERS, params=("frame_stack:3", "env_wrapper:None", "env_kwargs:{scale: 2}")))
    (data,) = (job for job in jobs if job.kind == "data")
    assert data.settings["frame_stack"] == 3 and "env_wrapper" not in data.settings
    assert data.command[7:12] == (data.output, "--env-kwargs", "scale:2", "--frame-stack", "3")
    # What collect would do by itself is said not to be done.
    monkeypatch.setattr(graph, "preprocessing_entry", lambda env_id: {"env_wrapper": ["b.Other"], "frame_stack": 2})
    monkeypatch.setattr(graph, "hyperparameters_entry", lambda algo, env_id: {"n_timesteps": 1, "policy": "CnnPolicy"})
    (data,) = (job for job in build(OTHERS) if job.kind == "data")
    assert data.command[8:12] == ("--env-wrapper", "none", "--frame-stack", "1")


def test_an_encoder_of_other_wrappers_is_refused_before_any_job(tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    write_encoder(path, "Toy-v0", "ssi", preprocessing={"env_wrapper": ["a.B"]})
    plan = dataclasses.replace(OTHERS, env_ids=("Toy-v0",), methods=(f"ssi={path}",))
    with pytest.raises(ValueError, match=r"env_wrapper: \['a.B'\] in pretraining, \[\] now.*add -params"):
        build(plan)
    assert build(dataclasses.replace(plan, params=("env_wrapper:a.B",)))


def test_options_of_a_method_are_another_arm() -> None:
    """The same encoder under both, and labels that a report tells apart."""
    methods = ("abisim,frozen", "abisim,frozen,task_features_dim=8,augment=random_shift", "drq")
    plan = dataclasses.replace(PLAN, methods=methods, env_ids=("Nav2D-v0",), seeds=(0,))
    jobs = build(plan)
    plain, more, drq = (job for job in jobs if job.kind == "run")
    assert plain.inputs == more.inputs != () == drq.inputs and len({plain.name, more.name, drq.name}) == 3
    assert list(run_labels(jobs).values()) == list(methods)
    told = {name: value for name, value in more.settings.items() if name not in plain.settings}
    assert told == {"task_features_dim": 8, "augment": "random_shift"}
    conf_file = more.command[more.command.index("--conf-file") + 1]
    assert conf_file == f"abisim={more.inputs[0].output},frozen,task_features_dim=8,augment=random_shift"
    assert "/abisim-frozen-task_features_dim-8-augment-random_shift-" in more.output
    assert drq.command[drq.command.index("--conf-file") + 1] == "drq"


def test_the_image_of_a_dict_is_one_for_data_and_all_methods() -> None:
    plan = Plan(
        methods=("ssi,frozen", "vanilla", "drq"), env_ids=("Robot-v0",), seeds=(0,), final_episodes=0,
        image_key="wrist", params=("normalize:False",),
    )  # fmt: skip
    jobs = build(plan)
    assert [job.kind for job in jobs] == ["data", "encoder", "run", "run", "run"]
    for job in jobs:
        # Encoders know it from their data.
        given = [after for word, after in itertools.pairwise(job.command) if word == "--image-key"]
        assert given == ([] if job.kind == "encoder" else ["wrist"])
    assert list(run_labels(jobs).values()) == ["ssi,frozen", "vanilla", "drq"]
    other = names(build(dataclasses.replace(plan, image_key="camera")))
    assert not names(jobs) & other, "another image makes other jobs"
    with pytest.raises(ValueError, match=r"the image is the same for all methods; give --image-key camera"):
        build(dataclasses.replace(plan, methods=("vanilla,image_key=camera",)))


def test_a_frozen_encoder_of_a_dict_is_shown_stacks_by_the_zoo(tmp_path: Path) -> None:
    """Nothing embeds in the environment there, so that ``frame_stack`` stacks observations."""
    file = write_encoder(
        tmp_path / "e.safetensors", "Toy-v0", "ssi", {"frame_stack": 2, "image_key": "wrist", "env_wrapper": []}
    )
    plan = Plan(
        methods=(f"ssi={tmp_path / 'e.safetensors'},frozen",), env_ids=("Robot-v0",), seeds=(0,), final_episodes=0,
        params=("normalize:False", "frame_stack:2"),
    )  # fmt: skip
    (job,) = build(plan)
    assert job.settings["encoder_hash"] == file


@pytest.mark.parametrize(
    ("methods", "env_kwargs", "wrapper", "n_images"),
    [
        (("ssi", "vanilla"), "", "", 2),
        (("drq",), "env_kwargs:{wrist: False}", "", 1),
        # What the runs see is one image.
        (("drq",), "", "env_wrapper:toy_env.Camera", None),
        # The encoder file says which.
        (("ssi",), "", "", None),
    ],
)
def test_a_dict_without_a_key_is_refused_before_anything_runs(
    methods: tuple[str, ...], env_kwargs: str, wrapper: str, n_images: int | None
) -> None:
    params = tuple(word for word in ("normalize:False", env_kwargs, wrapper) if word)
    plan = Plan(methods=methods, env_ids=("Robot-v0",), seeds=(0,), params=params)
    if n_images is None:
        build(plan)
        return
    with pytest.raises(ValueError, match=rf"a Dict with {n_images} images \(camera.*choose one with --image-key"):
        build(plan)
