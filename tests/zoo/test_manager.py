"""rl-zoo3's manager with our hyperparameters, methods and evaluation splits. The commands are in test_command.py."""

import argparse
import importlib
import sys
import types
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from zoo_inputs import SMALL, write_encoder

from sb3_abisim.common.paths import resource_path
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.networks.encoder_name import EncoderNotFoundError
from sb3_abisim.registry import get_method, methods
from sb3_abisim.rl.checks import check_trained_with, find_extractors
from sb3_abisim.rl.extractor_classes import extractor_class
from sb3_abisim.rl.extractors import VanillaExtractor
from sb3_abisim.rl.file_network import network_arguments
from sb3_abisim.zoo.entries import ENCODING_WRAPPER, encoding_kwargs, read_entries
from sb3_abisim.zoo.manager import MethodExperimentManager, install, with_eval_split
from sb3_abisim.zoo.method_record import MethodRecord
from sb3_abisim.zoo.models import load_model
from sb3_abisim.zoo.runs import read_run

exp_manager = importlib.import_module("rl_zoo3.exp_manager")

ROOT = Path(__file__).resolve().parents[2]
ENTRIES = [
    (path.stem, env_id)
    for path in sorted(resource_path("hyperparams").glob("*.yml"))
    for env_id in yaml.safe_load(path.read_text())
]
PRETRAINED = [name for name, method in methods().items() if method.is_pretrained]


@pytest.fixture
def manager(tmp_path: Path) -> Any:
    def make(algo: str, env_id: str, config: str | None = None, **kwargs: Any) -> Any:
        args = argparse.Namespace(conf_file=config)
        return exp_manager.ExperimentManager(args, algo, env_id, str(tmp_path), config=config, **kwargs)

    return make


def effective(manager: Any) -> dict[str, Any]:
    """What the algorithm's constructor is given, with everything that goes elsewhere."""
    hyperparams, saved = manager.read_hyperparameters()
    rest = {key: saved[key] for key in ("n_envs", "n_timesteps", "monitor_kwargs", "callback") if key in saved}
    processed = dict(manager._preprocess_hyperparams(hyperparams)[0])
    for key in ("learning_rate", "clip_range", "clip_range_vf"):
        if key in processed:
            processed[key] = processed[key](0.5)
    return processed | rest | {"env_kwargs": manager.env_kwargs, "eval_env_kwargs": manager.eval_env_kwargs}


# Methods.


def with_network(encoder: str) -> dict[str, Any]:
    """The extractor's arguments for a shipped encoder, or one that does not ship."""
    try:
        return {"encoder": encoder, **network_arguments(load_encoder(encoder))}
    except EncoderNotFoundError:
        return {"encoder": encoder}


@pytest.mark.parametrize(("algo", "env_id"), ENTRIES)
def test_methods_differ_in_policy_kwargs_alone(manager: Any, algo: str, env_id: str) -> None:
    default = effective(manager(algo, env_id))
    kwargs = default.pop("policy_kwargs")
    shipped = kwargs["features_extractor_kwargs"]["encoder"]
    assert kwargs["features_extractor_class"].__name__ == "ActionBisimExtractor"
    for word, class_name, expected in [
        ("abisim", "ActionBisimExtractor", {"encoder": shipped}),
        *(
            (name, get_method(name).extractor, with_network(shipped.replace("/abisim", f"/{name}")))
            for name in PRETRAINED
        ),
        ("ssi=my runs/x.safetensors", "SSIExtractor", {"encoder": "my runs/x.safetensors"}),
        ("vanilla", "VanillaExtractor", None),
    ]:
        other = effective(manager(algo, env_id, word))
        other_kwargs = other.pop("policy_kwargs")
        assert other == default
        assert other_kwargs["features_extractor_class"].__name__ == class_name
        assert other_kwargs.get("features_extractor_kwargs") == expected
        differing = {key for key in kwargs | other_kwargs if kwargs.get(key) != other_kwargs.get(key)}
        assert differing <= {"features_extractor_class", "features_extractor_kwargs"}


