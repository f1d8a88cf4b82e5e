"""``policy_kwargs(FILE)`` and ``EncoderExtractor``: nobody repeats what the file knows."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import ALGORITHMS, OBSERVATIONS, SPACE, RandomImages, write
from gymnasium import spaces
from torch import nn

import sb3_abisim
from sb3_abisim import EncoderExtractor, load_encoder, policy_kwargs
from sb3_abisim.networks.base import make_encoder
from sb3_abisim.networks.encoder_file import save_encoder
from sb3_abisim.rl.checks import find_extractors, require_weights


class Pixels(RandomImages):
    def __init__(self, shape: tuple[int, ...], continuous: bool) -> None:
        super().__init__(continuous)
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)


def save(path: Path, shape: tuple[int, ...], network: str | None = None) -> Path:
    space = spaces.Box(0, 255, shape, np.uint8)
    th.manual_seed(3)
    save_encoder(
        path,
        make_encoder(space, network),
        observation_space=space,
        action_space=spaces.Discrete(4),
        env_id="Toy-v0",
        env_kwargs={},
        objective="ssi",
        settings={},
        dataset_hash="0" * 64,
        reference_observations=np.random.default_rng(0).integers(0, 256, (2, *shape), np.uint8),
    )
    return path


def extractors(model: Any) -> list[EncoderExtractor]:
    return [module for module in model.policy.modules() if isinstance(module, EncoderExtractor)]


def make(name: str, shape: tuple[int, ...], kwargs: dict[str, Any]) -> Any:
    algorithm, settings = ALGORITHMS[name]
    policy = "CnnLstmPolicy" if name == "RecurrentPPO" else "CnnPolicy"
    env = Pixels(shape, name in ("SAC", "TD3", "TQC"))
    return algorithm(policy, env, seed=5, device="cpu", policy_kwargs=kwargs, **settings)


@pytest.mark.parametrize(
    ("shape", "network"), [((3, 20, 20), "small"), ((3, 20, 20), "impala"), ((4, 84, 84), "nature")], ids=str
)
@pytest.mark.parametrize("freeze", [False, True])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm(tmp_path: Path, name: str, shape: tuple[int, ...], network: str, freeze: bool) -> None:
    path = save(tmp_path / "e.safetensors", shape, network)
    model = make(name, shape, policy_kwargs(path, freeze, net_arch=[8]))
    weights = load_encoder(path).encoder.state_dict()
    assert extractors(model)
    for extractor in extractors(model):
        assert extractor.encoder.state_dict().keys() == weights.keys() and extractor.frozen is freeze
        assert all(th.equal(value, weights[key]) for key, value in extractor.encoder.state_dict().items())
    observations = model.observation_space.sample()[None]
    action, _ = model.predict(observations, deterministic=True)
    # The zip is complete where the file is absent, whatever the network.
    model.save(tmp_path / "model.zip")
    path.unlink()
    loaded = type(model).load(tmp_path / "model.zip", device="cpu")
    require_weights(loaded)
    assert np.array_equal(loaded.predict(observations, deterministic=True)[0], action)


def test_a_new_dictionary_with_what_the_file_knows(tmp_path: Path) -> None:
    path = save(tmp_path / "e.safetensors", (3, 20, 20), "impala")
    kwargs = policy_kwargs(path, freeze=True, net_arch=[8])
    assert kwargs == {
        "features_extractor_class": EncoderExtractor,
        "features_extractor_kwargs": {
            "encoder": str(path), "network": "impala", "network_kwargs": {}, "freeze": True,
        },
        "net_arch": [8],
    }  # fmt: skip
    again = policy_kwargs(path, freeze=True, net_arch=[8])
    assert again["features_extractor_kwargs"] is not kwargs["features_extractor_kwargs"]
    with pytest.raises(ValueError, match="features_extractor_kwargs from the file; leave it out"):
        policy_kwargs(path, features_extractor_kwargs={})
    with pytest.raises(FileNotFoundError, match=r"mistyped\.safetensors"):
        policy_kwargs(tmp_path / "mistyped.safetensors")


def test_by_hand_the_network_comes_from_the_file(tmp_path: Path) -> None:
    path = save(tmp_path / "e.safetensors", (3, 20, 20), "impala")
    extractor = EncoderExtractor(spaces.Box(0, 255, (3, 20, 20), np.uint8), str(path))
    assert extractor.encoder.spec()["name"] == "impala" and extractor.metadata["objective"] == "ssi"
    with pytest.raises(ValueError, match=r"holds the network .*impala.*builds .*small"):
        EncoderExtractor(spaces.Box(0, 255, (3, 20, 20), np.uint8), str(path), network="small")
    with pytest.raises(ValueError, match=r"holds the network .*impala.*builds .*features_dim"):
        EncoderExtractor(spaces.Box(0, 255, (3, 20, 20), np.uint8), str(path), network_kwargs={"features_dim": 3})
    with pytest.raises(ValueError, match="pretrained on Toy-v0"):
        EncoderExtractor(spaces.Box(0, 255, (3, 20, 21), np.uint8), str(path))


@pytest.mark.parametrize("network", ["small", "impala"])
def test_by_hand_and_without_the_file(tmp_path: Path, network: str) -> None:
    """A zip loads where the network is the default one; else the message says what to do, and the file helps."""
    path = save(tmp_path / "e.safetensors", (3, 20, 20), network)
    kwargs = {"features_extractor_class": EncoderExtractor, "features_extractor_kwargs": {"encoder": str(path)}}
    make("PPO", (3, 20, 20), kwargs).save(tmp_path / "model.zip")
    content = path.read_bytes()
    path.unlink()
    if network == "small":
        require_weights(sb3.PPO.load(tmp_path / "model.zip", device="cpu"))
    else:
        with pytest.raises(ValueError, match=r"another network .*not there to tell; put it there, or .*policy_kwargs"):
            sb3.PPO.load(tmp_path / "model.zip", device="cpu")
        path.write_bytes(content)
        require_weights(sb3.PPO.load(tmp_path / "model.zip", device="cpu"))


def test_it_is_public() -> None:
    assert sb3_abisim.EncoderExtractor is EncoderExtractor and "EncoderExtractor" in dir(sb3_abisim)


class Agent(nn.Module):
    def __init__(self, encoder: nn.Module) -> None:
        super().__init__()
        self.encoder, self.head = encoder, nn.Linear(576, 2)


def test_a_loaded_encoder_is_not_initialized_with_the_agent(tmp_path: Path) -> None:
    encoder = load_encoder(write(tmp_path / "e.safetensors")).encoder
    before = {name: value.clone() for name, value in encoder.state_dict().items()}
    agent = Agent(encoder)

    @th.no_grad()
    def init(module: nn.Module) -> None:
        if isinstance(module, nn.Linear | nn.Conv2d):
            module.weight.fill_(7.0)

    assert agent.apply(init) is agent and float(agent.head.weight.detach().min()) == 7.0
    assert all(th.equal(value, before[name]) for name, value in encoder.state_dict().items())
    # A fresh one is, as any network.
    fresh = Agent(make_encoder(SPACE))
    fresh.apply(init)
    assert float(fresh.encoder.layers[0].weight.detach().min()) == 7.0
    assert len(OBSERVATIONS) and not find_extractors(agent)
