"""Buffers of Stable-Baselines3, filled by its algorithms: what comes back is what the environments did."""

import functools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_abisim import CUT, TERMINATED, TRUNCATED, TransitionDataset, import_dataset
from sb3_abisim.data.command import main
from sb3_abisim.data.importing import import_report
from sb3_abisim.data.readers.buffer import import_buffer

SHAPE = (3, 4, 5)
ENDS = {"terminated": TERMINATED, "truncated": TRUNCATED}
# (copy, episode, step) of an observation, the action from it, and how the episode ended there.
Step = tuple[int, int, int]


class TraceEnv(gym.Env):
    """Observations hold the copy, the episode and the step; what happens is written down.

    :param number: of the copy
    :param action_space: of the environment
    :param form: of the observations: "first", "last", "none" or "dict"
    """

    def __init__(self, number: int = 0, action_space: gym.Space | None = None, form: str = "first") -> None:
        self.action_space = gym.spaces.Discrete(3) if action_space is None else action_space
        self.number, self.form, self.episode = number, form, 0
        image = gym.spaces.Box(0, 255, self._show(np.zeros(SHAPE, np.uint8)).shape, np.uint8)
        self.observation_space = image
        if form == "dict":
            angle = gym.spaces.Box(-9, 99, (2,), np.float32)
            self.observation_space = gym.spaces.Dict(camera=image, angle=angle, gear=gym.spaces.Discrete(99))
        self.actions: dict[Step, Any] = {}
        self.ends: dict[Step, int] = {}

    def _show(self, image: np.ndarray) -> np.ndarray:
        if self.form == "none":
            return image.reshape(12, 5)
        return np.moveaxis(image, 0, -1) if self.form == "last" else image

    def _observe(self) -> Any:
        labels = np.array([self.number, self.episode, self.step_number], np.uint8)
        image = self._show(np.broadcast_to(labels[:, None, None], SHAPE))
        if self.form != "dict":
            return image
        return {"camera": image, "angle": np.float32([self.step_number, -1]), "gear": self.step_number}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.episode, self.step_number = self.episode + 1, 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        assert self.action_space.contains(action)
        self.actions[self.number, self.episode, self.step_number] = np.copy(action)
        self.step_number += 1
        # Episodes of 3 to 6 steps; every other one ends by itself.
        over = self.step_number >= 3 + (self.episode + self.number) % 4
        terminated = over and self.episode % 2 == 0
        if over:
            here = self.number, self.episode, self.step_number
            self.ends[here] = TERMINATED if terminated else TRUNCATED
        return self._observe(), 0.0, terminated, over and not terminated, {}


