"""Observations that are not what the environment declares are refused at any step; suspicious images are named."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import index_env
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_abisim.data.collect import collect, main
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.image_warning import warn_of_images
from sb3_abisim.data.importing import import_dataset
from sb3_abisim.data.rollout import Rollout

SHAPE = (3, 8, 9)
IMAGE = np.arange(216, dtype=np.uint8).reshape(SHAPE)
FACTORS = {
    "position": spaces.Box(-1, 1, (2,), np.float32),
    "count": spaces.Discrete(3),
}
GOOD = {"image": IMAGE, "position": np.zeros(2), "count": 1}


class ChangesEnv(gym.Env[Any, Any]):
    """Returns ``bad`` in place of its observation from a step on; step 0 is a reset."""

    action_space = spaces.Discrete(2)

    def __init__(self, bad: Any = None, at: int = 0, good: Any = IMAGE) -> None:
        image = spaces.Box(0, 255, SHAPE, np.uint8)
        self.observation_space = spaces.Dict({"image": image, **FACTORS}) if isinstance(good, dict) else image
        self.bad, self.at, self.good, self.n = bad, at, good, -1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        return self._observe(), 0.0, self.n % 5 == 4, False, {}

    def _observe(self) -> Any:
        self.n += 1
        if self.n < self.at or self.bad is None:
            return np.roll(self.good, self.n) if isinstance(self.good, np.ndarray) else self.good
        return self.bad


@pytest.mark.parametrize("at", [0, 3, 4, 7])
@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (IMAGE.astype(np.float32) / 255, "float32 (3, 8, 9) in 0..0.843137"),
        (np.full(SHAPE, np.nan), "float64 (3, 8, 9) with NaN"),
        (IMAGE.astype(np.int64), "int64 (3, 8, 9) in 0..215"),
        (IMAGE > 5, "bool (3, 8, 9) in"),
        (np.moveaxis(IMAGE, 0, -1), "uint8 (8, 9, 3) in"),
        (IMAGE[:, :4], "uint8 (3, 4, 9) in"),
    ],
)
def test_an_image_that_is_not_declared(bad: Any, said: str, at: int, tmp_path: Path) -> None:
    with pytest.raises(ValueError) as error:
        collect(lambda: ChangesEnv(bad, at), 40, tmp_path / "d", n_envs=2)
    expected = f"ChangesEnv declares observations as Box(0, 255, (3, 8, 9), uint8), but returned {said}"
    assert str(error.value).startswith(expected)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"image": IMAGE[0]}, "observations['image'] as Box(0, 255, (3, 8, 9), uint8), but returned uint8 (8, 9)"),
        (
            {"position": np.array([0, np.nan])},
            "observations['position'] as Box(-1.0, 1.0, (2,), float32), but returned",
        ),
        ({"position": np.array([0, 1.5])}, "float64 (2,) in 0..1.5"),
        ({"position": np.zeros(3)}, "float64 (3,) in 0..0"),
        ({"count": 3}, "observations['count'] as Discrete(3), but returned int64 () in 3..3"),
        ({"count": 0.5}, "float64 () in 0.5..0.5"),
        ({"other": 1}, "the keys ['count', 'image', 'position'], but returned ['count', 'image', 'other', 'position']"),
    ],
)
def test_a_part_that_is_not_declared(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError) as error:
        collect(lambda: ChangesEnv({**GOOD, **change}, 3, GOOD), 40, tmp_path / "d", n_envs=2)
    assert said in str(error.value)


def test_floats_of_another_width_are_as_declared(tmp_path: Path) -> None:
    images = [{**GOOD, "image": IMAGE}, {**GOOD, "image": IMAGE[::-1].copy(), "position": np.ones(2)}]
    collect(lambda: ChangesEnv(images[1], 3, images[0]), 20, tmp_path / "d", n_envs=2)


def test_a_batch_of_another_dtype(tmp_path: Path) -> None:
    class FloatVectorEnv(index_env.IndexVectorEnv):
        def _observe(self, indices: Any) -> Any:
            observations = super()._observe(indices)
            return observations.astype(np.float32) if self._step.max() > 2 else observations

    rollout = Rollout(FloatVectorEnv(4), np.random.SeedSequence(0))
    with pytest.raises(
        ValueError, match=r"FloatVectorEnv declares .* of 4 copies, but returned float32 \(4, 3, 4, 5\)"
    ):
        rollout.advance(20, 80, lambda n: None)


@pytest.mark.filterwarnings("ignore:.*The obs returned|.*is not within the observation space:UserWarning")
def test_the_command_says_it_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gym.register("Changes-v0", entry_point=ChangesEnv, kwargs={"bad": IMAGE.astype(np.int64), "at": 3})
    try:
        with pytest.raises(SystemExit) as end:
            main(["--env", "Changes-v0", "-n", "40", "-o", str(tmp_path / "d")])
    finally:
        del gym.registry["Changes-v0"]
    assert end.value.code == 2
    assert "error: Changes-v0 declares observations as Box" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("image", "cause"),
    [
        ((IMAGE > 100).astype(np.uint8), "none of 40 observations exceeds 1"),
        (np.zeros(SHAPE, np.uint8), "all 40 observations are of one value, 0"),
    ],
)
def test_images_that_are_none_are_named(image: Any, cause: str, tmp_path: Path) -> None:
    env = DummyVecEnv([lambda: ChangesEnv(good=image)] * 2)
    with pytest.warns(UserWarning, match=rf"d \(.*\): {cause}"):
        collect(env, 32, tmp_path / "d")


def test_imported_images_that_are_none_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", observations=np.stack([IMAGE] * 80), actions=np.zeros(79, np.int64), terminated=True)
    with pytest.warns(UserWarning, match="all 80 observations are the same image"):
        import_dataset("arrays", str(tmp_path / "a.npz"), tmp_path / "d")


def test_only_what_is_needed_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect(lambda: ChangesEnv(), 600, tmp_path / "d", n_envs=1)
    dataset, read = TransitionDataset(tmp_path / "d"), []
    monkeypatch.setattr(dataset, "frames", lambda index: read.append(len(index)) or np.stack([IMAGE, IMAGE[::-1]]))
    warn_of_images(dataset)
    assert read == [256]
