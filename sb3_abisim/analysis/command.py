"""What an encoder sees, as figures and numbers: ``sb3-abisim analyze COMMAND ...``.

``exact`` compares encoders of Nav2D with the exact action-bisimulation metric
(:mod:`sb3_abisim.analysis.nav2d_exact`), ``readouts`` reads from them what an agent needs
(:mod:`sb3_abisim.analysis.readouts`). Every other command is a figure of :mod:`sb3_abisim.analysis.figures`: a
PNG, and its numbers as JSON. ``all`` makes every figure.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sb3_abisim.analysis import probes, readouts
from sb3_abisim.analysis.figures import FIGURES, default_encoders, load_all, make_figure, make_sweep
from sb3_abisim.analysis.nav2d_exact import BINS, EVAL_SEED, STEPS, ExactReference, check_nav2d
from sb3_abisim.analysis.sweep import PAPER_C
from sb3_abisim.common.cli import make_parser, run
from sb3_abisim.common.files import check_output, write_atomic
from sb3_abisim.pretraining.pretrain import read_env_id

SWEEP_LAYOUTS = 2
# The committed encoders, where the command runs in a checkout.
TRAINED = Path("benchmarks/encoders")
ENCODERS_HELP = {
    False: "files or names (default: all that ship for the environment)",
    True: "files or names (default: all that ship for the environment, and those in TRAINED/<env id>)",
}


def exact(
    encoders: list[str], base: str, c: float, env_id: str, n_layouts: int, seed: int = EVAL_SEED
) -> dict[str, Any]:
    """Compare encoders with the exact metric over a base encoder.

    :param encoders: files or names
    :param base: file or name of the encoder whose distance is the metric's base
    :param c: weight of the recursive term
    :param env_id: an id of Nav2D
    :param n_layouts: eval layouts to average over
    :param seed: of the first layout
    :return: JSON types: the settings, and per encoder its hash and the fields of ``Comparison``
    :raises ValueError: for encoders of other observations or another environment
    """
    if n_layouts < 1:
        raise ValueError(f"n_layouts must be at least 1, got {n_layouts}")
    check_nav2d(env_id)
    # All of them before minutes of computing.
    (base_file,) = load_all([base], env_id).values()
    files = load_all(encoders, env_id)
    reference = ExactReference(base_file.encoder.eval(), c, env_id, n_layouts, seed)
    results = {}
    for name, file in files.items():
        results[name] = {"hash": file.hash, **asdict(reference.compare(file.encoder.eval()))}
    settings = {"env_id": env_id, "base": base, "base_hash": base_file.hash, "c": c}
    return {**settings, "n_layouts": n_layouts, "seed": seed, "bins": BINS, "steps": STEPS, "encoders": results}


def table(results: dict[str, Any]) -> str:
    """The results of :func:`exact` as two Markdown tables: the comparison, and distances by steps.

    :param results: what it returned
    """
    bins = [f"{low}" if low == high else f"{low}-{high}" for low, high in results["bins"]]
    rows = [["encoder", "map correlation", "state correlation", "profile error", *bins]]
    steps = [["distance of states so many steps apart", *map(str, results["steps"])]]
    for name, result in results["encoders"].items():
        numbers = [result["map_correlation"], result["state_correlation"], result["profile_error"], *result["profile"]]
        rows.append([name, *(f"{number:.3f}" for number in numbers)])
        steps.append([name, *(f"{number:.2f}" for number in result["step_profile"])])
    first = next(iter(results["encoders"].values()))
    rows.append(["exact metric", "1", "1", "0", *(f"{number:.3f}" for number in first["exact_profile"])])
    steps.append(["exact metric", *(f"{number:.2f}" for number in first["exact_step_profile"])])
    return f"{_markdown(rows)}\n\n{_markdown(steps)}"


def _markdown(rows: list[list[str]]) -> str:
    lines = [rows[0], ["---", *["---:"] * (len(rows[0]) - 1)], *rows[1:]]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its words; the program's arguments by default
    """
    words = sys.argv[1:] if argv is None else list(argv)
    if not words or words[0] not in COMMANDS:
        # Help, or an error that lists the commands.
        parser = make_parser("analyze", "Show what an encoder sees.", "analyze probes --env DistractorPointMaze-v0")
        commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
        for name, (text, _, _) in COMMANDS.items():
            commands.add_parser(name, help=text)
        parser.parse_args(words)
        return
    _, make, function = COMMANDS[words[0]]
    run(make(words[0]), words[1:], function)


