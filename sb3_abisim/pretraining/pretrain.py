"""Pretrain an encoder on a dataset: the only training loop, and its command.

``sb3-abisim pretrain --objective abisim --env Nav2D-v0 --data DIR -o FILE``

A run is a function of its settings and the data. While it lasts, ``<FILE without ending>.run/`` holds its checkpoints
and logs; the same command goes on from the last checkpoint and ends in the same bytes as an uninterrupted run (on the
same machine type, package versions, device type and thread count).
"""

import argparse
import contextlib
import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_abisim.common.cli import make_parser, parse_pairs, run
from sb3_abisim.pretraining.config import PRECISIONS, PretrainConfig, load_config
from sb3_abisim.registry import get_method, get_objective

# In front of settings of the base encoder.
_BASE = "base."

if TYPE_CHECKING:
    from sb3_abisim.data.dataset import TransitionDataset
    from sb3_abisim.pretraining.ranks import Ranks
    from sb3_abisim.pretraining.track import Tracking
    from sb3_abisim.pretraining.trainer import Callback


def pretrain(
    objective: str,
    data: str | Path,
    output: str | Path,
    config: PretrainConfig | dict[str, Any] | None = None,
    base: str | None = None,
    seed: int = 0,
    device: str = "auto",
    progress_bar: bool = True,
    verbose: int = 1,
    callback: "Callback | None" = None,
    keep_checkpoint: bool = False,
    track: "Tracking | None" = None,
) -> Path:
    """Train an encoder and write its file and model card; go on where an interrupted call with equal arguments stopped.

    :param objective: name of a method that has one, such as "ssi"
    :param data: a dataset's folder
    :param output: the encoder file, ending in ``.safetensors``; the model card is ``.json`` beside it
    :param config: settings that replace those of ``hyperparams/pretrain/`` for the dataset's environment, such as
        ``{"n_updates": 1000, "objective_kwargs.c": 0.9}``; or all of them. Those that begin with ``base.``, such as
        ``base.n_updates``, are for the base encoder that is pretrained first
    :param base: file or name of a base encoder, for an objective that builds on another method's, as "abisim" does on
        "ssi"; None pretrains it on the same data first, into ``<output without ending>.base.safetensors``
    :param seed: of weights and batches
    :param device: "auto", "cpu", "cuda", ...
    :param progress_bar: show one
    :param verbose: 1 prints the log's rows
    :param callback: takes the encoder in evaluation mode at every row of the log and returns further numbers for it, by
        name; the encoder file does not depend on it
    :param keep_checkpoint: keep the last checkpoint when the run ends. With a constant learning rate, the same call
        with a larger ``n_updates`` then goes on from there, to the bytes of a run that had them from the start
    :param track: shows the log's rows on Weights & Biases, those of a base encoder that is pretrained first in a run of
        their own; the encoder file does not depend on it
    :return: the encoder file
    :raises ValueError: if the output belongs to other settings, or anything does not fit together
    :raises FloatingPointError: if a loss, a gradient or a weight is not finite; the last checkpoint stays
    """
    from sb3_abisim.common.files import check_output
    from sb3_abisim.common.malloc import keep_freed_memory
    from sb3_abisim.pretraining.card import refuse_to_replace
    from sb3_abisim.pretraining.ranks import processes

    get_objective(objective)
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed}")
    keep_freed_memory()
    output = Path(output)
    if output.suffix != ".safetensors":
        raise ValueError(f"the output must end in .safetensors, got {output}")
    if not output.is_file():
        check_output(output)
    refuse_to_replace(output.with_suffix(".json"))
    env_id = read_env_id(Path(data))
    base_settings: dict[str, Any] = {}
    if not isinstance(config, PretrainConfig):
        config, base_settings = _split_base_settings(config or {})
        _check_base_settings(base_settings, objective, base)
        config = load_config(objective, env_id, config)
    with processes(device) as ranks:
        quiet = not ranks.is_first
        _pretrain(
            objective, data, output, config, base, base_settings, seed, device, progress_bar and not quiet,
            0 if quiet else verbose, callback, keep_checkpoint, track, ranks,
        )  # fmt: skip
    return output


