"""The card on the Hub: front matter as the Hub reads it, what the encoder is, how it was made and what it gained."""

import math
import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_abisim.common.cli import PROGRAM
from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.spaces import space_from_json
from sb3_abisim.common.text import printable
from sb3_abisim.networks.encoder_file import EncoderFile
from sb3_abisim.networks.encoder_name import HUB_PREFIX
from sb3_abisim.pretraining.card import read_card
from sb3_abisim.push.evidence import Evidence, Result
from sb3_abisim.push.markdown import code_block, inert, table
from sb3_abisim.registry import methods

LIBRARY = "stable-baselines3"
TAGS = ("reinforcement-learning", "deep-reinforcement-learning", "representation-learning", LIBRARY, "sb3_abisim")
# Of the log of pretraining, beside its first row.
N_LOG_ROWS = 5
Lines = list[str]


def make_card(file: EncoderFile, repo_id: str, license: str | None, evidence: Sequence[Evidence]) -> str:
    """The text of ``README.md``.

    :param file: the encoder
    :param repo_id: ``owner/name``
    :param license: the Hub's identifier
    :param evidence: of this encoder
    :raises ValueError: if the model card beside the file is of another one
    """
    with needs_extra("hub", f"{PROGRAM} push"):
        from huggingface_hub import EvalResult, ModelCard, ModelCardData

    metadata = file.metadata
    results = [
        EvalResult(
            task_type=result.task,
            dataset_type=printable(result.env_id),
            dataset_name=printable(f"{result.env_id}, {result.split}"),
            # Results of one type, config and split share the name of the first.
            dataset_split=printable(result.split),
            metric_type=result.metric,
            metric_name=printable(result.name),
            metric_value=round(result.value, 4),
            metric_args=_arguments(result),
            verified=False,
        )
        for part in evidence
        for result in part.results
    ]
    data = ModelCardData(
        library_name=LIBRARY,
        license=license,
        pipeline_tag="reinforcement-learning",
        tags=[*TAGS, printable(metadata["objective"]), printable(metadata["env_id"])],
        # The Hub wants both or none.
        model_name=repo_id.partition("/")[2] if results else None,
        eval_results=results or None,
    )
    sections = [*_use(file, repo_id), *_content(file), *_making(file)]
    for part in evidence:
        sections += part.section
    if not evidence:
        sections += ["## Results", "", "None were given when this was uploaded.", ""]
    text = f"---\n{data.to_yaml()}\n---\n\n" + "\n".join(sections)
    # What cannot be read back is not written.
    ModelCard(text)
    return text


def _arguments(result: Result) -> dict[str, Any] | None:
    if result.half_width is None:
        return {"n_runs": result.n_runs} if result.metric == "mean_reward" else None
    return {"n_runs": result.n_runs, "half_width_of_95_percent_interval": round(result.half_width, 4)}


def _use(file: EncoderFile, repo_id: str) -> Lines:
    metadata, name = file.metadata, f"{HUB_PREFIX}{repo_id}"
    env_id, objective = metadata["env_id"], metadata["objective"]
    return [
        f"# {inert(objective)} encoder for {inert(env_id)}",
        "",
        "A visual encoder for [Stable-Baselines3](https://stable-baselines3.readthedocs.io), pretrained without "
        f"rewards with `sb3_abisim`{_label(objective)}. It turns an observation into {file.encoder.features_dim} "
        "numbers for the policy.",
        "",
        "## Use",
        "",
        *code_block(
            "python",
            [
                "import gymnasium as gym",
                "from stable_baselines3 import PPO",
                "",
                "import sb3_abisim",
                "",
                f'policy_kwargs = sb3_abisim.policy_kwargs("{name}", freeze=False)',
                f'model = PPO("CnnPolicy", gym.make({env_id!r}), policy_kwargs=policy_kwargs)',
            ],
        ),
        "or with rl-zoo3:",
        "",
        *code_block(
            "",
            [
                f"{PROGRAM} train --algo ppo --env {shlex.quote(env_id)} "
                f"--conf-file {shlex.quote(f'{objective}={name}')}"
            ],
        ),
        f"`{name}@COMMIT` fixes the version. Nothing in this repository is code, and loading it executes nothing.",
        "",
    ]


def _label(objective: str) -> str:
    """What the method of an encoder is called, where it is registered."""
    method = methods().get(objective)
    return "" if method is None or method.label == objective else f" by {inert(method.label)}"


def _content(file: EncoderFile) -> Lines:
    metadata, spec = file.metadata, file.encoder.spec()
    rows = {
        "environment": f"{metadata['env_id']} {metadata['env_kwargs'] or ''}",
        "observations": f"uint8, channels first, {metadata['observation_space']['shape']}",
        "preprocessing": metadata["preprocessing"] or "none",
        "actions": space_from_json(metadata["action_space"]) if metadata["action_space"] else "any",
        "network": f"{spec['name']} {spec['kwargs'] or ''}",
        "weights": sum(weights.numel() for weights in file.encoder.parameters()),
        "features": file.encoder.features_dim,
        "hash": file.hash,
    }
    return ["## Content", "", *table(["", ""], [[name, inert(value)] for name, value in rows.items()])]


def _making(file: EncoderFile) -> Lines:
    metadata, path = file.metadata, file.path.with_suffix(".json")
    versions = ", ".join(f"{name} {text}" for name, text in sorted(metadata["versions"].items()))
    lines = ["## How it was made", "",
             f"With {inert(versions)}, on data with the hash {inert(metadata['dataset_hash'])}.", ""]  # fmt: skip
    if not path.is_file():
        return [*lines, "The commands are not known: there was no model card beside the file.", ""]
    card = read_card(path)
    commands, curves = card["commands"], card["curves"]
    try:
        if card["settings"] != metadata["settings"] or card["dataset"]["hash"] != metadata["dataset_hash"]:
            raise ValueError(f"the model card {path} is not of {file.path}; copy both from where they were pretrained")
        lines += code_block("", commands)
        if base_hash := card["settings"].get("base_hash"):
            lines += [f"BASE is the encoder with the hash {inert(base_hash)}.", ""]
        n = max((len(values) for values in curves.values()), default=0)
        shown = sorted({*np.linspace(0, n - 1, N_LOG_ROWS + 1).round().astype(int).tolist()}) if n else []
        rows = [[inert(name), *(_number(values[k]) for k in shown)] for name, values in sorted(curves.items())]
        # The updates first, as the head of the table.
        rows.sort(key=lambda row: row[0] != inert("n_updates"))
    except (TypeError, KeyError, IndexError, AttributeError) as error:
        raise ValueError(f"the model card {path} is damaged ({error!r}); copy or pretrain it again") from error
    if rows:
        lines += ["The log of pretraining:", "", *table(rows[0], rows[1:])]
    return lines


def _number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.4g}"
