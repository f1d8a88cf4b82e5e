"""One pretraining run: its parts, its position, how both are saved, and the training loop."""

import itertools
import json
import math
import platform
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.logger import CSVOutputFormat, Logger, configure
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.utils import get_device
from tqdm import tqdm

from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.transitions import TransitionBatch
from sb3_abisim.data.dataset import Split, TransitionDataset
from sb3_abisim.data.format import CONTENT_HASH_KEY, HASH_KEY
from sb3_abisim.networks.base import Encoder, make_encoder
from sb3_abisim.networks.encoder_file import EncoderFileError, load_encoder, save_encoder
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.pretraining.card import reproducing_commands
from sb3_abisim.pretraining.checkpoint import load_training_state, save_training_state
from sb3_abisim.pretraining.config import PretrainConfig
from sb3_abisim.registry import get_objective

# From the encoder in evaluation mode to further numbers for a row of the log.
Callback = Callable[[Encoder], Mapping[str, float]]

# Arguments of an objective that follow from other settings.
FOLLOWING = {"k", "encoder", "action_space", "base_encoder"}
N_REFERENCE = 8
N_STANDARDIZE = 4096
N_EVAL_BATCHES = 8


def make_objective(
    objective: str, dataset: TransitionDataset, config: PretrainConfig, base_encoder: Encoder | None = None
) -> Objective:
    """An objective with a fresh encoder, on the CPU.

    :param objective: name of a method
    :param dataset: whose spaces it is for
    :param config: the settings
    :param base_encoder: for an objective that takes one
    :raises ValueError: for settings that do not fit the objective or the dataset
    """
    objective_class: type[Objective] = get_objective(objective)
    objective_class.check_k(config.k)
    kwargs = dict(config.objective_kwargs)
    for name in sorted(FOLLOWING & kwargs.keys()):
        remedy = f"set k itself: k:{kwargs['k']}" if name == "k" else "it follows from the other settings"
        raise ValueError(f"objective_kwargs.{name} cannot be set; {remedy}")
    if objective_class.reads_action_sequences:
        kwargs["k"] = config.k
    if base_encoder is not None:
        kwargs["base_encoder"] = base_encoder
    encoder = make_encoder(dataset.observation_space, config.network, **config.network_kwargs)
    try:
        return objective_class(encoder, dataset.action_space, **kwargs)
    except TypeError as error:
        raise ValueError(f"objective_kwargs do not fit {objective}: {error}") from error


