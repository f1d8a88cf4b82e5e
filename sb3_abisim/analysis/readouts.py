"""A ladder for encoders that needs no RL: what an agent needs to find a goal, read from frozen embeddings by ridge.

Of environments that offer shortest paths (:meth:`~sb3_abisim.envs.base.BatchEnv.shortest_paths`). From the embedding of
a state is read:

* ``optimal_action``: whether each action leads on along a shortest path to the goal, the area under the ROC curve;
* ``geodesic_excess``: how much longer the shortest path is than without obstacles, R^2;
* ``blocked_1`` to ``blocked_4``: which of the points so many cells, meters or steps away are blocked, the area under
  the ROC curve (:meth:`~sb3_abisim.envs.base.BatchEnv.blocked_around`).

States are those in which episodes begin: one of each of many layouts, in our environments anywhere. The ridge
regression learns on some, of the train split where there are splits, and is scored on others of each split.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_abisim.analysis.nav2d_exact import EVAL_SEED, embed
from sb3_abisim.analysis.probes import Target, train_probe
from sb3_abisim.analysis.scenes import N_COPIES, eval_settings, offsets_within, preprocessing_of
from sb3_abisim.common.extras import require_extra
from sb3_abisim.data.environments import Preprocessing, make_vector_env
from sb3_abisim.envs.base import BatchEnv, batch_class, offers
from sb3_abisim.networks.base import Encoder
from sb3_abisim.networks.encoder_file import EncoderFile

N_STATES = 2000
DISTANCES = (1, 2, 3, 4)

Scores = dict[str, dict[str, float]]
States = tuple[NDArray[np.uint8], dict[str, Target]]


def check_offers(env_id: str) -> None:
    """Refuse environments without shortest paths.

    :param env_id: any id; one that is not registered is left to what makes it
    :raises ValueError: naming the remedy
    """
    found = batch_class(env_id)
    if env_id in gym.registry and (found is None or not offers(found, "shortest_paths")):
        raise ValueError(
            f"read-outs need shortest paths, and {env_id} offers none; write shortest_paths() in its BatchEnv "
            "(docs/extending.md)"
        )


def sample_states(env_id: str, n: int, seed: int = EVAL_SEED, env_kwargs: dict[str, Any] | None = None) -> States:
    """Observations of states in which episodes begin, and what is to be read from them.

    :param env_id: of an environment that offers shortest paths
    :param n: how many, at least 1
    :param seed: of the first episode; the next has the next seed
    :param env_kwargs: passed to the environment
    :return: uint8 (n, channels, height, width), and the targets by name
    :raises ValueError: for another environment, or ``n`` below 1
    """
    check_offers(env_id)
    require_extra("analysis", "a read-out", "sklearn", "scipy")
    if n < 1:
        raise ValueError(f"the number of states must be at least 1, got {n}")
    copies = make_vector_env(env_id, min(n, N_COPIES), env_kwargs or {})
    env = copies.unwrapped
    assert isinstance(env, BatchEnv)
    shown, states = [], []
    for first in range(0, n, env.num_envs):
        shown.append(copies.reset(seed=seed + first)[0])
        states.append(env.factors())
    factors = {name: np.concatenate([state[name] for state in states])[:n] for name in states[0]}
    paths = env.shortest_paths(factors)
    found = {
        "optimal_action": Target(paths.optimal.astype(np.float64), "binary"),
        "geodesic_excess": Target((paths.geodesic - paths.straight)[:, None].astype(np.float64), "continuous"),
    }
    if offers(type(env), "blocked_around"):
        offsets = offsets_within(DISTANCES[-1])
        around, apart = env.blocked_around(factors, offsets), np.abs(offsets).sum(axis=1)
        for distance in DISTANCES:
            found[f"blocked_{distance}"] = Target(around[:, apart == distance].astype(np.float64), "binary")
    copies.close()
    return np.concatenate(shown)[:n], found


def sample_settings(
    env_id: str, n: int, seed: int = EVAL_SEED, files: dict[str, EncoderFile] | None = None
) -> tuple[States, dict[str, States]]:
    """States to learn from, and others to score in each setting.

    :param env_id: see :func:`sample_states`
    :param n: to learn from, and as many for each score
    :param seed: of the first episode
    :param files: encoders by name, see :func:`~sb3_abisim.analysis.scenes.eval_settings`
    :return: of the first setting, and by setting
    """
    settings = eval_settings(env_id, files)
    learn = sample_states(env_id, n, seed, next(iter(settings.values())))
    return learn, {name: sample_states(env_id, n, seed + n, kwargs) for name, kwargs in settings.items()}


def readouts(encoder: Encoder, learn: States, tests: dict[str, States]) -> Scores:
    """The ladder of one encoder.

    :param encoder: in evaluation mode
    :param learn: states to learn from
    :param tests: states to score, by setting
    :return: score by setting and target; a target that does not vary is left out
    """
    shown, learned = learn
    features = embed(encoder, shown).numpy()
    probes = {name: train_probe("linear", features, target) for name, target in learned.items()}
    scores: Scores = {}
    for setting, (test, tested) in tests.items():
        test_features = embed(encoder, test).numpy()
        found = {name: tested[name].score(predict(test_features)) for name, predict in probes.items()}
        scores[setting] = {name: score for name, score in found.items() if score is not None}
    return scores


def compare(files: dict[str, EncoderFile], env_id: str, n: int, seed: int = EVAL_SEED) -> dict[str, Any]:
    """The ladder of several encoders.

    :param files: by name, of plain observations
    :param env_id: see :func:`sample_states`
    :param n: see :func:`sample_settings`
    :param seed: of the first episode
    :return: JSON types: the settings, and per encoder its hash, objective, seed and scores by setting and target
    :raises ValueError: for encoders of wrapped or stacked observations
    """
    if preprocessing_of(files) != Preprocessing():
        name, file = next(iter(files.items()))
        raise ValueError(
            f"read-outs are of an environment's plain observations, and {name} was pretrained on others "
            f"({file.metadata['preprocessing']}); pretrain one without wrappers, stacks and an image key"
        )
    learn, tests = sample_settings(env_id, n, seed, files)
    encoders = {
        name: {
            "hash": file.hash,
            "objective": file.metadata["objective"],
            "seed": file.metadata["settings"].get("seed"),
            "scores": readouts(file.encoder.eval(), learn, tests),
        }
        for name, file in files.items()
    }
    return {"env_id": env_id, "n_states": n, "seed": seed, "encoders": encoders}


def table(results: dict[str, Any]) -> str:
    """The results of :func:`compare` as a Markdown table for each setting.

    :param results: what it returned
    """
    tables = []
    for setting, targets in next(iter(results["encoders"].values()))["scores"].items():
        lines = [[setting, *targets], ["---", *["---:"] * len(targets)]]
        for name, result in results["encoders"].items():
            lines.append([name, *(f"{result['scores'][setting][target]:.3f}" for target in targets)])
        tables.append("\n".join("| " + " | ".join(line) + " |" for line in lines))
    return "\n\n".join(tables)
