"""Pretrain an encoder on a dataset: the only training loop, and its command.

``python -m sb3_abisim.pretrain --objective abisim --env Nav2D-v0 --data DIR -o FILE``

A run is a function of its settings and the data. While it lasts, ``<FILE without ending>.run/`` holds its checkpoints
and logs; the same command goes on from the last checkpoint and ends in the same bytes as an uninterrupted run (on the
same machine type, package versions, device type and thread count).
"""

import argparse
import dataclasses
import itertools
import json
import platform
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from sb3_abisim.pretrain_config import PretrainConfig, load_config

if TYPE_CHECKING:
    import torch as th
    from stable_baselines3.common.logger import Logger

    from sb3_abisim.dataset import TransitionBatch, TransitionDataset
    from sb3_abisim.objectives import Objective, TensorBatch

OBJECTIVE_NAMES = ("ssi", "abisim")
N_GOLDEN = 8
N_HOLDOUT_BATCHES = 8


def pretrain(
    objective: str,
    data: str | Path,
    output: str | Path,
    config: PretrainConfig | None = None,
    base: str | None = None,
    seed: int = 0,
    device: str = "auto",
    progress_bar: bool = True,
    verbose: int = 1,
) -> Path:
    """Train an encoder and write its file and card; go on where an interrupted call with the same arguments stopped.

    :param objective: "ssi" or "abisim"
    :param data: folder written by :mod:`sb3_abisim.collect`
    :param output: the encoder file, ending in ``.safetensors``; the card is ``.json`` beside it
    :param config: settings; None takes ours for the dataset's environment
    :param base: for "abisim", the base encoder's file or name; None pretrains SSI on the same data first, into
        ``<output without ending>.base.safetensors``
    :param seed: of weights and batches
    :param device: "auto", "cpu", "cuda", ...
    :param progress_bar: show one
    :param verbose: 1 prints the log's rows
    :return: the encoder file
    :raises ValueError: if the output belongs to other settings, or anything does not fit together
    :raises FloatingPointError: if a loss, a gradient or a weight is not finite; the last checkpoint stays
    """
    from sb3_abisim.atomic import folder_lock
    from sb3_abisim.dataset import TransitionDataset

    if objective not in OBJECTIVE_NAMES:
        raise ValueError(f"unknown objective {objective!r}; known are {', '.join(OBJECTIVE_NAMES)}")
    output = Path(output)
    if output.suffix != ".safetensors":
        raise ValueError(f"the output must end in .safetensors, got {output}")
    env_id = read_env_id(Path(data))
    config = config or load_config(objective, env_id)
    dataset = TransitionDataset(data, holdout=config.holdout)
    if objective == "abisim" and base is None:
        base = str(output.with_name(f"{output.stem}.base.safetensors"))
        pretrain("ssi", data, base, seed=seed, device=device, progress_bar=progress_bar, verbose=verbose)
    if objective != "abisim" and base is not None:
        raise ValueError(f"a base encoder belongs to 'abisim' alone, got base={base!r} for {objective!r}")
    folder = output.with_suffix(".run")
    folder.mkdir(parents=True, exist_ok=True)
    with folder_lock(folder):
        run = _Run(objective, dataset, output, config, base, seed, device)
        if run.is_finished():
            if verbose:
                print(f"{output} is finished already; nothing to do")
            return output
        run.train(progress_bar, verbose)
    return output