@pytest.mark.parametrize(("algo", "env_id"), ENTRIES)
def test_frozen_puts_the_encoder_into_the_environment(manager: Any, algo: str, env_id: str) -> None:
    default = effective(manager(algo, env_id))
    kwargs = default.pop("policy_kwargs")
    shipped = kwargs["features_extractor_kwargs"]["encoder"]
    for word, encoder, objective in [
        ("abisim,frozen", shipped, "abisim"),
        ("ssi,frozen", shipped.replace("/abisim", "/ssi"), "ssi"),
        ("ssi=my runs/x.safetensors,frozen", "my runs/x.safetensors", "ssi"),
    ]:
        _, saved = manager(algo, env_id, word).read_hyperparameters()
        assert saved["vec_env_wrapper"] == [
            {"sb3_abisim.VecEncodeObservations": {"encoder": encoder, "objective": objective}}
        ]
        on_cpu = manager(algo, env_id, word, device="cpu").read_hyperparameters()[0]
        assert encoding_kwargs(on_cpu) == {"encoder": encoder, "objective": objective, "device": "cpu"}
        frozen = effective(manager(algo, env_id, word))
        # The network behind the encoder and all else are the same.
        head = {key: value for key, value in kwargs.items() if not key.startswith("features_extractor")}
        assert frozen.pop("policy_kwargs") == head
        assert frozen == default | {"policy": "MlpPolicy"}


def test_environments_are_stepped_as_one_batch(manager: Any, tmp_path: Path) -> None:
    def vec_env_class(algo: str, env_id: str = "Nav2D-v0", config: str | None = None, **kwargs: Any) -> str:
        one = manager(algo, env_id, config, **kwargs)
        one.read_hyperparameters()
        return str(one.vec_env_class.__name__)

    (tmp_path / "custom.yml").write_text("Nav2D-v0: {n_envs: 4, n_timesteps: 7, env_wrapper: some.Wrapper}\n")
    assert vec_env_class("ppo") == vec_env_class("ppo", config="vanilla") == "BatchedVecEnv"
    assert vec_env_class("dqn") == vec_env_class("ppo", hyperparams={"n_envs": 1}) == "BatchedVecEnv"
    assert vec_env_class("ppo", config=str(tmp_path / "custom.yml")) == "DummyVecEnv"
    assert vec_env_class("ppo", vec_env_type="subproc") == "SubprocVecEnv"
    assert vec_env_class("ppo", "CartPole-v1") == "DummyVecEnv"


# Hyperparameters.


def test_the_yaml_is_a_conf_file(manager: Any) -> None:
    for algo, env_id in ENTRIES:
        as_file = effective(manager(algo, env_id, str(resource_path("hyperparams") / f"{algo}.yml")))
        assert as_file == effective(manager(algo, env_id))


def test_every_environment_has_hyperparameters() -> None:
    assert {env_id for algo, env_id in ENTRIES if algo == "ppo"} == set(ENV_IDS)
    assert {env_id for algo, env_id in ENTRIES if algo == "dqn"} == {i for i in ENV_IDS if i.startswith("Nav2D")}
    assert {env_id for algo, env_id in ENTRIES if algo == "sac"} == {i for i in ENV_IDS if i.startswith("Continuous")}


def test_the_papers_numbers(manager: Any) -> None:
    for env_id in (env_id for env_id in ENV_IDS if "PointMaze" in env_id):
        ppo = effective(manager("ppo", env_id))
        assert ppo["n_envs"] * ppo["n_steps"] == 65536
        assert (ppo["batch_size"], ppo["learning_rate"], ppo["n_timesteps"]) == (256, 0.000025, 7e6)
        assert ppo["policy_kwargs"]["net_arch"] == [256] and ppo["policy_kwargs"]["activation_fn"] is nn.ReLU
    dqn = effective(manager("dqn", "Nav2D-v0"))
    assert (dqn["batch_size"], dqn["learning_rate"], dqn["gamma"], dqn["n_timesteps"]) == (32, 0.0001, 0.99, 2e6)
    assert (dqn["exploration_initial_eps"], dqn["exploration_final_eps"]) == (0.9, 0.2)


