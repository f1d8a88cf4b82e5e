"""``sb3-abisim data import``, ``data export`` and ``data show``: exchange datasets, and look at one."""

import argparse
import sys
from collections.abc import Sequence

from sb3_abisim.common.cli import make_parser, run
from sb3_abisim.data.importing import import_dataset
from sb3_abisim.registry import readers


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its arguments; None for those of the process
    """
    words = sys.argv[1:] if argv is None else list(argv)
    if not words or words[0] not in COMMANDS:
        # Help, or an error that lists the commands.
        example = "data import minari nav2d/random-v0 -o data/nav2d"
        parser = make_parser("data", "Exchange datasets with other formats, or look at one.", example)
        commands = parser.add_subparsers(dest="command", required=True, metavar="import | export | show")
        commands.add_parser("import", help="make a dataset folder of what something else has written")
        commands.add_parser("export", help="write a dataset folder into Minari's local store")
        commands.add_parser("show", help="write one HTML page of what is in a dataset")
        parser.parse_args(words)
        return
    make, function = COMMANDS[words[0]]
    run(make(), words[1:], function)


def _import_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "data import",
        "Make a dataset folder of what something else has written; rewards are dropped.",
        "data import minari nav2d/random-v0 -o data/nav2d",
    )
    known = "; ".join(f"{name} ({reader.help})" for name, reader in readers().items())
    parser.add_argument("reader", metavar="READER", help=f"name of a reader: {known}; or yours")
    parser.add_argument("source", metavar="SOURCE", help="what it reads, such as a file or the id of a Minari dataset")
    parser.add_argument("-o", "--output", required=True, metavar="DIR", help="the dataset's folder")
    parser.add_argument(
        "--env", metavar="ID",
        help="environment that was recorded; its action space holds where the source has none (arrays, lerobot)",
    )  # fmt: skip
    parser.add_argument(
        "--image-key", metavar="KEY", help="which of several observations is the image (default: the only one)"
    )
    return parser


def _import(args: argparse.Namespace) -> None:
    import_dataset(args.reader, args.source, args.output, env_id=args.env, image_key=args.image_key)


def _export_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "data export",
        "Write a dataset folder into Minari's local store (MINARI_DATASETS_PATH).",
        "data export data/nav2d nav2d/random-v0",
    )
    parser.add_argument("folder", metavar="DIR", help="a dataset's folder")
    parser.add_argument("dataset_id", metavar="ID", help="such as nav2d/random-v0")
    return parser


def _export(args: argparse.Namespace) -> None:
    from sb3_abisim.data.readers.minari import export_dataset

    export_dataset(args.folder, args.dataset_id)
    print(f"{args.dataset_id}: exported from {args.folder}; rewards were not recorded and are all 0")


def _show_parser() -> argparse.ArgumentParser:
    parser = make_parser(
        "data show",
        "Write one HTML page of what is in a dataset: episodes, actions, coverage of states, lengths, duplicates.",
        "data show data/nav2d -o nav2d.html",
    )
    parser.add_argument("folder", metavar="DIR", help="a dataset's folder")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="the page (.html)")
    parser.add_argument("--leak", metavar="JSON", help="numbers of sb3-abisim analyze leak --data DIR")
    return parser


def _show(args: argparse.Namespace) -> None:
    from sb3_abisim.data.show import show

    print(show(args.folder, args.output, args.leak))


COMMANDS = {
    "import": (_import_parser, _import),
    "export": (_export_parser, _export),
    "show": (_show_parser, _show),
}