def _pretrain(
    objective: str,
    data: str | Path,
    output: Path,
    config: PretrainConfig,
    base: str | None,
    base_settings: dict[str, Any],
    seed: int,
    device: str,
    progress_bar: bool,
    verbose: int,
    callback: "Callback | None",
    keep_checkpoint: bool,
    track: "Tracking | None",
    ranks: "Ranks",
) -> None:
    """:func:`pretrain` in one of the processes."""
    from sb3_abisim.data.dataset import TransitionDataset
    from sb3_abisim.data.image_warning import warn_of_images
    from sb3_abisim.networks.base import make_encoder
    from sb3_abisim.pretraining.trainer import PretrainRun, make_objective

    base_method = get_method(objective).base
    dataset = TransitionDataset(data, eval_fraction=config.eval_fraction)
    _check_parts(dataset, config)
    if ranks.is_first:
        warn_of_images(dataset, stacklevel=3)
    if base_method is not None and base is None:
        base = str(output.with_name(f"{output.stem}.base.safetensors"))
        # Mistakes in the settings of this objective are found before the base is trained.
        base_network_kwargs = get_objective(objective).base_network_kwargs(config.network_kwargs)
        stand_in = make_encoder(dataset.observation_space, config.network, **base_network_kwargs)
        make_objective(objective, dataset, config, stand_in)
        # Of the same network and data, whatever this one is asked to have, and as precise unless asked otherwise.
        base_config = load_config(base_method, dataset.env_id, base_settings)
        batch_size = base_config.batch_size
        base_config = dataclasses.replace(
            base_config,
            network=config.network,
            network_kwargs=base_network_kwargs,
            precision=base_settings.get("precision", config.precision),
            eval_fraction=config.eval_fraction,
            batch_size=batch_size if "batch_size" in base_settings else min(batch_size, config.batch_size),
        )
        pretrain(base_method, data, base, base_config, None, seed, device, progress_bar, verbose, track=track)
    if base_method is None and base is not None:
        raise ValueError(f"{objective!r} builds on no base encoder, got base={base!r}; leave it out")
    folder = output.with_suffix(".run")
    with contextlib.ExitStack() as stack:
        if ranks.is_first:
            stack.enter_context(_held(folder))
        run = PretrainRun(
            objective, dataset, output, config, base, seed, device, callback, keep_checkpoint, track, ranks
        )
        if not run.is_finished():
            run.train(progress_bar, verbose)
        elif ranks.is_first:
            run.clean_up()
            if verbose:
                print(f"{output} is finished already; nothing to do")


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold the folder of a run, made if need be; what was refused at once leaves no empty one behind."""
    from sb3_abisim.common.files import folder_lock, remove_temporaries

    folder.mkdir(parents=True, exist_ok=True)
    try:
        with folder_lock(folder):
            remove_temporaries(folder)
            yield
    finally:
        if not any(folder.iterdir()):
            folder.rmdir()


def _split_base_settings(settings: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Tell the settings of an objective from those of its base encoder.

    :param settings: by name; those of the base begin with ``base.``
    :return: those of the objective, and those of the base without their prefix
    """
    own = {name: value for name, value in settings.items() if not name.startswith(_BASE)}
    return own, {name.removeprefix(_BASE): value for name, value in settings.items() if name.startswith(_BASE)}


def _check_base_settings(settings: dict[str, Any], objective: str, base: str | None) -> None:
    """Refuse settings of a base encoder that would not hold."""
    for name in settings:
        if get_method(objective).base is None:
            raise ValueError(f"{_BASE}{name} is for a base encoder, and {objective!r} builds on none; leave it out")
        if base is not None:
            raise ValueError(
                f"{_BASE}{name} would not hold: the base encoder is there already, {base}; give one of the two"
            )
        if name.partition(".")[0] in ("network", "network_kwargs", "eval_fraction"):
            raise ValueError(
                f"{_BASE}{name} would not hold: the base has the network and the data of what builds on it; "
                f"set {name}, or pretrain the base by itself and give it with --base"
            )


def _check_parts(dataset: "TransitionDataset", config: PretrainConfig) -> None:
    n = len(dataset.pairs(config.k, "train")[0])
    if n < config.batch_size:
        raise ValueError(
            f"{dataset.path} has {n} transitions to train on, too few for a batch of {config.batch_size}; collect more "
            "or set a smaller batch_size"
        )
    if config.eval_fraction:
        try:
            dataset.pairs(config.k, "eval")
        except ValueError as error:
            raise ValueError(
                f"the eval split of {dataset.path} (eval_fraction {config.eval_fraction}) has no transition over k = "
                f"{config.k} steps; collect more transitions, or set eval_fraction:0"
            ) from error