@pytest.mark.parametrize(("algo", "env_id"), ENTRIES)
def test_every_entry_builds_its_model(manager: Any, tmp_path: Path, algo: str, env_id: str) -> None:
    hash = write_encoder(tmp_path / "mine.safetensors", env_id)
    given = dict(pair.split(":") for pair in SMALL[algo])
    hyperparams = {key: int(value) for key, value in given.items()}
    config = f"abisim={tmp_path / 'mine.safetensors'}"
    model, saved = manager(algo, env_id, config, hyperparams=hyperparams, eval_freq=-1).setup_experiment()
    part = model.actor if algo == "sac" else model.q_net if algo == "dqn" else model.policy
    assert part.features_extractor.hash == hash
    # Constructing the algorithm has left the weights as they are in the file, bit by bit.
    weights = load_encoder(tmp_path / "mine.safetensors").encoder.state_dict()
    assert all(th.equal(value, weights[name]) for name, value in part.features_extractor.encoder.state_dict().items())
    # What is saved beside the run is as readable as the YAML file.
    assert saved["policy_kwargs"]["features_extractor_class"] == "sb3_abisim.ActionBisimExtractor"
    # NatureCNN's defaults for net_arch, "no layers", must not reach our heads.
    head = {"ppo": lambda: model.policy.value_net, "dqn": lambda: model.q_net.q_net[-1], "sac": lambda: model.actor.mu}
    assert head[algo]().in_features == 256
    model.env.close()


def test_shipped_encoders() -> None:
    """Needs the files under encoders/, which come from `sb3-abisim pretrain`."""
    for algo, env_id in ENTRIES:
        # 256 pixels take a network too large to ship.
        if env_id == "ScanNavPaper-v0":
            continue
        kwargs = read_entries(resource_path("hyperparams") / f"{algo}.yml")[env_id]["policy_kwargs"]
        folder = kwargs["features_extractor_kwargs"]["encoder"].split("/")[0]
        # A method ships for every environment or for none (tests/test_encoders.py).
        shipped = [
            name for name in PRETRAINED if (resource_path("encoders") / f"{folder}/{name}.safetensors").is_file()
        ]
        assert {"ssi", "abisim"} <= set(shipped)
        for method in shipped:
            metadata = load_encoder(f"{folder}/{method}").metadata
            assert (metadata["env_id"], metadata["objective"]) == (folder, method)
            # Scans are pretrained on without the action stop, which no observation shows.
            env = gym.make(env_id, **metadata["env_kwargs"])
            load_encoder(f"{folder}/{method}").check(env.observation_space, env.action_space)


def test_other_environments_are_untouched(manager: Any) -> None:
    ours, theirs = manager("ppo", "CartPole-v1"), manager("ppo", "CartPole-v1")
    assert type(ours) is MethodExperimentManager
    assert ours.read_hyperparameters() == super(MethodExperimentManager, theirs).read_hyperparameters()
    theirs._spec = None
    assert vars(ours) == vars(theirs)
    assert Path(ours.config).parent.parent == Path(exp_manager.__file__).parent


def test_a_custom_file_is_read_as_it_is(manager: Any, tmp_path: Path) -> None:
    (tmp_path / "custom.yml").write_text("Nav2D-v0: {policy: MlpPolicy, n_timesteps: 7}\n")
    assert dict(manager("a2c", "Nav2D-v0", str(tmp_path / "custom.yml")).read_hyperparameters()[0]) == {
        "policy": "MlpPolicy",
        "n_timesteps": 7,
    }


def test_mistakes_are_refused(manager: Any) -> None:
    with pytest.raises(ValueError, match=r"no hyperparameters of a2c for Nav2D-v0, only of: dqn, ppo"):
        manager("a2c", "Nav2D-v0").read_hyperparameters()
    with pytest.raises(ValueError, match=r"no hyperparameters of sac for PointMaze-v0, only of: ppo"):
        manager("sac", "PointMaze-v0", "ssi").read_hyperparameters()
    with pytest.raises(ValueError, match=r"'abisin' is no YAML.*one of abisim, .*vanilla"):
        manager("ppo", "Nav2D-v0", "abisin").read_hyperparameters()
    with pytest.raises(ValueError, match="give one of the two"):
        manager("ppo", "Nav2D-v0", "ssi", hyperparams={"policy_kwargs": "dict()"}).read_hyperparameters()
    with pytest.raises(ValueError, match="-params vec_env_wrapper would undo"):
        manager("ppo", "Nav2D-v0", "ssi,frozen", hyperparams={"vec_env_wrapper": []}).read_hyperparameters()
    for normalize in (True, "dict(norm_reward=False)", "{'norm_obs': True}"):
        with pytest.raises(ValueError, match="would change the embeddings of the frozen encoder"):
            manager("ppo", "Nav2D-v0", "ssi,frozen", hyperparams={"normalize": normalize}).read_hyperparameters()
    with pytest.raises(ValueError, match="--trial-id would replace policy_kwargs"):
        manager("ppo", "Nav2D-v0", trial_id=3).read_hyperparameters()
    with pytest.raises(ValueError, match="--trial-id would replace policy_kwargs"):
        manager("ppo", "Nav2D-v0", str(ROOT / "hyperparams" / "ppo.yml"), trial_id=3).read_hyperparameters()


