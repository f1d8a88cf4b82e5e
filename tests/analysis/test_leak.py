"""The audit finds a display of the action, wherever it is, and nothing in the environments as they are."""

import warnings

import numpy as np
import pytest

from sb3_abisim.analysis.leak import N_PATCHES, ActionLeakWarning, audit, leak_maps, paint_action
from sb3_abisim.networks.base import ENCODERS

GENERATOR = np.random.default_rng(0)


def noise(n=400, size=16):
    return GENERATOR.integers(0, 256, (n, 3, size, size), dtype=np.uint8)


def test_display_is_found_where_it_is():
    frames, after, actions = noise(), noise(), GENERATOR.integers(0, 4, 400)
    after[:, :, 8:10, 12:14] = (50 * actions)[:, None, None, None]
    with pytest.warns(ActionLeakWarning, match="rows 8 to 11, columns 12 to 15"):
        result = audit(frames, actions, after, 4)
    assert result.leaks and result.best == (2, 3) and result.patch == (4, 4)
    assert result.scores[2, 3] > 0.95 and np.delete(result.scores.ravel(), 11).max() < 0.2


def test_noise_tells_nothing():
    result = audit(noise(), GENERATOR.integers(0, 4, 400), noise(), 4)
    assert not result.leaks and np.abs(result.scores).max() < 0.25


def test_continuous_actions():
    frames, actions = noise(), GENERATOR.uniform(-1, 1, (400, 2)).astype(np.float32)
    assert not audit(frames, actions, noise(), 4).leaks
    with pytest.warns(ActionLeakWarning, match="rows 0 to 3, columns 0 to 3"):
        assert audit(frames, actions, paint_action(noise(), actions), 4).best == (0, 0)


def test_a_display_of_one_of_two_dimensions_is_a_leak():
    frames, actions = noise(), GENERATOR.uniform(-1, 1, (400, 2)).astype(np.float32)
    painted = noise()
    painted[:, :, :4, :4] = np.rint((actions[:, 1] + 1) * 127).astype(np.uint8)[:, None, None, None]
    with pytest.warns(ActionLeakWarning, match="rows 0 to 3, columns 0 to 3"):
        assert audit(frames, actions, painted, 4).best == (0, 0)


def test_nav2d_leaks_only_with_a_display():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results = leak_maps("Nav2D-v0", 60)["audits"]
    plain, display = results.values()
    assert not plain["leaks"] and display["leaks"] and display["best"] == (0, 0)


def test_all_our_pictures_have_patches():
    sides = {network.observation_shape[-1] for network in ENCODERS.values()}
    assert sides == set(N_PATCHES) and all(side % N_PATCHES[side] == 0 for side in sides)


@pytest.mark.parametrize(
    ("n", "n_patches", "message"), [(400, 5, "divide 16 and 16, got 5"), (9, 4, "at least 10 transitions, got 9")]
)
def test_refuses(n, n_patches, message):
    with pytest.raises(ValueError, match=message):
        audit(noise(n), np.zeros(n, dtype=np.int64), noise(n), n_patches)
