"""Which transitions an auxiliary objective sees; each observation says its step, its episode and how it was reached."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
import torch as th
from auxiliary_inputs import (
    ACTION,
    CONTINUOUS,
    ENDED,
    EPISODE,
    STEP,
    CountingEnv,
    Recorder,
    action_code,
    build,
    make_envs,
    register_inputs,
)
from extractor_inputs import ALGORITHMS
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecFrameStack, VecNormalize

from sb3_abisim.objectives.base import TensorBatch
from sb3_abisim.rl.auxiliary import AuxiliaryObjective
from sb3_abisim.rl.auxiliary_data import ReplaySteps, RolloutHistory, RolloutSteps, Steps, sample_batch
from sb3_abisim.rl.combined import CombinedEncoderExtractor

GENERATOR = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    register_inputs(monkeypatch)


def seen(objective: str = "recorder") -> tuple[Any, Any, Any]:
    """The numbers in all observations and next observations that were seen [m, 4], and the actions [m, k, ...]."""
    batches = Recorder.batches
    assert batches, "no update was made"
    obs, next_obs = (
        np.rint(255 * th.cat([getattr(batch, name) for batch in batches])[:, :, 0, 0].numpy()).astype(int)
        for name in ("obs", "next_obs")
    )
    actions = th.cat([batch.actions for batch in batches]).numpy()
    return obs, next_obs, actions


def require_true_transitions(k: int, sequences: bool, limit: int) -> None:
    obs, next_obs, actions = seen()
    assert (next_obs[:, STEP] == obs[:, STEP] + k).all()
    assert (next_obs[:, EPISODE] == obs[:, EPISODE]).all()
    assert not obs[:, ENDED].any(), "no episode goes on from its end"
    led = action_code(actions).reshape(len(obs), -1)
    if sequences:
        assert led.shape[1] == k
        assert (led[:, -1] == next_obs[:, ACTION]).all()
    elif k == 1:
        assert (led[:, 0] == next_obs[:, ACTION]).all()
    assert next_obs[:, ENDED].any(), "ends of episodes are seen"
    assert (next_obs[:, STEP] == limit).any(), "truncated ones, too"


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize(("objective", "k"), [("recorder", 1), ("recorder", 3), ("sequence_recorder", 3)])
def test_transitions_are_true_ones(name: str, objective: str, k: int) -> None:
    model = build(name, make_envs(2, continuous=name in CONTINUOUS))
    model.learn(600, AuxiliaryObjective(objective, update_interval=8, batch_size=64, k=k))
    require_true_transitions(k, objective == "sequence_recorder", limit=5)


def test_continuous_actions_of_ppo_are_those_that_the_environment_got() -> None:
    """Stable-Baselines3 stores them before they are clipped, and these are mostly out of bounds."""
    model = build("PPO", make_envs(2, continuous=True))
    model.learn(600, AuxiliaryObjective("recorder", update_interval=8, batch_size=64))
    require_true_transitions(1, False, 5)
    _, _, actions = seen()
    assert actions.min() >= 2
    assert (actions == 2).any()


class OneArray(VecEnvWrapper):
    """Hands out every terminal observation in the same array."""

    def reset(self) -> Any:
        self._array = np.zeros(self.observation_space.shape, np.uint8)
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                self._array[:] = info["terminal_observation"]
                info["terminal_observation"] = self._array
        return observations, rewards, dones, infos


def test_a_terminal_observation_is_kept_as_it_was() -> None:
    build("PPO", OneArray(make_envs(1))).learn(600, AuxiliaryObjective("recorder", update_interval=8, batch_size=64))
    require_true_transitions(1, False, 5)


def test_a_range_of_steps() -> None:
    build("PPO").learn(600, AuxiliaryObjective("recorder", update_interval=8, batch_size=64, k=[1, 3]))
    obs, next_obs, _ = seen()
    assert {*(next_obs - obs)[:, STEP].tolist()} == {1, 2, 3}
    assert (next_obs[:, EPISODE] == obs[:, EPISODE]).all()


@pytest.mark.parametrize("kwargs", [
    {"n_steps": 3},
    {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}},
], ids=["n_step", "one_array"])  # fmt: skip
@pytest.mark.parametrize("k", [1, 3])
def test_other_replay_buffers(kwargs: dict[str, Any], k: int) -> None:
    """The ring is smaller than what is seen, so it wraps around."""
    model = build("DQN", **{"buffer_size": 60, **kwargs})
    model.learn(400, AuxiliaryObjective("recorder", update_interval=4, batch_size=16, k=k))
    obs, next_obs, actions = seen()
    assert (next_obs[:, STEP] == obs[:, STEP] + k).all()
    assert (next_obs[:, EPISODE] == obs[:, EPISODE]).all()
    if k == 1:
        assert (action_code(actions) == next_obs[:, ACTION]).all()
    # With one array, the next episode's first observation has taken the place of the last one.
    assert next_obs[:, ENDED].any() == ("n_steps" in kwargs)


class GoalEnv(CountingEnv):
    """As a task of goals, of which hindsight makes others."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(as_dict=True, **kwargs)
        image, goal = self.observation_space["camera"], spaces.Box(-1, 1, (2,))
        self.observation_space = spaces.Dict({"observation": image, "achieved_goal": goal, "desired_goal": goal})

    def _observe(self) -> Any:
        observation = super()._observe()
        goals = dict.fromkeys(("achieved_goal", "desired_goal"), observation["speed"])
        return {"observation": observation["camera"], **goals}

    def compute_reward(self, achieved: Any, desired: Any, infos: Any) -> Any:
        return -np.linalg.norm(achieved - desired, axis=-1)