def test_a_run_goes_on_with_its_encoder_or_not_at_all(manager: Any, tmp_path: Path) -> None:
    small = {"n_envs": 2, "n_steps": 8, "batch_size": 8}
    hash, other = (write_encoder(tmp_path / f"{name}.safetensors", "Nav2D-v0", "ssi") for name in ("mine", "other"))
    write_encoder(tmp_path / "acro.safetensors", "Nav2D-v0", "acro")
    assert hash != other

    def experiment(config: str, agent: str = "") -> Any:
        made = manager("ppo", "Nav2D-v0", config, hyperparams=dict(small), trained_agent=agent, eval_freq=-1)
        made.args = argparse.Namespace()
        model = made.setup_experiment()[0]
        model.env.close()
        return model

    agent, mine = str(tmp_path / "agent.zip"), f"ssi={tmp_path / 'mine.safetensors'}"
    experiment(mine).save(agent)
    assert experiment(mine, agent).policy.features_extractor.hash == hash
    written = set(tmp_path.glob("**/config.yml"))
    for config, here in (
        (f"acro={tmp_path / 'acro.safetensors'}", r"ACROExtractor, hash \w{64}"),
        (f"ssi={tmp_path / 'other.safetensors'}", f"SSIExtractor, hash {other}"),
        ("vanilla", "VanillaExtractor"),
    ):
        with pytest.raises(ValueError, match=f"trained with SSIExtractor, hash {hash}, not with {here}; give the same"):
            experiment(config, agent)
    assert set(tmp_path.glob("**/config.yml")) == written
    # The model has the weights itself.
    (tmp_path / "mine.safetensors").unlink()
    assert experiment(mine, agent).policy.features_extractor.hash == hash
    # And knows which file it was.
    latest = max(tmp_path.glob("ppo/*/*/method.json"), key=lambda found: int(found.parent.parent.name.split("_")[-1]))
    record = MethodRecord.read(latest.parent)
    assert record is not None and (record.label, record.encoder_hash) == ("ssi", hash)
    experiment("vanilla").save(agent)
    with pytest.raises(ValueError, match="was trained with VanillaExtractor, not with SSIExtractor"):
        experiment(mine, agent)


def test_a_run_that_unfreezes_goes_on_from_either_side(manager: Any, tmp_path: Path) -> None:
    file, agent = tmp_path / "mine.safetensors", tmp_path / "agent.zip"
    write_encoder(file, "Nav2D-v0", "ssi")
    kwargs = {"encoder": str(file), "freeze": True}
    entry = {
        "policy": "CnnPolicy",
        "policy_kwargs": {"features_extractor_class": "sb3_abisim.SSIExtractor", "features_extractor_kwargs": kwargs},
        "callback": [{"sb3_abisim.EncoderCallback": {"unfreeze_at": 24, "encoder_lr": "lin_1e-4"}}],
        **{"n_timesteps": 32, "n_envs": 2, "n_steps": 8, "batch_size": 8},
    }
    config = tmp_path / "mine.yml"
    config.write_text(yaml.safe_dump({"Nav2D-v0": entry}))
    for n_timesteps, continued, is_frozen in ((16, False, True), (48, True, False), (48, True, False)):
        trained_agent = str(agent) if continued else ""
        given = {"trained_agent": trained_agent, "eval_freq": -1, "log_interval": -1, "n_timesteps": n_timesteps}
        made = manager("ppo", "Nav2D-v0", str(config), **given)
        made.args = argparse.Namespace()
        model = made.setup_experiment()[0]
        before = find_extractors(model.policy)[0][1].relative_weight_change()
        made.learn(model)
        made.save_trained_model(model)
        model.save(agent)
        (_, extractor), *_ = find_extractors(model.policy)
        assert extractor.frozen == is_frozen and (extractor.relative_weight_change() != before) is not is_frozen
        # Built from the YAML, which says freeze: true, and from the weights.
        run: Any = types.SimpleNamespace(folder=Path(made.save_path), env_name="Nav2D-v0", algo="ppo")
        record = MethodRecord.read(made.params_path)
        assert record is not None and record.label == "ssi"
        built = load_model(Path(made.save_path) / "Nav2D-v0.zip", run)
        assert find_extractors(built.policy)[0][1].frozen == is_frozen
        state = built.policy.state_dict()
        assert all(th.equal(value, state[name]) for name, value in model.policy.state_dict().items())


