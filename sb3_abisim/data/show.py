"""``sb3-abisim data show``: one HTML page of what is in a dataset, without a server."""

import io
import json
import shlex
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim._version import __version__
from sb3_abisim.common.cli import PROGRAM
from sb3_abisim.common.extras import require_extra
from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.page import png_source, render_page
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import CUT
from sb3_abisim.data.summary import (
    END_NAMES,
    MAX_ACTIONS,
    MAX_FRAMES,
    Duplicates,
    Episodes,
    action_parts,
    chart_of,
    episodes_of,
    factor_parts,
    find_duplicates,
    spread,
)

N_STRIPS = 8
N_IN_STRIP = 10
# Side of a shown image: small ones are magnified in whole steps, large ones are made smaller.
SHOWN_PIXELS = 96
MAX_COMPONENTS = 16
# Shares from which the page warns.
FEW_DISTINCT, MANY_UNCHANGED = 0.1, 0.5


def show(data: str | Path, output: str | Path, leak: str | Path | None = None) -> Path:
    """Write the page; the same dataset gives the same one.

    :param data: a dataset's folder
    :param output: the page, ending in ``.html``; its folder is made
    :param leak: JSON of ``sb3-abisim analyze leak``
    :return: the page
    :raises ValueError: for another ending, a folder that holds no dataset, or an audit of another one
    """
    output = Path(output)
    if output.suffix != ".html":
        raise ValueError(f"the page must end in .html, got {output}")
    require_extra("pages", f"{PROGRAM} data show", "jinja2", "PIL")
    dataset = TransitionDataset(data)
    audit = None if leak is None else _read_leak(Path(leak), dataset)
    text = render(dataset, audit)
    output.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(output, lambda file: file.write(text.encode()))
    return output


def render(dataset: TransitionDataset, leak: dict[str, Any] | None = None) -> str:
    """The page.

    :param dataset: any
    :param leak: scores of patches, if there was an audit: ``text``, ``width``, ``height``, ``cells``
    """
    meta, episodes = dataset.meta, episodes_of(dataset)
    starts = dataset.valid_starts()
    shown_actions = spread(starts, MAX_ACTIONS)
    read = spread(starts, MAX_FRAMES)
    actions, duplicates = action_parts(dataset, shown_actions), find_duplicates(dataset, episodes, read)
    template = resources.files(__package__).joinpath("show.html").read_text(encoding="utf-8")
    return render_page(
        template,
        {"number": lambda value: f"{value:,}", "percent": _percent},
        env_id=dataset.env_id,
        env_kwargs=str(dataset.env_kwargs or ""),
        folder=str(dataset.path),
        folder_word=shlex.quote(str(dataset.path)),
        hash=dataset.hash,
        preprocessing=str(dataset.preprocessing or ""),
        origin=_origin(meta),
        shape=" x ".join(map(str, dataset.observation_space.shape)),
        action_space=str(dataset.action_space),
        n_transitions=dataset.n_transitions,
        n_frames=dataset.n_frames,
        n_episodes=len(episodes.n_steps),
        notes=_notes(episodes, actions, duplicates, leak),
        strips=_strips(dataset, episodes),
        shown_channels=_shown_channels(dataset.observation_space.shape[0]),
        lengths=_lengths(episodes),
        n_actions=len(shown_actions),
        actions=actions[:MAX_COMPONENTS],
        n_more_actions=max(0, len(actions) - MAX_COMPONENTS),
        factors=factor_parts(dataset, read),
        n_frames_read=duplicates.n_frames,
        n_pairs_read=duplicates.n_pairs,
        n_episodes_read=duplicates.n_episodes,
        distinct_text=f"{duplicates.n_distinct:,} of {duplicates.n_frames:,} observations are distinct.",
        duplicates=[
            {"label": "observations that occur again", "share": duplicates.repeated},
            {"label": "transitions that change nothing", "share": duplicates.unchanged},
            {"label": "episodes that occur again", "share": duplicates.equal_episodes},
        ],
        leak=leak,
        version=__version__,
    )


def _origin(meta: dict[str, Any]) -> str:
    if meta["source"] is not None:
        return f"Imported from {meta['source']}."
    return f"Collected by the policy {meta['policy']}, seed {meta['seed']}, {meta['n_envs']} copies."


def _percent(share: float) -> str:
    return "0 %" if share == 0 else "below 0.1 %" if share < 0.001 else f"{100 * share:.1f} %"


