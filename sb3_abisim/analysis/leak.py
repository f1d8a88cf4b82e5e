"""Can the action be read from a few pixels?

An inverse model that finds such pixels need look at nothing else, and its encoder then knows nothing else: the paper's
example is a small display of the last action. The audit gives each small patch of the picture, before and after the
step, to a decision tree that predicts the action. A patch through which an agent passes now and then tells little; a
patch that tells half of what there is to know, by itself, is a leak. The audit looks at data, not at an encoder: it can
be run before pretraining.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.analysis.scenes import sample_episodes

# A score (0 chance, 1 certainty) from which one patch alone counts as a leak.
THRESHOLD = 0.5
# Patches per side of the picture, by its size: each is 1/256 of a point maze or scan, 1/25 of Nav2D.
N_PATCHES = {15: 5, 64: 16, 128: 16, 256: 16}
MAX_DEPTH = 8
PER_EPISODE = 10
DISPLAY = 2  # pixels of the painted display, per side


class ActionLeakWarning(UserWarning):
    """The action can be read from a few pixels, so an inverse model may learn nothing else."""


@dataclass(frozen=True)
class LeakAudit:
    """What each patch tells about the action.

    :param scores: by patch [row, column]: for discrete actions (accuracy - chance) / (1 - chance) with chance the share
        of the commonest action, for continuous ones the coefficient of determination; on held-out transitions
    :param patch: (height, width) of a patch in pixels
    """

    scores: NDArray[np.float64]
    patch: tuple[int, int]

    @property
    def best(self) -> tuple[int, int]:
        """Row and column of the patch that tells most."""
        row, column = np.unravel_index(int(self.scores.argmax()), self.scores.shape)
        return int(row), int(column)

    @property
    def leaks(self) -> bool:
        """Whether one patch alone tells the action."""
        return bool(self.scores.max() >= THRESHOLD)


def audit(
    frames: NDArray[np.uint8], actions: NDArray[Any], next_frames: NDArray[np.uint8], n_patches: int
) -> LeakAudit:
    """Score every patch; warn if one of them tells the action.

    :param frames: s_t, uint8 (n, channels, height, width)
    :param actions: a_t, int (n,) or float (n, action_dim)
    :param next_frames: s_{t+1}, as ``frames``
    :param n_patches: per side; must divide height and width
    :raises ValueError: if it does not, or there are fewer than 10 transitions
    """
    n, channels, height, width = frames.shape
    if height % n_patches or width % n_patches:
        raise ValueError(f"n_patches must divide {height} and {width}, got {n_patches}")
    if n < 10:
        raise ValueError(f"an audit needs at least 10 transitions, got {n}")
    both = np.concatenate([frames, next_frames], axis=1)
    patches = both.reshape(n, 2 * channels, n_patches, height // n_patches, n_patches, width // n_patches)
    patches = patches.transpose(2, 4, 0, 1, 3, 5).reshape(n_patches, n_patches, n, -1)
    scores = np.array([[_score(patches[i, j], actions) for j in range(n_patches)] for i in range(n_patches)])
    result = LeakAudit(scores, (height // n_patches, width // n_patches))
    if result.leaks:
        row, column = result.best
        warnings.warn(
            f"rows {row * result.patch[0]} to {(row + 1) * result.patch[0] - 1}, columns {column * result.patch[1]} to "
            f"{(column + 1) * result.patch[1] - 1} of the picture alone tell the action (score "
            f"{scores.max():.2f} of 1): an inverse model may learn to look at nothing else; mask these pixels",
            ActionLeakWarning,
            stacklevel=2,
        )
    return result


def _score(pixels: NDArray[np.uint8], actions: NDArray[Any]) -> float:
    """How well a tree that has learned on the first two thirds predicts the rest."""
    from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor

    split = 2 * len(pixels) // 3
    # A patch in which nothing ever happens is a tree with a single leaf; this only saves time.
    if (pixels == pixels[0]).all():
        return 0.0
    if actions.ndim == 1:
        tree = DecisionTreeClassifier(max_depth=MAX_DEPTH, min_samples_leaf=5, random_state=0)
        tree.fit(pixels[:split], actions[:split])
        chance = np.bincount(actions[split:]).max() / (len(actions) - split)
        return float((tree.score(pixels[split:], actions[split:]) - chance) / max(1 - chance, 1e-9))
    # The largest over the action's dimensions: a display of one of them is a leak.
    scores = []
    for values in actions.T:
        regressor = DecisionTreeRegressor(max_depth=MAX_DEPTH, min_samples_leaf=5, random_state=0)
        scores.append(regressor.fit(pixels[:split], values[:split]).score(pixels[split:], values[split:]))
    return float(max(scores))


def paint_action(next_frames: NDArray[np.uint8], actions: NDArray[Any]) -> NDArray[np.uint8]:
    """The paper's example: a display of the last action in the top left corner of s_{t+1}, as gray levels.

    :param next_frames: uint8 (n, channels, height, width)
    :param actions: int (n,), or float (n, action_dim) in -1..1, of which the first two channels show the first two
    :return: a copy
    """
    painted = next_frames.copy()
    if actions.ndim == 1:
        painted[:, :, :DISPLAY, :DISPLAY] = (60 * actions)[:, None, None, None]
    else:
        levels = np.rint((actions[:, :2] + 1) * 127).astype(np.uint8)
        painted[:, : levels.shape[1], :DISPLAY, :DISPLAY] = levels[:, :, None, None]
    return painted


def leak_maps(env_id: str, n_episodes: int, seed: int = 0) -> dict[str, Any]:
    """Audit an environment as it is and, to show that the audit finds a leak, with the paper's display painted in.

    :param env_id: a registered id of ours
    :param n_episodes: of random play, :data:`PER_EPISODE` transitions of each
    :param seed: of the episodes
    """
    samples = sample_episodes(env_id, n_episodes, PER_EPISODE, seed)
    n_patches = N_PATCHES[samples.frames.shape[-1]]
    plain = audit(samples.frames, samples.actions, samples.next_frames, n_patches)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ActionLeakWarning)
        painted = paint_action(samples.next_frames, samples.actions)
        display = audit(samples.frames, samples.actions, painted, n_patches)
    audits = {"as it is": plain, "with a display of the action": display}
    return {
        "n_transitions": len(samples),
        "threshold": THRESHOLD,
        "audits": {
            name: {"scores": one.scores.tolist(), "best": one.best, "patch": one.patch, "leaks": one.leaks}
            for name, one in audits.items()
        },
    }
