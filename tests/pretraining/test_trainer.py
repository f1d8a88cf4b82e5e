"""The training loop: what is trained on, in which order, and when it stops."""

import errno
import json

import pytest
import torch as th
from pretrain_inputs import SETTINGS, collect_grids, make_run, run
from stable_baselines3.common.logger import Logger

from sb3_abisim import register_network, registry
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.networks.encoder_file import embed, load_encoder
from sb3_abisim.objectives.ssi import InverseDynamics
from sb3_abisim.pretraining import trainer
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import pretrain


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return collect_grids(tmp_path_factory)


@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_stops_at_numbers_that_are_not_finite(data, tmp_path, monkeypatch, where):
    plain, calls = InverseDynamics.loss, 0

    def broken(self, batch):
        nonlocal calls
        calls += self.training
        loss, terms = plain(self, batch)
        if self.training and calls == 8:
            if where == "loss":
                loss = loss * float("nan")
            else:
                weight = self.encoder.layers[0].weight
                loss = loss + 0.0 * th.sqrt(weight.sum() * 0.0)  # the value is 0, its derivative is not
        return loss, terms

    monkeypatch.setattr(InverseDynamics, "loss", broken)
    with pytest.raises(FloatingPointError, match=f"{where}.* at update 7.*learning_rate"):
        run(data, tmp_path / "ssi.safetensors")
    assert not (tmp_path / "ssi.safetensors").exists()
    assert [path.name for path in (tmp_path / "ssi.run").glob("checkpoint-*")] == ["checkpoint-000000005.safetensors"]


def test_weights_that_are_not_finite_are_never_saved(data, tmp_path, monkeypatch):
    plain = InverseDynamics.after_step

    def broken(self):
        plain(self)
        with th.no_grad():
            self.encoder.layers[0].weight[0, 0, 0, 0] = float("inf")

    monkeypatch.setattr(InverseDynamics, "after_step", broken)
    with pytest.raises(FloatingPointError, match=r"weights.* at update 0"):
        run(data, tmp_path / "ssi.safetensors", log_interval=1, checkpoint_interval=1)
    assert not list((tmp_path / "ssi.run").glob("checkpoint-*"))


def test_transitions_of_the_eval_split_are_not_trained_on(data, tmp_path, monkeypatch):
    plain_batches, plain_loss, seen = TransitionDataset.batches, InverseDynamics.loss, []

    def batches(self, *args, split=None, **kwargs):
        for batch in plain_batches(self, *args, split=split, **kwargs):
            seen.append([split])
            yield batch

    def loss(self, batch):
        seen[-1].append("train" if self.training else "eval")
        return plain_loss(self, batch)

    monkeypatch.setattr(TransitionDataset, "batches", batches)
    monkeypatch.setattr(InverseDynamics, "loss", loss)
    # One that is made ahead would come between a batch and its loss.
    monkeypatch.setattr(trainer, "gains_from_ahead", lambda *args: False)
    run(data, tmp_path / "ssi.safetensors", n_updates=10)
    assert seen.count(["train", "train"]) == 10
    assert 0 < seen.count(["eval", "eval"]) == len(seen) - 10


def test_the_embedding_is_standardized_over_the_train_split_alone(data, tmp_path):
    # All 2,000 transitions are fewer than it takes, so mean and variance of the split are exact.
    file = load_encoder(run(data, tmp_path / "ssi.safetensors", eval_fraction=0.5))
    dataset = TransitionDataset(data, eval_fraction=0.5)
    mean, deviation = {}, {}
    for split in ("train", "eval"):
        frames = dataset.frames(dataset.valid_starts(split=split))
        embeddings = embed(file.encoder, dataset.observation_space, th.as_tensor(frames))
        mean[split] = float(embeddings.mean(dim=0).abs().max())
        deviation[split] = abs(float(embeddings.var(dim=0, correction=0).mean()) - 1)
    assert mean["train"] < 1e-4 and deviation["train"] < 1e-4
    assert mean["eval"] > 1e-2 and deviation["eval"] > 1e-3, "the splits can be distinguished"