def make(n_envs: int, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([functools.partial(TraceEnv, i, **kwargs) for i in range(n_envs)])


def train(
    algorithm: Any, n_steps: int, n_envs: int = 2, times: int = 1, reset: bool = False, env: Any = None, **kwargs: Any
) -> tuple[Any, list[TraceEnv]]:
    """A model that has acted, and its environments."""
    env = make(n_envs) if env is None else env
    dictionary = isinstance(env.observation_space, gym.spaces.Dict)
    more = {"policy_kwargs": {"net_arch": [4]}, "device": "cpu", "seed": 0}
    if algorithm not in (PPO, RecurrentPPO):
        more |= {"learning_starts": 10**6, "buffer_size": 1000, "train_freq": 1}
    else:
        more |= {"n_epochs": 1, "batch_size": 16, "n_steps": n_steps}
    policy = "MultiInputPolicy" if dictionary else "MlpLstmPolicy" if algorithm is RecurrentPPO else "MlpPolicy"
    model = algorithm(policy, env, **(more | kwargs))
    for _ in range(times):
        model.learn(n_steps * n_envs, reset_num_timesteps=reset)
    return model, [copy.unwrapped for copy in env.envs]


def transitions(dataset: TransitionDataset) -> dict[Step, Any]:
    """Each transition's first observation and its action, after a look at the second."""
    found = {}
    for batch in dataset.batches(1):
        obs, next_obs = (
            (o[0] == o[0, :, :1, :1]).all() and o[0, :, 0, 0].tolist() for o in (batch.obs, batch.next_obs)
        )
        assert next_obs == [*obs[:2], obs[2] + 1], "within an episode, one step on"
        assert tuple(obs) not in found
        found[tuple(obs)] = batch.actions[0]
    return found


def ends(dataset: TransitionDataset) -> dict[Step, int]:
    last = np.flatnonzero(dataset.ends)
    labels = dataset.frames(last)[:, :, 0, 0].tolist()
    return {tuple(label): end for label, end in zip(labels, dataset.ends[last].tolist(), strict=True)}


def read(buffer: Any, folder: Path, **options: Any) -> TransitionDataset:
    import_dataset("buffer", buffer, folder, verbose=0, **options)
    return TransitionDataset(folder, eval_fraction=0.0)


def of(traces: list[TraceEnv], name: str) -> dict[Step, Any]:
    return {step: value for trace in traces for step, value in getattr(trace, name).items()}


def test_a_replay_buffer_holds_all_that_happened(tmp_path: Path) -> None:
    model, traces = train(DQN, 40, n_envs=3)
    dataset = read(model.replay_buffer, tmp_path / "d", env_id="Trace-v0")
    assert transitions(dataset) == of(traces, "actions")
    found, happened = ends(dataset), of(traces, "ends")
    assert {step: end for step, end in found.items() if end != CUT} == happened
    assert {TERMINATED, TRUNCATED} < set(found.values()) and list(found.values()).count(CUT) <= 3
    assert dataset.env_id == "Trace-v0" and dataset.meta["source"]["left_out"] == ["rewards"]
    assert read(model.replay_buffer, tmp_path / "unnamed").env_id == "unknown"


def test_a_full_replay_buffer_begins_at_its_oldest_transition(tmp_path: Path) -> None:
    model, traces = train(DQN, 50, buffer_size=2 * 17)
    assert model.replay_buffer.full and model.replay_buffer.pos == 50 % 17
    dataset = read(model.replay_buffer, tmp_path / "d")
    kept = [step for trace in traces for step in list(trace.actions)[-17:]]
    happened = of(traces, "actions")
    assert transitions(dataset) == {step: happened[step] for step in kept}


@pytest.mark.parametrize("n_steps", [12, 50, 51], ids=["not full", "full", "full and at its beginning"])
def test_one_array_for_both_observations(n_steps: int, tmp_path: Path) -> None:
    """Of each episode, the last transition is lost; so is the oldest of a full ring."""
    kwargs = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    model, traces = train(DQN, n_steps, buffer_size=2 * 17, **kwargs)
    assert model.replay_buffer.full == (n_steps >= 50) and (model.replay_buffer.pos == 0) == (n_steps == 51)
    dataset = read(model.replay_buffer, tmp_path / "d")
    happened, over = of(traces, "actions"), of(traces, "ends")
    kept = [step for trace in traces for step in list(trace.actions)[-min(n_steps, 17) :][n_steps >= 50 :]]
    newest = [list(trace.actions)[-1] for trace in traces]
    lost = [s for s in kept if (*s[:2], s[2] + 1) in over and s not in newest]
    assert len(lost) > 2
    assert transitions(dataset) == {step: happened[step] for step in kept if step not in lost}
    assert {end for step, end in ends(dataset).items() if step in lost} == {CUT}
    assert dataset.meta["source"]["unseen_ends"] == len(lost)
    assert f"{len(lost)} transitions whose next observation is not in the buffer" in import_report(tmp_path / "d")


def test_an_end_that_is_the_newest_transition_is_there_in_one_array(tmp_path: Path) -> None:
    space = TraceEnv().observation_space
    settings = {"optimize_memory_usage": True, "handle_timeout_termination": False, "device": "cpu"}
    buffer = ReplayBuffer(9, space, gym.spaces.Discrete(3), **settings)
    env = TraceEnv()
    obs, _ = env.reset()
    done = False
    while not done:
        next_obs, _, terminated, truncated, _ = env.step(1)
        done = terminated or truncated
        buffer.add(obs[None], next_obs[None], np.array([1]), np.zeros(1), np.array([done]), [{}])
        obs = next_obs
    dataset = read(buffer, tmp_path / "d")
    assert transitions(dataset) == env.actions
    # Without timeouts, nothing tells how it ended.
    assert list(ends(dataset).values()) == [TERMINATED]
    assert "which episodes were truncated" in import_report(tmp_path / "d")


def test_a_reset_between_two_calls_of_learn_cuts_the_episode(tmp_path: Path) -> None:
    model, traces = train(DQN, 8, times=3, reset=True)
    happened, over = of(traces, "actions"), of(traces, "ends")
    n_left = sum((*step[:2], step[2] + 1) not in over and (*step[:2], step[2] + 1) not in happened for step in happened)
    assert n_left > 2 * len(traces) or n_left >= 4
    dataset = read(model.replay_buffer, tmp_path / "d")
    assert transitions(dataset) == happened
    assert list(ends(dataset).values()).count(CUT) == n_left


@pytest.mark.parametrize("form", ["last", "none", "dict"])
def test_forms_of_observations(form: str, tmp_path: Path) -> None:
    env = make(2, form=form)
    buffer_class = DictReplayBuffer if form == "dict" else ReplayBuffer
    buffer = buffer_class(100, env.observation_space, env.action_space, device="cpu", n_envs=2)
    obs = env.reset()
    for _ in range(20):
        actions = np.array([env.action_space.sample() for _ in range(2)])
        next_obs, rewards, dones, infos = env.step(actions)
        true_next = {k: v.copy() for k, v in next_obs.items()} if form == "dict" else next_obs.copy()
        for i in np.flatnonzero(dones):
            for key in true_next if form == "dict" else [slice(None)]:
                end = infos[i]["terminal_observation"]
                (true_next[key] if form == "dict" else true_next)[i] = end[key]
        buffer.add(obs, true_next, actions, rewards, dones, infos)
        obs = next_obs
    dataset = read(buffer, tmp_path / "d")
    assert dataset.meta["source"]["channels"] == ("first" if form == "dict" else form)
    traces = [copy.unwrapped for copy in env.envs]
    if form == "none":
        assert dataset.observation_space.shape == (1, 12, 5)
        steps = dataset.frames(np.arange(dataset.n_frames)).reshape(-1, 3, 20)[:, :, 0]
        kept = steps[np.flatnonzero(dataset.ends == 0)]
        assert sorted(map(tuple, kept.tolist())) == sorted(of(traces, "actions"))
        return
    assert dataset.observation_space.shape == SHAPE
    assert transitions(dataset) == of(traces, "actions")
    if form == "dict":
        steps = dataset.frames(np.arange(dataset.n_frames))[:, 2, 0, 0]
        factors = dataset.factors(np.arange(dataset.n_frames))
        assert factors["angle"].shape == (dataset.n_frames, 2) and (factors["angle"][:, 0] == steps).all()
        assert factors["gear"].dtype == np.int64 and (factors["gear"] == steps).all()


def test_a_dict_with_a_broken_vector_is_cut_there(tmp_path: Path) -> None:
    """Images that follow each other are not enough."""
    space = TraceEnv(form="dict").observation_space
    buffer = DictReplayBuffer(10, space, gym.spaces.Discrete(3), device="cpu")
    rows = [
        {"camera": np.zeros((1, *SHAPE), np.uint8), "angle": np.float32([[i, np.nan]]), "gear": np.array([0])}
        for i in (0, 1, 2, 9, 4)
    ]
    for before, after in ((0, 1), (1, 2), (3, 4)):
        args = rows[before], rows[after], np.array([0]), np.zeros(1), np.array([False]), [{}]
        buffer.add(*args)
    dataset = read(buffer, tmp_path / "d")
    assert dataset.ends.tolist() == [0, 0, CUT, 0, CUT]
    assert dataset.factors(np.arange(5))["angle"][:, 0].tolist() == [0, 1, 2, 9, 4]


WIDE = gym.spaces.Box(np.float32([[0, -5, 1]]), np.float32([[10, 5, 1.5]]))


def test_actions_of_an_off_policy_algorithm_are_those_of_the_environment(tmp_path: Path) -> None:
    model, traces = train(SAC, 20, env=make(2, action_space=WIDE))
    assert np.abs(model.replay_buffer.actions).max() <= 1
    dataset = read(model.replay_buffer, tmp_path / "d")
    happened, found = of(traces, "actions"), transitions(dataset)
    assert dataset.action_space == WIDE and found.keys() == happened.keys()
    for step, action in happened.items():
        np.testing.assert_allclose(found[step], action, rtol=1e-5, atol=1e-5)


def test_actions_that_are_not_scaled(tmp_path: Path) -> None:
    buffer = ReplayBuffer(10, TraceEnv().observation_space, WIDE, device="cpu")
    env = TraceEnv(action_space=WIDE)
    obs, _ = env.reset()
    action = np.float32([[7, -2, 1.25]])
    next_obs = env.step(action)[0]
    buffer.add(obs[None], next_obs[None], action[None], np.zeros(1), np.zeros(1, bool), [{}])
    with pytest.raises(ValueError, match=r"actions up to 7, .* pass scaled_actions=False"):
        read(buffer, tmp_path / "a")
    dataset = read(buffer, tmp_path / "b", scaled_actions=False)
    assert np.array_equal(dataset.actions([0])[0], action)


@pytest.mark.parametrize("trained", [False, True], ids=["before get()", "after get()"])
@pytest.mark.parametrize(("algorithm", "n_envs"), [(PPO, 1), (PPO, 3), (RecurrentPPO, 3)])
def test_a_rollout_buffer_lacks_what_ends_episodes(algorithm: Any, n_envs: int, trained: bool, tmp_path: Path) -> None:
    model, traces = train(algorithm, 32, n_envs=n_envs)
    buffer = model.rollout_buffer
    assert buffer.generator_ready
    if not trained:
        model.collect_rollouts(model.env, _no_callback(model), buffer, 32)
        assert not buffer.generator_ready
    dataset = read(buffer, tmp_path / "d")
    happened, over = of(traces, "actions"), of(traces, "ends")
    kept = [step for trace in traces for step in list(trace.actions)[-32:]]
    newest = [list(trace.actions)[-1] for trace in traces]
    lost = [step for step in kept if (*step[:2], step[2] + 1) in over or step in newest]
    assert transitions(dataset) == {step: happened[step] for step in kept if step not in lost}
    assert set(ends(dataset).values()) == {CUT}
    n_ended = sum((*step[:2], step[2] + 1) in over and step not in newest for step in kept)
    assert dataset.meta["source"]["unseen_ends"] == n_ended > 0
    assert f"{len(lost)} transitions whose next" in import_report(tmp_path / "d")


def _no_callback(model: Any) -> Any:
    from stable_baselines3.common.callbacks import ConvertCallback

    callback = ConvertCallback(lambda *args: True)
    callback.init_callback(model)
    return callback


def test_actions_of_an_on_policy_algorithm_are_clipped_as_the_environment_saw_them(tmp_path: Path) -> None:
    model, traces = train(PPO, 16, env=make(2, action_space=WIDE))
    assert (model.rollout_buffer.actions.reshape(-1, 3) < WIDE.low.ravel()).any(), "as the network gave them"
    found, happened = transitions(read(model.rollout_buffer, tmp_path / "d")), of(traces, "actions")
    assert found and all(np.array_equal(action, happened[step]) for step, action in found.items())


def test_a_rollout_without_an_end_is_warned_about(tmp_path: Path) -> None:
    buffer = RolloutBuffer(3, TraceEnv().observation_space, gym.spaces.Discrete(3), device="cpu")
    import torch as th

    for i in range(2):
        obs = np.full((1, *SHAPE), i, np.uint8)
        buffer.add(obs, np.array([[1]]), np.zeros(1), np.array([i == 0]), th.zeros(1), th.zeros(1))
    with pytest.warns(UserWarning, match="no episode ends among the 1 transitions"):
        dataset = read(buffer, tmp_path / "d")
    assert dataset.frames([0, 1])[:, 0, 0, 0].tolist() == [0, 1]


def test_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, _ = train(DQN, 5)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    with pytest.raises(SystemExit) as exit_info:
        main(["import", "buffer", str(tmp_path / "buffer.pkl"), "-o", str(tmp_path / "d")])
    (line,) = capsys.readouterr().err.splitlines()
    assert exit_info.value.code == 2 and "can run any code" in line and "model.load_replay_buffer(FILE)" in line
    with pytest.raises(ValueError, match="can run any code"):
        import_buffer(tmp_path / "buffer.pkl", tmp_path / "d")


def test_what_is_no_buffer_or_empty(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a ReplayBuffer or a RolloutBuffer .*, got list"):
        import_buffer([1], tmp_path / "d")
    empty = ReplayBuffer(5, TraceEnv().observation_space, gym.spaces.Discrete(3), device="cpu")
    with pytest.raises(ValueError, match="ReplayBuffer is empty; import it after learn"):
        import_buffer(empty, tmp_path / "d")
    vectors = ReplayBuffer(5, gym.spaces.Box(0, 1, (4,)), gym.spaces.Discrete(3), device="cpu")
    vectors.add(np.zeros(4), np.zeros(4), np.array([0]), np.zeros(1), np.zeros(1), [{}])
    with pytest.raises(ValueError, match=r"ReplayBuffer: .*only uint8 images"):
        import_buffer(vectors, tmp_path / "d")
    assert not (tmp_path / "d").exists()
