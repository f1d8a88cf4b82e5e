"""Zoo runs that are started together get folders of their own; one that meets NaN saves no model."""

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import pytest
from zoo_inputs import SMALL, run

from sb3_abisim.rl.merge import merge_encoder
from sb3_abisim.zoo import merge as merge_command
from sb3_abisim.zoo.manager import MethodExperimentManager


def test_each_claims_a_folder(tmp_path: Path) -> None:
    """All have counted before any makes its folder."""
    log_path = f"{tmp_path}/ppo/"
    managers = [
        SimpleNamespace(log_path=log_path, save_path=f"{log_path}Nav2D-v0_1", env_name="Nav2D-v0") for _ in range(8)
    ]
    barrier = threading.Barrier(len(managers))

    def claim(manager: Any) -> None:
        barrier.wait()
        MethodExperimentManager._claim_folder(manager)

    threads = [threading.Thread(target=claim, args=[manager]) for manager in managers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(Path(manager.save_path).name for manager in managers) == [f"Nav2D-v0_{k}" for k in range(1, 9)]
    assert sum(hasattr(manager, "params_path") for manager in managers) == 7


def test_a_manager_whose_folder_was_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = MethodExperimentManager._make_record

    def taken(manager: MethodExperimentManager) -> Any:
        (tmp_path / "ppo" / "Nav2D-v0_1").mkdir(parents=True, exist_ok=True)
        return make(manager)

    monkeypatch.setattr(MethodExperimentManager, "_make_record", taken)
    words = ["--algo", "ppo", "--env", "Nav2D-v0", "-f", str(tmp_path), "--conf-file", "vanilla", "-n", "64"]
    run(monkeypatch, "train", *words, "--eval-freq", "-1", "--num-threads", "1", "-params", *SMALL["ppo"])
    assert not list((tmp_path / "ppo" / "Nav2D-v0_1").iterdir())
    names = {path.name for path in (tmp_path / "ppo" / "Nav2D-v0_2").iterdir()}
    assert {"Nav2D-v0", "Nav2D-v0.zip", "0.monitor.csv", "hashes.json"} <= names


def test_nan_rewards_end_a_run_of_dqn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Broken(gym.RewardWrapper):
        def reward(self, reward: Any) -> float:
            return float("nan")

    plain = gym.envs.registration.EnvSpec.make
    monkeypatch.setattr(gym.envs.registration.EnvSpec, "make", lambda *a, **k: Broken(plain(*a, **k)))
    words = ["--algo", "dqn", "--env", "Nav2D-v0", "-f", str(tmp_path), "--conf-file", "vanilla", "-n", "100"]
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, "train", *words, "--eval-freq", "-1", "--num-threads", "1", "-params", *SMALL["dqn"])
    err = capsys.readouterr().err.splitlines()[-1]
    assert stopped.value.code == 1 and err.startswith("sb3-abisim train: reward is NaN or infinite at step 1, and")
    assert not list(tmp_path.rglob("*.zip"))


def test_merge_keeps_the_old_file_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "model.zip").write_bytes(b"model")
    (tmp_path / "merged.zip").write_bytes(b"old")

    class Merged:
        def save(self, file: Any) -> None:
            file.write(bytes(10))
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(merge_command, merge_encoder.__name__, lambda *_: Merged())
    monkeypatch.setattr(merge_command, "_model", lambda _: None)
    words = [str(tmp_path / "model.zip"), "-o", str(tmp_path / "merged.zip"), "--algo", "ppo", "-e", "e"]
    with pytest.raises(SystemExit) as stopped:
        merge_command.main(words)
    assert stopped.value.code == 1 and (tmp_path / "merged.zip").read_bytes() == b"old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["merged.zip", "model.zip"]
