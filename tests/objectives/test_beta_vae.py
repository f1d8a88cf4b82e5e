"""The evidence lower bound against a loop-written derivation, its gradients, and that it reconstructs."""

import math

import pytest
import torch as th
from objective_inputs import DISCRETE, LineEncoder, fit, loss_without_values, make_batch

from sb3_abisim.networks.decoder import Decoder
from sb3_abisim.networks.paper import PointMazeEncoder
from sb3_abisim.objectives.base import TensorBatch
from sb3_abisim.objectives.beta_vae import BetaVAE, beta_vae_loss


def test_loss_equals_loop():
    generator = th.Generator().manual_seed(1)
    logits, images = th.randn(2, 3, 2, 2, generator=generator), th.rand(2, 3, 2, 2, generator=generator)
    mean, log_std = th.randn(2, 5, generator=generator), th.randn(2, 5, generator=generator)
    reconstruction = kl = 0.0
    for x, p in zip(logits.flatten().tolist(), images.flatten().tolist(), strict=True):
        probability = 1 / (1 + math.exp(-x))
        reconstruction -= p * math.log(probability) + (1 - p) * math.log(1 - probability)
    for m, s in zip(mean.flatten().tolist(), log_std.flatten().tolist(), strict=True):
        # KL(N(m, e^2s) || N(0, 1)) = -s + (e^2s + m^2 - 1) / 2
        kl += -s + (math.exp(2 * s) + m * m - 1) / 2
    loss, terms = beta_vae_loss(logits, images, mean, log_std, 0.7)
    assert float(terms["reconstruction"]) == pytest.approx(reconstruction / 2, rel=1e-5)
    assert float(terms["kl"]) == pytest.approx(kl / 2, rel=1e-5)
    assert float(loss) == pytest.approx((reconstruction + 0.7 * kl) / 2, rel=1e-5)


@th.no_grad()
def test_decodes_a_sample_around_the_mean():
    th.manual_seed(0)
    objective, batch = BetaVAE(LineEncoder(), DISCRETE, kl_weight=0.5), make_batch(DISCRETE, 4)
    th.manual_seed(3)
    loss, terms = objective.loss(batch)
    mean = objective.encoder(batch.obs)
    log_std = objective.log_std(mean)
    th.manual_seed(3)
    z = mean + th.exp(log_std) * th.randn(4, 5)
    expected, _ = beta_vae_loss(objective.decoder(z), batch.obs, mean, log_std, 0.5)
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)
    probabilities = (1 / (1 + (-objective.decoder(z)).exp())).flatten().tolist()
    errors = [(p - x) ** 2 for p, x in zip(probabilities, batch.obs.flatten().tolist(), strict=True)]
    assert float(terms["squared_error"]) == pytest.approx(sum(errors) / len(errors), rel=1e-4)
    assert float(loss) != pytest.approx(float(objective.loss(batch)[0]), rel=1e-5), "another sample, another loss"


def test_gradients_reach_everything():
    objective = BetaVAE(LineEncoder(), DISCRETE)
    objective.loss(make_batch(DISCRETE))[0].backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in objective.parameters())


def test_reconstructs_unseen_observations_and_not_under_a_large_penalty():
    error = {}
    for kl_weight in (0.0, 100.0):
        th.manual_seed(0)
        objective = fit(BetaVAE(LineEncoder(), DISCRETE, kl_weight=kl_weight), make_batch(DISCRETE, 512), 400)
        error[kl_weight] = float(objective.loss(make_batch(DISCRETE, 512, seed=9))[1]["squared_error"])
    variance = 1 / 12  # of uniform numbers, the error of a constant image
    assert error[0.0] < 0.2 * variance
    assert error[100.0] > 0.8 * variance, "a posterior equal to the prior says nothing"


def test_the_loss_stays_on_the_device_of_its_inputs():
    assert loss_without_values(BetaVAE(LineEncoder(), DISCRETE), make_batch(DISCRETE, 4)) == {"meta"}


@th.no_grad()
def test_actions_and_next_observations_do_not_count():
    objective, batch = BetaVAE(LineEncoder(), DISCRETE), make_batch(DISCRETE, 4)
    th.manual_seed(1)
    one = objective.loss(batch)[0]
    th.manual_seed(1)
    other = objective.loss(TensorBatch.of(batch.obs, 2 - batch.actions, 1 - batch.next_obs))[0]
    assert float(one) == float(other)


@pytest.mark.parametrize("shape", [(3, 15, 15), (3, 64, 64), (4, 128, 96), (1, 5, 9)], ids=str)
def test_decoder_fits_every_size(shape):
    decoder = Decoder(7, shape)
    assert decoder(th.zeros(2, 7)).shape == (2, *shape)


def test_decoder_takes_its_shape_from_the_encoder():
    objective = BetaVAE(PointMazeEncoder(n_input_channels=2), DISCRETE)
    obs = th.rand(2, 2, 64, 64)
    objective.loss(TensorBatch.of(obs, th.zeros(2, dtype=th.int64), obs))


def test_the_weight_of_the_divergence_is_one_and_may_be_none():
    assert BetaVAE(LineEncoder(), DISCRETE).kl_weight == 1.0
    objective = BetaVAE(LineEncoder(), DISCRETE, kl_weight=0.0)
    loss, terms = objective.loss(make_batch(DISCRETE, 4))
    assert float(loss.detach()) == float(terms["reconstruction"])


@pytest.mark.parametrize("kl_weight", [-1.0, math.nan, math.inf])
def test_refuses_bad_settings(kl_weight):
    with pytest.raises(ValueError, match=str(kl_weight)):
        BetaVAE(LineEncoder(), DISCRETE, kl_weight=kl_weight)
