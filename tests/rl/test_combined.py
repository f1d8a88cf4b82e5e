"""``CombinedEncoderExtractor``: an encoder per image of a dictionary, vectors passed on."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from extractor_inputs import ALGORITHMS, SPACE, RandomImages, write
from gymnasium import spaces

import sb3_abisim
from sb3_abisim import CombinedEncoderExtractor, load_encoder, policy_kwargs
from sb3_abisim.rl.checks import find_extractors, require_weights

WIDE = spaces.Box(0, 255, (3, 40, 44), np.uint8)
VECTOR = spaces.Box(-2.0, 2.0, (2, 3), np.float32)
DICT = spaces.Dict({"camera": SPACE, "speed": VECTOR, "gear": spaces.Discrete(5), "wide": WIDE})


pytestmark = pytest.mark.usefixtures("batch_norm_is_known")


class Robot(RandomImages):
    """A camera, a wide camera, a vector and a gear."""

    def __init__(self, continuous: bool = False, space: spaces.Dict = DICT) -> None:
        super().__init__(continuous)
        self.observation_space: gym.Space[Any] = space

    def step(self, action: Any) -> Any:
        return self._sample(), float(np.sum(action)), bool(self.np_random.random() < 0.2), False, {}

    def _sample(self) -> Any:
        return self.observation_space.sample()


def make(name: str, kwargs: dict[str, Any]) -> Any:
    algorithm, settings = ALGORITHMS[name]
    policy = "MultiInputLstmPolicy" if name == "RecurrentPPO" else "MultiInputPolicy"
    env = Robot(name in ("SAC", "TD3", "TQC"))
    env.observation_space.seed(0)
    return algorithm(policy, env, seed=5, device="cpu", policy_kwargs={"net_arch": [8], **kwargs}, **settings)


def build(path: Path, freeze: bool = False, **more: Any) -> dict[str, Any]:
    kwargs = policy_kwargs({"camera": path}, freeze)
    kwargs["features_extractor_kwargs"].update(untrained=True, **more)
    return kwargs


def test_features_are_those_of_each_part_in_the_order_of_the_space(tmp_path: Path) -> None:
    path = write(tmp_path / "e.safetensors", "BatchNorm")
    extractor = CombinedEncoderExtractor(DICT, {"camera": str(path)}, untrained=True).eval()
    # Gymnasium sorts keys.
    assert list(extractor.extractors) == ["camera", "gear", "speed", "wide"]
    n = 4
    parts = {
        "camera": th.rand(n, *SPACE.shape), "gear": th.eye(5)[:n], "speed": th.randn(n, 2, 3),
        "wide": th.rand(n, *WIDE.shape),
    }  # fmt: skip
    features = extractor(parts)
    assert features.shape == (n, extractor.features_dim) and extractor.features_dim == 6 + 5 + 6 + 512
    assert th.equal(features[:, :6], load_encoder(path).encoder(parts["camera"]))
    assert th.equal(features[:, 6:11], parts["gear"]) and th.equal(features[:, 11:17], parts["speed"].flatten(1))
    (wide,) = extractor.extractors["wide"]  # type: ignore[misc]
    assert wide.spec()["name"] == "nature"
    assert th.equal(features[:, 17:], wide(parts["wide"]))


@pytest.mark.parametrize("freeze", [False, True])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_guards_hold_inside(tmp_path: Path, name: str, freeze: bool) -> None:
    """Initialization, training mode, target networks; a zip that loads without the file."""
    path = write(tmp_path / "e.safetensors", "BatchNorm")
    model = make(name, build(path, freeze))
    weights = load_encoder(path).encoder.state_dict()

    def is_the_files(model: Any) -> bool:
        found = find_extractors(model.policy)
        assert found
        states = [extractor.encoder.state_dict() for _, extractor in found]
        return all(th.equal(value, weights[key]) for state in states for key, value in state.items())

    assert is_the_files(model)
    model.learn(24)
    assert is_the_files(model) is freeze
    model.policy.set_training_mode(True)
    for _, extractor in find_extractors(model.policy):
        assert extractor.encoder.training is not freeze
        assert bool(list(extractor.parameters())) is not freeze
    model.save(tmp_path / "model.zip")
    path.unlink()
    loaded = type(model).load(tmp_path / "model.zip", env=Robot(name in ("SAC", "TD3", "TQC")), device="cpu")
    require_weights(loaded)
    assert is_the_files(loaded) is freeze
    observation = DICT.sample()
    assert np.array_equal(
        model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
    )


@pytest.mark.parametrize(
    ("space", "kwargs", "message"),
    [
        (DICT, {"encoders": {"camera": "{}"}}, "images wide have no encoder; .*untrained=True"),
        (DICT, {"encoders": {}}, "images camera, wide have no encoder"),
        (DICT, {"encoders": {"speed": "{}"}}, "given for speed, but the images .* are camera, wide"),
        (DICT, {"encoders": {"cam": "{}"}}, "given for cam, but"),
        (
            spaces.Dict({"camera": SPACE, "low": spaces.Box(0, 255, (3, 2, 40), np.uint8)}),
            {"encoders": {"camera": "{}"}, "untrained": True},
            r"the image low: small takes images of at least 3 x 3 pixels, got 2 x 40.*or keep the others only",
        ),
        (spaces.Dict({"wide": WIDE}), {"encoders": {"wide": "{}"}}, "pretrained on Nav2D-v0 with observation_space"),
        (SPACE, {"encoders": {}}, "must be a dictionary.*use EncoderExtractor"),
    ],
    ids=["missing", "none", "vector", "mistyped", "too small", "other image", "no dictionary"],
)
def test_refuses(tmp_path: Path, space: gym.Space[Any], kwargs: dict[str, Any], message: str) -> None:
    path = write(tmp_path / "e.safetensors")
    encoders = {key: file.format(path) for key, file in kwargs["encoders"].items()}
    with pytest.raises(ValueError, match=message):
        CombinedEncoderExtractor(space, **{**kwargs, "encoders": encoders})


def test_a_missing_file_is_fatal_when_training_starts(tmp_path: Path) -> None:
    kwargs = {"encoders": {"camera": str(tmp_path / "mistyped")}, "untrained": True}
    model = make("DQN", {"features_extractor_class": CombinedEncoderExtractor, "features_extractor_kwargs": kwargs})
    with pytest.raises(FileNotFoundError, match=r"searched .*mistyped"):
        require_weights(model)


def test_it_is_public() -> None:
    assert sb3_abisim.CombinedEncoderExtractor is CombinedEncoderExtractor
