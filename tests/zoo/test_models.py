"""Models of runs are built from their YAML; what a zip pickles is never executed, and actions stay bit for bit."""

import base64
import contextlib
import io
import os
import pickle
import re
import shutil
import sys
import types
import zipfile
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest
import torch as th
import yaml
from benchmark_inputs import write_run
from gymnasium import spaces
from model_inputs import CASES, CONTINUOUS, ENV_ID, Execute, flat, rewrite, train, write_encoder_once
from stable_baselines3.common.env_util import make_vec_env
from zoo_inputs import run

from sb3_abisim.zoo.models import algorithm_class, load_model, model_arguments
from sb3_abisim.zoo.named import named_policy_kwargs, read_text
from sb3_abisim.zoo.run_envs import final_model, make_run_env
from sb3_abisim.zoo.runs import Run, read_run

VANILLA = {"features_extractor_class": "sb3_abisim.VanillaExtractor"}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    made = {}
    with pytest.MonkeyPatch.context() as patch:
        for name, (algo, env_id, method, words) in CASES.items():
            made[name] = train(patch, tmp_path_factory.mktemp(name), algo, env_id, method, *words)
    return made


def actions(model: Any, env: Any, deterministic: bool) -> np.ndarray:
    """Of 40 steps from the same start."""
    np.random.seed(0)
    th.manual_seed(0)
    env.seed(0)
    observations, state, started, taken = env.reset(), None, np.ones(env.num_envs, bool), []
    for _ in range(40):
        action, state = model.predict(observations, state, started, deterministic=deterministic)
        observations, _, started, _ = env.step(action)
        taken.append(action)
    return np.array(taken)


@pytest.mark.parametrize("name", CASES)
def test_actions_are_those_of_the_unpickled_model(runs: dict[str, Run], name: str) -> None:
    agree(runs[name])


def agree(made: Run) -> None:
    """The model from the YAML and the unpickled one have the same weights and numbers, and act the same."""
    rebuilt, unpickled = final_model(made), final_model(made, trust=True)
    assert type(rebuilt) is type(unpickled)
    for key, values in unpickled.get_parameters().items():
        for mine, its in zip(flat(rebuilt.get_parameters()[key]), flat(values), strict=True):
            assert mine == its
    for key in ("num_timesteps", "n_envs", "buffer_size", "n_steps", "batch_size", "exploration_rate", "_n_updates"):
        assert getattr(rebuilt, key, None) == getattr(unpickled, key, None), key
    assert rebuilt.num_timesteps > 0
    env = make_run_env(made, rebuilt, 2, made.env_kwargs, 0)
    for deterministic in (True, False):
        first, second = (actions(model, env, deterministic) for model in (rebuilt, unpickled))
        assert first.tobytes() == second.tobytes()
    env.close()


def save_run(folder: Path, env_id: str, algo: str, config: dict[str, Any], n_timesteps: int) -> Run:
    """A run as rl-zoo3 makes it of a configuration, without its command: of our extractor, from random weights."""
    folder = write_run(folder, env_id, "vanilla", 0, [100], np.zeros((1, 2)), algo=algo)
    config = {"policy_kwargs": VANILLA, **config}
    (folder / env_id / "config.yml").write_text(yaml.dump(config))
    env = make_vec_env(env_id, config["n_envs"], seed=0)
    arguments = model_arguments(algo, config, env.action_space, "config.yml")
    del arguments["n_envs"]
    model = algorithm_class(algo)(env=env, seed=1, device="cpu", **arguments)
    model.learn(n_timesteps)
    model.save(folder / f"{env_id}.zip")
    return read_run(folder)


@pytest.mark.parametrize(
    ("env_id", "algo", "config"),
    [
        (ENV_ID, "qrdqn", {"policy": "CnnPolicy", "buffer_size": 300, "learning_starts": 20}),
        (ENV_ID, "ppo_lstm", {"policy": "CnnLstmPolicy", "n_steps": 16, "batch_size": 16}),
        (ENV_ID, "a2c", {"policy": "CnnPolicy", "policy_kwargs": "dict(optimizer_class=RMSpropTFLike, optimizer_kwargs="
                         "dict(eps=1e-5), activation_fn=nn.ELU, net_arch=dict(pi=[8], vf=[16]), "
                         "features_extractor_class=get_class_by_name('sb3_abisim.VanillaExtractor'))"}),
        (CONTINUOUS, "a2c", {"policy": "CnnPolicy", "use_sde": True}),
        (CONTINUOUS, "tqc", {"policy": "CnnPolicy", "buffer_size": 60, "learning_starts": 40, "batch_size": 4}),
        (CONTINUOUS, "td3", {"policy": "CnnPolicy", "buffer_size": 60, "learning_starts": 40, "batch_size": 4,
                             "noise_type": "normal", "noise_std": 0.1, "train_freq": [1, "step"]}),
    ],
)  # fmt: skip
def test_other_algorithms(tmp_path: Path, env_id: str, algo: str, config: dict[str, Any]) -> None:
    agree(save_run(tmp_path, env_id, algo, {"n_envs": 2, **config}, 64))


