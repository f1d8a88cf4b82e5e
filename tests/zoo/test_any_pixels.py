"""The three commands on environments of odd shapes, from the command line to an agent that is evaluated."""

import gc
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from torch import nn
from zoo_inputs import SMALL, run

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.zoo import entries, manager
from sb3_abisim.zoo.evaluate import evaluate_final
from sb3_abisim.zoo.method_record import MethodRecord
from sb3_abisim.zoo.record import record
from sb3_abisim.zoo.run_envs import final_model
from sb3_abisim.zoo.runs import read_run

LENGTH = 5


class OddEnv(gym.Env[Any, Any]):
    """Noise of any shape, with any actions; ``vector`` puts it into a Dict, ``text`` beside a text."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}

    def __init__(
        self, shape: tuple[int, ...] = (40, 56, 3), actions: str = "discrete", vector: bool = False, text: bool = False,
        floats: bool = False, dtype: str = "uint8", render_mode: str | None = None,
    ) -> None:  # fmt: skip
        image = (
            spaces.Box(0, 1, tuple(shape), np.float32)
            if floats
            else spaces.Box(0, 255, tuple(shape), np.dtype(dtype).type)
        )
        parts: dict[str, Any] = {"eye": image, "arm": spaces.Box(-1, 1, (3,)), "door": spaces.Discrete(2)}
        parts |= {"words": spaces.Text(4)} if text else {}
        self.observation_space = spaces.Dict(parts) if vector or text else image
        self.action_space = {
            "discrete": spaces.Discrete(3),
            "start": spaces.Discrete(3, start=2),
            "box": spaces.Box(np.float32([-2, 0]), np.float32([2, 1])),
            "multi_discrete": spaces.MultiDiscrete([2, 3]),
            "multi_binary": spaces.MultiBinary(2),
        }[actions]
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        self.n = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), action
        self.n += 1
        return self.observation_space.sample(), 1.0, False, self.n == LENGTH, {}

    def render(self) -> np.ndarray:
        return np.zeros((20, 30, 3), np.uint8)


gym.register("Odd-v0", entry_point=OddEnv)

CASES: dict[str, tuple[list[str], list[str], str]] = {
    # Of the environment, more for both commands as -params has it, and of the algorithm.
    "gray, stacked": (["shape:[40, 48, 1]"], ["frame_stack:4"], "ppo"),
    "gray, channels last": (["shape:[37, 90, 1]"], [], "dqn"),
    "two channels, smaller than nature": (["shape:[2, 9, 17]", "actions:multi_discrete"], [], "ppo"),
    "five channels, box": (["shape:[36, 41, 5]", "actions:box"], [], "sac"),
    "tiny, stacked, multi binary": (["shape:[7, 7, 3]", "actions:multi_binary"], ["frame_stack:2"], "ppo"),
    "a Dict": (["shape:[12, 16, 3]", "vector:true"], [], "ppo"),
    "a Dict, stacked": (
        ["shape:[16, 12, 3]", "vector:true", "actions:box"],
        ["frame_stack:2", "env_wrapper:{gymnasium.wrappers.FilterObservation: {filter_keys: [eye, arm]}}"],
        "sac",
    ),
    "floats": (
        ["shape:[12, 16, 3]", "floats:true"],
        [
            "env_wrapper:[{gymnasium.wrappers.RescaleObservation: {min_obs: 0, max_obs: 255}}, "
            "{gymnasium.wrappers.DtypeObservation: {dtype: uint8}}]"
        ],
        "ppo",
    ),
    "actions counted from 2": (["shape:[12, 16, 3]", "actions:start"], ["env_wrapper:sb3_abisim.PlainActions"], "dqn"),
    "integers": (
        ["shape:[12, 16, 3]", "dtype:int64"],
        [
            "env_wrapper:[{gymnasium.wrappers.DtypeObservation: {dtype: float32}}, "
            "{gymnasium.wrappers.RescaleObservation: {min_obs: 0, max_obs: 255}}, "
            "{gymnasium.wrappers.DtypeObservation: {dtype: uint8}}]"
        ],
        "ppo",
    ),
    "wrapped": (
        ["shape:[64, 64, 3]"],
        ["env_wrapper:{gymnasium.wrappers.GrayscaleObservation: {keep_dim: true}}"],
        "ppo",
    ),
}


def commands(folder: Path, kwargs: list[str], params: list[str], algo: str, frozen: bool = False) -> list[list[str]]:
    flags = [
        part for word in params for part in (f"--{word.partition(':')[0]}".replace("_", "-"), word.partition(":")[2])
    ]
    env = ["--env", "Odd-v0", "--env-kwargs", *kwargs]
    encoder = str(folder / "e.safetensors")
    train = ["train", "--algo", algo, *env, "--conf-file", f"ssi={encoder}{',frozen' * frozen}", "-n", "64"]
    train += ["-f", str(folder / "logs"), "--eval-freq", "-1", "--num-threads", "1", "--verbose", "0"]
    return [
        ["collect", *env, *flags, "-n", "60", "--n-envs", "2", "-o", str(folder / "d")],
        ["pretrain", "--objective", "ssi", "--data", str(folder / "d"), "-o", encoder, "--verbose", "0", "-params",
         "n_updates:1", "batch_size:8", "log_interval:1", "checkpoint_interval:1"],
        [*train, "-params", *SMALL[algo], *params],
    ]  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_collect_pretrain_train_evaluate_record(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if "DtypeObservation" in str(CASES[name]) and gym.__version__ < "1.4":
        pytest.skip("gymnasium before 1.4 takes no dtype by name")
    for words in commands(tmp_path, *CASES[name]):
        run(monkeypatch, *words)
    folder = tmp_path / "logs" / CASES[name][2] / "Odd-v0_1"
    hash = load_encoder(tmp_path / "e.safetensors").hash
    written = MethodRecord.read(folder / "Odd-v0")
    assert written is not None and (written.label, written.encoder_hash) == ("ssi", hash)
    extractors = find_extractors(final_model(read_run(folder)).policy)
    assert extractors and all(extractor.hash == hash for _, extractor in extractors)
    assert np.load(evaluate_final(folder, 2))["deterministic/standard/ep_lengths"].tolist() == [LENGTH] * 2
    record(folder, tmp_path / "a.gif", n_episodes=1)


@pytest.mark.parametrize("name", ["a Dict", "tiny, stacked, multi binary"])
def test_frozen(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for words in commands(tmp_path, *CASES[name], frozen=True):
        run(monkeypatch, *words)
    folder = tmp_path / "logs" / CASES[name][2] / "Odd-v0_1"
    written = MethodRecord.read(folder / "Odd-v0")
    assert written is not None and written.label == "ssi,frozen"
    assert all(extractor.frozen for _, extractor in find_extractors(final_model(read_run(folder)).policy))
    assert np.load(evaluate_final(folder, 2))["deterministic/standard/ep_lengths"].tolist() == [LENGTH] * 2


@pytest.mark.parametrize("frozen", [False, True])
def test_an_entry_of_the_zoo_whose_policy_kwargs_are_a_text(
    frozen: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of CarRacing, for one: what is saved says all that the model is made of."""
    entry = {"normalize": "dict(norm_obs=False, norm_reward=True)", "policy": "CnnPolicy", "n_timesteps": 64}
    entry["policy_kwargs"] = "dict(log_std_init=-2, activation_fn=nn.GELU, net_arch=dict(pi=[7], vf=[8]), )"
    (tmp_path / "ppo.yml").write_text(yaml.dump({"Odd-v0": entry}))
    for module in (entries, manager):
        monkeypatch.setattr(module, "zoo_hyperparams", lambda: tmp_path)
    for words in commands(tmp_path, ["shape:[37, 41, 3]", "actions:box"], [], "ppo", frozen):
        run(monkeypatch, *words)
    folder = tmp_path / "logs" / "ppo" / "Odd-v0_1"
    policy = final_model(read_run(folder)).policy
    heads = policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net
    assert [head[0].out_features for head in heads] == [7, 8]
    assert all(isinstance(head[1], nn.GELU) for head in heads)
    assert bool(find_extractors(policy)) != frozen
    assert np.load(evaluate_final(folder, 2))["deterministic/standard/ep_lengths"].tolist() == [LENGTH] * 2
    record(folder, tmp_path / "a.gif", n_episodes=1)