def _figure_parser(name: str) -> argparse.ArgumentParser:
    figure = FIGURES[name]
    parser = make_parser(
        f"analyze {name}",
        f"Make the figure {name} and its numbers: {figure.help}.",
        f"analyze {name} --env {figure.env_ids[0]} --images figures",
    )
    if figure.encoders:
        parser.add_argument("encoders", nargs="*", metavar="ENCODER", help=ENCODERS_HELP[figure.trained])
    parser.add_argument("--env", default=figure.env_ids[0], metavar="ID", help="environment (default: %(default)s)")
    if figure.as_pretrained:
        help = "of a Dict of observations, the image to show to encoders of imported data (default: what they know)"
        parser.add_argument("--image-key", metavar="KEY", help=help)
    if figure.of_data is not None:
        help = "look at this dataset of sb3-abisim collect instead of new episodes"
        parser.add_argument("--data", type=Path, metavar="DIR", help=help)
    parser.add_argument("-n", type=int, default=figure.size, help=f"{figure.unit} (default: %(default)s)")
    parser.set_defaults(name=name, image_key=None)
    _add_folders(parser)
    return parser


def _figure(args: argparse.Namespace) -> None:
    one = FIGURES[args.name]
    if getattr(args, "data", None) is None:
        one.require(args.env)
    trained = _trained(args)
    files = {}
    if one.encoders:
        names = args.encoders or default_encoders(args.env, trained if one.trained else None)
        files = load_all(names, args.env, one.as_pretrained, args.image_key)
    data = args.data if one.of_data is not None else None
    env_id = args.env if data is None else read_env_id(data)
    path = make_figure(args.name, files, env_id, args.n, args.images, _numbers(args), data)
    if args.name == "probes":
        print(probes.table(json.loads((_numbers(args) / f"{path.stem}.json").read_text())))
    print(path)


def _sweep_parser(name: str) -> argparse.ArgumentParser:
    parser = make_parser(
        "analyze sweep",
        "Perturbation maps on Nav2D over c, beside those of the exact metric. Missing encoders are pretrained.",
        "analyze sweep -c 0.25 0.75 --data data/nav2d --trained my_encoders",
    )
    parser.add_argument("-c", type=float, nargs="+", default=list(PAPER_C), help="(default: those of the paper)")
    parser.add_argument("--base", default="Nav2D-v0/ssi", help="single-step encoder (default: %(default)s)")
    parser.add_argument("--data", type=Path, metavar="DIR", help="dataset for what is not in TRAINED/c_sweep")
    parser.add_argument("-n", type=int, default=SWEEP_LAYOUTS, help="layouts (default: %(default)s)")
    _add_folders(parser)
    return parser


def _sweep(args: argparse.Namespace) -> None:
    folders = (args.images, _numbers(args))
    print(make_sweep(args.c, args.base, _trained(args) / "c_sweep", args.data, args.n, *folders))


def _exact_parser(name: str) -> argparse.ArgumentParser:
    parser = make_parser(
        "analyze exact",
        "Compare encoders of Nav2D with the exact action-bisimulation metric.",
        "analyze exact Nav2D-v0/ssi Nav2D-v0/abisim -o exact.json",
    )
    parser.add_argument("encoders", nargs="+", metavar="ENCODER", help="encoder files or names")
    parser.add_argument("--base", default="Nav2D-v0/ssi", help="base encoder of the metric (default: %(default)s)")
    parser.add_argument("-c", type=float, default=0.9, help="weight of the recursive term (default: %(default)s)")
    parser.add_argument("--env", default="Nav2D-v0", metavar="ID", help="an id of Nav2D (default: %(default)s)")
    parser.add_argument("--n-layouts", type=int, default=10, help="six seconds each (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=EVAL_SEED, help="of the first layout (default: %(default)s)")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the numbers there as JSON")
    return parser


