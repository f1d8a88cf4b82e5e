"""An auxiliary objective is saved with the model, and a run that is continued goes on exactly."""

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from auxiliary_inputs import CONTINUOUS, FEW_GOALS, SMALL, build, make_envs, register_inputs
from extractor_inputs import ALGORITHMS
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_abisim.rl.auxiliary import AuxiliaryObjective
from sb3_abisim.rl.auxiliary_state import KEY, pack, unpack

KWARGS: dict[str, dict[str, Any]] = {
    "abisim": {"objective_kwargs": {"action_radius": 2.0, "expectation": "uniform"}},
    "goal_progress": {"objective_kwargs": FEW_GOALS},
}


@pytest.fixture(autouse=True)
def inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    register_inputs(monkeypatch)


def callback_of(objective: str, **kwargs: Any) -> AuxiliaryObjective:
    return AuxiliaryObjective(objective, **{**SMALL, **KWARGS.get(objective, {}), **kwargs})


def through_a_file(model: Any, path: Path, **kwargs: Any) -> Any:
    """Saved and loaded, in the same environment; random numbers that Stable-Baselines3 seeds again are as before."""
    model.save(path / "model.zip")
    random, numpy_random = th.get_rng_state(), np.random.get_state()
    loaded = type(model).load(path / "model.zip", env=model.get_env(), device="cpu", force_reset=False, **kwargs)
    if getattr(model, "replay_buffer", None) is not None:
        model.save_replay_buffer(path / "buffer.pkl")
        loaded.load_replay_buffer(path / "buffer.pkl", truncate_last_traj=False)
    th.set_rng_state(random)
    np.random.set_state(numpy_random)
    loaded.action_space.np_random.bit_generator.state = model.action_space.np_random.bit_generator.state
    return loaded


def state_of(model: Any) -> dict[str, th.Tensor]:
    """All of the policy's tensors, and the state's by name, for messages."""
    state = dict(model.policy.state_dict())
    for name in [name for name in state if name.endswith(KEY)]:
        tensors, numbers = unpack(state.pop(name))
        state |= {f"{name}/{key}": tensor for key, tensor in tensors.items()}
        state[f"{name}/numbers"] = th.tensor(list(repr(sorted(numbers.items())).encode()))
    return state


CASES = [
    ("PPO", "ssi"), ("PPO", "abisim"), ("PPO", "goal_progress"), ("PPO", "beta_vae"), ("PPO", "curl"), ("A2C", "acro"),
    ("A2C", "abisim"), ("DQN", "ssi"), ("DQN", "abisim"), ("DQN", "goal_progress"), ("SAC", "info_nce"),
    ("TRPO", "ssi"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "objective"), CASES)
def test_n_and_n_steps_are_2_n(name: str, objective: str, tmp_path: Path) -> None:
    """Bit for bit, heads, targets, Adam, counters and random numbers included."""
    n = 96
    once = build(name, make_envs(2, continuous=name in CONTINUOUS))
    once.learn(2 * n, callback_of(objective))
    twice = build(name, make_envs(2, continuous=name in CONTINUOUS))
    twice.learn(n, callback_of(objective))
    twice = through_a_file(twice, tmp_path)
    callback = callback_of(objective)
    twice.learn(n, callback, reset_num_timesteps=False)
    trainer = next(iter(callback._trainers.values()))
    assert trainer.n_updates > 2 * n // 8 - 8
    there, here = state_of(once), state_of(twice)
    assert there.keys() == here.keys()
    assert any("adam" in name for name in there)
    differing = [name for name in there if not th.equal(there[name], here[name])]
    assert not differing


def test_one_callback_in_two_calls_of_learn_is_two_callbacks() -> None:
    states = []
    for new in (False, True):
        model, callback = build("PPO"), callback_of("ssi")
        model.learn(48, callback)
        model.learn(48, callback_of("ssi") if new else callback, reset_num_timesteps=False)
        states.append(state_of(model))
    assert all(th.equal(states[0][name], states[1][name]) for name in states[0])


def test_updates_are_counted_across_calls() -> None:
    """96 steps in rollouts of 16 make three updates of 32, however they are divided."""
    for parts in ([96], [48, 48], [16] * 6):
        model = build("PPO")
        for n in parts:
            callback = callback_of("ssi", update_interval=32)
            model.learn(n, callback, reset_num_timesteps=False)
        assert callback._trainers["actor"].n_updates == 3


def test_a_model_without_the_callback_keeps_the_state(tmp_path: Path) -> None:
    model = build("PPO")
    model.learn(48, callback_of("ssi"))
    packed = model.policy.state_dict()[f"features_extractor.{KEY}"]
    loaded = through_a_file(model, tmp_path)
    loaded.learn(16, reset_num_timesteps=False)
    loaded = through_a_file(loaded, tmp_path)
    assert th.equal(loaded.policy.state_dict()[f"features_extractor.{KEY}"], packed)
    callback = callback_of("ssi")
    loaded.learn(16, callback, reset_num_timesteps=False)
    assert callback._trainers["actor"].n_updates > 4