@pytest.fixture
def copied(runs: dict[str, Run], tmp_path: Path, request: pytest.FixtureRequest) -> Run:
    """A run that a test may damage."""
    name = getattr(request, "param", "ppo")
    folder = tmp_path / "copy" / f"{runs[name].env_name}_1"
    shutil.copytree(runs[name].folder, folder)
    return read_run(folder)


def pickled(value: Any) -> str:
    return base64.b64encode(cloudpickle.dumps(value)).decode()


@pytest.mark.parametrize("copied", ["ppo-frozen"], indirect=True)
def test_no_command_executes_a_model(copied: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marker = tmp_path / "executed"
    path = copied.folder / f"{ENV_ID}.zip"

    def plant(data: dict[str, Any]) -> None:
        for name in ("policy_class", "policy_kwargs", "lr_schedule", "learning_rate", "ep_info_buffer"):
            data[name] = {":type:": "", ":serialized:": pickled(Execute(marker))}

    rewrite(path, plant)
    collected = ["collect", "--env", ENV_ID, "-n", "20", "--n-envs", "2", "-o", str(tmp_path / "d")]
    commands = [
        ["record", str(copied.folder), "-o", str(tmp_path / "a.gif"), "--episodes", "1"],
        ["benchmark", "evaluate", str(copied.folder), "--episodes", "1"],
        ["merge", str(path), "--algo", "ppo", "-o", str(tmp_path / "m.zip")],
        [*collected, "--policy", str(copied.folder)],
    ]
    for words in commands:
        run(monkeypatch, *words)
        assert not marker.exists(), words
    for words in commands:
        # It is there, and waits for those who trust it.
        marker.unlink(missing_ok=True)
        with contextlib.suppress(SystemExit, Exception):
            run(monkeypatch, *words, "--trust")
        assert marker.exists(), words


def test_a_space_is_a_space(copied: Run, tmp_path: Path) -> None:
    marker, path = tmp_path / "executed", copied.folder / f"{ENV_ID}.zip"
    wrong = spaces.Box(0, 255, (3, 15, 15), np.uint8)
    wrong._shape = (3, 10**6, 10**6)
    for value, message in (
        (Execute(marker), "calls pathlib.* which is not among"),
        (os.system, "names posix.system, which is not among"),
        (np.zeros(3), "a ndarray is no space"),
        (wrong, "bounds of a Box have another shape"),
    ):
        rewrite(path, lambda data, value=value: data["action_space"].update({":serialized:": pickled(value)}))
        with pytest.raises(ValueError, match=message):
            load_model(path, copied)
    rewrite(path, lambda data: data.pop("action_space"))
    with pytest.raises(ValueError, match=r"says nothing of its spaces.*--trust unpickles it"):
        load_model(path, copied)
    assert not marker.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policy": "os.system"}, "config.yml names 'os.system' as a policy, which is no BasePolicy"),
        ({"policy": "antigravity.Policy"}, "'antigravity.Policy' of a package that is not imported; .*--packages anti"),
        ({"policy": "unittest.__main__.main"}, "which is no dotted path"),
        ({"policy": 7}, "the policy 7"),
        ({"policy_kwargs": {"activation_fn": "subprocess.Popen"}}, "as a activation_fn, which is no Module"),
        ({"policy_kwargs": {"optimizer_class": "torch.nn.ReLU"}}, "which is no Optimizer"),
        ({"policy_kwargs": "dict(x=__import__('os').system('false'))"}, "only dict"),
        ({"policy_kwargs": "(lambda: 1)()"}, "only dict"),
        ({"policy_kwargs": "[" * 5000}, "only dict"),
        ({"policy_kwargs": "dict(net_arch=" + "[" * 300 + "]" * 300 + ")"}, "only dict|cannot be built"),
        ({"policy_kwargs": ["x"]}, "must be a mapping"),
        (
            {"policy_kwargs": {**VANILLA, "features_extractor_kwargs": {"network": "antigravity:Net"}}},
            "names the network 'antigravity:Net'; if you trust it, add --packages antigravity:Net",
        ),
        ({"policy_kwargs": {**VANILLA, "net_arch": [10**9]}}, "larger networks than the file has weights for"),
        ({"policy_kwargs": {**VANILLA, "net_arch": [7]}}, "cannot be built .*size mismatch|Missing key"),
        ({"learning_rate": [1]}, "Invalid value for learning_rate"),
        ({"gamma": {"a": 1}, "n_envs": "many"}, "cannot be built"),
    ],
)  # fmt: skip
def test_a_configuration_executes_and_imports_nothing(copied: Run, change: dict[str, Any], message: str) -> None:
    path = copied.folder / ENV_ID / "config.yml"
    config = yaml.safe_load(path.read_text().replace("!!python/object/apply:collections.OrderedDict", ""))
    config = dict(config[0]) if isinstance(config, list) else config
    path.write_text(yaml.dump({**config, **change}))
    with pytest.raises(ValueError, match=message) as refused:
        load_model(copied.folder / f"{ENV_ID}.zip", copied)
    assert "antigravity" not in sys.modules and "\n" not in str(refused.value)