@pytest.mark.parametrize("k", [1, 3])
def test_hindsight(k: int) -> None:
    """Its buffer makes other goals, and the images are those that were seen."""
    kwargs = {"encoders": {"observation": None}, "networks": {"observation": {"network": "Flat"}}}
    env = DummyVecEnv([lambda first=first: gym.wrappers.TimeLimit(GoalEnv(first=first), 5) for first in (0, 128)])
    model = build(
        "DQN", env, buffer_size=60, learning_starts=20, replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 2}, features_extractor_class=CombinedEncoderExtractor,
        features_extractor_kwargs=kwargs,
    )  # fmt: skip
    model.learn(400, AuxiliaryObjective("recorder", update_interval=4, batch_size=16, k=k))
    require_true_transitions(k, False, limit=5)


@pytest.mark.parametrize("name", ["PPO", "DQN"])
def test_stacked_frames(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stack of an episode's last observation holds the frames before it, and none of the next episode."""
    # Stable-Baselines3 takes the shortest side for the channels.
    monkeypatch.setattr("auxiliary_inputs.SHAPE", (4, 9, 10))
    model = build(name, VecFrameStack(make_envs(2), 2, channels_order="first"))
    model.learn(600, AuxiliaryObjective("recorder", update_interval=8, batch_size=64))
    n = 4
    for batch in Recorder.batches:
        before, after = batch.obs, batch.next_obs
        assert th.equal(after[:, :n], before[:, n:])
    newest = [TensorBatch.of(b.obs[:, n:], b.actions, b.next_obs[:, n:]) for b in Recorder.batches]
    Recorder.batches[:] = newest
    require_true_transitions(1, False, limit=5)


@pytest.mark.parametrize("shared", [False, True])
def test_all_that_a_full_ring_holds_is_sampled_and_nothing_else(shared: bool) -> None:
    env = make_envs(1)
    buffer = ReplayBuffer(
        7, env.observation_space, env.action_space, "cpu",
        optimize_memory_usage=shared, handle_timeout_termination=False,
    )  # fmt: skip
    frames = np.arange(12, dtype=np.uint8)[:, None, None, None, None] * np.ones((1, 1, 4, 5, 6), np.uint8)
    for i in range(11):
        buffer.add(frames[i], frames[i + 1], np.array([i % 3]), np.zeros(1), np.array([i == 6]), [{}])
    frames_of_an_end = {(4, 5), (6, 7)}  # the oldest, and the one before the next episode's first
    assert pairs_of(ReplaySteps(buffer), 1) == {(i, i + 1) for i in range(4, 11)} - (
        frames_of_an_end if shared else set()
    )
    lost = {(4, 6), (5, 7)} if shared else set()
    assert pairs_of(ReplaySteps(buffer), 2) == {(i, i + 2) for i in range(4, 10)} - {(6, 8)} - lost


def pairs_of(steps: Steps, k: int) -> set[tuple[int, int]]:
    """All that is sampled, by the first number of each observation."""
    generator = np.random.default_rng(0)
    batches = [sample_batch(steps, generator, 4, k) for _ in range(100)]
    return {(int(batch.obs[i].flat[0]), int(batch.next_obs[i].flat[0])) for batch in batches if batch for i in range(4)}


def test_several_steps_do_not_cross_a_reset_by_a_second_learn() -> None:
    model = build("DQN", make_envs(1, limit=50))
    callback = AuxiliaryObjective("recorder", update_interval=4, batch_size=16, k=2)
    for _ in range(30):
        model.learn(7, callback)
    obs, next_obs, _ = seen()
    assert (next_obs[:, EPISODE] == obs[:, EPISODE]).all()


def test_short_rollouts_join_and_others_are_read_alone() -> None:
    """Of the newest rollouts as many are kept as hold enough steps; one that does not follow drops the others."""

    def rollout(first: int, n: int) -> RolloutSteps:
        frames = np.arange(first, first + n + 1, dtype=np.uint8)[:, None, None, None, None]
        return RolloutSteps(
            {None: frames[:-1]}, np.zeros((n, 1)), np.zeros((n, 1), bool), {None: {}}, {None: frames[-1]}
        )

    history = RolloutHistory(8)
    for first in range(0, 20, 4):
        history.add(rollout(first, 4))
        history.release()
    joined = RolloutSteps.join(history.parts)
    assert joined.observed[None].flatten().tolist() == list(range(12, 20))
    assert pairs_of(joined, 8) == {(12, 20)}
    history.add(rollout(21, 4))
    assert RolloutSteps.join(history.parts).observed[None].flatten().tolist() == [21, 22, 23, 24]
    history.add(rollout(25, 9))
    history.release()
    assert not history.parts


def test_a_rollout_comes_back_from_tensors() -> None:
    part = RolloutSteps(
        {None: np.arange(4, dtype=np.uint8).reshape(4, 1, 1, 1, 1)}, np.zeros((4, 1)),
        np.array([[False], [True], [False], [False]]), {None: {(1, 0): np.full((1, 1, 1), 9, np.uint8)}},
        {None: np.full((1, 1, 1, 1), 4, np.uint8)},
    )  # fmt: skip
    again = RolloutSteps.from_tensors(part.to_tensors())
    t = np.arange(4)
    for steps in (part, again):
        assert steps.next_observations(None, t, 0 * t).flatten().tolist() == [1, 9, 3, 4]
        assert steps.has_next(t, 0 * t).all()


def test_an_end_without_its_observation_is_left_out() -> None:
    part = RolloutSteps(
        {None: np.arange(4, dtype=np.uint8).reshape(4, 1, 1, 1, 1)}, np.zeros((4, 1)),
        np.array([[False], [True], [False], [False]]), {None: {}}, {None: np.full((1, 1, 1, 1), 4, np.uint8)},
    )  # fmt: skip
    batch = sample_batch(part, np.random.default_rng(0), 4)
    assert batch is not None
    assert 1 not in batch.obs
    with pytest.raises(ValueError, match=r"hardly any 3 lie in one episode .* lower k"):
        sample_batch(part, np.random.default_rng(0), 1, k=3)
    assert sample_batch(part, np.random.default_rng(0), 5) is None, "too few steps"


@pytest.mark.parametrize("name", ["PPO", "RecurrentPPO", "DQN", "SAC"])
def test_the_image_of_a_dictionary(name: str, tmp_path: Any) -> None:
    from sb3_abisim.networks.base import make_encoder
    from sb3_abisim.networks.encoder_file import save_encoder

    env = make_envs(2, continuous=name in CONTINUOUS, as_dict=True)
    space = env.observation_space["camera"]  # type: ignore[index]
    save_encoder(
        tmp_path / "e.safetensors", make_encoder(space, "Flat"), observation_space=space,
        action_space=env.action_space, env_id="x", env_kwargs={}, objective="ssi", settings={}, dataset_hash="0" * 64,
        reference_observations=np.zeros((2, *space.shape), np.uint8),
    )  # fmt: skip
    model = build(
        name, VecNormalize(env, norm_obs_keys=["speed"]), features_extractor_class=CombinedEncoderExtractor,
        features_extractor_kwargs={"encoders": {"camera": str(tmp_path / "e.safetensors")}},
    )  # fmt: skip
    model.learn(400, CallbackList([AuxiliaryObjective("recorder", update_interval=8, batch_size=32)]))
    require_true_transitions(1, False, 5)
