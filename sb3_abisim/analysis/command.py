"""What an encoder sees, as figures and numbers: ``sb3-abisim analyze COMMAND ...``.

``exact`` holds encoders of Nav2D against the exact action-bisimulation metric
(:mod:`sb3_abisim.analysis.nav2d_exact`). Every other command is a figure of :mod:`sb3_abisim.analysis.figures`: a
PNG, and its numbers as JSON. ``all`` makes every figure.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_abisim.analysis import probes
from sb3_abisim.analysis.figures import FIGURES, default_encoders, load_all, make_figure, make_sweep
from sb3_abisim.analysis.nav2d_exact import BINS, ENV_IDS, HELD_OUT_SEED, ExactReference
from sb3_abisim.analysis.sweep import PAPER_C
from sb3_abisim.common.cli import make_parser, run
from sb3_abisim.common.files import write_atomic
from sb3_abisim.networks.encoder_file import EncoderFile, load_encoder

SWEEP_LAYOUTS = 2
# The committed encoders, where the command runs in a checkout.
TRAINED = Path("benchmarks/encoders")
ENCODERS_HELP = {
    False: "files or names (default: all that ship for the environment)",
    True: "files or names (default: all that ship for the environment, and those in TRAINED/<env id>)",
}


def exact(
    encoders: list[str], base: str, c: float, env_id: str, n_layouts: int, seed: int = HELD_OUT_SEED
) -> dict[str, Any]:
    """Compare encoders with the exact metric over a base encoder.

    :param encoders: files or names
    :param base: file or name of the encoder whose distance is the metric's base
    :param c: weight of the recursive term
    :param env_id: one of the Nav2D environments
    :param n_layouts: held-out layouts to average over
    :param seed: of the first layout
    :return: JSON types: the settings, and per encoder its digest and the fields of ``Comparison``
    :raises ValueError: for encoders of other observations or another environment
    """
    if n_layouts < 1:
        raise ValueError(f"n_layouts must be at least 1, got {n_layouts}")
    base_file = load_encoder(base)
    # All of them before minutes of computing.
    files = {name: _check(load_encoder(name)) for name in encoders}
    reference = ExactReference(_check(base_file).encoder.eval(), c, env_id, n_layouts, seed)
    results = {}
    for name, file in files.items():
        results[name] = {"hash": file.hash, **asdict(reference.compare(file.encoder.eval()))}
    settings = {"env_id": env_id, "base": base, "base_hash": base_file.hash, "c": c}
    return {**settings, "n_layouts": n_layouts, "seed": seed, "bins": BINS, "encoders": results}


def _check(file: EncoderFile) -> EncoderFile:
    file.check(gym.make(ENV_IDS[0]).observation_space)
    return file


def table(results: dict[str, Any]) -> str:
    """The results of :func:`exact` as a Markdown table.

    :param results: what it returned
    """
    bins = [f"{low}" if low == high else f"{low}-{high}" for low, high in results["bins"]]
    header = ["encoder", "map correlation", "state correlation", "profile error", *bins]
    rows = [header, ["---", *["---:"] * (len(header) - 1)]]
    for name, result in results["encoders"].items():
        numbers = [result["map_correlation"], result["state_correlation"], result["profile_error"], *result["profile"]]
        rows.append([name, *(f"{number:.3f}" for number in numbers)])
    exact_profile = next(iter(results["encoders"].values()))["exact_profile"]
    rows.append(["exact metric", "1", "1", "0", *(f"{number:.3f}" for number in exact_profile)])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def figure(args: argparse.Namespace) -> None:
    """Make one figure.

    :param args: of a figure's command
    """
    one = FIGURES[args.command]
    files = {}
    if one.encoders:
        trained = (args.trained or TRAINED) if one.trained else None
        files = load_all(args.encoders or default_encoders(args.env, trained), args.env)
    path = make_figure(args.command, files, args.env, args.n, args.images, args.numbers or args.images)
    if args.command == "probes":
        print(probes.table(json.loads(((args.numbers or args.images) / f"{path.stem}.json").read_text())))
    print(path)


def all_figures(args: argparse.Namespace) -> None:
    """Make every figure with its default encoders, the sweep first since it may need data.

    :param args: of the command ``all``
    """
    commands = [["sweep", "-n", str(args.n or SWEEP_LAYOUTS), *(["--data", str(args.data)] if args.data else [])]]
    for name, one in FIGURES.items():
        commands += [[name, "--env", env_id, "-n", str(args.n or one.size)] for env_id in one.usual_ids]
    folders = ["--images", str(args.images), "--numbers", str(args.numbers or args.images)]
    for words in commands:
        print(f"$ sb3-abisim analyze {' '.join(words)}", flush=True)
        main([*words, *folders, *(["--trained", str(args.trained)] if args.trained else [])])


def _parser() -> argparse.ArgumentParser:
    parser = make_parser("analyze", "Show what an encoder sees.", "analyze probes --env DistractorPointMaze-v0")
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("exact", help="hold encoders of Nav2D against the exact metric")
    command.add_argument("encoders", nargs="+", metavar="ENCODER", help="encoder files or names")
    command.add_argument("--base", default="Nav2D-v0/ssi", help="base encoder of the metric (default: %(default)s)")
    command.add_argument("-c", type=float, default=0.9, help="weight of the recursive term (default: %(default)s)")
    command.add_argument("--env", default=ENV_IDS[0], choices=ENV_IDS)
    command.add_argument("--n-layouts", type=int, default=10, help="six seconds each (default: %(default)s)")
    command.add_argument("--seed", type=int, default=HELD_OUT_SEED, help="of the first layout (default: %(default)s)")
    command.add_argument("-o", "--output", metavar="FILE", help="write the numbers there as JSON")
    for name, one in FIGURES.items():
        command = commands.add_parser(name, help=one.help)
        if one.encoders:
            command.add_argument("encoders", nargs="*", metavar="ENCODER", help=ENCODERS_HELP[one.trained])
        command.add_argument("--env", default=one.env_ids[0], choices=one.env_ids)
        command.add_argument("-n", type=int, default=one.size, help=f"{one.unit} (default: %(default)s)")
        _add_folders(command)
    command = commands.add_parser("sweep", help="perturbation maps on Nav2D over c, beside the exact metric's")
    command.add_argument("-c", type=float, nargs="+", default=list(PAPER_C), help="(default: those of the paper)")
    command.add_argument("--base", default="Nav2D-v0/ssi", help="single-step encoder (default: %(default)s)")
    command.add_argument("--data", type=Path, metavar="DIR", help="dataset for what is not in TRAINED/c_sweep")
    command.add_argument("-n", type=int, default=SWEEP_LAYOUTS, help="layouts (default: %(default)s)")
    _add_folders(command)
    command = commands.add_parser("all", help="every figure, with the default encoders")
    command.add_argument("--data", type=Path, metavar="DIR", help="dataset of Nav2D-v0, see sweep")
    command.add_argument("-n", type=int, help="one size for all of them, for a quick look")
    _add_folders(command)
    return parser


def _add_folders(command: argparse.ArgumentParser) -> None:
    command.add_argument("--images", type=Path, default="figures", metavar="DIR", help="PNGs (default: %(default)s)")
    command.add_argument("--numbers", type=Path, metavar="DIR", help="JSON (default: the folder of the PNGs)")
    command.add_argument(
        "--trained", type=Path, metavar="TRAINED",
        help=f"encoders trained for figures: <env id>/*.safetensors, and c_sweep (default: {TRAINED}, if it is there)",
    )  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its words; the program's arguments by default
    """
    run(_parser(), argv, _command)


def _command(args: argparse.Namespace) -> None:
    if getattr(args, "trained", None) and not args.trained.is_dir():
        raise ValueError(f"there is no folder --trained {args.trained}; it holds <env id>/*.safetensors")
    if args.command == "exact":
        _exact_command(args)
    elif args.command == "all":
        all_figures(args)
    elif args.command == "sweep":
        folders = (args.images, args.numbers or args.images)
        print(make_sweep(args.c, args.base, (args.trained or TRAINED) / "c_sweep", args.data, args.n, *folders))
    else:
        figure(args)


def _exact_command(args: argparse.Namespace) -> None:
    if args.output is not None:
        Path(args.output).parent.mkdir(parents=True, exist_ok=True)
    results = exact(args.encoders, args.base, args.c, args.env, args.n_layouts, args.seed)
    print(table(results))
    if args.output is not None:
        text = json.dumps(results, indent=1) + "\n"
        write_atomic(Path(args.output), lambda file: file.write(text.encode()))
