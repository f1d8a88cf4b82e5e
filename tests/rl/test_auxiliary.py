"""What an auxiliary objective trains, and what it leaves alone."""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from auxiliary_inputs import FEW_GOALS, SMALL, Recorder, build, make_envs, register_inputs
from extractor_inputs import ALGORITHMS, SHARING, write
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EveryNTimesteps

from sb3_abisim.objectives.base import TensorBatch
from sb3_abisim.registry import get_objective, methods
from sb3_abisim.rl.auxiliary import AuxiliaryObjective
from sb3_abisim.rl.auxiliary_state import KEY
from sb3_abisim.rl.callbacks import EncoderCallback
from sb3_abisim.rl.checks import find_extractors

VARIANTS = [(name, False) for name in ALGORITHMS] + [(name, True) for name in SHARING]
OBJECTIVES = [name for name, method in methods().items() if method.is_pretrained]
KWARGS: dict[str, dict[str, Any]] = {
    "abisim": {"objective_kwargs": {"action_radius": 2.0}},
    "goal_progress": {"objective_kwargs": FEW_GOALS},
}


@pytest.fixture(autouse=True)
def inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    register_inputs(monkeypatch)


class Watch(BaseCallback):
    """Notes what a part of the loop changes: the policy's parameters before and after it, and what is logged."""

    def __init__(self, notes: list[Any]) -> None:
        super().__init__()
        self.notes = notes

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        named = {name: p.detach().clone() for name, p in self.model.policy.named_parameters()}
        self.notes.append((named, dict(self.logger.name_to_value)))


def moved_by(callback: AuxiliaryObjective, model: Any, n: int = 64) -> set[str]:
    """The names of the policy's parameters that the callback moves, as opposed to RL."""
    before: list[Any] = []
    after: list[Any] = []
    model.learn(n, CallbackList([Watch(before), callback, Watch(after)]))
    assert len(before) == len(after) > 0
    return {
        name
        for (there, _), (here, _) in zip(before, after, strict=True)
        for name in there
        if not th.equal(there[name], here[name])
    }


