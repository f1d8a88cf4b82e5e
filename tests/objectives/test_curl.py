"""InfoNCE with bilinear similarity against a loop-written derivation, its gradients, and that keys are found."""

import math

import pytest
import torch as th
from objective_inputs import DISCRETE, LineEncoder, change_weights, fit, loss_without_values, make_batch

from sb3_abisim.networks.augmentations import random_crop, random_noise, random_shift
from sb3_abisim.objectives.curl import CURL, curl_loss


def test_loss_equals_loop():
    generator = th.Generator().manual_seed(1)
    query, key = th.randn(4, 3, generator=generator), th.randn(4, 3, generator=generator)
    weight = th.randn(3, 3, generator=generator)
    total, hits = 0.0, 0
    for i in range(4):
        similarities = []
        for j in range(4):
            s = sum(float(query[i, a] * weight[a, b] * key[j, b]) for a in range(3) for b in range(3))
            similarities.append(s)
        total -= similarities[i] - math.log(sum(math.exp(s) for s in similarities))
        hits += similarities.index(max(similarities)) == i
    loss, terms = curl_loss(query, key, weight)
    assert float(loss) == pytest.approx(total / 4, rel=1e-5)
    assert float(terms["accuracy"]) == hits / 4 and float(terms["info_nce"]) == float(loss)
    # The weight is not symmetric, so its transpose shows which side each embedding stands on.
    assert float(curl_loss(query, key, weight.T)[0]) != pytest.approx(float(loss), rel=1e-2)


@th.no_grad()
def test_both_copies_are_changed_each_in_its_own_way(monkeypatch):
    th.manual_seed(0)
    objective, batch = CURL(LineEncoder(), DISCRETE, strength=0.3), make_batch(DISCRETE, 4)
    change_weights(objective.key_encoder)
    th.manual_seed(5)
    loss, _ = objective.loss(batch)
    th.manual_seed(5)
    query = objective.encoder(random_noise(batch.obs, 0.3))
    key = objective.key_encoder(random_noise(batch.obs, 0.3))
    assert float(loss) == pytest.approx(float(curl_loss(query, key, objective.weight)[0]), rel=1e-5)


@pytest.mark.parametrize("augmentation", ["noise", "shift", "crop"])
def test_the_loss_stays_on_the_device_of_its_inputs(augmentation):
    objective = CURL(LineEncoder(), DISCRETE, augmentation=augmentation)
    assert loss_without_values(objective, make_batch(DISCRETE, 4)) == {"meta"}


def test_gradients_reach_query_and_weight_alone():
    objective = CURL(LineEncoder(), DISCRETE)
    objective.loss(make_batch(DISCRETE))[0].backward()
    for name, parameter in objective.named_parameters():
        assert (parameter.grad is None) == name.startswith("key_encoder"), name


def test_key_encoder_is_a_moving_average():
    objective = CURL(LineEncoder(), DISCRETE, tau=0.25)
    with th.no_grad():
        for parameter in objective.encoder.parameters():
            parameter.add_(1.0)
    before = [p.clone() for p in objective.key_encoder.parameters()]
    objective.after_step()
    for old, new in zip(before, objective.key_encoder.parameters(), strict=True):
        th.testing.assert_close(new, old + 0.25)


def test_the_least_and_the_most_of_each_setting():
    objective = CURL(LineEncoder(), DISCRETE)
    assert (objective.augmentation, objective.strength, objective.tau) == ("noise", 0.1, 0.05)
    objective = CURL(LineEncoder(), DISCRETE, tau=1.0)
    assert not any(parameter.requires_grad for parameter in objective.key_encoder.parameters())
    change_weights(objective.encoder)
    objective.after_step()
    for online, key in zip(objective.encoder.parameters(), objective.key_encoder.parameters(), strict=True):
        assert th.equal(online, key)
    with pytest.raises(ValueError, match=r"strength must lie between 0 and 1, got 1.0"):
        CURL(LineEncoder(), DISCRETE, strength=1.0)


def test_similarity_starts_as_a_dot_product():
    assert th.equal(CURL(LineEncoder(), DISCRETE).weight.detach(), th.eye(5))


def test_finds_the_other_copy_of_unseen_observations():
    th.manual_seed(0)
    objective = CURL(LineEncoder(), DISCRETE, strength=0.02)
    unseen = make_batch(DISCRETE, 64, seed=9)
    before = float(objective.loss(unseen)[1]["accuracy"])
    fit(objective, make_batch(DISCRETE, 256), 400)
    assert float(objective.loss(unseen)[1]["accuracy"]) > max(0.35, 5 * before)


def ramp(n=3, height=8, width=6):
    """Images whose intensity shows row and column."""
    rows, columns = th.arange(height)[:, None], th.arange(width)
    return (rows * 10 + columns).float().expand(n, 2, height, width) / 100


def test_noise_has_the_given_strength():
    th.manual_seed(0)
    noise = random_noise(th.full((50, 3, 20, 20), 0.5), 0.2) - 0.5
    assert float(noise.std()) == pytest.approx(0.2, rel=0.02)
    assert abs(float(noise.mean())) < 0.01


def test_shift_moves_whole_images_and_repeats_the_border():
    th.manual_seed(0)
    images = ramp(40)
    shifted = random_shift(images, 0.25)
    found = set()
    for image in shifted:
        th.testing.assert_close(image[0], image[1])
        candidates = []
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                rows = [min(max(y + dy, 0), 7) for y in range(8)]
                columns = [min(max(x + dx, 0), 5) for x in range(6)]
                if th.equal(image[0], images[0, 0][rows][:, columns]):
                    candidates.append((dy, dx))
        assert len(candidates) == 1
        found.update(candidates)
    assert {dy for dy, _ in found} == {dx for _, dx in found} == {-2, -1, 0, 1, 2}


def test_a_small_shift_is_a_pixel_and_none_is_none():
    th.manual_seed(0)
    images = ramp(40)
    assert th.equal(random_shift(images, 0.0), images)
    moved = (random_shift(images, 0.01) != images).flatten(1).any(dim=1)
    assert 25 < int(moved.sum()) < 40  # eight of nine


def test_crop_enlarges_a_window_within_the_image():
    th.manual_seed(0)
    images = ramp(30, 16, 16)
    cropped = random_crop(images, 0.5)
    assert cropped.shape == images.shape
    for image in cropped:
        # Half of the rows over the full height: inside the image intensity rises half as fast as in the original.
        th.testing.assert_close(image[0, 9, 4] - image[0, 5, 4], th.tensor(0.2))
        assert float(image.min()) >= float(images.min()) and float(image.max()) <= float(images.max())
    corners = {round(float(image[0, 0, 0]), 3) for image in cropped}
    assert len(corners) > 10


@pytest.mark.parametrize(
    "kwargs", [{"augmentation": "blur"}, {"strength": 0.0}, {"strength": 1.5}, {"tau": 0.0}, {"tau": 2.0}], ids=str
)
def test_refuses_bad_settings(kwargs):
    with pytest.raises(ValueError, match=str(next(iter(kwargs.values())))):
        CURL(LineEncoder(), DISCRETE, **kwargs)


@pytest.mark.parametrize("augmentation", ["noise", "shift", "crop"])
def test_takes_every_augmentation(augmentation):
    objective = CURL(LineEncoder(), DISCRETE, augmentation=augmentation, strength=0.3)
    assert math.isfinite(float(objective.loss(make_batch(DISCRETE, 8))[0].detach()))


def test_accuracy_of_guessing():
    assert CURL(LineEncoder(), DISCRETE).chance_accuracy(256) == 1 / 256
