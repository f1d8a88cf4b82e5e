"""Probes: what can be read from an embedding, by a ridge regression and by a small network.

Probes learn from observations of some episodes and are scored on those of others. Where the environment has splits
there are two settings: probes are scored on the train split, and on the eval split. They always learn on the train
split, except for clip and phase: only a probe that knows a clip can read those, so they are learned on the clips that
are scored (in other layouts). Targets are continuous (scored by the coefficient of determination), yes or no (area
under the ROC curve, mean over the points around the agent) or classes (share of correct answers).

Of Nav2D, the point mazes and ScanNav the targets are the agent and its surroundings. Of any other environment they are
all of its ``factors()``.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_abisim.analysis.nav2d_exact import embed
from sb3_abisim.analysis.pixels import backgrounds_of, clips_of, swapped_backgrounds
from sb3_abisim.analysis.scenes import (
    Samples,
    agent_positions,
    eval_settings,
    local_obstacles,
    preprocessing_of,
    render_point_mazes,
    sample_episodes,
)
from sb3_abisim.benchmark.report.statistics import mean_and_interval
from sb3_abisim.common.extras import needs_extra
from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.networks.encoder_file import EncoderFile

PER_EPISODE = 10
PROBES = ("linear", "MLP")
HIDDEN = 64
ALPHAS = tuple(10.0**k for k in range(-2, 5))
UNTRAINED = "untrained"


@dataclass(frozen=True)
class Target:
    """Something to read.

    :param values: (n, n_outputs), floats for "continuous", 0 and 1 for "binary" and "classes" (one-hot)
    :param kind: "continuous", "binary" or "classes"
    """

    values: NDArray[np.float64]
    kind: str

    def score(self, predictions: NDArray[np.float64]) -> float | None:
        """R^2, mean area under the ROC curve, or accuracy; None where the target does not vary.

        :param predictions: as ``values``
        """
        with needs_extra("analysis", "a probe"):
            from sklearn.metrics import r2_score, roc_auc_score

        varies = self.values.std(axis=0) > 0
        if not varies.any():
            return None
        values, predictions = self.values[:, varies], predictions[:, varies]
        if self.kind == "continuous":
            return float(r2_score(values, predictions))
        if self.kind == "binary":
            return float(roc_auc_score(values, predictions, average="macro"))
        return float((values.argmax(axis=1) == predictions.argmax(axis=1)).mean())


def targets(samples: Samples) -> dict[str, Target]:
    """What is to be read from an observation; goals that never move and clips that are not shown are left out.

    A heading is read as cosine and sine.

    :param samples: of an environment with factors
    :raises ValueError: for one without
    """
    factors, agents, obstacles = samples.factors, agent_positions(samples), local_obstacles(samples)
    if not factors:
        raise ValueError(
            "probes read an environment's factors(), and this one has none; add them to its batch class, or show "
            "numbers beside the image in a Dict of observations"
        )
    if agents is None or obstacles is None:
        return {name: _plain_target(values) for name, values in factors.items()}
    found = {"agent": Target(agents, "continuous"), "obstacles": Target(obstacles.astype(np.float64), "binary")}
    if "heading" in factors:
        angle = np.deg2rad(factors["heading"].astype(np.float64))
        found["heading"] = Target(np.stack([np.cos(angle), np.sin(angle)], axis=1), "continuous")
    elif "goal" in factors and factors["goal"].std(axis=0).max() > 0:
        found["goal"] = Target(factors["goal"].astype(np.float64), "continuous")
    clips = clips_of(samples)
    if clips is not None:
        # All clips of the split, in its order, so that classes are the same in every sample.
        found["clip"] = Target((factors["clip_id"][:, None] == clips.clip_ids).astype(np.float64), "classes")
        found["phase"] = Target((factors["frame"] / (clips.lengths[factors["clip"]] - 1))[:, None], "continuous")
    return found


def _plain_target(values: NDArray[Any]) -> Target:
    numbers = values.reshape(len(values), -1).astype(np.float64)
    return Target(numbers, "binary" if values.dtype == bool else "continuous")


def make_probe(kind: str) -> Any:
    """A scikit-learn regressor on standardized inputs.

    :param kind: one of :data:`PROBES`
    """
    with needs_extra("analysis", "a probe"):
        from sklearn.linear_model import RidgeCV
        from sklearn.neural_network import MLPRegressor
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

    if kind == "linear":
        return make_pipeline(StandardScaler(), RidgeCV(ALPHAS))
    return make_pipeline(
        StandardScaler(), MLPRegressor(hidden_layer_sizes=(HIDDEN,), early_stopping=True, max_iter=300, random_state=0)
    )


def train_probe(kind: str, features: NDArray[Any], target: Target) -> Callable[[NDArray[Any]], NDArray[np.float64]]:
    """Train a probe.

    :param kind: one of :data:`PROBES`
    :param features: (n, features_dim)
    :param target: to learn
    :return: from other features, (m, features_dim), to its predictions, (m, n_outputs)
    """
    mean, std = target.values.mean(axis=0), target.values.std(axis=0)
    # Classes and yes-or-no answers are learned by least squares as well; their scores are of ranks.
    scale = np.where(std > 0, std, 1.0) if target.kind == "continuous" else np.ones_like(std)
    probe = make_probe(kind)
    wanted = (target.values - mean) / scale
    with warnings.catch_warnings():
        # A network that stops at the limit of its epochs is a result, too.
        warnings.simplefilter("ignore")
        probe.fit(features, wanted[:, 0] if wanted.shape[1] == 1 else wanted)

    def predict(features: NDArray[Any]) -> NDArray[np.float64]:
        predictions: NDArray[np.float64] = np.asarray(probe.predict(features)).reshape(len(features), -1) * scale + mean
        return predictions

    return predict


def read(
    kind: str, features: NDArray[Any], target: Target, test_features: NDArray[Any], test_target: Target
) -> float | None:
    """Train a probe and score it.

    :param kind: one of :data:`PROBES`
    :param features: (n, features_dim)
    :param target: to learn
    :param test_features: of other episodes, (m, features_dim)
    :param test_target: to score
    :return: see :meth:`Target.score`
    """
    return test_target.score(train_probe(kind, features, target)(test_features))


def probes(files: dict[str, EncoderFile], env_id: str, n_episodes: int, seed: int = 0) -> dict[str, Any]:
    """The whole table of an environment, with an untrained encoder for comparison.

    :param files: encoders by name
    :param env_id: a registered id, of an environment with factors
    :param n_episodes: to learn from, and as many again for each score
    :param seed: of the episodes and the untrained weights
    :return: per encoder: objective, seed, ``scores`` by setting
        (:func:`~sb3_abisim.analysis.scenes.eval_settings`), target and probe, and ``invariance`` by setting
        (:func:`invariance_ratio`; None without clips), and ``clip_shifts``
    :raises ValueError: for an environment without factors, or two encoders of one objective and seed
    """
    # Before minutes of computing.
    _refuse_twins([_origin(file) for file in files.values()])
    settings, shown = eval_settings(env_id, files), preprocessing_of(files)
    learn, test = (
        {
            name: sample_episodes(env_id, n_episodes, PER_EPISODE, 2 * seed + k, kwargs, shown)
            for name, kwargs in settings.items()
        }
        for k in (1, 2)
    )
    observations = next(iter(learn.values())).obs
    encoders: dict[str, tuple[Encoder, dict[str, Any]]] = {
        name: (file.encoder.eval(), {"hash": file.hash, **_origin(file)}) for name, file in files.items()
    }
    # The network of the first one, with random weights.
    network = next(iter(files.values())).encoder.spec()
    th.manual_seed(seed)
    untrained = make_encoder(_space_of(observations), network["name"], **network["kwargs"]).eval()
    encoders[UNTRAINED] = (untrained, {"hash": None, "objective": UNTRAINED, "seed": seed})
    results = {}
    for name, (encoder, origin) in encoders.items():
        scores = {setting: _scores(encoder, learn, test, setting) for setting in settings}
        ratios = {setting: invariance_ratio(encoder, test[setting]) for setting in settings}
        shifts = clip_shifts(encoder, next(iter(test.values())), list(test.values()))
        results[name] = {**origin, "scores": scores, "invariance": ratios, "clip_shifts": shifts}
    return {"n_observations": len(observations), "encoders": results, "groups": by_objective(results)}


def _space_of(observations: NDArray[np.uint8]) -> Any:
    from gymnasium.spaces import Box

    return Box(0, 255, observations.shape[1:], np.uint8)


def _origin(file: EncoderFile) -> dict[str, Any]:
    return {"objective": file.metadata["objective"], "seed": file.metadata["settings"].get("seed")}


def _scores(encoder: Encoder, learn: dict[str, Samples], test: dict[str, Samples], setting: str) -> dict[str, Any]:
    """Target and probe to score in one setting."""
    embedded: dict[int, NDArray[Any]] = {}

    def features(samples: Samples) -> NDArray[Any]:
        if id(samples) not in embedded:
            embedded[id(samples)] = embed(encoder, samples.obs).numpy()
        return embedded[id(samples)]

    scores = {}
    for name, tested in targets(test[setting]).items():
        source = learn[setting] if name in ("clip", "phase") else next(iter(learn.values()))
        learned = targets(source)[name]
        scores[name] = {kind: read(kind, features(source), learned, features(test[setting]), tested) for kind in PROBES}
    return scores


def invariance_ratio(encoder: Encoder, samples: Samples, seed: int = 0) -> float | None:
    """Distance between the same state on two clips, over the distance between different states on the same clip.

    0 is an encoder that does not see the background, 1 one for which a new clip is as much as a new state.

    :param encoder: in evaluation mode
    :param samples: :data:`PER_EPISODE` of each episode
    :param seed: of the choices
    :return: None for environments without clips
    """
    backgrounds = backgrounds_of(samples)
    if backgrounds is None:
        return None
    generator = np.random.default_rng(seed)
    agents, obstacles = samples.factors["agent"], samples.factors["obstacles"]
    others = np.roll(np.arange(len(samples)), PER_EPISODE)
    here = embed(encoder, render_point_mazes(agents, obstacles, backgrounds))
    elsewhere = embed(encoder, render_point_mazes(agents[others], obstacles[others], backgrounds))
    swapped = embed(encoder, render_point_mazes(agents, obstacles, swapped_backgrounds(samples, generator)))
    return float((here - swapped).abs().sum(dim=1).mean() / (here - elsewhere).abs().sum(dim=1).mean())


def clip_shifts(encoder: Encoder, reference: Samples, samples: list[Samples]) -> dict[str, float]:
    """How far each clip moves the mean embedding, in units of the mean distance of states from their mean.

    :param encoder: in evaluation mode
    :param reference: of the train clips; its mean embedding is where distances are measured from
    :param samples: of the clips to look at
    :return: by name of the clip; empty without clips
    """
    features = embed(encoder, reference.obs)
    center = features.mean(dim=0)
    unit = (features - center).abs().sum(dim=1).mean()
    shifts = {}
    for one in samples:
        clips = clips_of(one)
        if clips is None:
            continue
        features = embed(encoder, one.obs)
        shown = th.as_tensor(one.factors["clip"])
        for k in np.unique(one.factors["clip"]).tolist():
            shifts[clips.names[k]] = float((features[shown == k].mean(dim=0) - center).abs().sum() / unit)
    return shifts


def by_objective(results: dict[str, Any]) -> dict[str, Any]:
    """Mean over pretraining seeds, with the half width of its 95 % confidence interval (Student's t).

    :param results: per encoder, as in :func:`probes`
    :return: per objective: ``n_seeds``, ``scores`` as there with ``(mean, half width)`` for each number (the half width
        None for one seed), and ``invariance`` likewise
    :raises ValueError: if two encoders have the same objective and seed: they differ in something else
    """
    _refuse_twins(list(results.values()))
    groups: dict[str, list[dict[str, Any]]] = {}
    for result in results.values():
        groups.setdefault(result["objective"], []).append(result)
    summary = {}
    for objective, members in groups.items():
        scores = {
            setting: {
                target: {
                    kind: _over_seeds([member["scores"][setting][target][kind] for member in members])
                    for kind in PROBES
                }
                for target in members[0]["scores"][setting]
            }
            for setting in members[0]["scores"]
        }
        ratios = {
            setting: _over_seeds([member["invariance"][setting] for member in members])
            for setting in members[0]["invariance"]
        }
        summary[objective] = {"n_seeds": len(members), "scores": scores, "invariance": ratios}
    return summary


def _refuse_twins(origins: list[dict[str, Any]]) -> None:
    pairs = [(origin["objective"], origin["seed"]) for origin in origins]
    twins = sorted({pair for pair in pairs if pairs.count(pair) > 1})
    if twins:
        raise ValueError(
            f"encoders of the same objective and the same seed: {twins}; intervals are over pretraining seeds, so give "
            "encoders that differ in nothing else"
        )


def _over_seeds(values: list[float | None]) -> tuple[float, float | None] | None:
    """Mean and half width of its interval; the latter None for one seed, all None without values."""
    numbers = [value for value in values if value is not None]
    if not numbers:
        return None
    mean, half = mean_and_interval(np.array(numbers))
    return float(mean), None if len(numbers) == 1 else float(half)


def table(results: dict[str, Any]) -> str:
    """The results of :func:`probes` as a Markdown table, ``linear / MLP`` in each entry.

    :param results: what it returned
    """
    first = next(iter(results["groups"].values()))
    columns = [(setting, target) for setting, scores in first["scores"].items() for target in scores]
    ratios = [setting for setting, ratio in first["invariance"].items() if ratio is not None]
    header = ["encoder", "seeds", *(f"{target}, {setting}" for setting, target in columns)]
    header += [f"invariance ratio, {setting}" for setting in ratios]
    rows = [header, ["---", *["---:"] * (len(header) - 1)]]
    for objective, group in results["groups"].items():
        scores = [group["scores"][setting][target] for setting, target in columns]
        words = [" / ".join(_number(score[kind]) for kind in PROBES) for score in scores]
        row = [objective, str(group["n_seeds"]), *words]
        rows.append(row + [_number(group["invariance"][setting]) for setting in ratios])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _number(value: tuple[float, float | None] | None) -> str:
    if value is None:
        return "-"
    mean, half = value
    return f"{mean:.3f}" if half is None else f"{mean:.3f} ± {half:.3f}"