def test_evaluation_is_in_the_environment_of_training(manager: Any) -> None:
    """rl-zoo3 gives it the arguments of --env-kwargs, not those among the hyperparameters."""
    chosen = {"hyperparams": {"env_kwargs": {"max_episode_steps": 20}}}
    for expected, given in (
        ({"max_episode_steps": 20}, {}),
        ({"max_episode_steps": 9}, {"eval_env_kwargs": {"max_episode_steps": 9}}),
    ):
        made = manager("ppo", "Nav2D-v0", "ssi", **chosen, **given)
        made.read_hyperparameters()
        assert made.eval_env_kwargs == expected
    plain = manager("ppo", "Nav2D-v0", "ssi", env_kwargs={"max_episode_steps": 7})
    plain.read_hyperparameters()
    assert plain.eval_env_kwargs == {"max_episode_steps": 7}


def test_custom_extractors_may_hold_ours() -> None:
    class Custom(BaseFeaturesExtractor):
        def __init__(self, space: gym.Space) -> None:
            super().__init__(space, 576)
            self.image = VanillaExtractor(space)

        def forward(self, observations: th.Tensor) -> th.Tensor:
            return self.image(observations)

    kwargs = {"features_extractor_class": Custom}
    model = PPO("CnnPolicy", "Nav2D-v0", n_steps=8, batch_size=8, policy_kwargs=kwargs, device="cpu")
    check_trained_with(model, kwargs)
    with pytest.raises(ValueError, match="trained with VanillaExtractor, not with none of our extractors"):
        check_trained_with(model, {})


def test_another_environment_with_normalized_embeddings_is_refused(manager: Any, tmp_path: Path) -> None:
    wrapper = f"[{{{ENCODING_WRAPPER}: {{encoder: x}}}}]"
    text = f"CartPole-v1: {{policy: MlpPolicy, n_timesteps: 7, normalize: true, vec_env_wrapper: {wrapper}}}\n"
    (tmp_path / "custom.yml").write_text(text)
    with pytest.raises(ValueError, match="would change the embeddings of the frozen encoder"):
        manager("ppo", "CartPole-v1", str(tmp_path / "custom.yml")).read_hyperparameters()


def test_installing_again_changes_nothing() -> None:
    before = exp_manager.ExperimentManager, importlib.import_module("rl_zoo3").create_test_env
    install()
    assert before == (MethodExperimentManager, importlib.import_module("rl_zoo3.utils").create_test_env)
    assert exp_manager.ExperimentManager is before[0]
    assert importlib.import_module("rl_zoo3").create_test_env is before[1]


# What read_run needs of a command's arguments.
ARGS = {"algo": "ppo", "env": "Nav2D-v0", "seed": 1, "n_timesteps": -1, "env_kwargs": None, "eval_env_kwargs": None}
ARGS |= {"eval_freq": -1, "eval_episodes": 1}