def _notes(
    episodes: Episodes, actions: list[dict[str, Any]], duplicates: Duplicates, leak: dict[str, Any] | None
) -> list[str]:
    """What may make pretraining on it useless."""
    notes = []
    if (episodes.ends == CUT).all():
        notes.append("No episode ends within the data, so nobody has seen what follows a reset but at its beginning.")
    for part in actions:
        never = [row["label"] for row in part["rows"] if row["share"] == 0]
        if never:
            notes.append(f"Of {part['name']}, {', '.join(never)} never occurs in the sample.")
    if duplicates.n_distinct <= FEW_DISTINCT * duplicates.n_frames:
        notes.append(f"Only {duplicates.n_distinct:,} of {duplicates.n_frames:,} observations are distinct.")
    if duplicates.unchanged >= MANY_UNCHANGED:
        notes.append(
            f"{_percent(duplicates.unchanged)} of the transitions change nothing: no action can be read from them."
        )
    if duplicates.equal_episodes > 0:
        notes.append(f"{_percent(duplicates.equal_episodes)} of the episodes occur again, action for action.")
    if leak is not None and leak["leaks"]:
        notes.append("A few pixels show the action: an inverse model may learn to look at nothing else.")
    return notes


def _lengths(episodes: Episodes) -> dict[str, Any]:
    whole = episodes.n_steps[episodes.ends != CUT]
    text = "No episode is whole."
    if len(whole):
        text = (
            f"{len(whole):,} whole episodes have {whole.min():,} to {whole.max():,} steps, {np.median(whole):,.0f} in "
            "the median."
        )
    shares = [
        {"label": name, "share": float((episodes.ends == end).mean())}
        for end, name in END_NAMES.items()
        if (episodes.ends == end).any()
    ]
    return {"text": text, "chart": chart_of(whole) if len(whole) > 1 else None, "ends": shares}


def _shown_channels(n_channels: int) -> str:
    if n_channels in (1, 3):
        return ""
    if n_channels == 4:
        return "Of four channels, the first three are shown as colors."
    return f"Of {n_channels} channels, the last {'three are shown as colors' if n_channels % 3 == 0 else 'is shown'}."


def _strips(dataset: TransitionDataset, episodes: Episodes) -> list[dict[str, Any]]:
    n = len(episodes.n_steps)
    strips = []
    for k in np.unique(np.linspace(0, n - 1, N_STRIPS).round().astype(int)).tolist():
        frames = episodes.frames(k)
        places = np.unique(np.linspace(0, len(frames) - 1, N_IN_STRIP).round().astype(int))
        strips.append({
            "number": k,
            "n_steps": int(episodes.n_steps[k]),
            "end": END_NAMES[int(episodes.ends[k])],
            "shown": ", ".join(map(str, places.tolist())),
            "images": [png_source(_png(frame)) for frame in dataset.frames(frames[places])],
        })  # fmt: skip
    return strips


def _png(frame: NDArray[np.uint8]) -> bytes:
    """One observation, (C, H, W), as an image."""
    from PIL import Image

    n_channels, height, width = frame.shape
    shown = frame[:3] if n_channels == 4 else frame[-3:] if n_channels % 3 == 0 else frame[-1:]
    pixels = np.ascontiguousarray(shown.transpose(1, 2, 0))
    image = Image.fromarray(pixels if len(shown) == 3 else pixels[:, :, 0])
    scale = SHOWN_PIXELS / max(height, width)
    if scale >= 1:
        image = image.resize((width * int(scale), height * int(scale)), Image.Resampling.NEAREST)
    else:
        image.thumbnail((SHOWN_PIXELS, SHOWN_PIXELS))
    stream = io.BytesIO()
    image.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _read_leak(path: Path, dataset: TransitionDataset) -> dict[str, Any]:
    """An audit that ``analyze leak --data`` has made of this dataset."""
    try:
        numbers = json.loads(path.read_bytes())
        one, threshold = numbers["audits"]["as it is"], float(numbers["threshold"])
        scores = np.array(one["scores"], np.float64)
        if numbers["figure"] != "leak" or scores.ndim != 2 or not scores.size or not np.isfinite(scores).all():
            raise ValueError("no table of scores")
        n, hash, leaks = int(numbers["n_transitions"]), numbers.get("dataset_hash"), bool(one["leaks"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is not the JSON of {PROGRAM} analyze leak ({error!r})") from error
    if hash != dataset.hash:
        raise ValueError(
            f"{path} is not an audit of {dataset.path}; make one with {PROGRAM} analyze leak --data {dataset.path}"
        )
    verdict = (
        f"above {threshold:g}, where one patch by itself predicts the action"
        if leaks
        else f"below {threshold:g}, so no patch by itself predicts the action"
    )
    return {
        "leaks": leaks,
        "text": f"The highest score of a patch is {scores.max():.2f} of 1, {verdict} ({n:,} transitions).",
        "height": scores.shape[0],
        "width": scores.shape[1],
        "cells": [
            {"x": int(x), "y": int(y), "share": round(min(float(scores[y, x]), 1.0), 3)}
            for y, x in np.argwhere(scores > 0)
        ],
    }