def test_a_registered_network_with_batch_norm_is_standardized_as_it_is_used(data, tmp_path, monkeypatch):
    registry.networks()
    monkeypatch.setattr(registry._NETWORKS, "by_name", dict(registry._NETWORKS.by_name))
    layers = (th.nn.Conv2d(3, 4, 5, stride=5), th.nn.BatchNorm2d(4), th.nn.Flatten())
    register_network("normed", lambda space: th.nn.Sequential(*layers))
    # Without an eval split nothing has put the network into evaluation mode before.
    file = load_encoder(run(data, tmp_path / "ssi.safetensors", network="normed", eval_fraction=0.0))
    dataset = TransitionDataset(data)
    embeddings = embed(file.encoder, dataset.observation_space, th.as_tensor(dataset.frames(dataset.valid_starts())))
    assert float(embeddings.mean(dim=0).abs().max()) < 1e-4
    assert float(embeddings.var(dim=0, correction=0).mean()) == pytest.approx(1.0, rel=1e-4)


def test_the_moving_average_follows_the_weights_after_the_step(data):
    pretraining = make_run(data, "curl", **{"objective_kwargs.tau": 1.0})
    before = [parameter.clone() for parameter in pretraining.module.encoder.parameters()]
    pretraining._update(next(pretraining._batches()))
    module = pretraining.module
    assert not any(map(th.equal, before, module.encoder.parameters()))
    assert all(map(th.equal, module.key_encoder.parameters(), module.encoder.parameters()))


def test_learning_rate_reaches_the_optimizer(data, tmp_path, monkeypatch):
    seen = []
    step = th.optim.Adam.step
    monkeypatch.setattr(
        th.optim.Adam, "step", lambda self, *args: (seen.append(self.param_groups[0]["lr"]), step(self, *args))
    )
    run(data, tmp_path / "ssi.safetensors", n_updates=4, learning_rate="lin_0.4")
    assert seen == pytest.approx([0.4, 0.3, 0.2, 0.1])


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("gpu0", "unknown device 'gpu0'"),
        pytest.param(
            "cuda", "'cuda' is not available", marks=pytest.mark.skipif(th.cuda.is_available(), reason="CUDA is there")
        ),
    ],
)
def test_a_device_that_is_not_there_is_refused(data, tmp_path, device, message):
    config = load_config("ssi", "Nav2D-v0", SETTINGS)
    with pytest.raises(ValueError, match=message):
        pretrain("ssi", data, tmp_path / "ssi.safetensors", config, device=device, progress_bar=False, verbose=0)


def test_k_has_one_place(data, tmp_path):
    with pytest.raises(ValueError, match=r"objective_kwargs\.k cannot be set; set k itself: k:3"):
        run(data, tmp_path / "x.safetensors", "info_nce", **{"objective_kwargs.k": 3})


@pytest.mark.parametrize(
    ("objective", "k", "message"),
    [("ssi", 2, "use acro"), ("acro", 1, "which is ssi"), ("info_nce", [1, 2], "one length"), ("curl", 3, "single")],
)
def test_refuses_steps_that_the_objective_is_not_made_for(data, tmp_path, objective, k, message):
    with pytest.raises(ValueError, match=message):
        run(data, tmp_path / "x.safetensors", objective, k=k)
    assert not list(tmp_path.iterdir()), "a refused run leaves nothing behind"


def test_a_callback_adds_to_the_log_and_changes_nothing_else(data, tmp_path):
    # CURL samples noise; without an eval split nothing else changes the mode.
    plain = run(data, tmp_path / "plain.safetensors", "curl", eval_fraction=0.0)
    modes = []

    def callback(encoder):
        modes.append(encoder.training)
        return {"exact/size": encoder(th.rand(2, 3, 15, 15)).abs().sum()}

    output = run(data, tmp_path / "logged.safetensors", "curl", callback, eval_fraction=0.0)
    assert output.read_bytes() == plain.read_bytes()
    assert modes == [False] * 6
    sizes = json.loads(output.with_suffix(".json").read_text())["curves"]["exact/size"]
    assert len(sizes) == 6 and all(size > 0 for size in sizes)
    assert "exact/size" in (output.with_suffix(".run") / "progress.csv").read_text().splitlines()[0].split(",")


@pytest.mark.parametrize("method", ["dump", "close"])
def test_a_log_that_cannot_be_written_names_its_folder(data, tmp_path, monkeypatch, method):
    """TensorBoard's writer names no file."""

    whole = getattr(Logger, method)

    def fill_the_disk(self, *args):
        whole(self, *args)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Logger, method, fill_the_disk)
    with pytest.raises(OSError, match=r"No space left on device: '.*x\.run'"):
        run(data, tmp_path / "x.safetensors")
