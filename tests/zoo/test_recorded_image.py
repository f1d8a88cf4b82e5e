"""An encoder of somebody's recording, used in an environment whose image has another name."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from lerobot_inputs import CAMERA, SIZE, write_lerobot
from zoo_inputs import SMALL, run

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.zoo.method_record import MethodRecord
from sb3_abisim.zoo.run_envs import final_model
from sb3_abisim.zoo.runs import read_run

ENV_ID = "test/Arm-v0"


class ArmEnv(gym.Env[Any, Any]):
    """Two cameras of the recording's size, with names of their own, and the state."""

    observation_space = spaces.Dict(
        {
            **{name: spaces.Box(0, 255, (*SIZE, 3), np.uint8) for name in ("front", "top")},
            "state": spaces.Box(-1, 1, (2,)),
        }
    )
    action_space = spaces.Box(-1000, 1000, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self._step = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        self._step += 1
        return self.observation_space.sample(), 0.0, False, self._step == 8, {}


gym.register(ENV_ID, entry_point=ArmEnv)


@pytest.fixture
def encoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    folder, file = str(write_lerobot(tmp_path / "arm")), str(tmp_path / "e.safetensors")
    run(monkeypatch, "data", "import", "lerobot", folder, "-o", str(tmp_path / "d"), "--image-key", CAMERA,
        "--env", ENV_ID)  # fmt: skip
    run(monkeypatch, "pretrain", "--objective", "ssi", "--data", str(tmp_path / "d"), "-o", file, "--verbose", "0",
        "-params", "n_updates:1", "batch_size:4", "log_interval:1", "checkpoint_interval:1",
        "eval_fraction:0")  # fmt: skip
    return file


def test_the_image_is_named_where_the_encoder_is_used(
    encoder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "image_key" not in load_encoder(encoder).metadata["preprocessing"]
    words = ["--algo", "ppo", "--env", ENV_ID, "--conf-file", f"ssi={encoder}", "-n", "64", "--eval-freq", "-1",
             "--num-threads", "1", "--verbose", "0", "-f"]  # fmt: skip
    params = ["-params", *SMALL["ppo"], "normalize:False"]
    for command in (
        ["train", *words, str(tmp_path / "refused"), *params],
        ["analyze", "neighbors", encoder, "--env", ENV_ID],
    ):
        with pytest.raises(SystemExit):
            run(monkeypatch, *command)
        assert "2 images (front, top)" in (said := capsys.readouterr().err) and "choose one with --image-key" in said
    run(monkeypatch, "train", *words, str(tmp_path / "logs"), "--image-key", "top", *params)
    folder = tmp_path / "logs" / "ppo" / "test-Arm-v0_1"
    written = MethodRecord.read(folder / "test-Arm-v0")
    assert written is not None and written.preprocessing["image_key"] == "top"
    assert written.encoder_hash == load_encoder(encoder).hash
    assert all(name.endswith(".extractors.top") for name, _ in find_extractors(final_model(read_run(folder)).policy))
    run(monkeypatch, "analyze", "neighbors", encoder, "--env", ENV_ID, "--image-key", "top", "-n", "8",
        "--images", str(tmp_path))  # fmt: skip
    assert (tmp_path / "neighbors-test-Arm-v0.png").is_file()
