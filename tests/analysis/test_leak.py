"""The audit finds a display of the action, wherever it is, and nothing in the environments as they are."""

import warnings

import gymnasium as gym
import index_env  # noqa: F401  (registers the environment)
import numpy as np
import pytest
from action_spaces import SPACES, ActionEnv
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Discrete, MultiDiscrete

from sb3_abisim.analysis.leak import ActionLeakWarning, audit, leak_maps, paint_action

PUSHES = Box(-1, 1, (2,))
GENERATOR = np.random.default_rng(0)


def noise(n=400, height=12, width=12):
    """Observations of 4 x 4 patches of 3 x 3 pixels."""
    return GENERATOR.integers(0, 256, (n, 3, height, width), dtype=np.uint8)


def test_display_is_found_where_it_is():
    obs, after, actions = noise(), noise(), GENERATOR.integers(0, 4, 400)
    after[:, :, 6:8, 9:11] = (50 * actions)[:, None, None, None]
    with pytest.warns(ActionLeakWarning, match="rows 6 to 8, columns 9 to 11 of the observation"):
        result = audit(obs, actions, after, Discrete(4))
    assert result.leaks and result.best == (2, 3) and result.patch == (3, 3)
    assert result.scores[2, 3] > 0.95 and np.delete(result.scores.ravel(), 11).max() < 0.2


def test_noise_predicts_nothing():
    result = audit(noise(), GENERATOR.integers(0, 4, 400), noise(), Discrete(4))
    assert not result.leaks and np.abs(result.scores).max() < 0.25


def test_continuous_actions():
    obs, actions = noise(), GENERATOR.uniform(-1, 1, (400, 2)).astype(np.float32)
    assert not audit(obs, actions, noise(), PUSHES).leaks
    with pytest.warns(ActionLeakWarning, match="rows 0 to 2, columns 0 to 2"):
        assert audit(obs, actions, paint_action(noise(), actions, PUSHES), PUSHES).best == (0, 0)


def test_a_display_of_one_of_two_dimensions_is_a_leak():
    obs, actions = noise(), GENERATOR.uniform(-1, 1, (400, 2)).astype(np.float32)
    painted = noise()
    painted[:, :, :3, :3] = np.rint((actions[:, 1] + 1) * 127).astype(np.uint8)[:, None, None, None]
    with pytest.warns(ActionLeakWarning, match="rows 0 to 2, columns 0 to 2"):
        assert audit(obs, actions, painted, PUSHES).best == (0, 0)


@pytest.mark.parametrize("pixel", [(0, 0), (20, 52)])
def test_patches_cover_observations_of_any_size(pixel):
    """7 x 16 patches for 21 x 53 pixels: the last row and column are not left out."""
    obs, after, actions = noise(60, 21, 53), noise(60, 21, 53), GENERATOR.integers(0, 3, 60)
    after[:] = 0
    obs[:] = 0
    after[:, :, pixel[0], pixel[1]] = (50 * actions)[:, None]
    with pytest.warns(ActionLeakWarning, match="alone predict the action") as caught:
        result = audit(obs, actions, after, Discrete(4))
    assert result.scores.shape == (7, 16) and result.patch == (3, 4)
    assert (result.scores > 0).sum() == 1
    top, left = (int(edge * size / n) for edge, size, n in zip(result.best, (21, 53), (7, 16), strict=True))
    assert f"rows {top} to" in str(caught[0].message) and f"columns {left} to" in str(caught[0].message)
    assert top <= pixel[0] < top + 4 and left <= pixel[1] < left + 4


def test_nav2d_leaks_only_with_a_display():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results = leak_maps("Nav2D-v0", 60)["audits"]
    plain, display = results.values()
    assert not plain["leaks"] and display["leaks"] and display["best"] == (0, 0)
    # Patches of a point maze are 1/256 of it, those of Nav2D 3 x 3 cells.
    assert plain["patch"] == (3, 3) and np.array(plain["scores"]).shape == (5, 5)


def test_any_image_environment_can_be_audited():
    """Continuous actions with bounds of their own, no factors, 4 x 5 pixels."""
    plain, display = leak_maps("PlainEnv-v0", 100)["audits"].values()
    assert not plain["leaks"] and display["leaks"]


@pytest.mark.parametrize("kind", SPACES)
def test_every_action_space_can_be_audited(kind, monkeypatch):
    """An environment that shows each component of the last action in a pixel of the first row."""
    monkeypatch.setitem(
        gym.registry, "Kind-v0", EnvSpec("Kind-v0", ActionEnv, max_episode_steps=7, kwargs={"kind": kind})
    )
    with pytest.warns(ActionLeakWarning, match=r"rows 0 to 2, columns (0 to 2|3 to 5)"):
        results = leak_maps("Kind-v0", 60)["audits"]
    shown = [np.array(one["scores"]) for one in results.values()]
    # What is painted is one thing more than what the environment shows, in the same patch.
    assert all(scores[0, 0] > 0.9 and (scores.ravel()[2:] == 0).all() for scores in shown)


def test_a_display_of_one_of_two_choices_is_a_leak():
    actions = np.stack([GENERATOR.integers(0, 3, 400), GENERATOR.integers(0, 5, 400)], axis=1)
    painted = noise()
    painted[:, :, 3:6, 3:6] = (50 * actions[:, 1])[:, None, None, None]
    with pytest.warns(ActionLeakWarning, match="rows 3 to 5, columns 3 to 5"):
        result = audit(noise(), actions, painted, MultiDiscrete([3, 5]))
    assert result.scores[1, 1] > 0.9


def test_an_audit_needs_some_transitions():
    with pytest.raises(ValueError, match="at least 10 transitions, got 9"):
        audit(noise(9), np.zeros(9, dtype=np.int64), noise(9), Discrete(4))
