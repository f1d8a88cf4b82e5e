"""Color jitter against pixels computed one by one, and what is sampled."""

import numpy as np

from sb3_abisim.envs.backgrounds.color_jitter import ColorJitter


def test_before_a_sample_frames_stay_as_they_are():
    frames = np.random.default_rng(0).integers(0, 256, (2, 3, 5, 4), dtype=np.uint8)
    jittered = ColorJitter(3).apply(frames, np.array([2, 0]))
    assert np.array_equal(jittered, frames) and jittered is not frames


def test_each_pixel_by_hand():
    frames = np.random.default_rng(1).integers(0, 256, (4, 3, 5, 4), dtype=np.uint8)
    frames[:, :, 0, 0], frames[:, :, 4, 3] = 0, 255
    jitter = ColorJitter(6)
    for index in range(6):
        jitter.sample(index, np.random.default_rng(index))
    jitter._first[5], jitter._last[5] = 255, 256  # the largest sum that 16 bits must hold
    indices = np.array([5, 0, 3, 1])
    jittered = jitter.apply(frames, indices)
    for i, index in enumerate(indices.tolist()):
        up_down, left_right = (jitter._flips[index] == -1).tolist()
        for c, row, column in np.ndindex(3, 5, 4):
            x = int(
                frames[i, jitter._channels[index, c], 4 - row if up_down else row, 3 - column if left_right else column]
            )
            first, last = int(jitter._first[index, c, 0, 0]), int(jitter._last[index, c, 0, 0])
            assert jittered[i, c, row, column] == (256 * first + (last - first) * x) // 256


def test_what_is_sampled():
    jitter = ColorJitter(400)
    for index in range(400):
        jitter.sample(index, np.random.default_rng(index))
    assert {tuple(row) for row in jitter._flips.tolist()} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    assert len({tuple(row) for row in jitter._channels.tolist()}) == 6
    first, last = jitter._first[..., 0, 0].astype(int), jitter._last[..., 0, 0].astype(int)
    keeps = ((first == 0) & (last == 256)).all(axis=1)
    assert 0.4 < keeps.mean() < 0.6
    assert 0.4 < (last < first)[~keeps].mean() < 0.6
    assert np.abs(last - first)[~keeps].std() > 40
