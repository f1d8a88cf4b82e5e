"""Looks against pixels computed one by one, and what is drawn."""

import numpy as np

from sb3_abisim.envs.backgrounds.color_jitter import ColorJitter


def test_before_a_draw_pictures_stay_as_they_are():
    pictures = np.random.default_rng(0).integers(0, 256, (2, 3, 5, 4), dtype=np.uint8)
    changed = ColorJitter(3).apply(pictures, np.array([2, 0]))
    assert np.array_equal(changed, pictures) and changed is not pictures


def test_each_pixel_by_hand():
    pictures = np.random.default_rng(1).integers(0, 256, (4, 3, 5, 4), dtype=np.uint8)
    pictures[:, :, 0, 0], pictures[:, :, 4, 3] = 0, 255
    looks = ColorJitter(6)
    for index in range(6):
        looks.draw(index, np.random.default_rng(index))
    looks._first[5], looks._last[5] = 255, 256  # the largest sum that 16 bits must hold
    indices = np.array([5, 0, 3, 1])
    changed = looks.apply(pictures, indices)
    for i, index in enumerate(indices.tolist()):
        up_down, left_right = (looks._flips[index] == -1).tolist()
        for c, row, column in np.ndindex(3, 5, 4):
            x = int(
                pictures[
                    i, looks._channels[index, c], 4 - row if up_down else row, 3 - column if left_right else column
                ]
            )
            first, last = int(looks._first[index, c, 0, 0]), int(looks._last[index, c, 0, 0])
            assert changed[i, c, row, column] == (256 * first + (last - first) * x) // 256


def test_what_is_drawn():
    looks = ColorJitter(400)
    for index in range(400):
        looks.draw(index, np.random.default_rng(index))
    assert {tuple(row) for row in looks._flips.tolist()} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    assert len({tuple(row) for row in looks._channels.tolist()}) == 6
    first, last = looks._first[..., 0, 0].astype(int), looks._last[..., 0, 0].astype(int)
    keeps = ((first == 0) & (last == 256)).all(axis=1)
    assert 0.4 < keeps.mean() < 0.6
    assert 0.4 < (last < first)[~keeps].mean() < 0.6
    assert np.abs(last - first)[~keeps].std() > 40
