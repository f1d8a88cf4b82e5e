"""Can the action be read from a few pixels?

An inverse model that finds such pixels needs nothing else, and its encoder then knows nothing else: the paper's
example is a small display of the last action. The audit gives each small patch of the observation, before and after
the step, to a decision tree that predicts the action. A patch through which an agent passes now and then predicts
little. A patch that by itself predicts half of what can be predicted is a leak. The audit looks at data, not at an
encoder: it can be run before pretraining.
"""

import itertools
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_abisim.analysis.scenes import sample_episodes
from sb3_abisim.common.extras import needs_extra
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.objectives.actions import actions_of
from sb3_abisim.zoo.collect import preprocessing_entry
from sb3_abisim.zoo.preprocessing import recorded_preprocessing

# A score (0 chance, 1 certainty) from which one patch alone counts as a leak.
THRESHOLD = 0.5
# Per side of the observation: each patch is 1/256 of it, or of a small one 3 x 3 pixels.
MAX_PATCHES = 16
MIN_PATCH_PIXELS = 3
MAX_DEPTH = 8
PER_EPISODE = 10
DISPLAY = 2  # pixels of the painted display, per side


class ActionLeakWarning(UserWarning):
    """The action can be read from a few pixels, so an inverse model may learn nothing else."""


@dataclass(frozen=True)
class LeakAudit:
    """How well each patch predicts the action.

    :param scores: by patch [row, column], of the action's component that it predicts best: for choices (accuracy -
        chance) / (1 - chance) with chance the share of the commonest one, for numbers the coefficient of determination;
        on transitions that the tree has not learned from
    :param patch: (height, width) of the largest patch in pixels
    """

    scores: NDArray[np.float64]
    patch: tuple[int, int]

    @property
    def best(self) -> tuple[int, int]:
        """Row and column of the patch that predicts most."""
        row, column = np.unravel_index(int(self.scores.argmax()), self.scores.shape)
        return int(row), int(column)

    @property
    def leaks(self) -> bool:
        """Whether one patch alone predicts the action."""
        return bool(self.scores.max() >= THRESHOLD)


def audit(
    obs: NDArray[np.uint8], actions: NDArray[Any], next_obs: NDArray[np.uint8], action_space: gym.Space[Any]
) -> LeakAudit:
    """Score every patch; warn if one of them predicts the action.

    :param obs: s_t, uint8 (n, channels, height, width)
    :param actions: a_t, (n, *shape of an action)
    :param next_obs: s_{t+1}, as ``obs``
    :param action_space: of one environment
    :raises ValueError: for fewer than 10 transitions
    """
    if len(obs) < 10:
        raise ValueError(f"an audit needs at least 10 transitions, got {len(obs)}")
    components = _components(actions, action_space)
    both = np.concatenate([obs, next_obs], axis=1)
    rows, columns = (_edges(size) for size in obs.shape[2:])
    scores = np.array(
        [
            [_score(both[:, :, top:bottom, left:right], components) for left, right in itertools.pairwise(columns)]
            for top, bottom in itertools.pairwise(rows)
        ]
    )
    result = LeakAudit(scores, (max(np.diff(rows).tolist()), max(np.diff(columns).tolist())))
    if result.leaks:
        row, column = result.best
        warnings.warn(
            f"rows {rows[row]} to {rows[row + 1] - 1}, columns {columns[column]} to {columns[column + 1] - 1} of the "
            f"observation alone predict the action (score {scores.max():.2f} of 1): an inverse model may learn to look "
            "at nothing else; mask these pixels",
            ActionLeakWarning,
            stacklevel=2,
        )
    return result