@pytest.mark.parametrize("name", ALGORITHMS)
def test_models_of_before_load(name: str, tmp_path: Path) -> None:
    """Those that never had one, into those that have, and the other way round."""
    plain, trained = build(name), build(name)
    trained.learn(64, callback_of("ssi"))
    assert not any(key.endswith(KEY) for key in plain.policy.state_dict())
    assert any(key.endswith(KEY) for key in trained.policy.state_dict())
    parameters = trained.get_parameters()
    trained.set_parameters(plain.get_parameters())
    plain.set_parameters(parameters)
    plain.learn(16, reset_num_timesteps=False)
    plain.save(tmp_path / "model.zip")
    type(plain).load(tmp_path / "model.zip").policy.load_state_dict(plain.policy.state_dict())


def test_it_is_read_without_a_pickle(tmp_path: Path) -> None:
    import io
    import zipfile

    model = build("PPO")
    model.learn(48, callback_of("abisim"))
    model.save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        state = th.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
    packed = [tensor for name, tensor in state.items() if name.endswith(KEY)]
    # Aliases of the shared extractor, stored once.
    assert len(packed) == 3
    assert len({tensor.untyped_storage().data_ptr() for tensor in packed}) == 1
    tensors, numbers = unpack(packed[0])
    assert numbers["settings"]["objective"] == "abisim"
    assert "module.base_objective.encoder.layers.1.weight" in tensors
    assert not any(name.startswith("module.encoder.") for name in tensors), "the extractor saves that"


def test_a_state_that_is_loaded_while_training_is_taken_up() -> None:
    model, other = build("PPO"), build("PPO", learning_rate=0.1)
    other.learn(96, callback_of("ssi", learning_rate=0.1))
    parameters = other.get_parameters()

    class Load(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 12:
                self.model.set_parameters(parameters)
            return True

    callback = callback_of("ssi", learning_rate=1e-9)
    model.learn(32, CallbackList([Load(), callback]))
    head = "module.inverse_model.0.weight"
    packed = {key: unpack(m["policy"][f"features_extractor.{KEY}"])[0] for key, m in (
        ("other", parameters), ("model", model.get_parameters()),
    )}  # fmt: skip
    names = [name for name in packed["other"] if name.startswith("module.inverse_model")]
    assert names, head
    assert all(th.allclose(packed["other"][name], packed["model"][name], atol=1e-6) for name in names)
    assert callback._trainers["actor"].n_updates > 10


def test_another_objective_is_refused(tmp_path: Path) -> None:
    model = build("PPO")
    model.learn(32, callback_of("ssi"))
    for other in (
        callback_of("curl"),
        callback_of("ssi", objective_kwargs={"l1_penalty": 0.5}),
    ):
        loaded = through_a_file(model, tmp_path)
        with pytest.raises(ValueError, match=r"was trained with another auxiliary objective .* there, .* here"):
            loaded.learn(16, other, reset_num_timesteps=False)
    # What is no part of the state may change.
    loaded = through_a_file(model, tmp_path)
    callback = callback_of("ssi", weight=0.5, learning_rate=1e-4, batch_size=8)
    loaded.learn(16, callback, reset_num_timesteps=False)
    assert callback._trainers["actor"].n_updates == 6


@pytest.mark.parametrize("weights", [(0.0, 1.0), (1.0, 0.0)])
def test_the_weight_may_become_0_or_be_it_no_longer(weights: tuple[float, float]) -> None:
    model = build("PPO")
    for weight in weights:
        callback = callback_of("ssi", weight=weight)
        model.learn(32, callback, reset_num_timesteps=False)
    assert callback._trainers["actor"].n_updates == 8


def test_copies_and_pickles_of_a_policy_keep_the_state() -> None:
    model = build("DQN")
    model.learn(64, callback_of("ssi"))
    packed = model.policy.state_dict()[f"q_net.features_extractor.{KEY}"]
    for other in (copy.deepcopy(model.policy), pickle.loads(pickle.dumps(model.policy))):
        assert th.equal(other.state_dict()[f"q_net.features_extractor.{KEY}"], packed)
        assert other.q_net.features_extractor.auxiliary.saver is None


def test_target_networks_hold_none() -> None:
    for name in ("DQN", "SAC"):
        model = build(name)
        model.learn(64, callback_of("ssi"))
        assert not any("target" in key for key in model.policy.state_dict() if key.endswith(KEY))


def test_packed_tensors_come_back_and_damage_is_found() -> None:
    tensors = {"a": th.arange(6).view(2, 3).t(), "b": th.ones((), dtype=th.float64)}
    packed = pack(tensors, {"x": [1, 2**100]})
    again, metadata = unpack(packed)
    assert packed.dtype == th.uint8
    assert metadata == {"x": [1, 2**100]}
    assert all(th.equal(tensors[name], again[name]) for name in tensors)
    with pytest.raises(ValueError, match="auxiliary objective in the saved model is damaged"):
        unpack(packed[:20])
