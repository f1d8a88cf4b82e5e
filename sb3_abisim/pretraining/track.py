"""Weights & Biases for pretraining: the rows of the log, as they come."""

import secrets
import shlex
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter

from sb3_abisim._version import __version__
from sb3_abisim.common.extras import needs_extra, require_extra
from sb3_abisim.common.files import write_atomic

# In the folder of a run: what Weights & Biases calls it, so that the same command goes on in the same place.
ID_NAME = "wandb_id.txt"


@dataclass(frozen=True)
class Tracking:
    """Where on Weights & Biases runs are to be shown; the words are rl-zoo3's.

    :param project: name of the project
    :param entity: user or team that it belongs to; None for the default one
    :param tags: of the runs, beside this package's version
    :raises ImportError: without the package, naming the extra
    """

    project: str = "sb3"
    entity: str | None = None
    tags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # Before a base encoder is pretrained, and before anything is read.
        require_extra("track", "--track", "wandb")

    def start(self, folder: Path, env_id: str, settings: Mapping[str, Any]) -> "WandbWriter":
        """A new run there, or the one that an interrupted command began.

        :param folder: of the pretraining run; it exists
        :param env_id: of the dataset
        :param settings: of the pretraining run
        :raises ValueError: if Weights & Biases cannot begin, with what it says
        """
        with needs_extra("track", "--track"):
            import wandb
        path = folder / ID_NAME
        if not path.is_file():
            write_atomic(path, lambda file: file.write(secrets.token_hex(4).encode()))
        try:
            run = wandb.init(
                id=path.read_text().strip(),
                resume="allow",
                name=f"{env_id}__{settings['objective']}__{settings['seed']}__{int(time.time())}",
                project=self.project,
                entity=self.entity,
                tags=[*self.tags, f"v{__version__}"],
                config={**settings, "env": env_id, "command": shlex.join(sys.orig_argv)},
                dir=str(folder),
            )
        except wandb.Error as error:
            raise ValueError(
                f"Weights & Biases did not begin ({error}); run `wandb login`, set WANDB_MODE=offline, or leave out "
                "--track"
            ) from error
        return WandbWriter(run, int(settings["n_updates"]))


class WandbWriter(KVWriter):
    """A format of Stable-Baselines3's logger.

    :param run: of Weights & Biases
    :param n_updates: the step at which the run is complete; closed before, it has failed
    """

    def __init__(self, run: Any, n_updates: int) -> None:
        self._run, self._n_updates, self._step = run, n_updates, 0

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """A row of the log.

        :param key_values: names and values
        :param key_excluded: unused: the rows of pretraining exclude nothing
        :param step: updates so far
        """
        self._step = step
        self._run.log(dict(key_values), step=step)

    def close(self) -> None:
        """End the run there."""
        self._run.finish(exit_code=int(self._step < self._n_updates))
