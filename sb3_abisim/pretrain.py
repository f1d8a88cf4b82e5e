"""Pretrain an encoder on a dataset: the only training loop, and its command.

``python -m sb3_abisim.pretrain --objective abisim --env Nav2D-v0 --data DIR -o FILE``

A run is a function of its settings and the data. While it lasts, ``<FILE without ending>.run/`` holds its checkpoints
and logs; the same command goes on from the last checkpoint and ends in the same bytes as an uninterrupted run (on the
same machine type, package versions, device type and thread count).
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from sb3_abisim.pretrain_config import PretrainConfig, load_config

if TYPE_CHECKING:
    from sb3_abisim.dataset import TransitionDataset
    from sb3_abisim.pretrain_run import Callback

OBJECTIVE_NAMES = ("ssi", "acro", "beta_vae", "curl", "info_nce", "abisim")


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
    callback: "Callback | None" = None,
) -> Path:
    """Train an encoder and write its file and card; go on where an interrupted call with the same arguments stopped.

    :param objective: a name in :data:`OBJECTIVE_NAMES`
    :param data: folder written by :mod:`sb3_abisim.collect`
    :param output: the encoder file, ending in ``.safetensors``; the card is ``.json`` beside it
    :param config: settings; None takes ours for the dataset's environment
    :param base: for "abisim", the base encoder's file or name; None pretrains SSI on the same data first, into
        ``<output without ending>.base.safetensors``
    :param seed: of weights and batches
    :param device: "auto", "cpu", "cuda", ...
    :param progress_bar: show one
    :param verbose: 1 prints the log's rows
    :param callback: takes the encoder in evaluation mode at every row of the log and returns further numbers for it, by
        name; the encoder file does not depend on it
    :return: the encoder file
    :raises ValueError: if the output belongs to other settings, or anything does not fit together
    :raises FloatingPointError: if a loss, a gradient or a weight is not finite; the last checkpoint stays
    """
    from sb3_abisim.allocator import keep_freed_memory
    from sb3_abisim.atomic import folder_lock, remove_temporaries
    from sb3_abisim.dataset import TransitionDataset
    from sb3_abisim.networks import make_encoder
    from sb3_abisim.pretrain_run import PretrainRun, make_objective

    if objective not in OBJECTIVE_NAMES:
        raise ValueError(f"unknown objective {objective!r}; known are {', '.join(OBJECTIVE_NAMES)}")
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed}")
    keep_freed_memory()
    output = Path(output)
    if output.suffix != ".safetensors":
        raise ValueError(f"the output must end in .safetensors, got {output}")
    _check_place_of_card(output.with_suffix(".json"))
    env_id = read_env_id(Path(data))
    config = config or load_config(objective, env_id)
    dataset = TransitionDataset(data, holdout=config.holdout)
    _check_parts(dataset, config)
    if objective == "abisim" and base is None:
        base = str(output.with_name(f"{output.stem}.base.safetensors"))
        # Mistakes in its own settings are found before the base is trained.
        stand_in = make_encoder(dataset.observation_space, config.network, **config.network_kwargs)
        make_objective(objective, dataset, config, stand_in)
        # Of the same network and data, whatever this one is asked to have.
        base_config = load_config("ssi", env_id)
        base_config = dataclasses.replace(
            base_config, network=config.network, network_kwargs=config.network_kwargs, holdout=config.holdout,
            batch_size=min(base_config.batch_size, config.batch_size),
        )  # fmt: skip
        pretrain("ssi", data, base, base_config, None, seed, device, progress_bar, verbose)
    if objective != "abisim" and base is not None:
        raise ValueError(f"a base encoder belongs to 'abisim' alone, got base={base!r} for {objective!r}")
    folder = output.with_suffix(".run")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with folder_lock(folder):
            remove_temporaries(folder)
            run = PretrainRun(objective, dataset, output, config, base, seed, device, callback)
            if run.is_finished():
                run.drop_checkpoints()
                if verbose:
                    print(f"{output} is finished already; nothing to do")
                return output
            run.train(progress_bar, verbose)
    finally:
        # What was refused at once leaves no empty folder behind.
        if not any(folder.iterdir()):
            folder.rmdir()
    return output


def _check_parts(dataset: "TransitionDataset", config: PretrainConfig) -> None:
    n = len(dataset.pairs(config.k, "train")[0])
    if n < config.batch_size:
        raise ValueError(
            f"{dataset.path} has {n} transitions to train on, too few for a batch of {config.batch_size}; collect more "
            "or set a smaller batch_size"
        )
    if config.holdout:
        try:
            dataset.pairs(config.k, "test")
        except ValueError as error:
            what = f"no segment held out of {dataset.path} (holdout {config.holdout}) has a transition of k steps"
            raise ValueError(f"{what}; collect more transitions, or set holdout:0") from error


def _check_place_of_card(path: Path) -> None:
    """The card's name follows from the encoder's, and may be that of a file which is somebody's own."""
    if path.exists():
        try:
            is_card = "curves" in json.loads(path.read_bytes())
        except (OSError, ValueError, TypeError):
            is_card = False
        if not is_card:
            raise ValueError(f"the encoder's card would replace {path}, which is none; name another output")


def read_env_id(data: Path) -> str:
    """The environment id of a finished dataset, without opening the rest of it.

    :param data: the dataset's folder
    :raises ValueError: if the folder holds none
    """
    meta_path = data / "meta.json"
    if not meta_path.is_file():
        raise ValueError(f"{data} holds no finished dataset (no meta.json); run sb3_abisim.collect first")
    try:
        return str(json.loads(meta_path.read_bytes())["env_id"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{meta_path} was not written by sb3_abisim.collect ({error!r}); give its folder") from error


def parse_overrides(words: list[str]) -> dict[str, Any]:
    """Read ``name:value`` words as settings for :func:`~sb3_abisim.pretrain_config.load_config`.

    :param words: values in YAML, or numbers such as 1e-4
    :raises ValueError: for a word without a colon
    """
    overrides = {}
    for word in words:
        name, colon, value = word.partition(":")
        if not colon:
            raise ValueError(f"settings are given as name:value, got {word!r}")
        overrides[name] = _number_or_same(yaml.safe_load(value))
    return overrides


def _number_or_same(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _number_or_same(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_number_or_same(part) for part in value]
    # YAML 1.1 takes 1e-4, without a dot, for a text.
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


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
    """The command; see ``--help``.

    :param argv: its words; the program's arguments by default
    """
    parser = _parser()
    args = parser.parse_args(argv)
    data = Path(args.data)
    try:
        config = load_config(args.objective, args.env, parse_overrides(args.params))
        env_id = read_env_id(data)
        if env_id != args.env:
            raise ValueError(f"{data} was collected in {env_id}, not in {args.env}")
    except (ValueError, yaml.YAMLError) as error:
        parser.error(str(error))
    try:
        pretrain(args.objective, data, args.output, config, args.base, args.seed, args.device, verbose=args.verbose)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    except (FloatingPointError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