def read_env_id(data: Path) -> str:
    """The environment id of a finished dataset, without opening the rest of it.

    :param data: the dataset's folder
    :raises ValueError: if the folder holds none
    """
    meta_path = data / "meta.json"
    if not meta_path.is_file():
        raise ValueError(f"{data} holds no finished dataset (no meta.json); make one with sb3-abisim collect")
    try:
        return str(json.loads(meta_path.read_bytes())["env_id"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{meta_path} is not that of a dataset ({error!r}); name a folder of sb3-abisim collect"
        ) from error


# The built-in ones by hand: to ask the registry would import PyTorch for --help.
OBJECTIVE_HELP = (
    "what the encoder is trained by: abisim (action-bisimulation), ssi, acro, info_nce (they predict actions), "
    "goal_progress (values of goals), curl, beta_vae (observations alone), or one that --packages registers"
)


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its arguments; None for those of the process
    """
    parser = make_parser(
        "pretrain",
        "Pretrain an encoder on a dataset. Killed at any moment, the same command goes on from its last checkpoint.",
        "pretrain --objective abisim --data data/pointmaze -o my/abisim.safetensors",
    )
    parser.add_argument("--objective", required=True, metavar="METHOD", help=OBJECTIVE_HELP)
    parser.add_argument("--env", metavar="ID", help="refuse data of another environment than this")
    parser.add_argument("--data", required=True, metavar="DIR", help="a dataset's folder")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="encoder file (.safetensors)")
    parser.add_argument(
        "--base", metavar="FILE", help="base encoder, for a method that builds on one (default: pretrain it first)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches (default: %(default)s)")
    parser.add_argument("--device", default="auto", help="as in Stable-Baselines3 (default: %(default)s)")
    parser.add_argument(
        "--precision",
        choices=PRECISIONS,
        help="of encoders while they train, the setting of this name (default: float32)",
    )
    parser.add_argument(
        "-params", "--params", nargs="+", action="extend", default=[], metavar="NAME:VALUE",
        help="replace settings, such as n_updates:1000 objective_kwargs.c:0.9; base.n_updates:1000 for the base",
    )  # fmt: skip
    parser.add_argument(
        "--keep-checkpoint", action="store_true",
        help="keep the last one when the run ends, so that it can be given more updates later",
    )  # fmt: skip
    track = parser.add_argument_group("Weights & Biases", "as in rl-zoo3")
    track.add_argument("--track", action="store_true", help="show the log there (default: no)")
    track.add_argument("--wandb-project-name", metavar="NAME", help="the project (default: sb3)")
    track.add_argument("--wandb-entity", metavar="NAME", help="user or team that the project belongs to")
    track.add_argument("-tags", "--wandb-tags", nargs="+", metavar="TAG", help="of the run, such as pr-123")
    parser.add_argument("--verbose", type=int, default=1, choices=(0, 1), help="1 prints the log (default: 1)")
    run(parser, argv, _command, "interrupted; the same command goes on from the last checkpoint")


def _tracking(args: argparse.Namespace) -> "Tracking | None":
    """:raises ValueError: for words that would not hold, since nothing is tracked"""
    given = {"project": args.wandb_project_name, "entity": args.wandb_entity, "tags": args.wandb_tags}
    words = {name: value for name, value in given.items() if value is not None}
    if not args.track:
        if words:
            raise ValueError(f"--wandb-... is given ({words}), but nothing is tracked; add --track, or leave it out")
        return None
    from sb3_abisim.pretraining.track import Tracking

    return Tracking(**{**words, "tags": tuple(args.wandb_tags or ())})


def _command(args: argparse.Namespace) -> None:
    track = _tracking(args)
    data = Path(args.data)
    env_id = read_env_id(data)
    if args.env is not None and env_id != args.env:
        raise ValueError(f"{data} was collected in {env_id}, not in {args.env}")
    settings = parse_pairs(args.params, "-params")
    if args.precision is not None and settings.setdefault("precision", args.precision) != args.precision:
        raise ValueError(f"--precision {args.precision} and -params precision:{settings['precision']} differ; give one")
    pretrain(
        args.objective, data, args.output, settings, args.base, args.seed, args.device,
        verbose=args.verbose, keep_checkpoint=args.keep_checkpoint, track=track,
    )  # fmt: skip
