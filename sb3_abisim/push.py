"""An encoder on the Hugging Face Hub: ``sb3-abisim push FILE owner/name``.

A repository holds ``model.safetensors`` (the encoder file, byte for byte), ``config.json`` (what builds and describes
it) and ``README.md`` (front matter as the Hub reads it, how to use the encoder, how it was made, and the evidence).
Nothing in it is code, and nothing executes when it is loaded: ``hf://owner/name@COMMIT`` in place of a file's name.
"""

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from sb3_abisim._version import __version__
from sb3_abisim.common.cli import PROGRAM, make_parser, run
from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.text import printable
from sb3_abisim.networks.encoder_file import HUB_FILE, HUB_PREFIX, EncoderFile, load_encoder

LIBRARY = "stable-baselines3"
TAGS = ("reinforcement-learning", "deep-reinforcement-learning", "representation-learning", LIBRARY, "sb3_abisim")
Table = list[list[str]]


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
    :raises ValueError: if the evidence is not of this encoder, or the name is none of the Hub
    """
    with needs_extra("hub", f"{PROGRAM} push"):
        from huggingface_hub import EvalResult, ModelCard, ModelCardData
        from huggingface_hub.errors import HFValidationError
        from huggingface_hub.utils import validate_repo_id
    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise ValueError(f"{repo_id!r} is no name on the Hub ({error}); give owner/name") from error
    if repo_id.count("/") != 1:
        raise ValueError(f"{repo_id!r} is no name on the Hub; give owner/name")
    file = load_encoder(name)
    returns, finals = _benchmark_section(file, benchmark) if benchmark is not None else ([], [])
    metadata = file.metadata
    results = [
        EvalResult(
            task_type="reinforcement-learning",
            dataset_type=printable(row["env_id"]),
            dataset_name=printable(f"{row['env_id']} {row['split']}"),
            metric_type="mean_reward",
            metric_name=printable(f"mean return of {row['n_runs']} runs, {row['mode']}"),
            metric_value=round(row["mean"], 3),
            verified=False,
        )
        for row in finals
    ]
    data = ModelCardData(
        library_name=LIBRARY,
        license=license,
        tags=[*TAGS, printable(metadata["objective"]), printable(metadata["env_id"])],
        # The Hub wants both or none.
        **({"model_name": repo_id.partition("/")[2], "eval_results": results} if results else {}),
    )
    sections = [
        *_use_section(file, repo_id), *_content_section(file), *_making_section(file),
        *returns, *(_probes_section(file, probes) if probes is not None else []),
    ]  # fmt: skip
    text = f"---\n{data.to_yaml()}\n---\n\n" + "\n".join(sections) + "\n"
    # What cannot be read back is not written.
    ModelCard(text)
    return {
        HUB_FILE: file.path.read_bytes(),
        "config.json": (json.dumps(_config(file), indent=1, sort_keys=True) + "\n").encode(),
        "README.md": text.encode(),
    }


def push(repo_id: str, files: dict[str, bytes], private: bool = False) -> str:
    """Upload files as one commit; the repository is made if it is not there.

    :param repo_id: ``owner/name``
    :param files: of :func:`repository`
    :param private: whether a new repository is seen by its owner alone
    :return: ``hf://owner/name@COMMIT``
    :raises OSError: if the Hub refuses or cannot be reached
    """
    with needs_extra("hub", f"{PROGRAM} push"):
        from huggingface_hub import CommitOperationAdd, HfApi
        from huggingface_hub.errors import HfHubHTTPError

    api = HfApi(library_name="sb3_abisim", library_version=__version__)
    try:
        api.create_repo(repo_id, private=private, exist_ok=True)
        operations = [CommitOperationAdd(path, content) for path, content in files.items()]
        commit = api.create_commit(repo_id, operations, commit_message="Upload an encoder with sb3-abisim push")
    except HfHubHTTPError as error:
        raise OSError(
            f"the Hub refused {repo_id}: {error}; log in with `hf auth login`, or set HF_TOKEN to a token that may write"
        ) from error
    return f"{HUB_PREFIX}{repo_id}@{commit.oid}"


def _config(file: EncoderFile) -> dict[str, Any]:
    metadata = file.metadata
    kept = ("env_id", "env_kwargs", "observation_space", "action_space", "preprocessing", "objective", "settings",
            "dataset_hash", "versions")  # fmt: skip
    network = {"network": file.encoder.spec(), "features_dim": file.encoder.features_dim}
    return {"library": "sb3_abisim", "hash": file.hash, **network, **{name: metadata[name] for name in kept}}


def _use_section(file: EncoderFile, repo_id: str) -> list[str]:
    metadata, name = file.metadata, f"{HUB_PREFIX}{repo_id}"
    env_id = metadata["env_id"]
    return [
        f"# {_cell(metadata['objective'])} encoder for {_cell(env_id)}",
        "",
        "A visual encoder for [Stable-Baselines3](https://stable-baselines3.readthedocs.io), pretrained without rewards with "
        "`sb3_abisim`. It turns an observation into "
        f"{file.encoder.features_dim} numbers for the policy.",
        "",
        "## Use",
        "",
        *_code(
            "python",
            "import gymnasium as gym",
            "import sb3_abisim as abisim",
            "from stable_baselines3 import PPO",
            "",
            f'policy_kwargs = abisim.policy_kwargs("{name}", freeze=False)',
            f'model = PPO("CnnPolicy", gym.make({env_id!r}), policy_kwargs=policy_kwargs)',
        ),
        "or with rl-zoo3:",
        "",
        *_code("", f"{PROGRAM} train --algo ppo --env {env_id} --conf-file {metadata['objective']}={name}"),
        f"`{name}@COMMIT` fixes the version. Nothing in this repository is code, and loading executes nothing.",
        "",
    ]


def _content_section(file: EncoderFile) -> list[str]:
    metadata, spec = file.metadata, file.encoder.spec()
    rows = [
        ["environment", f"{metadata['env_id']} {metadata['env_kwargs'] or ''}"],
        ["observations", f"uint8, channels first, {metadata['observation_space']['shape']}"],
        ["preprocessing", f"{metadata['preprocessing'] or 'none'}"],
        ["actions", f"{metadata['action_space'] or 'any'}"],
        ["network", f"{spec['name']} {spec['kwargs'] or ''}"],
        ["weights", f"{sum(weights.numel() for weights in file.encoder.parameters())}"],
        ["features", f"{file.encoder.features_dim}"],
        ["hash", file.hash],
    ]
    return ["## Content", "", *_table(["", ""], rows), ""]


def _making_section(file: EncoderFile) -> list[str]:
    from sb3_abisim.pretraining.card import read_card

    metadata, path = file.metadata, file.path.with_suffix(".json")
    versions = ", ".join(f"{name} {text}" for name, text in sorted(metadata["versions"].items()))
    lines = [
        "## How it was made",
        "",
        f"With {_cell(versions)}, on data with the hash `{_cell(metadata['dataset_hash'])}`.",
        "",
    ]
    if not path.is_file():
        return lines
    card = read_card(path)
    lines += _code("", *map(printable, card["commands"]))
    rows = [[name, f"{value:.4g}"] for name, value in sorted(card["metrics"].items())]
    return [*lines, "The last row of the log:", "", *_table(["term", "value"], rows), ""]


def _benchmark_section(file: EncoderFile, folder: str) -> tuple[list[str], list[dict[str, Any]]]:
    """The section, and the rows of this encoder."""
    from sb3_abisim.benchmark.report.tables import compare

    comparison = compare([folder])
    hashes = {
        (env_id, label): {run.record.encoder_hash for run in group.runs if run.record is not None}
        for env_id, methods in comparison.groups.items()
        for label, group in methods.items()
    }
    ours = {key for key, used in hashes.items() if file.hash in used}
    if not ours:
        raise ValueError(f"no run in {folder} used {file.path} ({file.hash}); give the benchmark that trained on it")
    rows = []
    for row in comparison.final:
        key = row["env_id"], row["method"]
        n_files = len(hashes[key] - {None})
        marked = f"**{_cell(row['method'])}**" if key in ours else _cell(row["method"])
        rows.append(
            [row["env_id"], marked, f"{row['mode']}, {row['split']}", f"{row['mean']:.2f} ± {row['half_width']:.2f}",
             str(row["n_runs"]), str(n_files or "")]
        )  # fmt: skip
    commands = sorted(
        {run.command.strip() for methods in comparison.groups.values() for group in methods.values()
         for run in group.runs if run.record is not None and run.record.encoder_hash == file.hash and run.command}
    )  # fmt: skip
    head = ["environment", "method", "mode and split", "return", "runs", "encoder files"]
    section = [
        "## Reinforcement learning",
        "",
        "Mean return of the final models, with the half width of the 95 % interval over runs. In bold: runs with this file, or with "
        "one of several files of the same method.",
        "",
        *_table(head, [[row[0], row[1], *row[2:]] for row in rows], raw=1),
        "",
        *(_code("", *map(printable, commands)) if commands else []),
    ]
    return section, [row for row in comparison.final if (row["env_id"], row["method"]) in ours]


def _probes_section(file: EncoderFile, path: str) -> list[str]:
    try:
        numbers = json.loads(Path(path).read_bytes())
        found = next((entry for entry in numbers["encoders"].values() if entry["hash"] == file.hash), None)
        if found is None:
            raise ValueError(f"{path} has no probes of {file.path} ({file.hash}); run {PROGRAM} analyze probes on it")
        rows = [
            [split, factor, kind, f"{score:.3f}"]
            for split, factors in found["scores"].items()
            for factor, kinds in factors.items()
            for kind, score in kinds.items()
        ]
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not the JSON of {PROGRAM} analyze probes ({error!r})") from error
    return [
        "## What can be read from it",
        "",
        f"Probes on {_cell(numbers['env_id'])}: R² of a regression on numbers, area under the ROC curve on yes and no.",
        "",
        *_table(["split", "factor", "probe", "score"], rows),
        "",
    ]


def _code(language: str, *lines: str) -> list[str]:
    # A fence that is longer than any in the text.
    fence = "`" * max(3, *(line.count("`") + 1 for line in lines))
    return [f"{fence}{language}", *lines, fence, ""]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], raw: int | None = None) -> list[str]:
    """A Markdown table; the cells of one column are Markdown already."""
    cells = [[cell if column == raw else _cell(cell) for column, cell in enumerate(row)] for row in rows]
    return ["| " + " | ".join(row) + " |" for row in (list(head), ["---"] * len(head), *cells)]


def _cell(text: str) -> str:
    """A text from a file, shown as it is: no Markdown, no HTML."""
    shown = printable(str(text)).replace("&", "&amp;").replace("<", "&lt;")
    return "".join(f"\\{letter}" if letter in "\\`*_[]|#" else letter for letter in shown).strip()


def main(argv: Sequence[str] | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its words; the program's arguments by default
    """
    parser = make_parser(
        "push",
        "Upload an encoder to the Hugging Face Hub, with a card that says what it is, how it was made and what it gained.",
        "push my/abisim.safetensors owner/name --benchmark benchmark",
    )
    parser.add_argument("encoder", metavar="FILE", help="an encoder file, or the name of a shipped one")
    parser.add_argument("repo_id", metavar="OWNER/NAME", help="repository on the Hub; made if it is not there")
    parser.add_argument("--license", metavar="ID", help="as the Hub names it, such as mit or cc-by-4.0")
    parser.add_argument("--benchmark", metavar="DIR", help="a benchmark, or its export, whose runs used the encoder")
    parser.add_argument("--probes", metavar="JSON", help="numbers of sb3-abisim analyze probes that has the encoder")
    parser.add_argument("--private", action="store_true", help="seen by the owner alone, where it is made")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="write the repository here, and upload nothing"
    )
    run(parser, argv, _command)


def _command(args: argparse.Namespace) -> None:
    files = repository(args.encoder, args.repo_id, args.license, args.benchmark, args.probes)
    if args.output is None:
        print(f"Uploaded as {push(args.repo_id, files, args.private)}")
        return
    args.output.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_atomic(args.output / name, lambda stream, content=content: stream.write(content))
    print(f"Wrote {', '.join(files)} to {args.output}")