@pytest.mark.parametrize(
    ("kwargs", "params", "step", "message"),
    [
        (["shape:[12]"], [], 0, "gymnasium.wrappers.AddRenderObservation --env-kwargs render_mode:rgb_array"),
        (["shape:[12, 12, 3]"], ["env_wrapper:gymnasium.wrappers.AddRenderObservation"], 0, "render_mode:rgb_array"),
        (["shape:[6, 7, 3]"], ["frame_stack:3"], 0, "stack fewer, or enlarge the observations"),
        (["shape:[3, 12, 12]", "text:true"], [], 2, "words (Text) have no numbers; keep the others only"),
        (["shape:[16, 12, 3]", "vector:true"], ["frame_stack:2"], 2, "door (Discrete) cannot be stacked; keep"),
        (["shape:[40, 48]"], [], 2, "ReshapeObservation: {shape: [40, 48, 1]}"),
        (["actions:start"], [], 2, "Discrete(3, start=2); wrap the environment in sb3_abisim.PlainActions"),
        (["shape:[12, 16, 3]", "floats:true"], [], 0, 'RescaleObservation: {min_obs: 0, max_obs: 255}" "gymnasium'),
        (["shape:[12, 16, 3]", "dtype:int64"], [], 0, 'DtypeObservation: {dtype: float32}" "gymnasium.wrappers.Resc'),
        (["shape:[0, 7, 3]"], [], 0, "(0, 7, 3), uint8); a wrapper makes images"),
        (["hape:[2, 3]"], [], 0, "; correct --env-kwargs, or env_kwargs of the zoo's entry"),
        (["shape:[2, 3, 4, 5]"], [], 0, "observations must be uint8 images"),
    ],
)  # fmt: skip
def test_refusals_name_the_remedy(
    kwargs: list[str], params: list[str], step: int, message: str, tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    *before, refused = commands(tmp_path, kwargs, params, "ppo")[: step + 1]
    for words in before:
        run(monkeypatch, *words)
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, *refused)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert message in line