class PretrainRun:
    """One pretraining run: its parts, its position, and how both are saved."""

    def __init__(
        self,
        objective: str,
        dataset: TransitionDataset,
        output: Path,
        config: PretrainConfig,
        base: str | None,
        seed: int,
        device: str,
        callback: Callback | None = None,
    ) -> None:
        self.dataset, self.output, self.config, self.seed = dataset, output, config, seed
        self.callback = callback
        self.folder = output.with_suffix(".run")
        self.device = _device(device)
        self.settings: dict[str, Any] = {
            "objective": objective,
            "seed": seed,
            "dataset_hash": dataset.hash,
            **config.as_settings(),
        }
        base_encoder = None
        if base is not None:
            base_file = load_encoder(base)
            base_file.check(dataset.observation_space, dataset.action_space)
            base_encoder = base_file.encoder
            self.settings["base_hash"] = base_file.hash
            self.settings["base_objective"] = base_file.metadata["objective"]
        # Weights are drawn on the CPU, so that they do not depend on the device.
        th.manual_seed(seed)
        module = make_objective(objective, dataset, config, base_encoder)
        # As encoders lie in memory; decoders, too.
        self.module: Objective = module.to(self.device, memory_format=th.channels_last)  # type: ignore[call-overload]
        self._trained = [parameter for parameter in self.module.parameters() if parameter.requires_grad]
        self.optimizer = th.optim.Adam(self._trained, lr=config.learning_rate_at(0))
        self.n_updates = self._saved_at = 0
        self.rows: list[dict[str, float]] = []

    # Position and files.

    def is_finished(self) -> bool:
        """Whether the encoder file is there, made with the same settings.

        :raises ValueError: if it was made with others, or is damaged
        """
        if not self.output.exists():
            return False
        try:
            settings = load_encoder(self.output).metadata["settings"]
        except EncoderFileError as error:
            raise ValueError(f"{error}. To have it written again, remove it first") from error
        _refuse_other_settings(self.output, settings, self.settings)
        return True

    def save(self) -> None:
        """Write a checkpoint, then drop all but the last two."""
        path = self.folder / f"checkpoint-{self.n_updates:09d}.safetensors"
        metadata = {"n_updates": self.n_updates, "settings": self.settings, "rows": self.rows}
        save_training_state(path, self.module, self.optimizer, metadata)
        self._saved_at = self.n_updates
        for old in self._checkpoints()[:-2]:
            old.unlink()

    def restore(self) -> None:
        """Go on from the newest checkpoint, if there is one."""
        checkpoints = self._checkpoints()
        if not checkpoints:
            return
        metadata = load_training_state(checkpoints[-1], self.module, self.optimizer, self.settings)
        self.n_updates, self.rows = metadata["n_updates"], metadata["rows"]
        self._saved_at = self.n_updates

    def drop_checkpoints(self) -> None:
        """Remove what only an unfinished run needs."""
        for checkpoint in self._checkpoints():
            checkpoint.unlink()

    def _checkpoints(self) -> list[Path]:
        return sorted(self.folder.glob("checkpoint-*.safetensors"))

    def finish(self) -> None:
        """Write the card and, last, the encoder file; its presence says that the run is over."""
        dataset = self.dataset
        starts = dataset.valid_starts()
        reference = dataset.frames(starts[:: max(1, len(starts) // N_REFERENCE)][:N_REFERENCE])
        encoder = self.module.encoder.cpu()
        encoder.standardize(self._sample_observations())
        card = self._card(n_parameters=sum(p.numel() for p in encoder.parameters()))
        text = json.dumps(card, indent=1, sort_keys=True) + "\n"
        write_atomic(self.output.with_suffix(".json"), lambda file: file.write(text.encode()))
        save_encoder(
            self.output,
            encoder,
            observation_space=dataset.observation_space,
            action_space=dataset.action_space,
            env_id=dataset.env_id,
            env_kwargs=dataset.env_kwargs,
            objective=self.settings["objective"],
            settings=self.settings,
            dataset_hash=dataset.hash,
            reference_observations=reference,
        )
        self.drop_checkpoints()
        self._warn_at_chance()

    def _warn_at_chance(self) -> None:
        """An encoder that has learned nothing looks like any other file."""
        name = "eval/accuracy" if self.config.eval_fraction else "train/accuracy"
        accuracy = self.rows[-1].get(name) if self.rows else None
        batch_size, n = self.config.batch_size, self.config.batch_size * N_EVAL_BATCHES
        if self.config.eval_fraction:
            n_eval = len(self.dataset.pairs(self.config.k, "eval")[0])
            batch_size, n = min(batch_size, n_eval), min(n, n_eval)
        chance = self.module.chance_accuracy(batch_size)
        if accuracy is None or chance is None:
            return
        if accuracy <= chance + max(0.005, 3 * math.sqrt(chance * (1 - chance) / n)):
            warnings.warn(
                f"{self.output}: {name} ended at {accuracy:.3g}, no better than guessing ({chance:.3g}), so the "
                "encoder has learned nothing of its objective; try more updates, another seed, a smaller l1_penalty "
                "or, for ssi and acro, a delta_scale above 1",
                stacklevel=2,
            )

    def _sample_observations(self) -> th.Tensor:
        """Observations from all over the dataset, as floats on the CPU."""
        starts = self.dataset.valid_starts(split="train")
        frames = self.dataset.frames(starts[:: max(1, len(starts) // N_STANDARDIZE)][:N_STANDARDIZE])
        observations = preprocess_obs(th.as_tensor(frames), self.dataset.observation_space)
        assert isinstance(observations, th.Tensor)
        return observations

    def _card(self, n_parameters: int) -> dict[str, Any]:
        """What a reader wants to know of an encoder; free of times and paths, so that equal runs write equal cards."""
        dataset = self.dataset
        return {
            "settings": self.settings,
            "commands": reproducing_commands(self.settings, self.config, dataset.meta),
            "dataset": {
                key: dataset.meta[key] for key in (HASH_KEY, "env_id", "env_kwargs", CONTENT_HASH_KEY, "n_transitions")
            },
            "features_dim": self.module.encoder.features_dim,
            "n_parameters": n_parameters,
            "metrics": self.rows[-1] if self.rows else {},
            # A callback may have been there for some of the rows only.
            "curves": {
                key: [row.get(key) for row in self.rows] for key in dict.fromkeys(k for r in self.rows for k in r)
            },
            "versions": {"python": platform.python_version(), "torch": th.__version__.split("+")[0]},
            "device": self.device.type,
        }

    # Training.

    def train(self, progress_bar: bool, verbose: int) -> None:
        """Train to the end and write the results.

        :param progress_bar: show one
        :param verbose: 1 prints the log's rows
        """
        th.manual_seed(self.seed)
        self.restore()
        logger = self._logger(verbose)
        sums: dict[str, float] = {}
        bar = tqdm(
            initial=self.n_updates,
            total=self.config.n_updates,
            desc=f"pretrain {self.settings['objective']} {self.dataset.env_id}",
            unit="update",
            disable=not progress_bar,
            mininterval=0.5,
        )
        try:
            for batch in self._batches():
                terms = self._update(batch)
                for name, value in terms.items():
                    sums[name] = sums.get(name, 0.0) + float(value)
                bar.update()
                if self.n_updates % self.config.log_interval and self.n_updates < self.config.n_updates:
                    continue
                self._log(logger, sums)
                sums = {}
                # A checkpoint falls on a row of the log, so that no half-filled sums need saving.
                if self.n_updates - self._saved_at >= self.config.checkpoint_interval:
                    self.save()
        finally:
            bar.close()
            logger.close()
        self.finish()

    def _update(self, batch: TensorBatch) -> dict[str, th.Tensor]:
        """One optimizer step; refuses to go on with numbers that are not finite."""
        self.module.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate_at(self.n_updates)
        loss, terms = self.module.loss(batch)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        gradients = [parameter.grad for parameter in self._trained if parameter.grad is not None]
        self._require_finite({"loss": loss, **terms, "gradient norm": th.nn.utils.get_total_norm(gradients)})
        self.optimizer.step()
        self.module.after_step()
        self._require_finite({"norm of the weights": th.nn.utils.get_total_norm(self._trained)})
        self.n_updates += 1
        return {"loss": loss.detach(), **terms}

    def _require_finite(self, values: dict[str, th.Tensor]) -> None:
        for name, value in values.items():
            if not bool(th.isfinite(value)):
                raise FloatingPointError(
                    f"{name} is {float(value.detach())} at update {self.n_updates}; the checkpoints before it stay in "
                    f"{self.folder}; try a smaller learning_rate and another output"
                )

    def _batches(self) -> Iterator[TensorBatch]:
        """The batches from the present position to the end; a position is (epoch, batch within it)."""
        config = self.config
        per_epoch = len(self.dataset.pairs(config.k, "train")[0]) // config.batch_size
        while self.n_updates < config.n_updates:
            epoch, start = divmod(self.n_updates, per_epoch)
            for batch in self._pass(config.batch_size, "train", epoch, start):
                yield self._to_tensors(batch)
                if self.n_updates >= config.n_updates:
                    return

    def _pass(self, batch_size: int, split: Split, epoch: int = 0, start: int = 0) -> Iterator[TransitionBatch[Any]]:
        sequences = self.module.reads_action_sequences
        # What is evaluated on is the same for all lengths of runs.
        k, chunk_length = self.config.k, self.config.chunk_length if split == "train" else 1
        return self.dataset.batches(
            batch_size, k, self.seed, epoch, start, split=split, sequences=sequences, chunk_length=chunk_length
        )

    def _to_tensors(self, batch: TransitionBatch[Any]) -> TensorBatch:
        """Through SB3's own preprocessing, so that pretraining sees the numbers that RL will see."""
        space = self.dataset.observation_space
        # Bytes are put in channels-last order before they become floats, four times as large.
        frames = th.as_tensor(batch.frames).contiguous(memory_format=th.channels_last).to(self.device)
        observations = preprocess_obs(frames, space)
        assert isinstance(observations, th.Tensor)
        obs_index, next_obs_index = (
            index if isinstance(index, slice) else th.as_tensor(index).to(self.device)
            for index in (batch.obs_index, batch.next_obs_index)
        )
        return TensorBatch(observations, th.as_tensor(batch.actions).to(self.device), obs_index, next_obs_index)

    def _log(self, logger: Logger, sums: dict[str, float]) -> None:
        n = self.n_updates - (int(self.rows[-1]["n_updates"]) if self.rows else 0)
        row = {f"train/{name}": value / n for name, value in sums.items()}
        row |= {f"eval/{name}": value for name, value in self._evaluate().items()}
        row |= self._called_back()
        self.rows.append({"n_updates": self.n_updates, **row})
        for name, value in row.items():
            logger.record(name, value)
        logger.record("train/n_updates", self.n_updates)
        logger.dump(self.n_updates)

    def _evaluate(self) -> dict[str, float]:
        """Mean terms over held-out batches; the random state is left as it was."""
        if not self.config.eval_fraction:
            return {}
        self.module.eval()
        means: dict[str, float] = {}
        n_eval = len(self.dataset.pairs(self.config.k, "eval")[0])
        batches = self._pass(min(self.config.batch_size, n_eval), "eval")
        with th.no_grad(), th.random.fork_rng(devices=[]):
            rows = [self.module.loss(self._to_tensors(b))[1] for b in itertools.islice(batches, N_EVAL_BATCHES)]
        for name in rows[0] if rows else ():
            means[name] = sum(float(row[name]) for row in rows) / len(rows)
        return means

    def _called_back(self) -> dict[str, float]:
        if self.callback is None:
            return {}
        self.module.eval()
        # Whatever it draws, training goes on as without it.
        with th.no_grad(), th.random.fork_rng(devices=[]):
            return {name: float(value) for name, value in self.callback(self.module.encoder).items()}

    def _logger(self, verbose: int) -> Logger:
        """SB3's logger, with the rows of an interrupted run written again so that the table is whole."""
        formats = ["csv", "tensorboard"] + (["stdout"] if verbose else [])
        logger = configure(str(self.folder), formats)
        for output in logger.output_formats:
            if isinstance(output, CSVOutputFormat):
                for row in self.rows:
                    values = {"train/n_updates": row["n_updates"], **row}
                    del values["n_updates"]
                    output.write(dict(sorted(values.items())), dict.fromkeys(values, ()))
        return logger


def _device(name: str) -> th.device:
    """As in Stable-Baselines3, except that a device that is not there is an error instead of the CPU."""
    try:
        device = get_device(name)
        there = name == "auto" or device.type == th.device(name).type
    except RuntimeError as error:
        raise ValueError(f"unknown device {name!r}: {error}") from error
    if not there:
        raise ValueError(f"device {name!r} is not available to this PyTorch; give --device auto or cpu")
    return device


def _refuse_other_settings(path: Path, there: dict[str, Any], here: dict[str, Any]) -> None:
    # Through JSON, since that is how the file's settings came back (tuples, for one, became lists).
    here = json.loads(json.dumps(here))
    keys = sorted(set(there) | set(here))
    differences = [f"{k}: {there.get(k)!r} there, {here.get(k)!r} here" for k in keys if there.get(k) != here.get(k)]
    if differences:
        raise ValueError(
            f"{path} belongs to another run ({'; '.join(differences)}); choose another output or remove it"
        )
