"""The ladder: targets are the environment's, learned on one split and scored on each; who offers none is refused."""

import json

import gymnasium as gym
import index_env  # noqa: F401  (registers an environment without shortest paths)
import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_abisim.analysis import command as analyze
from sb3_abisim.analysis import readouts
from sb3_abisim.envs.base import BatchEnv, SingleEnv
from sb3_abisim.envs.nav2d import SIZE
from sb3_abisim.envs.shortest_paths import ShortestPaths
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.registry import EnvTraits, register_traits


class SignsVectorEnv(BatchEnv):
    """One byte says which of two actions is best, in the split "eval" which is not, and another how far it is."""

    def __init__(self, num_envs=1, max_episode_steps=None, render_mode=None, autoreset=True, split="train"):
        space = gym.spaces.Box(0, 255, (3, 4, 4), np.uint8)
        super().__init__(num_envs, space, gym.spaces.Discrete(2), max_episode_steps, render_mode, autoreset)
        self._flip, self._state = split == "eval", np.zeros((num_envs, 2), dtype=np.int64)

    def _reset_envs(self, indices):
        for i in indices:
            self._state[i] = self._generators[i].integers(0, 2), self._generators[i].integers(0, 200)

    def _observe(self, indices):
        best, far = self._state[indices].T
        shown = np.zeros((len(indices), 3, 4, 4), dtype=np.uint8)
        shown[:, 0], shown[:, 1] = (255 * (best ^ self._flip))[:, None, None], far[:, None, None]
        return shown

    def factors(self):
        return {"state": self._state.copy()}

    def shortest_paths(self, factors):
        best, far = factors["state"].T
        return ShortestPaths(best[:, None] == np.arange(2), far + 3.0, np.full(len(far), 3.0))


class SignsEnv(SingleEnv):
    batch_class = SignsVectorEnv


gym.register("Signs-v0", entry_point=SignsEnv, vector_entry_point=SignsVectorEnv, max_episode_steps=5)
register_traits("Signs-v0", EnvTraits(splits=("eval", "train")))


class FirstPixels(nn.Module):
    def forward(self, x):
        return x[:, :2, 0, 0]


def test_an_environment_of_ones_own_is_learned_on_train_and_scored_on_each_split():
    learn, tests = readouts.sample_settings("Signs-v0", 60, seed=5)
    scores = readouts.readouts(FirstPixels(), learn, tests)
    assert list(scores) == ["train split", "eval split"]
    assert scores["train split"]["optimal_action"] == 1.0 and scores["eval split"]["optimal_action"] == 0.0
    assert min(scores[name]["geodesic_excess"] for name in scores) > 0.99
    assert set(scores["train split"]) == {"optimal_action", "geodesic_excess"}, "blocked points it does not know"


def test_states_are_first_ones_of_other_episodes_each():
    (shown, _), tests = readouts.sample_settings("Nav2D-v0", 70, seed=9)
    ((tested, _),) = tests.values()
    assert len({one.tobytes() for one in np.concatenate([shown, tested])}) == 140
    env = gym.make("Nav2D-v0")
    for k in (0, 49, 50, 69):
        np.testing.assert_array_equal(shown[k], env.reset(seed=9 + k)[0])
        np.testing.assert_array_equal(tested[k], env.reset(seed=9 + 70 + k)[0])


class Pixels(nn.Module):
    """The obstacles around the agent: knows what is blocked."""

    def forward(self, x):
        n = len(x)
        agent = x[:, 0].reshape(n, -1).argmax(dim=1)
        padded = nn.functional.pad(x[:, 1], (4, 4, 4, 4), value=1.0)
        rows, columns = agent // SIZE, agent % SIZE
        return th.stack(
            [padded[i, r : r + 9, c : c + 9].flatten() for i, (r, c) in enumerate(zip(rows, columns, strict=True))]
        )


def test_what_an_embedding_holds_is_read_and_nothing_else():
    (scores,) = readouts.readouts(Pixels(), *readouts.sample_settings("Nav2D-v0", 600)).values()
    assert all(scores[f"blocked_{n}"] > 0.99 for n in readouts.DISTANCES)
    assert scores["optimal_action"] < 0.9, "where the goal is, it does not know"


@pytest.mark.parametrize(
    ("env_id", "settings", "n_actions"),
    [
        ("ContinuousDistractorPointMazeRandomGoal-v0", ["train clips", "eval clips"], 4),
        ("PointMazeRandomGoal-v0", ["eval layouts"], 4),
        ("Nav2DRandomGoal-v0", ["eval layouts"], 4),
        ("ScanNav-v0", ["eval episodes"], 3),
    ],
)
def test_targets_of_our_environments(env_id, settings, n_actions):
    learn, tests = readouts.sample_settings(env_id, 4)
    assert list(tests) == settings
    for shown, targets in (learn, *tests.values()):
        assert len(shown) == 4 and targets["optimal_action"].values.shape == (4, n_actions)
        assert (targets["optimal_action"].values.sum(axis=1) >= 1).mean() > 0.7
        assert (targets["geodesic_excess"].values > -0.02).all()
        assert [targets[f"blocked_{n}"].values.shape for n in (1, 2, 3, 4)] == [(4, 4), (4, 8), (4, 12), (4, 16)]


def test_the_command_writes_table_and_numbers(tmp_path, capsys):
    output = tmp_path / "new" / "readouts.json"
    analyze.main(["readouts", "Nav2D-v0/ssi", "-n", "60", "-o", str(output)])
    assert "| Nav2D-v0/ssi |" in capsys.readouterr().out
    (result,) = json.loads(output.read_text())["encoders"].values()
    assert result["hash"] == load_encoder("Nav2D-v0/ssi").hash and result["objective"] == "ssi"
    assert list(result["scores"]) == ["eval layouts"]


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("IndexEnv-v0", "IndexEnv-v0 offers none; write shortest_paths() in its BatchEnv"),
        ("CartPole-v1", "CartPole-v1 offers none; write shortest_paths() in its BatchEnv"),
        ("Nav3D-v0", "unknown environment 'Nav3D-v0'"),
    ],
)
def test_who_offers_nothing_is_refused_with_the_remedy(env_id, message, capsys):
    with pytest.raises(SystemExit) as stopped:
        analyze.main(["readouts", "Nav2D-v0/ssi", "--env", env_id])
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert message in line


def test_no_states_and_stacked_observations_are_refused():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        readouts.sample_states("Nav2D-v0", 0)
    file = load_encoder("Nav2D-v0/ssi")
    file.metadata["preprocessing"]["frame_stack"] = 2
    with pytest.raises(ValueError, match="plain observations, and stacked was pretrained on others"):
        readouts.compare({"stacked": file}, "Nav2D-v0", 5)
