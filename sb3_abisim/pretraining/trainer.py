"""The training loop of pretraining."""

import contextlib
import itertools
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.logger import CSVOutputFormat, Logger, configure
from stable_baselines3.common.utils import get_device
from tqdm import tqdm

from sb3_abisim.common.files import naming
from sb3_abisim.common.transitions import TransitionBatch
from sb3_abisim.data.dataset import Split, TransitionDataset
from sb3_abisim.networks.base import Encoder, make_encoder, preprocess, set_memory_format
from sb3_abisim.networks.encoder_file import EncoderFileError, load_encoder, save_encoder
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.pretraining.ahead import gains_from_ahead, make_ahead
from sb3_abisim.pretraining.card import advice, make_card, warn_at_chance, write_card
from sb3_abisim.pretraining.checkpoint import (
    Checkpoints,
    asks_for_more_updates,
    rate_is_constant,
    refuse_other_settings,
)
from sb3_abisim.pretraining.config import FOLLOWING, N_EVAL_BATCHES, PretrainConfig
from sb3_abisim.pretraining.image_networks import in_bfloat16, require_bfloat16, wrap_forward
from sb3_abisim.pretraining.ranks import Ranks
from sb3_abisim.pretraining.track import Tracking
from sb3_abisim.registry import get_objective

# From the encoder in evaluation mode to further numbers for a row of the log.
Callback = Callable[[Encoder], Mapping[str, float]]