@pytest.mark.parametrize(("name", "other_sharing"), VARIANTS)
def test_it_moves_the_online_encoders_and_nothing_else(
    name: str, other_sharing: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    model = build(name, other_sharing=other_sharing)
    moved = moved_by(AuxiliaryObjective("ssi", **SMALL), model)
    expected = {
        f"{extractor_name}.{parameter}"
        for extractor_name, extractor in find_extractors(model.policy)
        for parameter, _ in extractor.named_parameters()
    }
    assert moved == expected
    first = capsys.readouterr().out.splitlines()[0]
    shared = SHARING.get(name, True) == other_sharing if name in SHARING else True
    if not shared:
        assert first.startswith("Auxiliary objective ssi: trains the encoder of actor and of critic, weight 1,")
        assert len(expected) == 4
    else:
        network = {"DQN": "q_net", "QRDQN": "quantile_net"}.get(name, "actor")
        assert first.startswith(f"Auxiliary objective ssi: trains the encoder of {network}, weight 1,")
        assert len(expected) == 2


def test_task_features_are_left_to_rl() -> None:
    model = build("PPO", features_extractor_kwargs={"network": "Flat", "task_features_dim": 3})
    extractor = model.policy.features_extractor
    assert [*extractor.task_features.parameters()]
    trained = {f"features_extractor.encoder.{name}" for name, _ in extractor.encoder.named_parameters()}
    assert moved_by(AuxiliaryObjective("ssi", **SMALL), model) == trained


def test_it_sees_no_augmented_observations() -> None:
    noise = {"augment": "random_noise", "augment_kwargs": {"strength": 1.0}}
    updated = []
    for kwargs in ({}, noise):
        after: list[Any] = []
        model = build("PPO", features_extractor_kwargs={"network": "Flat", **kwargs})
        model.learn(16, CallbackList([AuxiliaryObjective("ssi", **SMALL), Watch(after)]))
        assert model.policy.features_extractor.augment is not None or not kwargs
        updated.append(after[0][0])
    assert all(th.equal(updated[0][name], updated[1][name]) for name in updated[0])


@pytest.mark.parametrize("kwargs", [{"encoder_trained_by": "critic"}, {"encoder_lr": 1e-6}])
def test_its_rate_and_gradients_are_its_own_beside_fine_tuning(kwargs: dict[str, Any]) -> None:
    updated = []
    for arguments in ({}, kwargs):
        after: list[Any] = []
        model = build("SAC", make_envs(continuous=True), other_sharing=True, learning_starts=30)
        auxiliary = AuxiliaryObjective("ssi", update_interval=2, batch_size=16)
        model.learn(40, CallbackList([EncoderCallback(**arguments), auxiliary, Watch(after)]))
        # The first update of both; that of RL comes after it.
        n = [bool(values.get("auxiliary/n_updates")) for _, values in after].index(True)
        updated.append(after[n][0])
        weights = "actor.features_extractor.encoder.layers.1.weight"
        assert not th.equal(after[n - 1][0][weights], after[n][0][weights])
    assert all(th.equal(updated[0][name], updated[1][name]) for name in updated[0])


def test_gradients_of_rl_are_left_as_they_are() -> None:
    model = build("PPO")

    class Mark(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            for parameter in self.model.policy.parameters():
                parameter.grad = th.full_like(parameter, 7.0)

    class Look(Mark):
        def _on_rollout_end(self) -> None:
            assert all((p.grad == 7).all() for p in self.model.policy.parameters())  # type: ignore[union-attr]

    model.learn(32, CallbackList([Mark(), AuxiliaryObjective("ssi", **SMALL), Look()]))


@pytest.mark.parametrize(
    ("name", "objective"),
    [(name, "ssi") for name in ALGORITHMS] + [(name, o) for name in ("PPO", "SAC") for o in ("abisim", "beta_vae")],
)
def test_weight_0_is_plain_stable_baselines3(name: str, objective: str) -> None:
    """Parameters, the optimizer, the environments and all random numbers, bit for bit."""
    outcomes = []
    for callback in (None, AuxiliaryObjective(objective, weight=0, **SMALL, **KWARGS.get(objective, {}))):
        model = build(name)
        model.learn(120, callback)
        state = {n: t for n, t in model.policy.state_dict().items() if not n.endswith("auxiliary_state")}
        optimizers = [
            tensor
            for name, parameters in model.get_parameters().items()
            if name.endswith("optimizer")
            for held in parameters["state"].values()
            for tensor in held.values()
        ]
        assert optimizers
        outcomes.append((state, th.get_rng_state(), np.random.get_state()[1], model._last_obs, *optimizers))
        if callback is not None:
            trainer = next(iter(callback._trainers.values()))
            assert trainer.n_updates > 3
            assert trainer._optimizer.state, "heads learn"
            assert not any(name.startswith("encoder.") for name in trainer._trained)
    (plain, *rest), (with_callback, *others) = outcomes
    assert plain.keys() == with_callback.keys()
    assert all(th.equal(plain[n], with_callback[n]) for n in plain)
    for a, b in zip(rest, others, strict=True):
        assert np.array_equal(a, b)


def test_heads_learn_with_weight_0_and_the_terms_are_logged() -> None:
    notes: list[Any] = []
    model = build("PPO", features_extractor_kwargs={"network": "Flat", "network_kwargs": {"width": 32}})
    callback = AuxiliaryObjective("ssi", weight=0, update_interval=1, batch_size=64, learning_rate=0.01)
    model.learn(400, CallbackList([callback, Watch(notes)]))
    logged = [values for _, values in notes if "auxiliary/inverse_nll" in values]
    assert {"auxiliary/loss", "auxiliary/accuracy", "auxiliary/n_updates"} <= logged[0].keys()
    assert logged[-1]["auxiliary/inverse_nll"] < logged[0]["auxiliary/inverse_nll"] - 0.1


def test_weight_scales_the_encoders_learning_rate() -> None:
    """One step of Adam moves each weight by the learning rate."""
    for weight in (1.0, 0.25):
        before: list[Any] = []
        after: list[Any] = []
        model = build("PPO", n_steps=12, batch_size=24)
        callback = AuxiliaryObjective("ssi", weight=weight, learning_rate=1e-3, update_interval=24, batch_size=16)
        model.learn(24, CallbackList([Watch(before), callback, Watch(after)]))
        (there, _), (here, _) = before[0], after[0]
        name = "features_extractor.encoder.layers.1.weight"
        assert float((here[name] - there[name]).abs().max()) == pytest.approx(weight * 1e-3, rel=1e-3)


def test_off_policy_it_learns_once_the_algorithm_does() -> None:
    for learning_starts, learns in ((1000, False), (4, True)):
        callback = AuxiliaryObjective("ssi", **SMALL)
        build("DQN", learning_starts=learning_starts).learn(100, callback)
        assert (callback._trainers["q_net"].n_updates > 0) == learns


@pytest.mark.parametrize("objective", ["abisim", "goal_progress"])
def test_a_base_learns_beside_it(objective: str) -> None:
    """By its own loss, from the encoder's weights; the objective's copy follows it."""
    model = build("PPO")
    kwargs = KWARGS.get(objective, {})
    callback = AuxiliaryObjective(objective, learning_rate=0.01, update_interval=8, batch_size=64, **kwargs)
    notes: list[Any] = []
    model.learn(32, callback)
    trainer = callback._trainers["actor"]
    base, encoder = trainer._base, model.policy.features_extractor.encoder
    assert base is not None
    begun = {name: t.clone() for name, t in base.encoder.state_dict().items()}
    model.learn(400, CallbackList([callback, Watch(notes)]), reset_num_timesteps=False)
    trainer = callback._trainers["actor"]
    base = trainer._base
    assert base is not None
    for name, tensor in base.encoder.state_dict().items():
        assert th.equal(tensor, trainer.objective.base_encoder.state_dict()[name])  # type: ignore[operator, union-attr]
    weights = "layers.1.weight"
    assert not th.equal(base.encoder.state_dict()[weights], begun[weights])
    assert not th.equal(base.encoder.state_dict()[weights], encoder.state_dict()[weights])
    logged = [values["auxiliary/base_inverse_nll"] for _, values in notes if "auxiliary/base_inverse_nll" in values]
    assert np.mean(logged[-5:]) < np.mean(logged[:5]) - 0.1


def test_no_gradient_leads_from_the_objective_to_its_base() -> None:
    """Without the base's own loss, the base stays."""
    model = build("PPO")
    callback = AuxiliaryObjective("abisim", **SMALL)
    model.learn(32, callback)
    trainer = callback._trainers["actor"]
    assert trainer._base is not None
    trainer._base.loss = lambda batch: (th.zeros(()), {})  # type: ignore[method-assign]
    before = {name: t.clone() for name, t in trainer._base.state_dict().items()}
    batch = TensorBatch.of(th.rand(16, 4, 5, 6), th.randint(3, (16,)), th.rand(16, 4, 5, 6))
    trainer._step(batch)
    assert all(th.equal(before[name], t) for name, t in trainer._base.state_dict().items())


def test_goals_follow_the_base(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same states stay goals; their embeddings are made again, since the base changes."""
    objective_class: Any = get_objective("goal_progress")
    plain, chosen, goals = objective_class.prepare, [], []

    def prepare(self: Any, observations: th.Tensor) -> None:
        plain(self, observations)
        psi = self.base_encoder(observations)
        assert float(th.cdist(self.goals, psi, p=1.0).min(dim=1).values.max()) == 0, "of the base as it is now"
        chosen.append(th.cdist(self.goals, psi, p=1.0).argmin(dim=1))
        goals.append(self.goals.clone())

    monkeypatch.setattr(objective_class, "prepare", prepare)
    model = build("PPO")
    callback = AuxiliaryObjective("goal_progress", update_interval=2, batch_size=16, **KWARGS["goal_progress"])
    model.learn(160, callback)
    model.learn(160, callback, reset_num_timesteps=False)
    assert callback._trainers["actor"].n_updates > 100
    assert len(goals) >= 3
    assert all(th.equal(chosen[0], each) for each in chosen)
    assert not th.equal(goals[0], goals[1])


def test_two_extractors_have_random_numbers_of_their_own() -> None:
    model = build("PPO", other_sharing=True)
    callback = AuxiliaryObjective("ssi", **SMALL)
    model.learn(16, callback)
    actor, critic = callback._trainers.values()
    assert not th.equal(actor._randomness.state, critic._randomness.state)
    assert actor._generator.bit_generator.state != critic._generator.bit_generator.state


def test_nothing_of_the_log_collides_with_two_copies(capsys: pytest.CaptureFixture[str]) -> None:
    """Stable-Baselines3 shortens names for the terminal, and refuses two that become equal."""
    model = build("PPO", other_sharing=True, verbose=1)
    model.learn(200, AuxiliaryObjective("goal_progress", **SMALL, **KWARGS["goal_progress"]))
    assert "critic/progress_loss" in capsys.readouterr().out


@pytest.mark.parametrize("objective", ["ssi", "abisim"])
def test_a_number_that_is_not_finite_stops(objective: str, monkeypatch: pytest.MonkeyPatch) -> None:
    objective_class: Any = get_objective(objective)
    plain = objective_class.loss

    def loss(self: Any, batch: Any) -> Any:
        value, terms = plain(self, batch)
        return value, {**terms, "broken": th.tensor(float("nan"))}

    monkeypatch.setattr(objective_class, "loss", loss)
    model = build("PPO")
    with pytest.raises(
        FloatingPointError, match=rf"auxiliary objective {objective} has broken = nan at its update 0, .*learning_rate"
    ):
        model.learn(200, AuxiliaryObjective(objective, **SMALL))


def test_an_infinite_gradient_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Recorder, "loss", lambda self, batch: (self.encoder(batch.obs).mul(0).sqrt().sum(), {}))
    model = build("PPO")
    before = {name: p.clone() for name, p in model.policy.named_parameters()}
    with pytest.raises(FloatingPointError, match=r"recorder has gradient norm = (nan|inf)"):
        model.learn(16, AuxiliaryObjective("recorder", **SMALL))
    assert all(th.equal(before[name], p) for name, p in model.policy.named_parameters())


# What says that an objective has learned: a term, and how much of what it is without the loss may be left.
LEARNED = {
    "ssi": ("inverse_nll", 0.5), "acro": ("inverse_nll", 0.9), "info_nce": ("info_nce", 0.8), "curl": ("info_nce", 0.7),
    "abisim": ("metric_loss", 0.1), "beta_vae": ("squared_error", 0.1), "goal_progress": ("progress_loss", 0.2),
}  # fmt: skip


def test_it_is_known_of_each_objective_whether_it_has_learned() -> None:
    assert LEARNED.keys() == {*OBJECTIVES}


@pytest.mark.parametrize("objective", LEARNED)
def test_it_learns_while_rl_runs_and_not_without_its_loss(objective: str, monkeypatch: pytest.MonkeyPatch) -> None:
    term, share = LEARNED[objective]
    objective_class: Any = get_objective(objective)
    plain = objective_class.loss

    def no_loss(self: Any, batch: Any) -> Any:
        value, terms = plain(self, batch)
        return 0.0 * value, terms

    found = []
    for loss in (plain, no_loss):
        monkeypatch.setattr(objective_class, "loss", loss)
        notes: list[Any] = []
        model = build("PPO", make_envs(4, limit=6), learning_rate=1e-5, n_epochs=1)
        # An observation shows the action that led to it, so the first of two is not to be seen.
        kwargs = {"k": [1, 2]} if objective == "acro" else KWARGS.get(objective, {})
        callback = AuxiliaryObjective(objective, update_interval=4, batch_size=64, learning_rate=0.01, **kwargs)
        model.learn(1200, CallbackList([callback, Watch(notes)]))
        name = f"auxiliary/{term}"
        found.append(np.mean([values[name] for _, values in notes if name in values][-10:]))
    assert found[0] < share * found[1]


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_every_objective_with_every_algorithm(name: str, objective: str) -> None:
    notes: list[Any] = []
    model = build(name)
    callback = AuxiliaryObjective(objective, **SMALL, **KWARGS.get(objective, {}))
    model.learn(100, CallbackList([callback, Watch(notes)]))
    assert all(trainer.n_updates > 2 for trainer in callback._trainers.values())
    logged: dict[str, Any] = {}
    for _, values in notes:
        logged |= values
    prefix = "auxiliary/" if len(callback._trainers) == 1 else "auxiliary/critic/"
    assert np.isfinite(logged[f"{prefix}loss"])


def test_the_encoder_keeps_its_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    """In training mode as in pretraining, and afterwards as RL has put it."""
    modes: list[bool] = []

    def loss(self: Any, batch: Any) -> Any:
        modes.append(self.encoder.training)
        return self.head(self.encoder(batch.obs)).pow(2).mean(), {}

    monkeypatch.setattr(Recorder, "loss", loss)
    for weight in (1.0, 0.0):
        modes.clear()
        model = build("PPO")
        model.learn(16, AuxiliaryObjective("recorder", weight=weight, **SMALL))
        model.policy.set_training_mode(False)
        assert {*modes} == {weight > 0}

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            assert not any(module.training for module in self.model.policy.modules())

    build("PPO").learn(16, CallbackList([AuxiliaryObjective("recorder", **SMALL), Look()]))


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_a_frozen_encoder_is_measured_only(weight: float, tmp_path: Any) -> None:
    from extractor_inputs import build as build_pretrained

    model = build_pretrained("PPO", write(tmp_path / "e.safetensors"), freeze=True)
    callback = AuxiliaryObjective("abisim", weight=weight, **SMALL)
    if weight:
        with pytest.raises(ValueError, match=r"actor is frozen, so weight=1 .*freeze \(in the zoo ,frozen\).*weight=0"):
            model.learn(64, callback)
        return
    before = {name: t.clone() for name, t in model.policy.features_extractor.encoder.state_dict().items()}
    model.learn(64, callback)
    after = model.policy.features_extractor.encoder.state_dict()
    assert callback._trainers["actor"].n_updates > 0
    assert all(th.equal(before[name], after[name]) for name in before)


def test_it_goes_on_from_a_file(tmp_path: Any) -> None:
    """The base begins with the encoder's weights, too."""
    from extractor_inputs import build as build_pretrained

    model = build_pretrained("PPO", write(tmp_path / "e.safetensors"), freeze=False)
    weights = {name: t.clone() for name, t in model.policy.features_extractor.encoder.state_dict().items()}
    started: list[Any] = []

    class Look(BaseCallback):
        def _on_training_start(self) -> None:
            trainer = callback._trainers["actor"]
            assert trainer._base is not None
            started.append([{**module.state_dict()} for module in (trainer._encoder, trainer._base.encoder)])
            for state in started[0]:
                assert all(th.equal(weights[name], state[name]) for name in weights)

        def _on_step(self) -> bool:
            return True

    callback = AuxiliaryObjective("abisim", **SMALL)
    model.learn(32, CallbackList([callback, Look()]))
    assert started


def test_settings_come_from_pretraining_where_none_are_given() -> None:
    callback = AuxiliaryObjective("acro", objective_kwargs={"l1_penalty": 0.5})
    entry, settings = callback._settings("Nav2D-v0")
    assert entry == "Nav2D-v0"
    assert settings.k == 5
    assert settings.objective_kwargs == {"l1_penalty": 0.5, "adaptive": "chance_corrected", "delta_scale": 3.0}
    entry, settings = AuxiliaryObjective("abisim", base_kwargs={"delta_scale": 2.0})._settings("elsewhere-v0")
    assert entry == "default"
    assert settings.base_kwargs == {"l1_penalty": 0.01, "adaptive": "paper", "delta_scale": 2.0}
    assert AuxiliaryObjective("recorder")._settings(None)[0] is None


PAGE = (Path(__file__).parents[2] / "docs" / "while_rl_runs.md").read_text(encoding="utf-8")


def test_the_example_of_the_docs_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (code,) = [block for block in blocks if "AuxiliaryObjective" in block]
    assert len(code.splitlines()) <= 10
    assert "100_000" in code
    monkeypatch.chdir(tmp_path)
    exec(code.replace("100_000", "1_000"), {})
    assert KEY in "".join(sb3.PPO.load("agent").policy.state_dict())


def test_the_example_of_a_learning_rate_runs_to_its_end() -> None:
    """As there, the last rollout goes beyond the steps asked for."""
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "encoder_lr=" in block]
    assert "100_000" in code
    exec(code.replace("100_000", "100").replace("policy_kwargs=", "n_steps=64, policy_kwargs=", 1), {})


@pytest.mark.parametrize(("kwargs", "message"), [
    ({"objective": "sssi"}, r"unknown method 'sssi'; known are"),
    ({"objective": "vanilla"}, r"no objective pretrains 'vanilla', only"),
    ({"weight": -0.5}, "weight must be a number of at least 0, got -0.5"),
    ({"weight": float("nan")}, "weight must be a number of at least 0, got nan"),
    ({"learning_rate": 0.0}, "learning_rate must be a number above 0, got 0.0"),
    ({"update_interval": 0}, "update_interval must be at least 1, got 0"),
    ({"batch_size": 1}, "batch_size must be at least 2, got 1"),
    ({"rate": 1}, "AuxiliaryObjective takes no argument 'rate'; it takes objective, weight"),
    ({"weight": "1"}, "weight must be a number, got '1'"),
])  # fmt: skip
def test_wrong_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AuxiliaryObjective(**kwargs)


@pytest.mark.parametrize(("kwargs", "message"), [
    ({"objective": "ssi", "objective_kwargs": {"wight": 1}}, r"objective_kwargs do not fit ssi: .*wight"),
    ({"objective": "ssi", "k": 2}, "ssi takes single steps, got k = 2"),
    ({"objective": "ssi", "base_kwargs": {"delta_scale": 3.0}}, "'ssi' builds on no base"),
    ({"objective": "acro", "k": 7}, "hardly any 7 lie in one episode"),
])  # fmt: skip
def test_what_does_not_fit_is_refused_when_training_starts(kwargs: dict[str, Any], message: str) -> None:
    model = build("PPO")
    with pytest.raises(ValueError, match=message):
        model.learn(200, AuxiliaryObjective(**SMALL, **kwargs))


def test_other_extractors_are_refused() -> None:
    env = make_envs(2)
    model = sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8)
    with pytest.raises(ValueError, match=r"FlattenExtractor, but .* VanillaExtractor .*'network': 'nature'"):
        model.learn(16, AuxiliaryObjective("ssi"))


def test_two_of_them_are_refused() -> None:
    model = build("PPO")
    ssi = AuxiliaryObjective("ssi")
    for second, name in ((CallbackList([AuxiliaryObjective("curl")]), "curl"), (ssi, "ssi")):
        with pytest.raises(ValueError, match=f"two auxiliary objectives, ssi and {name}"):
            model.learn(16, CallbackList([ssi, second]))


@pytest.mark.parametrize("callback_class", [AuxiliaryObjective, EncoderCallback])
def test_within_a_callback_of_some_steps_it_is_refused(callback_class: type[BaseCallback]) -> None:
    """Rollouts would begin and end without it, and it would do nothing."""
    name = callback_class.__name__
    with pytest.raises(ValueError, match=f"{name} within EveryNTimesteps .* give both to learn in one list"):
        build("PPO").learn(16, EveryNTimesteps(4, CallbackList([callback_class()])))
    evaluation = EvalCallback(make_envs(1), callback_on_new_best=callback_class(), verbose=0)
    with pytest.raises(ValueError, match=f"{name} within EvalCallback"):
        build("PPO").learn(16, evaluation)


def test_actions_that_do_not_begin_at_0_are_refused() -> None:
    env = make_envs(2)
    env.action_space = spaces.Discrete(3, start=5)
    with pytest.raises(ValueError, match=r"count from 0 .*Discrete\(3, start=5\); .*sb3_abisim.PlainActions"):
        build("PPO", env).learn(16, AuxiliaryObjective("ssi"))


def test_an_encoder_in_the_environment_is_refused(tmp_path: Any) -> None:
    from extractor_inputs import RandomImages
    from stable_baselines3.common.vec_env import DummyVecEnv

    from sb3_abisim import VecEncodeObservations

    path = str(write(tmp_path / "e.safetensors"))
    env = VecEncodeObservations(DummyVecEnv([RandomImages]), path)
    model = sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8)
    with pytest.raises(ValueError, match=r"stands in the environment .*leave ,frozen out"):
        model.learn(16, AuxiliaryObjective("ssi"))


def test_an_encoder_without_its_file_is_refused(tmp_path: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from extractor_inputs import build as build_pretrained

        model = build_pretrained("DQN", tmp_path / "absent.safetensors", freeze=False)
    # Now, and not once it acts by its policy.
    model.learning_starts = 1000
    with pytest.raises(FileNotFoundError, match="no pretrained weights"):
        model.learn(16, AuxiliaryObjective("ssi"))
