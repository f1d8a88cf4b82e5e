"""More figures: pixel space, neighbors, probes, curves and the leak audit. Needs the extra ``plots``."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.analysis.plots import CMAP, as_array, pyplot, save, short_name, show_map, show_profiles
from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.files import write_atomic
from sb3_abisim.registry import get_traits

N_COLORS = 256


def plot_pixel_maps(results: dict[str, Any], path: Path) -> None:
    """Maps of a moved obstacle, profiles by distance, and what other changes do.

    :param results: of :func:`~sb3_abisim.analysis.pixels.pixel_maps`
    :param path: the PNG
    """
    plt = pyplot()
    encoders = results["encoders"]
    settings = list(next(iter(encoders.values()))["settings"])
    n = len(encoders)
    figure, axes = plt.subplots(
        len(settings), n + 2, figsize=(3.0 * (n + 2) + 0.6, 3.1 * len(settings) + 0.3), constrained_layout=True,
        squeeze=False,
    )  # fmt: skip
    for row, setting in zip(axes, settings, strict=True):
        here = {name: result["settings"][setting] for name, result in encoders.items()}
        for axis, (name, result) in zip(row, here.items(), strict=False):
            image = show_map(axis, as_array(result["map"]), short_name(name), results["reach"], "meters")
        row[0].set_ylabel(setting)
        figure.colorbar(image, ax=list(row[:n]), shrink=0.8, label="relative to the largest")
        lines = {short_name(name): result["profile"] for name, result in here.items()}
        show_profiles(row[n], lines, results["bins"], "m from agent to obstacle")
        row[n].tick_params(axis="x", rotation=30)
        # One legend for the figure: six encoders' would cover the curves.
        row[n].get_legend().remove()
        _show_changes(row[n + 1], here)
    handles, labels = axes[0, n + 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower right", ncols=min(n, 6), fontsize=8)
    figure.suptitle(f"Change of the embedding when one obstacle moves by 1 m, {results['env_id']}", fontsize=10)
    save(figure, path)
    _reduce_colors(path)


def _show_changes(axis: Any, here: dict[str, Any]) -> None:
    """Bars of what an obstacle beside the agent, the agent and the clip change."""
    changes = ["obstacle\nwithin 0.6 m", "agent\n1 m"]
    if next(iter(here.values()))["clip"] is not None:
        changes.append("clip")
    width = 0.8 / len(here)
    for k, (name, result) in enumerate(here.items()):
        heights = as_array([result["profile"][0], result["agent"], result["clip"]][: len(changes)])
        axis.bar(np.arange(len(changes)) + (k - (len(here) - 1) / 2) * width, heights, width, label=short_name(name))
    axis.axhline(1.0, color="0.5", lw=0.8, ls="--")
    axis.set_xticks(range(len(changes)), changes, fontsize=8)
    axis.set_ylabel("change (1: another state)")


def plot_neighbors(results: dict[str, Any], path: Path) -> None:
    """Queries in the first row, each encoder's nearest neighbors below with distances; settings side by side.

    :param results: of :func:`~sb3_abisim.analysis.neighbors.neighbors`
    :param path: the PNG
    """
    plt = pyplot()
    observations = results["observations"]
    rows = list(next(iter(observations.values())))
    columns = [(setting, k) for setting, shown in observations.items() for k in range(len(shown["query"]))]
    unit = get_traits(results["env_id"]).length_unit
    figure, axes = plt.subplots(
        len(rows), len(columns), figsize=(1.2 * len(columns) + 0.4, 1.5 * len(rows) + 0.5), constrained_layout=True
    )
    for row, name in zip(axes, rows, strict=True):
        for axis, (setting, k) in zip(row, columns, strict=True):
            axis.imshow(_visible(observations[setting][name][k]))
            axis.set_xticks([])
            axis.set_yticks([])
            if name == "query":
                axis.set_title(setting, fontsize=7)
                continue
            example = results["settings"][setting][name]["examples"]
            agent = "" if not example["agent"] else f", {example['agent'][k]:.1f} {unit}"
            clip = "" if not example["same_clip"] else ("same clip" if example["same_clip"][k] else "other clip")
            axis.set_title(f"d {example['distance'][k]:.2f}{agent}\n{clip}", fontsize=6)
        row[0].set_ylabel(name.rsplit("/", 1)[-1].removesuffix(".safetensors"), fontsize=7)
    # One setting makes a narrow figure.
    gap = "\n" if len(observations) == 1 else " "
    with_agents = any(one["random pairs"]["agent"] is not None for one in results["settings"].values())
    agents = f"; {unit}: distance of the agents" if with_agents else ""
    figure.suptitle(
        f"Nearest states of other episodes, {results['env_id']} (d: distance of the embeddings,{gap}1 is the mean of "
        f"all neighbors{agents})",
        fontsize=8,
    )
    save(figure, path)
    _reduce_colors(path)


def _visible(observation: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Three channels, last: the first three, or of fewer the first one in gray."""
    channels = observation[:3] if len(observation) >= 3 else observation[:1].repeat(3, axis=0)
    return channels.transpose(1, 2, 0)