def test_a_package_that_the_user_named() -> None:
    kwargs = {"activation_fn": "toy_package.Act"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "toy_package", types.SimpleNamespace(Act=type("Act", (th.nn.ReLU,), {})))
        assert named_policy_kwargs(kwargs, "config.yml")["activation_fn"].__name__ == "Act"
    with pytest.raises(ValueError, match=r"'toy_package\.Act' of a package that is not imported"):
        named_policy_kwargs(kwargs, "config.yml")


def test_nothing_is_downloaded_because_a_file_names_it() -> None:
    kwargs = named_policy_kwargs({"features_extractor_kwargs": {"encoder": "hf://a/b/c.safetensors"}}, "config.yml")
    assert kwargs["features_extractor_kwargs"]["encoder"] == "(the saved model has the weights of a/b/c.safetensors)"


def test_texts_of_the_zoo() -> None:
    text = "dict(net_arch=dict(pi=[64, 2], vf=()), log_std_init=-2.5, ortho_init=False, activation_fn=th.nn.Tanh)"
    assert read_text(text, "config.yml") == {
        "net_arch": {"pi": [64, 2], "vf": ()}, "log_std_init": -2.5, "ortho_init": False,
        "activation_fn": "torch.nn.Tanh",
    }  # fmt: skip
    assert read_text("{'norm_obs': False}", "config.yml") == {"norm_obs": False}


def test_weights_are_bounded_by_the_zip(copied: Run) -> None:
    path = copied.folder / f"{ENV_ID}.zip"
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        weights = th.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
    buffer = io.BytesIO()
    th.save({**weights, "action_net.bias": th.zeros(1).expand(10**9)}, buffer)
    for changes, message in (
        ({"policy.pth": buffer.getvalue()}, "no plain tensors"),
        ({"policy.pth": pickle.dumps(Execute(path))}, "is damaged or no model"),
        ({"more.pth": b""}, "is damaged or no model"),
    ):
        rewrite(path, **changes)
        with pytest.raises(ValueError, match=message):
            load_model(path, copied)
        path.write_bytes(whole)
    rewrite(path, None, zipfile.ZIP_DEFLATED, more=bytes(10**7))
    with pytest.raises(ValueError, match="holds more than its size"):
        load_model(path, copied)
    for end in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:end])
        with pytest.raises(ValueError, match=r"is damaged or no model of Stable-Baselines3 \(.*\); copy it again"):
            load_model(path, copied)


def test_a_zip_outside_of_a_run(
    copied: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(copied.folder / f"{ENV_ID}.zip", tmp_path / "m.zip")
    encoder = write_encoder_once(tmp_path, ENV_ID)
    words = [str(tmp_path / "m.zip"), "-o", str(tmp_path / "o.zip"), "-e", str(encoder)]
    for algo, more, message in (
        ("ppo", [], "lies in no folder of a run, .*--trust unpickles it"),
        ("ppo", ["--trust"], "not on the embeddings of an encoder"),
        ("none", [], "unknown algorithm 'none'"),
    ):
        with pytest.raises(SystemExit):
            run(monkeypatch, "merge", *words, "--algo", algo, *more)
        assert re.search(message, capsys.readouterr().err)
    with pytest.raises(SystemExit):
        run(monkeypatch, "merge", str(copied.folder / f"{ENV_ID}.zip"), *words[1:], "--algo", "dqn")
    assert "is a model of ppo, not dqn; give --algo ppo" in capsys.readouterr().err
