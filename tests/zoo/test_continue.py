"""Training that goes on from a saved model: the same to the bit as from the unpickled one, and nothing is executed."""

import base64
import pickle
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from model_inputs import CASES, Execute, flat, rewrite, train
from stable_baselines3.common.vec_env import VecNormalize
from zoo_inputs import SMALL, run

from sb3_abisim.zoo.manager import MethodExperimentManager
from sb3_abisim.zoo.models import unpickled_model
from sb3_abisim.zoo.runs import Run

# An algorithm with a buffer, exploration and noise, one on a frozen encoder, one whose rewards are normalized.
NOISY = [*SMALL["sac"], "noise_type:normal", "noise_std:0.1", "learning_rate:lin_0.0003", "ent_coef:auto_0.1"]
NAMES = {**{name: CASES[name] for name in ("dqn", "ppo-frozen", "ppo-normalized")},
         "sac-noise": ("sac", "ContinuousPointMaze-v0", ",frozen", NOISY)}  # fmt: skip


def go_on(patch: pytest.MonkeyPatch, made: Run, name: str, logs: Path, *more: str) -> Path:
    algo, env_id, method, words = NAMES[name]
    encoder = made.folder.parents[1] / "e.safetensors"
    flags = ["--algo", algo, "--env", env_id, "-f", str(logs), "--conf-file", f"abisim={encoder}{method}"]
    model = made.folder / f"{env_id}.zip"
    more_flags = ["-i", str(model), "-n", "300", "--eval-freq", "-1", "--num-threads", "1", "--seed", "7"]
    run(patch, "train", *flags, *more_flags, *more, "-params", *words)
    return logs / algo / f"{env_id}_1"


@pytest.mark.parametrize("name", NAMES)
def test_it_goes_on_to_the_bit(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    algo, env_id, method, words = NAMES[name]
    made = train(monkeypatch, tmp_path / "before", algo, env_id, method, *words)
    folders = [
        go_on(monkeypatch, made, name, tmp_path / which, *more)
        for which, more in (("rebuilt", ()), ("unpickled", ("--trust",)))
    ]
    rebuilt, unpickled = (unpickled_model(folder / f"{env_id}.zip", algo) for folder in folders)
    before = unpickled_model(made.folder / f"{env_id}.zip", algo)
    for key, values in unpickled.get_parameters().items():
        assert flat(rebuilt.get_parameters()[key]) == flat(values)
    assert flat(rebuilt.get_parameters()["policy"]) != flat(before.get_parameters()["policy"])
    left_out = ("start_time", "tensorboard_log", "_last_obs", "_last_original_obs", "ep_info_buffer")
    for attribute, value in vars(unpickled).items():
        if isinstance(value, int | float | str | bool) and attribute not in left_out:
            assert getattr(rebuilt, attribute) == value, attribute
    means = [folder / env_id / "vecnormalize.pkl" for folder in folders]
    assert means[0].is_file() == name.startswith("ppo")
    if means[0].is_file():
        first, second = (pickle.loads(path.read_bytes()) for path in means)
        assert isinstance(first, VecNormalize)
        assert (first.ret_rms.mean, first.ret_rms.var) == (second.ret_rms.mean, second.ret_rms.var)


def test_means_stay_as_they_are_in_evaluations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    algo, env_id, method, words = NAMES["ppo-normalized"]
    made = train(monkeypatch, tmp_path / "before", algo, env_id, method, *words)
    shown: list[tuple[bool, bool, bool]] = []
    real = MethodExperimentManager._maybe_normalize

    def watched(manager: Any, env: Any, eval_env: bool) -> Any:
        normalized = real(manager, env, eval_env)
        shown.append((eval_env, normalized.training, normalized.norm_reward))
        return normalized

    monkeypatch.setattr(MethodExperimentManager, "_maybe_normalize", watched)
    go_on(monkeypatch, made, "ppo-normalized", tmp_path / "after", "--eval-freq", "150", "--eval-episodes", "1")
    assert set(shown) == {(True, False, False), (False, True, True)}


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        ("model", "cannot be built from config.yml and its weights alone"),
        ("buffer", "replay_buffer.pkl is a pickle, which executes whatever it holds; add --trust for yours"),
        ("means", "vecnormalize.pkl is damaged or holds more than means"),
        ("moved", "lies in no folder of a run, whose YAML would say how to build it"),
        ("algorithm", "is a model of dqn, not qrdqn; give --algo dqn"),
        ("environment", "was trained in another environment"),
        ("memory", "it was trained with optimize_memory_usage, which is not given now"),
    ],
)
def test_what_is_refused(
    harm: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    algo, env_id, _, words = NAMES["dqn"]
    made, marker = train(monkeypatch, tmp_path / "before", algo, env_id, "", *words), tmp_path / "executed"
    model, poison = made.folder / f"{env_id}.zip", pickle.dumps(Execute(marker))
    flags = {"algo": algo, "env": env_id}
    if harm == "model":
        serialized = base64.b64encode(poison).decode()
        rewrite(model, lambda data: data.update(action_space={":type:": "", ":serialized:": serialized}))
    elif harm == "buffer":
        (made.folder / "replay_buffer.pkl").write_bytes(poison)
    elif harm == "means":
        (made.folder / env_id / "vecnormalize.pkl").write_bytes(poison)
    elif harm == "moved":
        model = Path(shutil.copy(model, tmp_path / "alone.zip"))
    elif harm == "memory":
        config = made.folder / env_id / "config.yml"
        config.write_text(config.read_text().rstrip() + "\n  - - optimize_memory_usage\n    - true\n")
        (made.folder / "hashes.json").unlink()
    elif harm == "algorithm":
        flags["algo"] = "qrdqn"
    else:
        flags["env"] = "PointMaze-v0"
    custom = tmp_path / "custom.yml"
    custom.write_text(f"{flags['env']}:\n  policy: CnnPolicy\n  n_timesteps: 100\n  buffer_size: 50\n")
    with pytest.raises(SystemExit) as stopped:
        words = ["--algo", flags["algo"], "--env", flags["env"], "-f", str(tmp_path / "after"), "-i", str(model)]
        run(
            monkeypatch,
            "train",
            *words,
            "--conf-file",
            str(custom),
            "-n",
            "50",
            "--eval-freq",
            "-1",
            "--num-threads",
            "1",
        )
    error = capsys.readouterr().err
    last = error.rstrip().rpartition("\n")[2]
    assert stopped.value.code == 2 and re.search(re.escape(message), last) and not marker.exists()
    assert not MethodExperimentManager.builds_from_yaml