def test_a_wrapper_of_actions_may_be_added_in_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It changes no observation. Another wrapper does, and the remedy keeps the one of actions."""
    *before, train = commands(tmp_path, ["shape:[12, 16, 3]", "actions:start"], [], "ppo")
    for words in before:
        run(monkeypatch, *words)
    run(monkeypatch, *train, "env_wrapper:sb3_abisim.PlainActions")
    folder = tmp_path / "logs" / "ppo" / "Odd-v0_1"
    assert np.load(evaluate_final(folder, 2))["deterministic/standard/ep_lengths"].tolist() == [LENGTH] * 2
    other = "{gymnasium.wrappers.ReshapeObservation: {shape: [12, 16, 3]}}"
    with pytest.raises(SystemExit):
        run(monkeypatch, *train, f"env_wrapper:[{other}, sb3_abisim.PlainActions]", "frame_stack:2")
    error = capsys.readouterr().err
    assert "add -params 'env_wrapper:['\"'\"'sb3_abisim.PlainActions'\"'\"']' frame_stack:1, or" in error


# rl-zoo3 leaves monitor files open.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_algorithm_for_other_actions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    *before, train = commands(tmp_path, ["shape:[12, 16, 3]", "actions:multi_binary"], [], "dqn")
    for words in before:
        run(monkeypatch, *words)
    with pytest.raises(SystemExit):
        run(monkeypatch, *train)
    error = capsys.readouterr().err
    assert "but MultiBinary(2) was provided; give an --algo for such actions, ppo or a2c for any" in error
    gc.collect()  # here rather than in a later test


def test_rewards_are_not_normalized_behind_a_replay_buffer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Stable-Baselines3's would get images with channels last, and fail at the first step."""
    *before, train = commands(tmp_path, ["shape:[12, 16, 3]"], [], "dqn")
    for words in before:
        run(monkeypatch, *words)
    with pytest.raises(SystemExit):
        run(monkeypatch, *train, "normalize:{norm_obs: false}")
    assert "replay buffer of dqn cannot hold images with channels last" in capsys.readouterr().err
    run(monkeypatch, *train, "normalize:False")
