"""What the tests of several processes share: the work of each process, importable in a fresh one."""

import json
import os
import signal
import warnings
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch as th
import torch.distributed as dist
from pretrain_inputs import make_run
from torch import nn

from sb3_abisim.objectives.base import Objective
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import pretrain
from sb3_abisim.pretraining.ranks import Ranks
from sb3_abisim.pretraining.trainer import PretrainRun
from sb3_abisim.registry import is_known_network, methods, register_method, register_network

# An odd batch: its shares differ.
SETTINGS = {"n_updates": 3, "batch_size": 31, "log_interval": 1, "checkpoint_interval": 1}
# In addition to those of the file of each objective.
MORE: dict[str, dict[str, Any]] = {
    "info_nce": {"k": 2, "chunk_length": 4},
    "abisim": {"objective_kwargs": {"pairs": "nearest", "n_pairs": 100, "l1_penalty": 0.01}},
    "goal_progress": {"network_kwargs": {}, "objective_kwargs.n_goals": 16},
}
DEATH = 2


class Spread(Objective):
    """A user's: it compares all pairs of the batch, samples, has a head, and calls its encoder twice."""

    name = "spread"

    def __init__(self, encoder, action_space):
        super().__init__(encoder, action_space)
        self.head = nn.Linear(encoder.features_dim, 8)

    def loss(self, batch):
        obs, next_obs = self.head(self.encoder(batch.obs)), self.head(self.encoder(batch.next_obs))
        near = (obs - next_obs).pow(2).mean()
        far = th.cdist(obs + 0.1 * th.randn(obs.shape), next_obs[th.randperm(len(obs))]).clamp_max(5).mean()
        decay = sum(parameter.pow(2).sum() for parameter in self.parameters())
        loss = near - far + 1e-3 * decay
        return loss, {"near": near.detach(), "far": far.detach()}


def register() -> None:
    """What a user would add: an objective, and a network that looks at the whole batch."""
    if "spread" not in methods():
        register_method("spread", Spread, label="spread")
    if not is_known_network("batch_norm"):
        register_network("batch_norm", _batch_norm)


class _Agent(nn.Module):
    """The agent's channel, of which every observation has one pixel: its statistics are the same in every batch."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return observations[:, :1]


def _batch_norm(observation_space: Any) -> nn.Module:
    return nn.Sequential(_Agent(), nn.BatchNorm2d(1), nn.AdaptiveAvgPool2d(4), nn.Flatten())


def objectives() -> list[str]:
    """Names of all that are registered."""
    return [name for name, method in methods().items() if method.objective is not None]


def pretrain_one(objective: str, data: Path, folder: Path, **settings: Any) -> Path:
    """One small run; for abisim on a base that is there."""
    config = {**SETTINGS, **MORE.get(objective, {}), **settings}
    if methods()[objective].base is not None and objective != "abisim":
        config |= {"base.n_updates": 2, "base.batch_size": 31}
    base = str(folder.parent / "base.safetensors") if objective == "abisim" else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        output = folder / f"{objective}.safetensors"
        return pretrain(objective, data, output, config, base, device="cpu", progress_bar=False, verbose=0)


def gradients(objective: str, data: Path, ranks: Ranks | None = None) -> dict[str, th.Tensor]:
    """Those of the first update; Adam, which divides by their size, would hide a factor."""
    config = load_config(objective, "Nav2D-v0", {**SETTINGS, **MORE.get(objective, {})})
    run = make_run(data, objective, **{name: getattr(config, name) for name in ("k", "chunk_length", "batch_size")})
    run.ranks = ranks or run.ranks
    run._update(next(run._batches()))
    return {name: p.grad for name, p in run.module.named_parameters() if p.grad is not None}


def work(rank: int, size: int, data: Path, folder: Path) -> None:
    """All that one of several processes does; the first writes what it found into ``folder``.

    :param rank: which of them
    :param size: how many
    :param data: a dataset
    :param folder: holds base.safetensors and gets a folder "several"
    """
    th.set_num_threads(1)
    register()
    dist.init_process_group(
        "gloo", init_method=f"file://{folder}/store", rank=rank, world_size=size, timeout=timedelta(minutes=1)
    )
    several = folder / "several"
    for objective in objectives():
        pretrain_one(objective, data, several)
    ranks = Ranks(rank, size)
    found = {objective: gradients(objective, data, ranks) for objective in ("ssi", "beta_vae", "curl", "info_nce")}
    if ranks.is_first:
        th.save(found, folder / "gradients.pt")
    said = {}
    try:
        pretrain_one("ssi", data, folder / "refused", network="batch_norm")
    except ValueError as error:
        said["batch_norm"] = str(error)
    # The second process dies in the middle of a run.
    update = PretrainRun._update

    def dying(self: PretrainRun, batch: Any) -> Any:
        if rank == 1 and self.n_updates == DEATH:
            os.kill(os.getpid(), signal.SIGKILL)
        return update(self, batch)

    PretrainRun._update = dying  # type: ignore[method-assign]
    try:
        pretrain_one("ssi", data, folder / "killed", n_updates=4)
    except ConnectionError as error:
        said["killed"] = str(error)
    (folder / "said.json").write_text(json.dumps(said))
    # Its partner is gone: no leave-taking.
    os._exit(0)