def _edges(size: int) -> list[int]:
    """Where the patches of a side begin, and where the last one ends."""
    n_patches = min(MAX_PATCHES, max(1, size // MIN_PATCH_PIXELS))
    return [size * k // n_patches for k in range(n_patches + 1)]


def _components(actions: NDArray[Any], action_space: gym.Space[Any]) -> NDArray[Any]:
    """What actions consist of, (n, n_components): integers for choices, floats for numbers."""
    components: NDArray[Any] = actions_of(action_space).components(th.as_tensor(actions)).numpy()
    return components


def _score(pixels: NDArray[np.uint8], components: NDArray[Any]) -> float:
    """How well trees that have learned on the first two thirds predict the rest: the best of all components.

    A display of one component is a leak.
    """
    pixels = pixels.reshape(len(pixels), -1)
    # A patch in which nothing ever happens is a tree with a single leaf; this only saves time.
    if (pixels == pixels[0]).all():
        return 0.0
    return max(_score_component(pixels, values) for values in components.T)


def _score_component(pixels: NDArray[np.uint8], values: NDArray[Any]) -> float:
    with needs_extra("analysis", "the audit of leaks"):
        from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor

    split = 2 * len(pixels) // 3
    is_choice = values.dtype.kind in "iu"
    tree = (DecisionTreeClassifier if is_choice else DecisionTreeRegressor)(
        max_depth=MAX_DEPTH, min_samples_leaf=5, random_state=0
    )
    score = float(tree.fit(pixels[:split], values[:split]).score(pixels[split:], values[split:]))
    if not is_choice:
        return score
    chance = np.unique(values[split:], return_counts=True)[1].max() / (len(values) - split)
    return float((score - chance) / max(1 - chance, 1e-9))


def paint_action(next_obs: NDArray[np.uint8], actions: NDArray[Any], action_space: gym.Space[Any]) -> NDArray[np.uint8]:
    """The paper's example: a display of the last action in the top left corner of s_{t+1}, as gray levels.

    :param next_obs: uint8 (n, channels, height, width); the channels show the action's components in turn
    :param actions: as for :func:`audit`
    :param action_space: of one environment
    :return: a copy
    """
    painted, components = next_obs.copy(), _components(actions, action_space)
    lowest, highest = (0, components.max(axis=0)) if components.dtype.kind in "iu" else (-1.0, 1.0)
    levels = np.rint(255 * (components - lowest) / np.maximum(highest - lowest, 1)).astype(np.uint8)
    shown = levels[:, np.arange(next_obs.shape[1]) % levels.shape[1]]
    painted[:, :, :DISPLAY, :DISPLAY] = shown[:, :, None, None]
    return painted


def leak_maps(env_id: str, n_episodes: int, seed: int = 0) -> dict[str, Any]:
    """Audit an environment as it is and, to show that the audit finds a leak, with the paper's display painted in.

    :param env_id: a registered id
    :param n_episodes: of random play, :data:`PER_EPISODE` transitions of each
    :param seed: of the episodes
    :raises ValueError: for an environment that shows no images as the zoo's entry of its id wraps it
    """
    entry = preprocessing_entry(env_id)
    shown = recorded_preprocessing(entry, f"the zoo's entry of {env_id}")
    try:
        samples = sample_episodes(env_id, n_episodes, PER_EPISODE, seed, entry.get("env_kwargs"), shown)
    except ValueError as error:
        raise ValueError(f"{error}; or audit what sb3-abisim collect has made of it: --data DIR") from error
    return _both_audits(samples.obs, samples.actions, samples.next_obs, samples.env.single_action_space)


def leak_maps_of_data(path: str | Path, n_episodes: int, seed: int = 0) -> dict[str, Any]:
    """As :func:`leak_maps`, on transitions of a dataset.

    :param path: a dataset's folder
    :param n_episodes: :data:`PER_EPISODE` transitions for each
    :param seed: of the choice
    """
    dataset = TransitionDataset(path)
    starts = dataset.valid_starts()
    n = min(len(starts), n_episodes * PER_EPISODE)
    starts = np.random.default_rng(seed).choice(starts, n, replace=False)
    obs, next_obs = dataset.frames(starts), dataset.frames(starts + 1)
    audits = _both_audits(obs, dataset.actions(starts), next_obs, dataset.action_space)
    return {"dataset_hash": dataset.hash, **audits}


def _both_audits(
    obs: NDArray[np.uint8], actions: NDArray[Any], next_obs: NDArray[np.uint8], space: gym.Space[Any]
) -> dict[str, Any]:
    plain = audit(obs, actions, next_obs, space)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ActionLeakWarning)
        display = audit(obs, actions, paint_action(next_obs, actions, space), space)
    audits = {"as it is": plain, "with a display of the action": display}
    return {
        "n_transitions": len(obs),
        "threshold": THRESHOLD,
        "audits": {
            name: {"scores": one.scores.tolist(), "best": one.best, "patch": one.patch, "leaks": one.leaks}
            for name, one in audits.items()
        },
    }