class _Run:
    """One pretraining run: its parts, its position, and how both are saved."""

    def __init__(
        self,
        objective: str,
        dataset: "TransitionDataset",
        output: Path,
        config: PretrainConfig,
        base: str | None,
        seed: int,
        device: str,
    ) -> None:
        import torch as th
        from stable_baselines3.common.utils import get_device

        from sb3_abisim.checkpoint import load_encoder
        from sb3_abisim.networks import make_encoder
        from sb3_abisim.objectives import OBJECTIVES

        self.dataset, self.output, self.config, self.seed = dataset, output, config, seed
        self.folder = output.with_suffix(".run")
        self.device = get_device(device)
        objective_kwargs = dict(config.objective_kwargs)
        self.settings: dict[str, Any] = {
            "objective": objective,
            "seed": seed,
            "dataset_digest": dataset.digest,
            **dataclasses.asdict(config),
        }
        if base is not None:
            base_file = load_encoder(base)
            base_file.check(dataset.observation_space, dataset.action_space)
            objective_kwargs["base_encoder"] = base_file.encoder
            self.settings["base_digest"] = base_file.digest
            self.settings["base_objective"] = base_file.contract["objective"]
        # Weights are drawn on the CPU, so that they do not depend on the device.
        th.manual_seed(seed)
        encoder = make_encoder(dataset.observation_space, config.network, **config.network_kwargs)
        try:
            module = OBJECTIVES[objective](encoder, dataset.action_space, **objective_kwargs)
        except TypeError as error:
            raise ValueError(f"objective_kwargs do not fit {objective}: {error}") from error
        # Channels last is the layout in which small convolutions are fastest on CPUs; the numbers are the same.
        self.module: Objective = module.to(self.device, memory_format=th.channels_last)  # type: ignore[call-overload]
        trained = [parameter for parameter in self.module.parameters() if parameter.requires_grad]
        self.optimizer = th.optim.Adam(trained, lr=config.learning_rate_at(0))
        self.n_updates = 0
        self.rows: list[dict[str, float]] = []

    # Position and files.

    def is_finished(self) -> bool:
        """Whether the encoder file is there, made with the same settings.

        :raises ValueError: if it was made with others
        """
        from sb3_abisim.checkpoint import load_encoder

        if not self.output.exists():
            return False
        _refuse_other_settings(self.output, load_encoder(str(self.output)).contract["settings"], self.settings)
        return True

    def save(self) -> None:
        """Write a checkpoint, then drop all but the last two."""
        from sb3_abisim.training_state import save_training_state

        path = self.folder / f"checkpoint-{self.n_updates:09d}.safetensors"
        metadata = {"n_updates": self.n_updates, "settings": self.settings, "rows": self.rows}
        save_training_state(path, self.module, self.optimizer, metadata)
        for old in self._checkpoints()[:-2]:
            old.unlink()

    def restore(self) -> None:
        """Go on from the newest checkpoint, if there is one."""
        from sb3_abisim.training_state import load_training_state

        checkpoints = self._checkpoints()
        if not checkpoints:
            return
        metadata = load_training_state(checkpoints[-1], self.module, self.optimizer, self.settings)
        self.n_updates, self.rows = metadata["n_updates"], metadata["rows"]

    def _checkpoints(self) -> list[Path]:
        return sorted(self.folder.glob("checkpoint-*.safetensors"))

    def finish(self) -> None:
        """Write the card and, last, the encoder file; its presence says that the run is over."""
        from sb3_abisim.atomic import write_atomic
        from sb3_abisim.checkpoint import save_encoder

        dataset = self.dataset
        starts = dataset.valid_starts(self.config.k)
        golden = dataset.frames(starts[:: max(1, len(starts) // N_GOLDEN)][:N_GOLDEN])
        encoder = self.module.encoder.cpu()
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
            dataset_digest=dataset.digest,
            golden_observations=golden,
        )
        for checkpoint in self._checkpoints():
            checkpoint.unlink()

    def _card(self, n_parameters: int) -> dict[str, Any]:
        """What a reader wants to know of an encoder; free of times and paths, so that equal runs write equal cards."""
        import torch as th

        dataset = self.dataset
        changed = {k: v for k, v in dataclasses.asdict(self.config).items() if v != getattr(PretrainConfig(), k)}
        collect = f"python -m sb3_abisim.collect --env {dataset.env_id} -n {dataset.n_transitions} -o DATA"
        collect += f" --seed {dataset.meta['seed']} --n-envs {dataset.meta['n_envs']}"
        if dataset.env_kwargs:
            collect += f" --env-kwargs {shlex.join(f'{k}:{v!r}' for k, v in dataset.env_kwargs.items())}"
        command = f"python -m sb3_abisim.pretrain --objective {self.settings['objective']} --env {dataset.env_id}"
        return {
            "settings": self.settings,
            "commands": [
                # Data that was imported has no command that would collect it again.
                *([collect] if dataset.meta["n_envs"] is not None else []),
                f"{command} --seed {self.seed} --data DATA -o FILE"
                + "".join(f" -params {shlex.quote(f'{k}:{json.dumps(v)}')}" for k, v in changed.items()),
            ],
            "dataset": {"digest": dataset.digest, "env_id": dataset.env_id, "n_transitions": dataset.n_transitions},
            "features_dim": self.module.encoder.features_dim,
            "n_parameters": n_parameters,
            "metrics": self.rows[-1] if self.rows else {},
            "curves": {key: [row[key] for row in self.rows] for key in (self.rows[0] if self.rows else {})},
            "versions": {"python": platform.python_version(), "torch": th.__version__.split("+")[0]},
            "device": self.device.type,
        }

    # Training.

    def train(self, progress_bar: bool, verbose: int) -> None:
        """Train to the end and write the results."""
        import torch as th
        from tqdm import tqdm

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
                if self.n_updates % self.config.log_interval == 0:
                    self._log(logger, sums)
                    sums = {}
                # A checkpoint falls on a row of the log, so that no half-filled sums need saving.
                due = self.n_updates % self.config.checkpoint_interval == 0
                if due and self.n_updates % self.config.log_interval == 0:
                    self.save()
        finally:
            bar.close()
            logger.close()
        self.finish()

    def _update(self, batch: "TensorBatch") -> dict[str, "th.Tensor"]:
        """One optimiser step; refuses to go on with numbers that are not finite."""
        import torch as th

        self.module.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate_at(self.n_updates)
        loss, terms = self.module.loss(batch)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        gradients = [p.grad for group in self.optimizer.param_groups for p in group["params"] if p.grad is not None]
        norm = th.nn.utils.get_total_norm(gradients)
        for name, value in {"loss": loss, **terms, "gradient norm": norm}.items():
            if not bool(th.isfinite(value)):
                raise FloatingPointError(
                    f"{name} is {float(value.detach())} at update {self.n_updates}: the weights were left as they were "
                    f"and checkpoints stay in {self.folder}; try a smaller learning_rate"
                )
        self.optimizer.step()
        self.module.after_step()
        self.n_updates += 1
        return {"loss": loss.detach(), **terms}

    def _batches(self) -> Iterator["TensorBatch"]:
        """The batches from the present position to the end; a position is (epoch, batch within it)."""
        config = self.config
        per_epoch = len(self.dataset.valid_starts(config.k, part="train")) // config.batch_size
        if per_epoch == 0:
            raise ValueError(
                f"the dataset has too few transitions for a batch of {config.batch_size}; "
                "collect more or set a smaller batch_size"
            )
        while self.n_updates < config.n_updates:
            epoch, start = divmod(self.n_updates, per_epoch)
            batches = self.dataset.batches(config.batch_size, config.k, self.seed, epoch, start, part="train")
            for batch in batches:
                yield self._to_tensors(batch)
                if self.n_updates >= config.n_updates:
                    return

    def _to_tensors(self, batch: "TransitionBatch") -> "TensorBatch":
        """Through SB3's own preprocessing, so that pretraining sees the numbers that RL will see."""
        import torch as th
        from stable_baselines3.common.preprocessing import preprocess_obs

        from sb3_abisim.objectives import TensorBatch

        space = self.dataset.observation_space
        # Bytes are put in channels-last order before they become floats, four times as large.
        observations, next_observations = (
            preprocess_obs(th.as_tensor(frames).contiguous(memory_format=th.channels_last).to(self.device), space)
            for frames in (batch.observations, batch.next_observations)
        )
        assert isinstance(observations, th.Tensor) and isinstance(next_observations, th.Tensor)
        return TensorBatch(observations, th.as_tensor(batch.actions).to(self.device), next_observations)

    def _log(self, logger: "Logger", sums: dict[str, float]) -> None:
        row = {f"train/{name}": value / self.config.log_interval for name, value in sums.items()}
        row |= {f"test/{name}": value for name, value in self._evaluate().items()}
        self.rows.append({"n_updates": self.n_updates, **row})
        for name, value in row.items():
            logger.record(name, value)
        logger.record("time/n_updates", self.n_updates)
        logger.dump(self.n_updates)

    def _evaluate(self) -> dict[str, float]:
        """Mean terms over held-out batches; the random state is left as it was."""
        import torch as th

        if not self.config.holdout:
            return {}
        self.module.eval()
        means: dict[str, float] = {}
        n_test = len(self.dataset.valid_starts(self.config.k, part="test"))
        batch_size = min(self.config.batch_size, n_test)
        batches = self.dataset.batches(batch_size, self.config.k, self.seed, part="test")
        with th.no_grad(), th.random.fork_rng(devices=[]):
            rows = [self.module.loss(self._to_tensors(b))[1] for b in itertools.islice(batches, N_HOLDOUT_BATCHES)]
        for name in rows[0] if rows else ():
            means[name] = sum(float(row[name]) for row in rows) / len(rows)
        return means

    def _logger(self, verbose: int) -> "Logger":
        """SB3's logger, with the rows of an interrupted run written again so that the table is whole."""
        from stable_baselines3.common.logger import CSVOutputFormat, configure

        formats = ["csv", "tensorboard"] + (["stdout"] if verbose else [])
        logger = configure(str(self.folder), formats)
        for output in logger.output_formats:
            if isinstance(output, CSVOutputFormat):
                for row in self.rows:
                    values = {"time/n_updates": row["n_updates"], **row}
                    del values["n_updates"]
                    output.write(dict(sorted(values.items())), dict.fromkeys(values, ()))
        return logger


def read_env_id(data: Path) -> str:
    """The environment id of a finished dataset, without opening the rest of it.

    :raises ValueError: if the folder holds none
    """
    meta_path = data / "meta.json"
    if not meta_path.is_file():
        raise ValueError(f"{data} holds no finished dataset (no meta.json); run sb3_abisim.collect first")
    return str(json.loads(meta_path.read_text())["env_id"])


def _refuse_other_settings(path: Path, there: dict[str, Any], here: dict[str, Any]) -> None:
    # Through JSON, since that is how the file's settings came back (tuples, for one, became lists).
    here = json.loads(json.dumps(here))
    keys = sorted(set(there) | set(here))
    differences = [f"{k}: {there.get(k)!r} there, {here.get(k)!r} here" for k in keys if there.get(k) != here.get(k)]
    if differences:
        raise ValueError(
            f"{path} belongs to another run ({'; '.join(differences)}); choose another output or remove it"
        )


def _parse_overrides(words: list[str]) -> dict[str, Any]:
    overrides = {}
    for word in words:
        name, colon, value = word.partition(":")
        if not colon:
            raise ValueError(f"settings are given as name:value, got {word!r}")
        overrides[name] = yaml.safe_load(value)
    return overrides


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m sb3_abisim.pretrain", description="Pretrain an encoder on a dataset.")
    parser.add_argument("--objective", required=True, choices=OBJECTIVE_NAMES)
    parser.add_argument("--env", required=True, metavar="ID", help="environment id: key of the settings")
    parser.add_argument("--data", required=True, metavar="DIR", help="folder written by sb3_abisim.collect")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="encoder file (.safetensors)")
    parser.add_argument("--base", help="base encoder for abisim: file or name (default: pretrain SSI first)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("-params", "--params", nargs="+", default=[], metavar="NAME:VALUE", help="replace settings")
    parser.add_argument("--verbose", type=int, default=1, choices=(0, 1))
    return parser


def main(argv: list[str] | None = None) -> None:
    """The command; see ``--help``."""
    parser = _parser()
    args = parser.parse_args(argv)
    data = Path(args.data)
    try:
        config = load_config(args.objective, args.env, _parse_overrides(args.params))
        env_id = read_env_id(data)
        if env_id != args.env:
            raise ValueError(f"{data} was collected in {env_id}, not in {args.env}")
    except (ValueError, yaml.YAMLError) as error:
        parser.error(str(error))
    try:
        pretrain(args.objective, data, args.output, config, args.base, args.seed, args.device, verbose=args.verbose)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    except FloatingPointError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
