"""Frozen encoders that are fine-tuned later on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from extractor_inputs import OBSERVATIONS, SPACE, VARIANTS, RandomImages, build, write
from torch import nn

from sb3_abisim import ActionBisimExtractor, load_encoder, unfreeze_encoder
from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.rl.extractors import PretrainedExtractor

pytestmark = pytest.mark.usefixtures("batch_norm_is_known")


def shapes(optimizer: th.optim.Optimizer) -> list[tuple[int, ...]]:
    return [tuple(parameter.shape) for group in optimizer.param_groups for parameter in group["params"]]


def optimizers(policy: Any) -> list[th.optim.Optimizer]:
    owners = (policy, getattr(policy, "actor", None), getattr(policy, "critic", None))
    return [owner.optimizer for owner in owners if getattr(owner, "optimizer", None) is not None]


@pytest.mark.parametrize("name, other_sharing", VARIANTS)
def test_training_goes_on_with_the_encoder(tmp_path: Path, name: str, other_sharing: bool) -> None:
    path = write(tmp_path / "e.safetensors")
    model = build(name, path, True, other_sharing)
    model.learn(24)
    kwargs = model.policy_kwargs
    before = {id(p): dict(o.state[p]) for o in optimizers(model.policy) for g in o.param_groups for p in g["params"]}
    unfreeze_encoder(model)
    # As a model that was never frozen, in the same order.
    never = build(name, path, False, other_sharing)
    assert list(map(shapes, optimizers(model.policy))) == list(map(shapes, optimizers(never.policy)))
    assert [n for n, _ in model.policy.named_parameters()] == [n for n, _ in never.policy.named_parameters()]
    after = {id(p): dict(o.state[p]) for o in optimizers(model.policy) for g in o.param_groups for p in g["params"]}
    assert any(before.values()) and len(after) > len(before)
    for parameter, state in before.items():
        assert all(value is after[parameter][key] for key, value in state.items())
    assert kwargs["features_extractor_kwargs"]["freeze"] is True
    model.learn(24, reset_num_timesteps=False)
    for _, extractor in find_extractors(model.policy):
        assert 0.0 < extractor.relative_weight_change() < 10.0 and not extractor.frozen
        assert extractor.hash == load_encoder(path).hash
    model.save(tmp_path / "model.zip")
    path.unlink()
    loaded = type(model).load(tmp_path / "model.zip", env=RandomImages(name in ("SAC", "TD3", "TQC")), device="cpu")
    state = loaded.policy.state_dict()
    assert all(th.equal(value, state[key]) for key, value in model.policy.state_dict().items())
    loaded.learn(16, reset_num_timesteps=False)
    assert np.isfinite(loaded.predict(OBSERVATIONS, deterministic=True)[0]).all()


def test_the_extractor_alone(tmp_path: Path) -> None:
    path = str(write(tmp_path / "e.safetensors", "BatchNorm"))
    frozen, trained = (ActionBisimExtractor(SPACE, path, freeze, network="BatchNorm") for freeze in (True, False))
    frozen.train()
    x = th.from_numpy(OBSERVATIONS).float() / 255
    output = frozen(x)
    new = frozen.unfreeze()
    assert [p.shape for p in new] == [p.shape for p in trained.encoder.parameters()] and not frozen.frozen
    assert [name for name, _ in frozen.named_parameters()] == [name for name, _ in trained.named_parameters()]
    assert all(a is b for a, b in zip(new, frozen.parameters(), strict=True))
    (norm,) = (module for module in frozen.modules() if isinstance(module, nn.BatchNorm2d))
    assert norm.training and th.equal(frozen.eval()(x), output) and frozen.unfreeze() == []
    assert frozen(x).requires_grad
    assert frozen.relative_weight_change() == 0.0


def test_nothing_to_unfreeze(tmp_path: Path) -> None:
    path = write(tmp_path / "e.safetensors")
    with pytest.raises(ValueError, match="holds no frozen encoder"):
        unfreeze_encoder(build("PPO", path, False))


class Own(PretrainedExtractor):
    """A custom extractor that is always frozen."""

    def __init__(self, observation_space: Any, encoder: str) -> None:
        super().__init__(observation_space, encoder, freeze=True)


def test_a_model_that_could_not_be_loaded_again_is_left_as_it_is(tmp_path: Path) -> None:
    path = write(tmp_path / "e.safetensors")
    kwargs = {"features_extractor_class": Own, "features_extractor_kwargs": {"encoder": str(path)}}
    model = sb3.PPO("CnnPolicy", RandomImages(), policy_kwargs=kwargs, device="cpu")
    with pytest.raises(ValueError, match=r"hold no freeze=True.*take freeze as an argument"):
        unfreeze_encoder(model)
    assert find_extractors(model.policy)[0][1].frozen
