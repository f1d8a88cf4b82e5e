"""Probes on targets that are known to be readable, or not."""

import index_env  # noqa: F401  (registers the environments)
import numpy as np
import pytest
import torch as th
from analysis_inputs import Masked, file_of, identity
from torch import nn

from sb3_abisim.analysis import probes as module
from sb3_abisim.analysis.probes import (
    Target,
    by_objective,
    invariance_ratio,
    probes,
    read,
    table,
    targets,
)
from sb3_abisim.analysis.scenes import eval_settings, sample_episodes
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
    """The position in the observation and the heading, both before the step; episodes do not end at once."""
    samples = sample_episodes("ScanNav-v0", 3, 10, env_kwargs=eval_settings("ScanNav-v0")["eval episodes"])
    assert len(samples) == 30
    found = targets(samples)
    assert set(found) == {"agent", "obstacles", "heading"}
    east, north = found["agent"].values.T * 128 / 6
    ahead = found["heading"].values
    for k, frame in enumerate(samples.obs.astype(int)):
        # The nose is the only magenta thing.
        rows, columns = np.nonzero((frame[0] > 200) & (frame[1] < 60) & (frame[2] > 150))
        # 0.17 m ahead of the agent; a heading of 0 is up and of 90 is left.
        nose = np.array([columns.mean() + 0.5 - 64 - east[k], 64 - rows.mean() - 0.5 - north[k]])
        assert np.abs(nose - 0.17 * 128 / 6 * np.array([-ahead[k, 1], ahead[k, 0]])).max() < 1.0


def test_mean_over_seeds():
    def encoder(seed, score, ratio):
        scores = {"eval": {"agent": dict.fromkeys(module.PROBES, score)}}
        return {"objective": "ssi", "seed": seed, "scores": scores, "invariance": {"eval": ratio}}

    three = {str(seed): encoder(seed, float(seed), None) for seed in (1, 2, 3)}
    group = by_objective(three)["ssi"]
    mean, half = group["scores"]["eval"]["agent"]["linear"]
    # Student's t with two degrees of freedom: 4.303 standard errors.
    assert mean == 2.0 and half == pytest.approx(4.302653 / np.sqrt(3))
    assert group["n_seeds"] == 3 and group["invariance"]["eval"] is None
    single = by_objective({"one": encoder(0, 0.5, 0.25)})["ssi"]
    assert single["scores"]["eval"]["agent"]["MLP"] == (0.5, None) and single["invariance"]["eval"] == (0.25, None)


def test_invariance_by_what_an_encoder_sees():
    samples = sample_episodes("DistractorPointMaze-v0", 8, module.PER_EPISODE)

    class Obstacles(nn.Module):
        def forward(self, observations):
            color = th.tensor(top_down.OBSTACLE)[:, None, None] / 255
            return ((observations - color).abs().amax(dim=1) < 1e-3).float().flatten(1)

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
    pixels = samples.obs.reshape(len(samples), -1) / 255.0
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
    mean, half = group["scores"]["eval layouts"]["agent"]["linear"]
    # Position is linear in the agent's channel, and both encoders hold the same of it.
    assert group["n_seeds"] == 2 and mean > 0.7 and half == pytest.approx(0, abs=1e-4)
    assert group["scores"]["eval layouts"]["obstacles"]["linear"][0] < 0.75
    assert "| ssi | 2 |" in table(results) and "untrained" in table(results) and "invariance" not in table(results)


def test_two_encoders_of_one_seed_are_refused():
    with pytest.raises(ValueError, match="same seed"):
        by_objective({"a": {"objective": "ssi", "seed": 0}, "b": {"objective": "ssi", "seed": 0}})
    files = {name: file_of(Masked(np.ones((3, 15, 15))), (3, 15, 15)) for name in "ab"}
    with pytest.raises(ValueError, match="same seed"):
        probes(files, "Nav2D-v0", 1)


def test_factors_of_any_environment_are_read(monkeypatch):
    monkeypatch.setattr(module, "PROBES", ("linear",))
    samples = sample_episodes("IndexEnv-v0", 200, 4)
    found = targets(samples)
    assert {name: (target.kind, target.values.shape[1]) for name, target in found.items()} == {
        "step": ("continuous", 1), "pair": ("continuous", 2), "even": ("binary", 1),
    }  # fmt: skip
    np.testing.assert_array_equal(found["even"].values[:, 0], samples.factors["step"] % 2 == 0)
    # The step is the first channel's number.
    features = samples.obs.reshape(len(samples), -1).astype(float)
    first, second = (Target(found["step"].values[half], "continuous") for half in (slice(400), slice(400, None)))
    assert read("linear", features[:400], first, features[400:], second) > 0.999


def test_without_factors_there_is_nothing_to_read():
    with pytest.raises(ValueError, match=r"probes read an environment's factors\(\), and this one has none"):
        targets(sample_episodes("PlainEnv-v0", 2, 2))