def test_policy_kwargs_of_a_custom_file_may_be_a_text(manager: Any, tmp_path: Path) -> None:
    """As in every YAML file of rl-zoo3; both forms give the same."""
    hash = write_encoder(tmp_path / "mine.safetensors", "Nav2D-v0", "ssi")
    text = "dict(features_extractor_class=get_class_by_name('sb3_abisim.SSIExtractor'), net_arch=[7], "
    text += f"features_extractor_kwargs={{'encoder': {str(tmp_path / 'mine.safetensors')!r}}}, activation_fn=nn.Tanh)"
    mapping = {
        "features_extractor_class": "sb3_abisim.SSIExtractor",
        "features_extractor_kwargs": {"encoder": str(tmp_path / "mine.safetensors")},
        "net_arch": [7],
        "activation_fn": "torch.nn.Tanh",
    }
    made = []
    for kwargs in (text, mapping):
        entry = {"policy": "CnnPolicy", "n_timesteps": 7, "n_steps": 8, "batch_size": 8, "policy_kwargs": kwargs}
        (tmp_path / "custom.yml").write_text(yaml.safe_dump({"Nav2D-v0": entry}))
        made.append(effective(manager("ppo", "Nav2D-v0", str(tmp_path / "custom.yml"))))
        one = manager("ppo", "Nav2D-v0", str(tmp_path / "custom.yml"), eval_freq=-1)
        one.args = argparse.Namespace(**ARGS)
        model, saved = one.setup_experiment()
        model.env.close()
        assert model.policy.features_extractor.hash == hash and saved["policy_kwargs"] == kwargs
        record = MethodRecord.read(one.params_path)
        assert record is not None and (record.label, record.encoder_hash) == ("ssi", hash)
        # Two runs of the same hyperparameters on other encoder files have these settings in common.
        run = read_run(one.save_path)
        assert "mine.safetensors" not in str(run.settings) and "SSIExtractor" in str(run.settings)
    assert made[0] == made[1]
    assert made[0]["policy_kwargs"]["features_extractor_class"] is extractor_class("ssi")


