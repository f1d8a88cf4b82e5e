"""What the extractors refuse, and how they say it."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
from extractor_inputs import OBSERVATIONS, SPACE, RandomImages, build, write
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_abisim
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.registry import methods
from sb3_abisim.rl.extractor_classes import extractor_class, method_of
from sb3_abisim.rl.extractors import ActionBisimExtractor, PretrainedExtractor, VanillaExtractor
from sb3_abisim.rl.file_network import network_arguments

pytestmark = pytest.mark.usefixtures("batch_norm_is_known")


EXTRACTORS: dict[str, Any] = {
    name: extractor_class(name) for name, method in methods().items() if method.has_encoder_file
}
NAMES = {
    "abisim": "ActionBisimExtractor",
    "acro": "ACROExtractor",
    "beta_vae": "BetaVAEExtractor",
    "curl": "CURLExtractor",
    "drq": "DrQExtractor",
    "foreign": "ForeignExtractor",
    "info_nce": "InfoNCEExtractor",
    "ssi": "SSIExtractor",
    "vanilla": "VanillaExtractor",
}


@pytest.mark.parametrize("method", NAMES)
def test_every_method_has_an_extractor(method: str) -> None:
    made: Any = extractor_class(method)
    assert made.__name__ == NAMES[method] and getattr(sb3_abisim, NAMES[method]) is made
    assert method_of(made) == method
    untrained = method in ("vanilla", "drq")
    assert issubclass(made, VanillaExtractor) if untrained else made.objective == method
    assert ":param observation_space:" in made.__doc__ and ":param network_kwargs:" in made.__doc__
    # A class of the same name belongs to nobody.
    assert method_of(type(NAMES[method], (PretrainedExtractor,), {})) is None


def test_the_methods_of_the_paper_keep_their_names() -> None:
    assert set(NAMES) <= set(methods())


@pytest.mark.parametrize("objective", EXTRACTORS)
def test_wrong_class_for_the_file(tmp_path: Path, objective: str) -> None:
    file = str(write(tmp_path / objective, objective=objective))
    right = EXTRACTORS[objective]
    assert right(SPACE, file).metadata["objective"] == objective
    for wrong in set(EXTRACTORS.values()) - {right}:
        text = f"{objective} was trained by '{objective}', not '{wrong.objective}'; use {right.__name__}"
        with pytest.raises(ValueError, match=text):
            wrong(SPACE, file)


def test_file_of_an_unknown_objective(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"trained by 'other'.*known methods are abisim, .*ssi, .*--packages imports"):
        ActionBisimExtractor(SPACE, str(write(tmp_path / "other", objective="other")))


def test_network_must_be_named_as_the_error_says(batch_norm_path: Path, tmp_path: Path) -> None:
    wide = str(write(tmp_path / "wide", "BatchNorm", width=5))
    remedy = {"network": "BatchNorm", "network_kwargs": {"width": 5}}
    text = r"network='BatchNorm', network_kwargs=\{'width': 5\}"
    with pytest.raises(ValueError, match=rf"Nav2DEncoder.*{text}"):
        ActionBisimExtractor(SPACE, wide)
    with pytest.raises(ValueError, match=rf"the extractor builds .*'kwargs': {{}}.*{text}"):
        ActionBisimExtractor(SPACE, wide, network="BatchNorm")
    with pytest.raises(ValueError, match=rf"unknown network 'Nonsense'.*{text}"):
        ActionBisimExtractor(SPACE, wide, network="Nonsense")
    assert network_arguments(load_encoder(wide)) == remedy
    assert ActionBisimExtractor(SPACE, wide, **remedy).features_dim == 6  # type: ignore[arg-type]
    # The same is required where the file is absent, so that a mistake is not found out on another machine.
    assert ActionBisimExtractor(SPACE, "absent", **remedy).n_parameters == 3 * 9 * 5 + 5 + 10 + 125 * 6 + 6  # type: ignore[arg-type]


def test_arguments_are_not_changed(path: Path) -> None:
    kwargs = build("SAC", path, True, network_kwargs={"n_input_channels": 3}).policy_kwargs["features_extractor_kwargs"]
    assert kwargs == {"encoder": str(path), "freeze": True, "network_kwargs": {"n_input_channels": 3}}


def test_damaged_file(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1] + b"\0\0")
    with pytest.raises(ValueError, match=f"{path}.*damaged"):
        build("PPO", path, True)


@pytest.mark.parametrize("extractor_class", [ActionBisimExtractor, VanillaExtractor])
@pytest.mark.parametrize(
    "space, match",
    [
        (spaces.Box(0, 1, (3, 15, 15), np.float32), r"0..255, got Box.*float32\); two wrappers.*RescaleObservation"),
        (spaces.Box(-10, 10, (3, 15, 15), np.float32), "norm_obs=False"),
        (spaces.Box(0, 1, (3, 15, 15), np.uint8), "uint8 images"),
        (spaces.Box(0, 255, (675,), np.uint8), "uint8 images"),
        (spaces.Discrete(3), "uint8 images"),
        (spaces.Dict({"image": SPACE}), "MultiInputPolicy"),
        (spaces.Box(0, 255, (15, 12, 3), np.uint8), "15, 12, 3"),
    ],
)
def test_observation_space(path: Path, extractor_class: Any, space: gym.Space[Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        extractor_class(space, **({} if extractor_class is VanillaExtractor else {"encoder": str(path)}))


def test_normalized_images_are_refused(path: Path) -> None:
    policy_kwargs = build("PPO", path, True).policy_kwargs
    vec_env = VecNormalize(DummyVecEnv([RandomImages]))
    with pytest.raises(ValueError, match="norm_obs=False"):
        sb3.PPO("CnnPolicy", vec_env, policy_kwargs={**policy_kwargs, "normalize_images": False})
    model = sb3.PPO(
        "CnnPolicy", RandomImages(), policy_kwargs={**policy_kwargs, "normalize_images": False}, device="cpu"
    )
    black = np.zeros_like(OBSERVATIONS)
    model.predict(black)
    with pytest.raises(ValueError, match=r"reach 255.*remove normalize_images=False"):
        model.predict(OBSERVATIONS)
