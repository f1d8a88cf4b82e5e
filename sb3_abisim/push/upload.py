"""The files of a repository on the Hub, their upload, and the command."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_abisim._version import __version__
from sb3_abisim.common.cli import PROGRAM, make_parser, run
from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.files import write_atomic
from sb3_abisim.networks.encoder_file import EncoderFile, load_encoder
from sb3_abisim.networks.encoder_name import HUB_FILE, HUB_PREFIX
from sb3_abisim.push.card import make_card
from sb3_abisim.push.evidence import Evidence, benchmark_evidence, probes_evidence

_KEPT = (
    "env_id", "env_kwargs", "observation_space", "action_space", "preprocessing", "objective", "settings",
    "dataset_hash", "versions",
)  # fmt: skip


def repository(
    name: str, repo_id: str, license: str | None = None, benchmark: str | None = None, probes: str | None = None
) -> dict[str, bytes]:
    """The files of a repository.

    :param name: of the encoder, as for ``load_encoder``
    :param repo_id: ``owner/name``
    :param license: the Hub's identifier, such as "mit"
    :param benchmark: folder of a benchmark whose runs used this encoder
    :param probes: JSON of ``sb3-abisim analyze probes`` that has this encoder
    :return: path in the repository to content
    :raises FileNotFoundError: if there is no such encoder, benchmark or JSON
    :raises ValueError: if the evidence is not of this encoder, or the name is none of the Hub
    """
    _check_name(repo_id)
    file = load_encoder(name)
    evidence: list[Evidence] = []
    if benchmark is not None:
        evidence.append(benchmark_evidence(file, benchmark))
    if probes is not None:
        evidence.append(probes_evidence(file, probes))
    content = file.path.read_bytes()
    return {
        HUB_FILE: content,
        "config.json": (json.dumps(_config(file), indent=1, sort_keys=True) + "\n").encode(),
        "README.md": make_card(file, repo_id, license, evidence).encode(),
    }


def push(repo_id: str, files: dict[str, bytes], private: bool = False) -> str:
    """Upload files as one commit; the repository is made if it is not there.

    :param repo_id: ``owner/name``
    :param files: of :func:`repository`
    :param private: whether the repository is to be seen by its owner alone
    :return: ``hf://owner/name@COMMIT``
    :raises ValueError: without a token, or if ``private`` and the repository is there already, and public
    :raises OSError: if the Hub refuses or cannot be reached
    """
    with needs_extra("hub", f"{PROGRAM} push"):
        from huggingface_hub import CommitOperationAdd, HfApi, errors

    check_token()
    api = HfApi(library_name="sb3_abisim", library_version=__version__)
    try:
        api.create_repo(repo_id, private=private, exist_ok=True)
        if private and not api.model_info(repo_id).private:
            raise ValueError(f"{repo_id} is there already, and public; leave out --private, or give another name")
        operations = [CommitOperationAdd(path, content) for path, content in files.items()]
        commit = api.create_commit(repo_id, operations, commit_message="Upload an encoder with sb3-abisim push")
    except errors.HTTPError as error:  # type: ignore[attr-defined]
        # Of the client underneath: what the Hub answers, and that it does not.
        raise OSError(
            f"the Hub did not take {repo_id}: {error}; see that the token may write there (hf auth login, or HF_TOKEN)"
        ) from error
    return f"{HUB_PREFIX}{repo_id}@{commit.oid}"


def check_token() -> None:
    """Refuse an upload that cannot be.

    :raises ValueError: without a token
    """
    with needs_extra("hub", f"{PROGRAM} push"):
        from huggingface_hub import get_token

    if get_token() is None:
        raise ValueError("no token of the Hugging Face Hub; log in with `hf auth login`, or set HF_TOKEN")


def _check_name(repo_id: str) -> None:
    with needs_extra("hub", f"{PROGRAM} push"):
        from huggingface_hub.errors import HFValidationError
        from huggingface_hub.utils import validate_repo_id  # type: ignore[attr-defined]
    try:
        if repo_id.count("/") != 1:
            raise HFValidationError("one slash")
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise ValueError(f"{repo_id!r} is no name on the Hub ({error}); give owner/name") from error


def _config(file: EncoderFile) -> dict[str, Any]:
    network = {"network": file.encoder.spec(), "features_dim": file.encoder.features_dim}
    return {"library": "sb3_abisim", "hash": file.hash, **network, **{name: file.metadata[name] for name in _KEPT}}


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its words; the program's arguments by default
    """
    parser = make_parser(
        "push",
        "Upload an encoder to the Hugging Face Hub, with a card that says what it is, how it was made and what it "
        "gained.",
        "push my/abisim.safetensors owner/name --benchmark benchmark",
    )
    parser.add_argument("encoder", metavar="FILE", help="an encoder file, or the name of a shipped one")
    parser.add_argument("repo_id", metavar="OWNER/NAME", help="repository on the Hub; made if it is not there")
    parser.add_argument("--license", metavar="ID", help="as the Hub names it, such as mit or cc-by-4.0")
    parser.add_argument("--benchmark", metavar="DIR", help="a benchmark, or its export, whose runs used the encoder")
    parser.add_argument("--probes", metavar="JSON", help="numbers of sb3-abisim analyze probes that has the encoder")
    parser.add_argument("--no-evidence", action="store_true", help="a card without results; it says so")
    parser.add_argument("--private", action="store_true", help="seen by the owner alone")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="write the repository here, and upload nothing"
    )
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> None:
    if args.no_evidence == (args.benchmark is not None or args.probes is not None):
        raise ValueError(
            "a card says what the encoder gained: give --benchmark DIR, --probes JSON or both, or --no-evidence"
        )
    if args.output is None:
        check_token()
    files = repository(args.encoder, args.repo_id, args.license, args.benchmark, args.probes)
    if args.output is None:
        name = push(args.repo_id, files, args.private)
        print(f"Uploaded. Whoever names {name} gets this very file")
        return
    args.output.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        _write(args.output / name, content)
    print(f"Wrote {', '.join(files)} to {args.output}; nothing was uploaded")


def _write(path: Path, content: bytes) -> None:
    write_atomic(path, lambda file: file.write(content))