def _exact(args: argparse.Namespace) -> None:
    _make_room(args.output)
    results = exact(args.encoders, args.base, args.c, args.env, args.n_layouts, args.seed)
    print(table(results))
    _write(results, args.output)


def _readouts_parser(name: str) -> argparse.ArgumentParser:
    parser = make_parser(
        "analyze readouts",
        "What an agent needs to find the goal, read from frozen embeddings by ridge regression. For environments that "
        "offer shortest paths: Nav2D, the point mazes, ScanNav, and yours if its batch class has shortest_paths().",
        "analyze readouts Nav2D-v0/ssi Nav2D-v0/abisim -o readouts.json",
    )
    parser.add_argument("encoders", nargs="+", metavar="ENCODER", help="encoder files or names")
    parser.add_argument("--env", default="Nav2D-v0", metavar="ID", help="environment (default: %(default)s)")
    parser.add_argument(
        "-n", type=int, default=readouts.N_STATES,
        help="states to learn from, and as many others to score (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=EVAL_SEED, help="of the first episode (default: %(default)s)")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the numbers there as JSON")
    return parser


def _readouts(args: argparse.Namespace) -> None:
    readouts.check_offers(args.env)
    _make_room(args.output)
    results = readouts.compare(load_all(args.encoders, args.env, as_pretrained=True), args.env, args.n, args.seed)
    print(readouts.table(results))
    _write(results, args.output)


def _make_room(output: Path | None) -> None:
    """Before minutes of computing."""
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        check_output(output)


def _write(results: dict[str, Any], output: Path | None) -> None:
    if output is not None:
        text = json.dumps(results, indent=1) + "\n"
        write_atomic(output, lambda file: file.write(text.encode()))


def _all_parser(name: str) -> argparse.ArgumentParser:
    parser = make_parser(
        "analyze all", "Make every figure with the default encoders.", "analyze all --images figures -n 2"
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="dataset of Nav2D-v0, see sweep")
    parser.add_argument("-n", type=int, help="one size for all of them, for a quick look")
    _add_folders(parser)
    return parser


def _all(args: argparse.Namespace) -> None:
    # The sweep first, since it may need data.
    commands = [["sweep", "-n", str(args.n or SWEEP_LAYOUTS), *(["--data", str(args.data)] if args.data else [])]]
    for name, one in FIGURES.items():
        commands += [[name, "--env", env_id, "-n", str(args.n or one.size)] for env_id in one.env_ids]
    folders = ["--images", str(args.images), "--numbers", str(_numbers(args))]
    folders += [] if args.trained is None else ["--trained", str(_trained(args))]
    for words in commands:
        print(f"$ sb3-abisim analyze {' '.join(words)}", flush=True)
        main([*words, *folders])


def _add_folders(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", type=Path, default="figures", metavar="DIR", help="PNGs (default: %(default)s)")
    parser.add_argument("--numbers", type=Path, metavar="DIR", help="JSON (default: the folder of the PNGs)")
    parser.add_argument(
        "--trained", type=Path, metavar="TRAINED",
        help=f"encoders trained for figures: <env id>/*.safetensors, and c_sweep (default: {TRAINED}, if it is there)",
    )  # fmt: skip


def _numbers(args: argparse.Namespace) -> Path:
    folder: Path = args.numbers or args.images
    return folder


def _trained(args: argparse.Namespace) -> Path:
    if args.trained is not None and not args.trained.is_dir():
        raise ValueError(f"there is no folder --trained {args.trained}; it holds <env id>/*.safetensors")
    return args.trained or TRAINED


_Run = Callable[[argparse.Namespace], None]
# Name: what it does, its parser and its function.
COMMANDS: dict[str, tuple[str, Callable[[str], argparse.ArgumentParser], _Run]] = {
    "exact": ("compare encoders of Nav2D with the action-bisimulation metric, solved exactly", _exact_parser, _exact),
    "readouts": ("what an agent needs to find the goal, read from embeddings", _readouts_parser, _readouts),
    **{name: (one.help, _figure_parser, _figure) for name, one in FIGURES.items()},
    "sweep": ("perturbation maps on Nav2D over c, beside those of the exact metric", _sweep_parser, _sweep),
    "all": ("every figure, with the default encoders", _all_parser, _all),
}
