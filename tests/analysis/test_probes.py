"""Probes on targets that are known to be readable, or not."""

import numpy as np
import pytest
import torch as th
from analysis_inputs import Masked, file_of, identity
from torch import nn

from sb3_abisim.analysis import probes as module
from sb3_abisim.analysis.pixels import clip_settings
from sb3_abisim.analysis.probes import (
    Target,
    by_objective,
    invariance_ratio,
    mean_interval,
    probes,
    read,
    table,
    targets,
)
from sb3_abisim.analysis.scenes import sample_episodes
from sb3_abisim.envs.point_maze import top_down

SHAPE = (3, 64, 64)


def test_scores_by_hand():
    binary = Target(np.array([[0.0, 1], [1, 1], [1, 1], [0, 1]]), "binary")
    # Three of the four pairs of a no and a yes are in order; the constant second column does not count.
    assert binary.score(np.array([[0.1, 0], [0.2, 0], [0.9, 0], [0.5, 0]])) == pytest.approx(0.75)
    assert binary.score(1 - binary.values) == 0.0
    continuous = Target(np.array([[0.0], [2.0], [4.0]]), "continuous")
    assert continuous.score(np.array([[0.0], [2.0], [2.0]])) == pytest.approx(1 - 4 / 8)
    classes = Target(np.eye(3)[[0, 1, 2, 2]], "classes")
    assert classes.score(np.eye(3)[[0, 1, 1, 2]]) == 0.75
    assert Target(np.ones((4, 2)), "continuous").score(np.zeros((4, 2))) is None


def test_linear_and_small_network():
    generator = np.random.default_rng(0)
    features = generator.uniform(-1, 1, (1200, 3))
    wanted = {"linear": features[:, :2] @ [[1, 2], [3, -1]], "MLP": features[:, :1] * features[:, 1:2]}
    scores = {
        (name, kind): read(kind, features[:800], Target(y[:800], "continuous"), features[800:],
                           Target(y[800:], "continuous"))
        for name, y in wanted.items() for kind in ("linear", "MLP")
    }  # fmt: skip
    assert scores["linear", "linear"] > 0.999
    assert scores["MLP", "linear"] < 0.1 and scores["MLP", "MLP"] > 0.8


def test_targets_are_those_that_vary():
    assert set(targets(sample_episodes("PointMaze-v0", 2, 2))) == {"agent", "obstacles"}
    samples = sample_episodes("DistractorPointMaze-v0", 30, 2, env_kwargs={"split": "eval"})
    found = targets(samples)
    assert set(found) == {"agent", "obstacles", "clip", "phase"}
    np.testing.assert_array_equal(found["clip"].values.argmax(axis=1), samples.factors["clip"])
    assert 0 <= found["phase"].values.min() < 0.3 and 0.7 < found["phase"].values.max() <= 1


def test_targets_in_a_scan():
    """The position in the picture and the heading, both of the state before the step; episodes do not end at once."""
    samples = sample_episodes("ScanNav-v0", 3, 10, env_kwargs=clip_settings("ScanNav-v0")["other episodes"])
    assert len(samples) == 30
    found = targets(samples)
    assert set(found) == {"agent", "obstacles", "heading"}
    east, north = found["agent"].values.T * 128 / 6
    ahead = found["heading"].values
    for k, frame in enumerate(samples.frames.astype(int)):
        # The nose is the only magenta thing.
        rows, columns = np.nonzero((frame[0] > 200) & (frame[1] < 60) & (frame[2] > 150))
        # 0.17 m ahead of the agent; a heading of 0 is up and of 90 is left.
        nose = np.array([columns.mean() + 0.5 - 64 - east[k], 64 - rows.mean() - 0.5 - north[k]])
        assert np.abs(nose - 0.17 * 128 / 6 * np.array([-ahead[k, 1], ahead[k, 0]])).max() < 1.0


def test_interval_by_hand():
    mean, half = mean_interval([1.0, 2.0, 3.0])
    # Student's t with two degrees of freedom: 4.303 standard errors.
    assert mean == 2.0 and half == pytest.approx(4.302653 / np.sqrt(3))
    assert mean_interval([0.5]) == (0.5, None)
    assert mean_interval([None, None]) is None


def test_invariance_by_what_an_encoder_sees():
    samples = sample_episodes("DistractorPointMaze-v0", 8, module.PER_EPISODE)

    class Obstacles(nn.Module):
        def forward(self, observations):
            color = th.tensor(top_down.OBSTACLE)[:, None, None] / 255
            return ((((observations + 1) / 2) - color).abs().amax(dim=1) < 1e-3).float().flatten(1)

    blind = invariance_ratio(file_of(Obstacles(), SHAPE).encoder, samples)
    raw = invariance_ratio(identity(SHAPE).encoder, samples)
    assert blind < 0.05 and raw > 0.4
    assert invariance_ratio(identity(SHAPE).encoder, sample_episodes("PointMaze-v0", 2, 2)) is None


def test_shift_of_a_clip_that_is_all_an_encoder_sees():
    samples = sample_episodes("DistractorPointMaze-v0", 8, 3)
    encoder = identity(SHAPE).encoder
    shifts = module.clip_shifts(encoder, samples, [samples])
    shown = np.unique(samples.factors["clip"])
    assert len(shifts) == len(shown)
    pixels = samples.frames.reshape(len(samples), -1) / 255.0
    center = pixels.mean(axis=0)
    unit = np.abs(pixels - center).sum(axis=1).mean()
    first = np.abs(pixels[samples.factors["clip"] == shown[0]].mean(axis=0) - center).sum() / unit
    assert next(iter(shifts.values())) == pytest.approx(first, rel=1e-3)
    plain = sample_episodes("PointMaze-v0", 2, 2)
    assert module.clip_shifts(encoder, plain, [plain]) == {}


def test_table_over_seeds(monkeypatch):
    monkeypatch.setattr(module, "PROBES", ("linear",))
    mask = np.zeros((3, 15, 15))
    mask[0] = 1
    files = {f"seed {seed}": file_of(Masked(mask), mask.shape, "ssi", seed) for seed in (0, 1)}
    files["seed 1"].encoder.scale *= 3
    results = probes(files, "Nav2D-v0", 60)
    group = results["groups"]["ssi"]
    mean, half = group["scores"]["held-out layouts"]["agent"]["linear"]
    # Position is linear in the agent's channel, and both encoders hold the same of it.
    assert group["n_seeds"] == 2 and mean > 0.7 and half == pytest.approx(0, abs=1e-4)
    assert group["scores"]["held-out layouts"]["obstacles"]["linear"][0] < 0.75
    assert "| ssi | 2 |" in table(results) and "untrained" in table(results) and "invariance" not in table(results)


def test_two_encoders_of_one_seed_are_refused():
    with pytest.raises(ValueError, match="same seed"):
        by_objective({"a": {"objective": "ssi", "seed": 0}, "b": {"objective": "ssi", "seed": 0}})
    files = {name: file_of(Masked(np.ones((3, 15, 15))), (3, 15, 15)) for name in "ab"}
    with pytest.raises(ValueError, match="same seed"):
        probes(files, "Nav2D-v0", 1)
