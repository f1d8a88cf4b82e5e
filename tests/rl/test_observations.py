"""Observations that are not images in 0..255 stop an agent, or are named, at any step."""

import re
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import EvalCallback, EveryNTimesteps
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper

from sb3_abisim import EncoderExtractor, VanillaExtractor
from sb3_abisim.rl.callbacks import EncoderCallback
from sb3_abisim.rl.vec_encode import VecEncodeObservations

ENCODER = "Nav2D-v0/abisim"
SPACE = spaces.Box(0, 255, (3, 15, 15), np.uint8)


class Images(gym.Env[Any, Any]):
    """Random images between two values."""

    observation_space = SPACE
    action_space = spaces.Discrete(2)

    def __init__(self, low: int = 0, high: int = 255) -> None:
        self.low, self.high = low, high

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> Any:
        return self.np_random.integers(self.low, self.high, SPACE.shape, np.uint8, endpoint=True)


class Invert(gym.ObservationWrapper[Any, Any, Any]):
    def observation(self, observation: Any) -> Any:
        return 255 - observation


class Breaks(VecEnvWrapper):
    """Returns ``value`` among its numbers from the given step on, as a VecEnv without buffers of its own may."""

    def __init__(self, venv: Any, value: float, at: int) -> None:
        super().__init__(venv)
        self.value, self.at, self.n = value, at, 0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, *rest = self.venv.step_wait()
        self.n += 1
        if self.n >= self.at:
            observations = observations.astype(np.float32)
            observations[0, 0, 0, 0] = self.value
        return observations, *rest


def venv(n: int = 2, *args: Any, wrapper: Any = lambda env: env) -> DummyVecEnv:
    return DummyVecEnv([lambda: wrapper(Images(*args))] * n)


def kwargs() -> dict[str, Any]:
    return {"features_extractor_class": EncoderExtractor, "features_extractor_kwargs": {"encoder": ENCODER}}


@pytest.mark.parametrize("value", [np.nan, 300.0, -5.0])
@pytest.mark.parametrize("algorithm", [PPO, DQN])
def test_a_number_out_of_range_stops_at_any_step(algorithm: Any, value: float) -> None:
    small = (
        {"n_steps": 16} if algorithm is PPO else {"buffer_size": 100, "learning_starts": 2, "exploration_fraction": 0}
    )
    small |= {} if algorithm is PPO else {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}
    env = Breaks(venv(1), value, 8)
    model = algorithm("CnnPolicy", env, policy_kwargs=kwargs(), device="cpu", batch_size=4, **small)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NumPy's, where a buffer casts it
        with pytest.raises(ValueError, match=r"observations reach .* but EncoderExtractor \(Nav2D-v0/abisim\) takes"):
            model.learn(40)
    assert 8 <= model.num_timesteps <= 10


def test_weights_that_are_nan_stop_under_gradients_too() -> None:
    extractor = VanillaExtractor(SPACE)
    images = th.rand(4, *SPACE.shape)
    extractor(images)
    with th.no_grad():
        next(extractor.parameters()).fill_(float("nan"))
    with pytest.raises(ValueError, match=r"embeddings of VanillaExtractor \(untrained\) are NaN or infinite"):
        extractor(images)


@pytest.mark.parametrize(("low", "high", "cause"), [(0, 1, "exceeds 1"), (7, 7, "are of one value, 7")])
def test_images_that_are_none_are_named_once(low: int, high: int, cause: str) -> None:
    env = venv(2, low, high)
    with pytest.warns(UserWarning) as caught:
        PPO("CnnPolicy", env, n_steps=16, batch_size=16, n_epochs=1, policy_kwargs=kwargs()).learn(64)
    with pytest.warns(UserWarning) as caught_too:
        encoded = VecEncodeObservations(env, ENCODER)
        PPO("MlpPolicy", encoded, n_steps=16, batch_size=16, n_epochs=1, device="cpu").learn(64)
    for warned, name in ((caught, "EncoderExtractor"), (caught_too, "VecEncodeObservations")):
        texts = [str(warning.message) for warning in warned]
        assert len(texts) == 1 and cause in texts[0] and texts[0].startswith(f"{name} (Nav2D-v0/abisim)")


def test_an_image_that_never_changes_is_named_after_a_while() -> None:
    extractor = VanillaExtractor(SPACE)
    image = th.rand(1, *SPACE.shape).expand(4, -1, -1, -1)
    for _ in range(15):
        extractor(image)
    with pytest.warns(UserWarning, match="all 64 observations are the same image"):
        extractor(image)


def test_a_black_beginning_is_nothing() -> None:
    extractor = VanillaExtractor(SPACE)
    extractor(th.zeros(15, *SPACE.shape))
    extractor(th.rand(2, *SPACE.shape))
    assert extractor._input_checked
    extractor(th.zeros(100, *SPACE.shape))


def test_embeddings_of_observations_that_are_not_declared() -> None:
    env = VecEncodeObservations(Breaks(venv(1), np.nan, 3), ENCODER)
    env.reset()
    with pytest.raises(ValueError, match=r"VecEncodeObservations \(Nav2D-v0/abisim\) got observations float32"):
        for _ in range(3):
            env.step(np.zeros(1, np.int64))


def test_evaluation_environments_have_trainings_encoder_and_wrappers() -> None:
    def encoded(name: str, wrapper: Any = lambda env: env) -> VecEncodeObservations:
        return VecEncodeObservations(venv(1, wrapper=wrapper), f"Nav2D-v0/{name}")

    def learn(train: Any, evaluation: Any, nested: bool = False) -> None:
        model = PPO("MlpPolicy", train, n_steps=8, batch_size=8, n_epochs=1, device="cpu")
        callback: Any = EvalCallback(evaluation, eval_freq=100, verbose=0)
        callback = EveryNTimesteps(100, callback) if nested else callback
        model.learn(8, callback=[EncoderCallback(), callback])

    learn(encoded("abisim"), encoded("abisim"))
    for nested in (False, True):
        with pytest.raises(ValueError, match=r"EvalCallback evaluates on .*hash .*give its eval_env the same encoder"):
            learn(encoded("abisim"), encoded("ssi"), nested=nested)
    with pytest.raises(ValueError, match=re.escape("test_observations.Invert, but training makes them by VecEncode")):
        learn(encoded("abisim"), encoded("abisim", Invert))
    with pytest.raises(ValueError, match=r"made by nothing, but training makes them by .*Invert"):
        learn(venv(1, wrapper=Invert), venv(1))