def _reduce_colors(path: Path) -> None:
    """Photographs and many panels make large PNGs; with a palette they take a third of that."""
    with needs_extra("plots", "a figure"):
        from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB").quantize(N_COLORS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    write_atomic(path, lambda file: small.save(file, "PNG", optimize=True))


def plot_probes(results: dict[str, Any], path: Path) -> None:
    """Bars of the score of every probe, with confidence intervals where there are several seeds.

    :param results: of :func:`~sb3_abisim.analysis.probes.probes`
    :param path: the PNG
    """
    plt = pyplot()
    groups = results["groups"]
    settings = next(iter(groups.values()))["scores"]
    # Of every target: what probes there are.
    kinds = list(next(iter(next(iter(settings.values())).values())))
    n = len(settings)
    figure, axes = plt.subplots(1, n, figsize=(max(6.0, 5.0 * n), 3.4), constrained_layout=True, squeeze=False)
    width = 0.8 / (len(groups) * len(kinds))
    for axis, (setting, names) in zip(axes[0], settings.items(), strict=True):
        for k, (objective, group) in enumerate(groups.items()):
            for j, kind in enumerate(kinds):
                scores = [group["scores"][setting][target][kind] for target in names]
                heights = [np.nan if score is None else max(score[0], -0.2) for score in scores]
                errors = [0.0 if score is None or score[1] is None else score[1] for score in scores]
                place = np.arange(len(names)) + (k * len(kinds) + j - (len(groups) * len(kinds) - 1) / 2) * width
                style = {"color": f"C{k}", "alpha": 0.5 if kind == "linear" else 1.0, "label": f"{objective}, {kind}"}
                axis.bar(place, heights, width, yerr=errors if any(errors) else None, **style)
        axis.set_xticks(range(len(names)), names)
        axis.set_title(setting, fontsize=9)
        axis.set_ylim(-0.2, 1.05)
        axis.grid(axis="y", alpha=0.3)
    axes[0, 0].set_ylabel("score (R², AUC, accuracy)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    # As many as fit on a line: the figure grows with its panels.
    ncols = 7 * axes.shape[1] // 2
    figure.legend(handles, labels, loc="outside lower center", ncols=ncols, fontsize=7)
    figure.suptitle(f"What probes read from the embedding, {results['env_id']}", fontsize=10)
    save(figure, path)


def plot_curves(results: dict[str, Any], path: Path) -> None:
    """The main pretraining curve of each encoder.

    :param results: of :func:`~sb3_abisim.analysis.curves.curves`
    :param path: the PNG
    """
    plt = pyplot()
    encoders = results["encoders"]
    n = len(encoders)
    figure, axes = plt.subplots(1, n, figsize=(3.6 * n, 2.9), constrained_layout=True, squeeze=False)
    for axis, (name, result) in zip(axes[0], encoders.items(), strict=True):
        term = result["term"]
        for split in ("eval", "train"):
            key = f"{split}/{term.split('/')[1]}"
            if key in result["curves"]:
                axis.plot(result["curves"]["n_updates"], result["curves"][key], marker=".", label=f"{split} episodes")
        axis.set(xlabel="updates", ylabel=term.split("/")[1])
        axis.set_title(short_name(name), fontsize=9)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.suptitle("Pretraining", fontsize=10)
    save(figure, path)


def plot_leak(results: dict[str, Any], path: Path) -> None:
    """How well each patch, by itself, predicts the action.

    :param results: of :func:`~sb3_abisim.analysis.leak.leak_maps`
    :param path: the PNG
    """
    plt = pyplot()
    audits = results["audits"]
    figure, axes = plt.subplots(1, len(audits), figsize=(3.6 * len(audits), 3.4), constrained_layout=True)
    for axis, (name, one) in zip(axes, audits.items(), strict=True):
        image = axis.imshow(as_array(one["scores"]), cmap=CMAP, vmin=0, vmax=1)
        verdict = "leak" if one["leaks"] else "no leak"
        axis.set_title(f"{name}\n{verdict}, best patch {np.max(one['scores']):.2f}", fontsize=9)
        axis.set_xticks([])
        axis.set_yticks([])
    figure.colorbar(image, ax=list(axes), shrink=0.8, label="score of one patch alone")
    figure.suptitle(f"Can the action be read from few pixels? {results['env_id']}", fontsize=10)
    save(figure, path)