N_REFERENCE = 8
N_STANDARDIZE = 4096


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
    """One pretraining run: its parts, and the loop that trains them.

    :param objective: name of a method that has one
    :param dataset: to train on
    :param output: the encoder file; checkpoints and logs go to the folder ``<output without ending>.run``
    :param config: the settings
    :param base: file or name of the base encoder, for an objective that takes one
    :param seed: of weights and batches
    :param device: as in Stable-Baselines3
    :param callback: see :func:`~sb3_abisim.pretraining.pretrain.pretrain`
    :param keep_checkpoint: see :func:`~sb3_abisim.pretraining.pretrain.pretrain`
    :param track: see :func:`~sb3_abisim.pretraining.pretrain.pretrain`
    :param ranks: the processes of the run, None for this one alone; only the first of them writes
    """

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
        keep_checkpoint: bool = False,
        track: Tracking | None = None,
        ranks: Ranks | None = None,
    ) -> None:
        self.keep_checkpoint, self.track = keep_checkpoint, track
        self.ranks = ranks or Ranks()
        self.dataset, self.output, self.config, self.seed = dataset, output, config, seed
        self.callback = callback
        self.folder = output.with_suffix(".run")
        self.device = _device(device)
        # Evaluated is what RL gets, in float32.
        self._precision = [in_bfloat16] if config.precision == "bf16" else []
        if self._precision:
            require_bfloat16(self.device)
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
        # Weights are sampled on the CPU, so that they do not depend on the device.
        th.manual_seed(seed)
        self.module = make_objective(objective, dataset, config, base_encoder).to(self.device)
        # As encoders lie in memory; decoders, too.
        set_memory_format(self.module, th.channels_last)
        self._trained = [parameter for parameter in self.module.parameters() if parameter.requires_grad]
        self.optimizer = th.optim.Adam(self._trained, lr=config.learning_rate_at(0))
        self.checkpoints = Checkpoints(self.folder, self.settings)
        self.n_updates = self._saved_at = 0
        self.rows: list[dict[str, float]] = []

    def is_finished(self) -> bool:
        """Whether the encoder file is there, made with the same settings; one that can be given more updates is not.

        :raises ValueError: if it was made with others, cannot be given more updates, or is damaged
        """
        if not self.output.exists():
            return False
        try:
            settings = load_encoder(self.output).metadata["settings"]
        except EncoderFileError as error:
            raise ValueError(f"{error}. To have it written again, remove it first") from error
        if not asks_for_more_updates(settings, self.settings):
            refuse_other_settings(self.output, settings, self.settings)
            return True
        reason = None
        if not rate_is_constant(self.settings):
            reason = f"at whose end its learning_rate {self.settings['learning_rate']} has fallen to 0"
        elif not self.checkpoints.exist():
            reason = f"and no checkpoint was kept in {self.folder}"
        if reason is not None:
            raise ValueError(
                f"{self.output} has had its n_updates of {settings['n_updates']}, {reason}, so there is no going on to "
                f"{self.settings['n_updates']}; choose another output (--keep-checkpoint with a constant "
                "learning_rate lets a run go on later)"
            )
        return False

    def clean_up(self) -> None:
        """Remove the checkpoints of a finished run, except one that is to be kept."""
        self.checkpoints.remove(keep=int(self.keep_checkpoint))

    def train(self, progress_bar: bool, verbose: int) -> None:
        """Train to the end, from the newest checkpoint if there is one, and write the results.

        :param progress_bar: show one
        :param verbose: 1 prints the log's rows
        """
        th.manual_seed(self.seed)
        self.n_updates, self.rows = self.checkpoints.restore(self.module, self.optimizer)
        self.ranks.require_equal(self.n_updates)
        frames = th.as_tensor(self._some_frames(N_REFERENCE)).to(self.device)
        self.ranks.require_independent_rows(self.module, preprocess(frames, self.dataset.observation_space))
        if not self.n_updates:
            frames = th.as_tensor(self._some_frames(N_STANDARDIZE, "train")).to(self.device)
            self.module.prepare(preprocess(frames, self.dataset.observation_space))
        self._saved_at = self.n_updates
        with naming(self.folder):
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
            batches = self._batches()
            if gains_from_ahead(self.device, self.ranks.size):
                batches = make_ahead(batches)
            with contextlib.closing(batches):
                for batch in batches:
                    terms = self._update(batch)
                    for name, value in terms.items():
                        sums[name] = sums.get(name, 0.0) + float(value)
                    bar.update()
                    if self.n_updates % self.config.log_interval and self.n_updates < self.config.n_updates:
                        continue
                    with naming(self.folder):
                        self._log(logger, sums)
                    sums = {}
                    # A checkpoint falls on a row of the log, so that no half-filled sums need saving.
                    if self.n_updates - self._saved_at >= self.config.checkpoint_interval:
                        self.save()
        finally:
            bar.close()
            with naming(self.folder):
                logger.close()
        if self.ranks.is_first:
            self.finish()
        # What comes next may need the file.
        self.ranks.wait()

    def save(self) -> None:
        """Write a checkpoint."""
        if self.ranks.is_first:
            self.checkpoints.save(self.module, self.optimizer, self.n_updates, self.rows)
        self._saved_at = self.n_updates

    def finish(self) -> None:
        """Write the model card and, last, the encoder file; its presence says that the run is over."""
        if self.keep_checkpoint and self._saved_at < self.n_updates:
            self.save()
        dataset, encoder = self.dataset, self.module.encoder.cpu().eval()
        try:
            encoder.standardize(preprocess(self._some_frames(N_STANDARDIZE, "train"), dataset.observation_space))
        except ValueError as error:
            words = advice(self.module, dataset.preprocessing)
            raise ValueError(f"{error}; name another output or remove {self.folder}, and {words}") from error
        card = make_card(self.settings, self.config, dataset, self.module, self.rows, self.device.type, self.ranks.size)
        write_card(self.output.with_suffix(".json"), card)
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
            reference_observations=self._some_frames(N_REFERENCE),
            # That there was no wrapper is known of what was collected through wrappers, if there were any.
            preprocessing={"env_wrapper": [], **dataset.preprocessing} if "preprocessing" in dataset.meta else None,
        )
        self.clean_up()
        warn_at_chance(self.output, self.module, self.config, self.rows, self._n_eval(), dataset.preprocessing)

    def _some_frames(self, n: int, split: Split | None = None) -> NDArray[np.uint8]:
        """Frames from all over the dataset, n of them unless there are fewer."""
        starts = self.dataset.valid_starts(split=split)
        return self.dataset.frames(starts[:: max(1, len(starts) // n)][:n])

    def _n_eval(self) -> int:
        """Transitions of the eval split."""
        return len(self.dataset.pairs(self.config.k, "eval")[0]) if self.config.eval_fraction else 0

    def _update(self, batch: TensorBatch) -> dict[str, th.Tensor]:
        """One optimizer step; refuses to go on with numbers that are not finite."""
        self.module.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate_at(self.n_updates)
        with wrap_forward(self.module, *self._precision, self.ranks.divide):
            loss, terms = self.module.loss(batch)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.ranks.average_gradients(self._trained)
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

    def _batches(self) -> Generator[TensorBatch, None, None]:
        """The batches from the present position to the end; a position is (epoch, batch within it)."""
        # Asked for ahead of the updates, so it keeps a count of its own.
        config, n = self.config, self.n_updates
        per_epoch = len(self.dataset.pairs(config.k, "train")[0]) // config.batch_size
        while n < config.n_updates:
            epoch, start = divmod(n, per_epoch)
            whole_pass = self._pass(config.batch_size, "train", epoch, start)
            for batch in itertools.islice(whole_pass, config.n_updates - n):
                n += 1
                yield self._to_tensors(batch)

    def _pass(self, batch_size: int, split: Split, epoch: int = 0, start: int = 0) -> Iterator[TransitionBatch[Any]]:
        sequences = self.module.reads_action_sequences
        # What is evaluated on is the same for all lengths of chunks.
        k, chunk_length = self.config.k, self.config.chunk_length if split == "train" else 1
        return self.dataset.batches(
            batch_size, k, self.seed, epoch, start, split=split, sequences=sequences, chunk_length=chunk_length
        )

    def _to_tensors(self, batch: TransitionBatch[Any]) -> TensorBatch:
        """Through SB3's own preprocessing, so that pretraining sees the numbers that RL will see."""
        # Bytes are put in channels-last order before they become floats, four times as large.
        frames = th.as_tensor(batch.frames).contiguous(memory_format=th.channels_last).to(self.device)
        obs_index, next_obs_index = (
            index if isinstance(index, slice) else th.as_tensor(index).to(self.device)
            for index in (batch.obs_index, batch.next_obs_index)
        )
        actions = th.as_tensor(batch.actions).to(self.device)
        return TensorBatch(preprocess(frames, self.dataset.observation_space), actions, obs_index, next_obs_index)

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
        """Mean terms over batches of the eval split; the random state is left as it was."""
        if not self.config.eval_fraction:
            return {}
        self.module.eval()
        means: dict[str, float] = {}
        batches = self._pass(min(self.config.batch_size, self._n_eval()), "eval")
        with th.no_grad(), th.random.fork_rng(devices=[]), wrap_forward(self.module, self.ranks.divide):
            rows = [self.module.loss(self._to_tensors(b))[1] for b in itertools.islice(batches, N_EVAL_BATCHES)]
        for name in rows[0] if rows else ():
            means[name] = sum(float(row[name]) for row in rows) / len(rows)
        return means

    def _called_back(self) -> dict[str, float]:
        if self.callback is None or not self.ranks.is_first:
            return {}
        self.module.eval()
        # Whatever it samples, training goes on as without it.
        with th.no_grad(), th.random.fork_rng(devices=[]):
            return {name: float(value) for name, value in self.callback(self.module.encoder).items()}

    def _logger(self, verbose: int) -> Logger:
        """SB3's logger, with the rows of an interrupted run written again so that the table is whole."""
        if not self.ranks.is_first:
            return Logger(None, [])
        # First, since it may be refused.
        tracked = [self.track.start(self.folder, self.dataset.env_id, self.settings)] if self.track else []
        formats = ["csv", "tensorboard"] + (["stdout"] if verbose else [])
        logger = configure(str(self.folder), formats)
        for output in logger.output_formats:
            if isinstance(output, CSVOutputFormat):
                for row in self.rows:
                    values = {"train/n_updates": row["n_updates"], **row}
                    del values["n_updates"]
                    output.write(dict(sorted(values.items())), dict.fromkeys(values, ()))
        logger.output_formats += tracked
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
