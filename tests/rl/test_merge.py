"""A model trained on embeddings and the merged one agree on observations, for every pixel algorithm."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import ALGORITHMS, OBSERVATIONS, SHARING, VARIANTS, RandomImages, register_batch_norm, write
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.rl.extractors import ActionBisimExtractor, SSIExtractor
from sb3_abisim.rl.merge import merge_encoder
from sb3_abisim.rl.vec_encode import VecEncodeObservations
from sb3_abisim.zoo.merge import main

CONTINUOUS = ("SAC", "TD3", "TQC")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "e.safetensors")


def on_embeddings(name: str, path: Path, other_sharing: bool = False) -> Any:
    algorithm, settings = ALGORITHMS[name]
    env = VecEncodeObservations(DummyVecEnv([lambda: RandomImages(name in CONTINUOUS)]), str(path), device="cpu")
    policy_kwargs: dict[str, Any] = {"net_arch": [8]}
    if other_sharing:
        policy_kwargs["share_features_extractor"] = SHARING[name]
    if name == "RecurrentPPO":
        policy_kwargs["lstm_hidden_size"] = 8
    policy = "MlpLstmPolicy" if name == "RecurrentPPO" else "MlpPolicy"
    return algorithm(policy, env, seed=5, device="cpu", policy_kwargs=policy_kwargs, **settings)


def outputs(model: Any, observations: Any) -> Any:
    """The numbers before an action is chosen."""
    policy, tensor = model.policy, th.as_tensor(observations)
    policy.set_training_mode(False)
    with th.no_grad():
        if hasattr(policy, "q_net"):
            return policy.q_net(tensor)
        if hasattr(policy, "quantile_net"):
            return policy.quantile_net(tensor)
        if hasattr(policy, "lstm_actor"):
            return th.as_tensor(model.predict(observations, deterministic=True)[1][0][0])
        if hasattr(policy, "predict_values"):
            return th.cat([policy.get_distribution(tensor).distribution.logits, policy.predict_values(tensor)], 1)
        actions = policy(tensor, deterministic=True)
        values = [critic(tensor, actions) for critic in (policy.critic, policy.critic_target)]
        # TQC stacks its critics, SAC and TD3 give a tuple.
        values = [value.flatten(1) if isinstance(value, th.Tensor) else th.cat(value, 1) for value in values]
        return th.cat([actions, *values], 1)


@pytest.mark.parametrize("name, other_sharing", VARIANTS)
def test_merged(path: Path, name: str, other_sharing: bool) -> None:
    model = on_embeddings(name, path, other_sharing)
    model.learn(24)
    encode = model.env.encode
    merged = merge_encoder(model, str(path))
    hash = load_encoder(path).hash
    merged.save(path.parent / "merged.zip")
    path.unlink()
    env = RandomImages(continuous=name in CONTINUOUS)
    loaded = type(model).load(path.parent / "merged.zip", env=env, device="cpu")
    expected = outputs(model, encode(OBSERVATIONS))
    for pixel_model in (merged, loaded):
        assert type(pixel_model) is type(model)
        assert pixel_model.observation_space == RandomImages().observation_space
        for _, extractor in find_extractors(pixel_model.policy):
            assert type(extractor) is ActionBisimExtractor and extractor.frozen and extractor.hash == hash
        actions = pixel_model.predict(OBSERVATIONS, deterministic=True)[0]
        assert np.allclose(actions, model.predict(encode(OBSERVATIONS), deterministic=True)[0], atol=1e-5)
        assert th.allclose(outputs(pixel_model, OBSERVATIONS), expected, atol=1e-5)
    assert expected.std(0).max() > 1e-3
    # Training goes on, with the optimizers as they were.
    for key, value in model.get_parameters().items():
        if key.endswith("optimizer"):
            state = loaded.get_parameters()[key]["state"]
            assert value["state"].keys() == state.keys()
            assert all(th.equal(value["state"][i]["step"], state[i]["step"]) for i in state)
    if name in ("SAC", "TQC"):
        assert loaded.log_ent_coef.item() == merged.log_ent_coef.item() == model.log_ent_coef.item() != 0.0
    assert loaded.num_timesteps == 24
    loaded.learn(16)
    assert all(extractor.relative_weight_change() == 0.0 for _, extractor in find_extractors(loaded.policy))
    # The original is as it was.
    assert th.equal(outputs(model, encode(OBSERVATIONS)), expected)
    model.learn(16)


def test_another_network_and_objective(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    register_batch_norm(monkeypatch)
    path = write(tmp_path / "bn.safetensors", "BatchNorm", objective="ssi", width=3)
    model = on_embeddings("PPO", path)
    merged = merge_encoder(model, str(path))
    assert type(merged.policy.features_extractor) is SSIExtractor
    assert th.allclose(outputs(merged, OBSERVATIONS), outputs(model, model.env.encode(OBSERVATIONS)), atol=1e-5)


def test_state_dependent_exploration(path: Path) -> None:
    env = VecEncodeObservations(DummyVecEnv([lambda: RandomImages(continuous=True)]), str(path), device="cpu")
    model = sb3.A2C("MlpPolicy", env, use_sde=True, device="cpu")
    merged = merge_encoder(model, str(path))
    observations = model.env.encode(OBSERVATIONS)
    assert np.allclose(
        merged.predict(OBSERVATIONS, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )
    merged.predict(OBSERVATIONS)


def test_refusals(path: Path, tmp_path: Path) -> None:
    model = on_embeddings("PPO", path)
    with pytest.raises(FileNotFoundError, match="searched"):
        merge_encoder(model, str(tmp_path / "mistyped"))
    other = write(tmp_path / "other.safetensors", objective="ssi")
    with pytest.raises(ValueError, match=r"hash [0-9a-f]{64}, but .*other\.safetensors has [0-9a-f]{64}"):
        merge_encoder(model, str(other))
    with pytest.raises(ValueError, match="not on the embeddings of an encoder; wrap its environment"):
        merge_encoder(sb3.PPO("MlpPolicy", RandomImages(), device="cpu"), str(path))
    env = VecEncodeObservations(DummyVecEnv([RandomImages]), str(path))
    with pytest.raises(ValueError, match=r"VecNormalize\(norm_obs=False\)"):
        merge_encoder(sb3.PPO("MlpPolicy", VecNormalize(env), device="cpu"), str(path))
    merge_encoder(sb3.PPO("MlpPolicy", VecNormalize(env, norm_obs=False), device="cpu"), str(path))


def test_mistakes_of_the_command(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sb3.PPO("MlpPolicy", RandomImages(), device="cpu").save(tmp_path / "plain.zip")
    for model, message in (
        ("absent.zip", "there is no model"),
        ("plain.zip", "not on the embeddings of an encoder"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main([str(tmp_path / model), "-o", str(tmp_path / "out.zip"), "--algo", "ppo", "-e", str(path), "--trust"])
        assert stopped.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "out.zip").exists()
