"""``sb3-abisim merge``: from a run's model on embeddings to a zip of the equal model that acts on observations."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_abisim.common.cli import add_trust, make_parser, run
from sb3_abisim.common.files import check_output, find, write_atomic
from sb3_abisim.networks.encoder_file import RUN_COPY
from sb3_abisim.rl.merge import merge_encoder
from sb3_abisim.zoo.models import algorithm_class, load_model, read_model_run, unpickled_model


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: the program's arguments by default
    """
    parser = make_parser(
        "merge",
        "Put a frozen encoder into the model that was trained on its embeddings; the result acts on observations.",
        "merge --algo ppo logs/ppo/PointMaze-v0_1/PointMaze-v0.zip -o agent.zip",
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="zip of a model trained on an encoder's embeddings")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="zip to write")
    parser.add_argument("--algo", required=True, help="its algorithm, by rl-zoo3's name, such as ppo")
    parser.add_argument("-e", "--encoder", metavar="FILE", help="encoder (default: the copy in the run's folder)")
    add_trust(parser)
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> None:
    algorithm_class(args.algo)
    # As Stable-Baselines3 does.
    output = args.output if args.output.suffix else args.output.with_suffix(".zip")
    check_output(output)
    if not args.model.is_file():
        raise ValueError(f"there is no model {args.model}; give the zip in the folder of a run that has ended")
    encoder = args.encoder
    if encoder is None:
        copies = find(args.model.parent, f"*/{RUN_COPY}")
        if len(copies) != 1:
            raise ValueError(f"{args.model.parent} holds {len(copies)} encoder files */{RUN_COPY}; give --encoder")
        encoder = str(copies[0])
    merged = merge_encoder(_model(args), encoder)
    # Its save writes over what is there, which a full disk would leave damaged.
    write_atomic(output, lambda file: merged.save(file))  # type: ignore[arg-type]
    print(f"Wrote {output}, a model that acts on observations")


def _model(args: argparse.Namespace) -> BaseAlgorithm:
    if args.trust:
        return unpickled_model(args.model, args.algo)
    zoo_run = read_model_run(args.model)
    if zoo_run.algo != args.algo:
        raise ValueError(f"{args.model} is a model of {zoo_run.algo}, not {args.algo}; give --algo {zoo_run.algo}")
    return load_model(args.model, zoo_run)
