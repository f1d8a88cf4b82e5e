"""What the tests of pretraining share: a small dataset, and runs of seconds."""

from pathlib import Path

from sb3_abisim.data.collect import collect
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import pretrain
from sb3_abisim.pretraining.trainer import PretrainRun

SETTINGS = {"n_updates": 30, "batch_size": 32, "log_interval": 5, "checkpoint_interval": 5}


def collect_grids(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "nav2d"
    collect("Nav2D-v0", 2000, folder, n_envs=8)
    return folder


def run(data, output, objective="ssi", callback=None, keep_checkpoint=False, **settings):
    config = load_config(objective, "Nav2D-v0", {**SETTINGS, **settings})
    quiet = {"device": "cpu", "progress_bar": False, "verbose": 0}
    return pretrain(objective, data, output, config, callback=callback, keep_checkpoint=keep_checkpoint, **quiet)


def make_run(data, objective="ssi", output=Path("x.safetensors"), **settings):
    """A run that has not begun."""
    config = load_config(objective, "Nav2D-v0", {**SETTINGS, **settings})
    dataset = TransitionDataset(data, eval_fraction=config.eval_fraction)
    return PretrainRun(objective, dataset, output, config, None, 0, "cpu")
