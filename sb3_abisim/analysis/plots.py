"""The figures, plotted from the numbers that the other modules of this folder compute. Needs the extra ``plots``."""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.files import write_atomic

DPI = 90
CMAP = "inferno"
COLORS = {"agent": (214, 40, 40), "obstacles": (60, 64, 72), "floor": (240, 240, 235), "goal": (46, 160, 67)}


def pyplot() -> Any:
    """Matplotlib's pyplot, without a window where the user has not imported it before, as a notebook has.

    :raises ImportError: if matplotlib is not installed
    """
    with needs_extra("plots", "a figure"):
        import matplotlib
    if "matplotlib.pyplot" not in sys.modules:
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def save(figure: Any, path: Path) -> None:
    """Write a figure as PNG and close it.

    :param figure: of matplotlib
    :param path: the PNG; its folder is made
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Without the version of matplotlib, so that equal figures are equal files.
    write_atomic(path, lambda file: figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None}))
    pyplot().close(figure)


def as_array(values: Iterable[Any]) -> NDArray[np.float64]:
    """Nested lists with None for missing numbers, as an array with NaN.

    :param values: numbers or None
    """
    return np.array(values, dtype=np.float64)


def short_name(name: str) -> str:
    """An encoder's name in a title: the last two parts of a path, without ending.

    :param name: as the user gave it
    """
    return "/".join(Path(name).with_suffix("").parts[-2:]) if name.endswith(".safetensors") else name


def _bin_names(bins: Iterable[tuple[float, float]]) -> list[str]:
    return [f"{low:g}" if low == high else f"{low:g}-{high:g}" for low, high in bins]


def show_map(axis: Any, values: NDArray[np.float64], title: str, reach: int, unit: str) -> Any:
    """Plot a map by offset around the agent, brightness relative to its largest value.

    :param axis: of matplotlib
    :param values: [dy, dx], odd sides, the agent in the middle
    :param title: of the panel
    :param reach: largest offset shown
    :param unit: of the offsets, in the plural
    """
    size = values.shape[0] // 2
    image = axis.imshow(
        values / np.nanmax(values), cmap=CMAP, vmin=0, vmax=1, extent=(-size - 0.5, size + 0.5, size + 0.5, -size - 0.5)
    )
    axis.set_facecolor("0.6")
    axis.set(xlim=(-reach - 0.5, reach + 0.5), ylim=(reach + 0.5, -reach - 0.5), xlabel=f"{unit} from the agent")
    axis.set_title(title, fontsize=9)
    return image


def show_profiles(axis: Any, lines: dict[str, list[float]], bins: Any, xlabel: str) -> None:
    """Plot sensitivity by distance on a logarithmic scale.

    :param axis: of matplotlib
    :param lines: label to a number for each bin
    :param bins: (low, high) of each
    :param xlabel: of the axis
    """
    for style, (name, values) in enumerate(lines.items()):
        axis.semilogy(as_array(values), marker="osv^Dx*"[style % 7], ms=4, label=name)
    names = _bin_names(bins)
    axis.set_xticks(range(len(names)), names, fontsize=8)
    axis.set(xlabel=xlabel, ylabel="change of the embedding")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7)


def plot_maps(results: dict[str, Any], path: Path) -> None:
    """Perturbation maps in a row, and their profiles.

    :param results: of :func:`~sb3_abisim.analysis.perturbation.nav2d_maps`
    :param path: the PNG
    """
    plt = pyplot()
    encoders = results["encoders"]
    n = len(encoders)
    figure, axes = plt.subplots(1, n + 1, figsize=(3.1 * (n + 1) + 1, 3.4), constrained_layout=True)
    for axis, (name, result) in zip(axes, encoders.items(), strict=False):
        image = show_map(axis, as_array(result["map"]), short_name(name), 7, "cells")
    figure.colorbar(image, ax=list(axes[:n]), shrink=0.8, label="relative to the largest")
    lines = {short_name(name): result["profile"] for name, result in encoders.items()}
    show_profiles(axes[n], lines, results["bins"], "city-block distance")
    figure.suptitle(f"Change of the embedding when one cell is toggled, {results['env_id']}", fontsize=10)
    save(figure, path)


def plot_sweep(results: dict[str, Any], path: Path) -> None:
    """Learned maps over exact ones, a column for each c, and the profiles of both.

    :param results: of :func:`~sb3_abisim.analysis.perturbation.sweep_maps`
    :param path: the PNG
    """
    plt = pyplot()
    encoders = results["encoders"]
    n = len(encoders)
    figure, axes = plt.subplots(2, n + 1, figsize=(2.6 * n + 4.4, 6.0), constrained_layout=True)
    for row, (key, label) in enumerate((("", "learned"), ("exact_", "exact metric"))):
        for axis, (name, result) in zip(axes[row], encoders.items(), strict=False):
            show_map(axis, as_array(result[f"{key}map"]), f"{label}, {name}", 7, "cells")
        lines = {name: result[f"{key}profile"] for name, result in encoders.items()}
        show_profiles(axes[row, n], lines, results["bins"], "city-block distance")
        axes[row, n].set_title(label, fontsize=9)
        axes[row, n].set_ylim(1e-3, 1.3)
    figure.suptitle("Action-bisimulation with several weights c of the recursive term, Nav2D-v0", fontsize=10)
    save(figure, path)


def plot_near_and_far(results: dict[str, Any], path: Path) -> None:
    """Violins of near and far changes, and the regions.

    :param results: of :func:`~sb3_abisim.analysis.perturbation.near_and_far`
    :param path: the PNG
    """
    plt = pyplot()
    encoders = results["encoders"]
    n = len(encoders)
    figure, axes = plt.subplots(1, n + 1, figsize=(3.0 * n + 3.4, 3.4), constrained_layout=True)
    for axis, (name, result) in zip(axes, encoders.items(), strict=False):
        axis.violinplot([result["near"], result["far"]], showmedians=True)
        axis.set_xticks([1, 2], ["near", "far"])
        axis.set_title(f"{short_name(name)}\nnear > far in {result['near_share']:.0%}", fontsize=9)
        # A scale for each: an obstacle counts ten times as much where observations are reconstructed.
        axis.set_ylim(bottom=0)
        axis.grid(axis="y", alpha=0.3)
    axes[0].set_ylabel("change of the embedding\n(1: the agent elsewhere)")
    _show_regions(axes[n], results)
    figure.suptitle(f"A new 2 x 2 obstacle near the agent or far from it, {results['env_id']}", fontsize=10)
    save(figure, path)


def _show_regions(axis: Any, results: dict[str, Any]) -> None:
    obstacles = np.array(results["example"]["obstacles"])
    x, y = results["example"]["agent"]
    size = len(obstacles)
    distance = np.maximum(np.abs(np.arange(size)[:, None] - y), np.abs(np.arange(size)[None] - x))
    image = np.full((size, size, 3), 1.0)
    image[distance <= results["near_reach"]] = (1.0, 0.80, 0.45)
    image[distance >= results["far_reach"]] = (0.70, 0.85, 1.0)
    for name, where in (("obstacles", obstacles), ("goal", np.zeros_like(obstacles)), ("agent", distance == 0)):
        image[where] = np.array(COLORS[name]) / 255
    image[size // 2, size // 2] = np.array(COLORS["goal"]) / 255
    axis.imshow(image)
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_title("regions: near (orange), far (blue)", fontsize=9)


def plot_structures(results: dict[str, Any], path: Path) -> None:
    """Sensitivity to each cell of a fixed structure, and its profiles by kind of cell.

    :param results: of :func:`~sb3_abisim.analysis.perturbation.structure_maps`
    :param path: the PNG
    """
    plt = pyplot()
    encoders = results["encoders"]
    n = len(encoders)
    structure = np.array([list(row) for row in results["structure"]])
    figure, axes = plt.subplots(2, n + 1, figsize=(2.9 * (n + 1), 6.0), constrained_layout=True, squeeze=False)
    kinds = np.select([structure == "#", structure == "?"], [0.0, 0.5], 1.0)
    axes[0, 0].imshow(kinds, cmap="gray", vmin=0, vmax=1)
    axes[0, 0].set_title("reachable (white), walls (black),\nout of reach (gray)", fontsize=9)
    axes[1, 0].axis("off")
    for k, (name, result) in enumerate(encoders.items(), start=1):
        cells = as_array(result["cells"])
        axes[0, k].imshow(cells / np.nanmax(cells), cmap=CMAP, vmin=0, vmax=1)
        axes[0, k].set_facecolor("0.6")
        outside = result["kinds"]["out of reach"]
        axes[0, k].set_title(f"{short_name(name)}\nout of reach: {outside:.2f} of reachable", fontsize=8)
        show_profiles(axes[1, k], result["profiles"], results["bins"], "city-block distance")
    for axis in axes[0]:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(f"Mean change of the embedding when a cell is toggled, {results['env_id']}", fontsize=10)
    save(figure, path)