def test_records_say_what_a_run_used(manager: Any, tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    hash = write_encoder(path, "Nav2D-v0", "ssi")
    small = {"n_envs": 2, "n_steps": 8, "batch_size": 8}
    normalize = {"normalize": "dict(norm_obs=False, norm_reward=True)"}
    ours = {"features_extractor_class": extractor_class("ssi")}
    (tmp_path / "custom.yml").write_text("Nav2D-v0: {n_timesteps: 7}\n")
    for config, kwargs, expected in (
        (f"ssi={path}", None, MethodRecord("ssi", False, str(path), hash, normalize)),
        (f"ssi={path},frozen", None, MethodRecord("ssi", True, str(path), hash, normalize)),
        (f"ssi={path},frozen,task_features_dim=4", None, MethodRecord("ssi", True, str(path), hash, normalize, 4)),
        ("vanilla", None, MethodRecord("vanilla", False, None, None, normalize)),
        ("drq", None, MethodRecord("drq", False, None, None, normalize)),
        ("vanilla,augment=random_crop", None, MethodRecord("vanilla", False, None, None, normalize, 0, "random_crop")),
        (str(tmp_path / "custom.yml"), {}, MethodRecord(None, False, None, None, {})),
        (
            str(tmp_path / "custom.yml"),
            ours | {"features_extractor_kwargs": {"encoder": path, "freeze": True}},
            MethodRecord("ssi", True, str(path), hash, {}),
        ),
    ):
        custom = {"policy_kwargs": kwargs, "policy": "CnnPolicy" if kwargs else "MlpPolicy"}
        hyperparams = small | ({} if kwargs is None else custom)
        one = manager("ppo", "Nav2D-v0", config, hyperparams=hyperparams, eval_freq=-1)
        model, _ = one.setup_experiment()
        model.env.close()
        assert MethodRecord.read(one.params_path) == expected


def test_a_missing_encoder_leaves_no_folder(manager: Any, tmp_path: Path) -> None:
    for config in ("ssi=mistyped", "ssi=mistyped,frozen"):
        for optimize in (False, True):
            one = manager("ppo", "Nav2D-v0", config, optimize_hyperparameters=optimize)
            with pytest.raises(FileNotFoundError, match="no encoder file 'mistyped'"):
                one.setup_experiment()
    assert not list(tmp_path.iterdir())


def test_names_that_others_have_imported_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in ``rl_zoo3.train --gym-packages sb3_abisim.zoo``, which has imported the manager before this package."""
    module = types.ModuleType("somebody")
    plain = MethodExperimentManager.__base__
    make_env = importlib.import_module("rl_zoo3").create_test_env.__wrapped__
    module.__dict__.update(ExperimentManager=plain, create_test_env=make_env, other=plain)
    monkeypatch.setitem(sys.modules, "somebody", module)
    install()
    assert module.ExperimentManager is MethodExperimentManager and module.other is plain
    assert module.create_test_env is importlib.import_module("rl_zoo3").create_test_env


# Evaluation on the evaluation split.


@pytest.mark.parametrize("config", [None, "vanilla", str(ROOT / "hyperparams" / "ppo.yml")])
def test_evaluation_is_on_the_eval_split(manager: Any, config: str | None) -> None:
    def kwargs(env_id: str = "DistractorPointMaze-v0", **given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        one = manager("ppo", env_id, config, **given)
        one._preprocess_hyperparams(one.read_hyperparameters()[0])
        return one.env_kwargs, one.eval_env_kwargs

    assert kwargs() == ({}, {"split": "eval"})
    assert kwargs(env_kwargs={"order": "shuffled"}) == ({"order": "shuffled"}, {"order": "shuffled", "split": "eval"})
    only = {"split": "clean", "clips": ["sea"], "reward": "binary"}
    assert kwargs(env_kwargs=only) == (only, {"reward": "binary", "split": "eval"})
    assert kwargs(eval_env_kwargs={"split": "clean"}) == ({}, {"split": "clean"})
    assert kwargs(eval_env_kwargs={"order": "shuffled"}) == ({}, {"order": "shuffled", "split": "eval"})
    both = kwargs(env_kwargs={"videos": "mine", "order": "shuffled"}, eval_env_kwargs={"order": "loop"})
    assert both[1] == {"split": "eval", "videos": "mine", "order": "loop"}
    in_yaml = {"env_kwargs": {"order": "shuffled"}}
    assert kwargs(hyperparams=in_yaml) == ({"order": "shuffled"}, {"order": "shuffled", "split": "eval"})
    # Choosing hyperparameters must not look at the evaluation clips.
    assert kwargs(optimize_hyperparameters=True, n_evaluations=1) == ({}, {})
    assert kwargs("PointMaze-v0") == ({}, {})


def test_evaluation_environments_show_the_clips_of_their_split(manager: Any) -> None:
    train, unseen = (gym.make("DistractorPointMaze-v0", split=split).unwrapped for split in ("train", "eval"))
    small = {"n_envs": 1, "n_steps": 8, "batch_size": 8}
    one = manager("ppo", "DistractorPointMaze-v0", "vanilla", eval_freq=-1, hyperparams=small)
    model, _ = one.setup_experiment()
    create_test_env = importlib.import_module("rl_zoo3").create_test_env
    envs = [
        model.env,
        one.create_envs(1, eval_env=True),
        create_test_env("DistractorPointMaze-v0", should_render=False, hyperparams={}),
    ]
    shown = [env.get_attr("content_hash")[0] for env in envs]
    for env in envs:
        env.close()
    assert shown == [train.content_hash, unseen.content_hash, unseen.content_hash]
    assert train.content_hash != unseen.content_hash


def test_enjoy_is_on_the_eval_split() -> None:
    seen: list[Any] = []

    def plain(env_id: str, n_envs: int = 1, stats_path: str | None = None, env_kwargs: Any = None) -> None:
        seen.append(env_kwargs)

    make = with_eval_split(plain)
    make("DistractorPointMaze-v0", env_kwargs={"order": "shuffled"})
    make("DistractorPointMaze-v0", env_kwargs={"split": "train"})
    make("DistractorPointMaze-v0", env_kwargs={"clips": ["sea"]})
    make("ContinuousDistractorPointMaze-v0", n_envs=2, env_kwargs=None)
    make("PointMaze-v0", env_kwargs=None)
    make("DistractorPointMaze-v0", 1, None, {"order": "shuffled"})
    assert seen == [
        {"order": "shuffled", "split": "eval"},
        {"split": "train"},
        {"clips": ["sea"]},
        {"split": "eval"},
        None,
        {"order": "shuffled", "split": "eval"},
    ]
    for name in ("rl_zoo3", "rl_zoo3.utils"):
        assert hasattr(importlib.import_module(name).create_test_env, "__wrapped__")
