"""``sb3-abisim data``: datasets from other formats, and to Minari."""

import argparse
from collections.abc import Sequence

from sb3_abisim.common.cli import make_parser, run
from sb3_abisim.registry import get_reader


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: arguments, None for those of the process
    """
    parser = make_parser(
        "data", "Exchange datasets with other formats.", "data import minari nav2d/random-v0 -o data/nav2d"
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="import | export")
    importer = commands.add_parser("import", help="make a dataset folder of what something else has written")
    importer.add_argument("reader", metavar="READER", help="name of a reader, such as minari")
    importer.add_argument("source", metavar="SOURCE", help="what it reads, such as the id of a Minari dataset")
    importer.add_argument("-o", "--output", required=True, metavar="DIR", help="the dataset's folder")
    export = commands.add_parser("export", help="write a dataset folder into Minari's local store")
    export.add_argument("folder", metavar="DIR", help="a dataset's folder")
    export.add_argument("dataset_id", metavar="DATASET_ID", help="such as nav2d/random-v0")
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> None:
    if args.command == "import":
        hash = get_reader(args.reader).read_fn(args.source, args.output)
        print(f"{args.output}: imported from {args.source} (digest {hash[:16]}); rewards were dropped")
        return
    from sb3_abisim.data.readers.minari import export_dataset

    export_dataset(args.folder, args.dataset_id)
    print(f"{args.dataset_id}: exported from {args.folder}; rewards were not recorded and are all 0")
