"""Collecting with the model of a run."""

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Discrete
from gymnasium.wrappers import TransformAction
from zoo_inputs import run, write_encoder

from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.zoo.preprocessing import check_preprocessing

gym.register("Turned-v0", lambda: TransformAction(gym.make("Nav2D-v0"), lambda a: a - 1, Discrete(4, start=1)))
WORDS = ["-params", "n_envs:2", "n_steps:32", "batch_size:32", "--eval-freq", "-1", "-n", "64", "--verbose", "0"]


@pytest.mark.parametrize("frozen", ["", ",frozen"])
def test_the_model_of_a_run_acts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], frozen: str
) -> None:
    write_encoder(tmp_path / "e.safetensors", "Nav2D-v0")
    logs = tmp_path / "logs"
    method = f"abisim={tmp_path / 'e.safetensors'}{frozen}"
    run(monkeypatch, "train", "--algo", "ppo", "--env", "Nav2D-v0", "--conf-file", method, "-f", str(logs), *WORDS)
    folder = logs / "ppo" / "Nav2D-v0_1"
    words = ["collect", "--env", "Nav2D-v0", "-n", "60", "--n-envs", "2"]
    run(monkeypatch, *words, "-o", str(tmp_path / "d"), "--policy", str(folder))
    run(monkeypatch, *words, "-o", str(tmp_path / "e"), "--policy", str(folder / "Nav2D-v0.zip"), "--epsilon", "0.5")
    greedy, exploring = TransitionDataset(tmp_path / "d"), TransitionDataset(tmp_path / "e")
    assert greedy.meta["policy"].startswith("ppo ") and greedy.meta["policy"].endswith(", epsilon 0")
    assert exploring.meta["policy"] == greedy.meta["policy"].replace("epsilon 0", "epsilon 0.5")
    # A model of two updates always takes its favorite action; random ones are in between with epsilon.
    shares = [np.bincount(d.actions(d.valid_starts())).max() / 60 for d in (greedy, exploring)]
    assert shares[0] > shares[1]
    for policy, message in ((str(tmp_path), "no run folder"), (str(folder / "other.zip"), "there is no ")):
        with pytest.raises(SystemExit):
            run(monkeypatch, *words, "-o", str(tmp_path / "f"), "--policy", policy)
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run(monkeypatch, *words, "-o", str(tmp_path / "g"), "--policy", str(folder), "--env", "PointMaze-v0")
    assert "takes observations (3, 15, 15), and the dataset's are (3, 64, 64)" in capsys.readouterr().err
    for flags, message in (
        (
            ["--policy", str(folder), "--env", "Turned-v0"],
            r"chooses from Discrete\(4\), and .* takes Discrete\(4, start=1",
        ),
        (["--epsilon", "0.5"], "--epsilon 0.5 puts random actions .* give --policy RUN"),
    ):
        with pytest.raises(SystemExit):
            run(monkeypatch, *words, "-o", str(tmp_path / "h"), *flags)
        assert re.search(message, capsys.readouterr().err)


def test_other_wrappers_and_stacks_than_in_pretraining_are_refused() -> None:
    def check(recorded: dict[str, Any], settings: dict[str, Any], frozen: bool = False) -> None:
        check_preprocessing(EncoderFile(Path("e"), "", None, {"preprocessing": recorded}), settings, frozen)

    recorded = {"channels": "last", "env_wrapper": ["a.B"], "frame_stack": 4}
    check(recorded, {"env_wrapper": "a.B", "frame_stack": 4})
    check(recorded, {"env_wrapper": ["a.B"]}, frozen=True)
    check({}, {"env_wrapper": "a.B", "frame_stack": 2})
    with pytest.raises(
        ValueError, match=r"env_wrapper: \['a.B'\] in pretraining, \[\] now; frame_stack: 4 in .*, 1 now"
    ):
        check(recorded, {})
    with pytest.raises(ValueError, match=r"frame_stack: 4 in pretraining, 3 now"):
        check(recorded, {"env_wrapper": "a.B", "frame_stack": 3})
    with pytest.raises(ValueError, match=r"env_wrapper: \[\] in pretraining"):
        check({"channels": "last"}, {"env_wrapper": "a.B"}, frozen=True)
