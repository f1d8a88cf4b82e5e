"""The figures of a report."""

import io
import itertools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_abisim.benchmark.report.groups import WITHOUT_SPLITS, Group
from sb3_abisim.benchmark.report.tables import Comparison, Row
from sb3_abisim.registry import get_traits, methods

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which color-blind readers can distinguish, and two more for whatever else is compared.
PALETTE = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31", "#7F7F7F",
)  # fmt: skip
GRAY = "#6b7280"
DPI = 150
MINUS = "\N{MINUS SIGN}"
_STYLE: Any = {
    "font.size": 10,
    # A label is a text, whatever it holds.
    "text.parse_math": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GRAY,
    "axes.labelcolor": "#374151",
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "xtick.color": GRAY,
    "ytick.color": GRAY,
    "axes.grid": True,
    "grid.color": "#e5e7eb",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def level_text(value: float) -> str:
    """A return as a reader sees it.

    :param value: four digits of it are enough
    """
    return f"{value:.4g}".replace("-", MINUS)


def threshold_text(row: Row) -> str:
    """A threshold as a reader sees it, with its return.

    :param row: of the table of thresholds
    """
    if isinstance(row["threshold"], str):
        return f"the final return of {row['threshold']} ({level_text(row['return'])})"
    return f"{100 * row['threshold']:g} % normalized return ({level_text(row['return'])})"


def split_order(comparison: Comparison, env_id: str) -> list[str]:
    """The splits that final models of an environment were evaluated on, the one for evaluation first.

    :param comparison: with final evaluations
    :param env_id: one of its environments
    """
    found = {row["split"] for row in comparison.final if row["env_id"] == env_id} - {*WITHOUT_SPLITS}
    known = [split for split in get_traits(env_id).splits if split in found]
    return known + sorted(found - {*known})


def plot(comparison: Comparison) -> dict[str, bytes]:
    """All figures that the comparison has numbers for.

    :param comparison: what to plot
    :return: name without ending to PNG file
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    labels = list(dict.fromkeys(label for groups in comparison.groups.values() for label in groups))
    labels.sort(key=lambda label: label != comparison.reference)
    colors = assign_colors(labels)
    images = {}
    functions = {
        "curves": _curves, "thresholds": _thresholds, "splits": _splits, "aggregates": _aggregates,
        "profiles": _profiles, "improvement": _improvement,
    }  # fmt: skip
    with plt.rc_context(_STYLE):
        for name, function in functions.items():
            figure = function(comparison, colors)
            if figure is not None:
                images[name] = _png(figure)
    return images


def plot_curves(comparison: Comparison, names: Mapping[str, str]) -> bytes:
    """The learning curves of some methods, under names for readers.

    :param comparison: what to plot
    :param names: label of a method to what the legend calls it, in the order of the legend
    :return: a PNG file
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context(_STYLE):
        return _png(_curves(comparison, assign_colors(list(names)), names))


def _png(figure: "Figure") -> bytes:
    import matplotlib.pyplot as plt

    buffer = io.BytesIO()
    # Without it the file holds matplotlib's version, and equal reports would differ.
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    plt.close(figure)
    return buffer.getvalue()


def assign_colors(labels: Sequence[str]) -> dict[str, str]:
    """To each method the same color in every report; variants of a method, and others, take what is left.

    :param labels: of the methods, the reference first
    :return: label to color
    """
    known = methods()
    names = [re.split("[=,]", label)[0] for label in labels]
    colors = {name: known[name].color for name in names if name in known}
    taken = {name: color for name, color in colors.items() if color is not None}
    spare = itertools.cycle([color for color in PALETTE if color not in taken.values()])
    pairs = zip(labels, names, strict=True)
    return {label: taken.pop(name) if name in taken else next(spare) for label, name in pairs}


def _curves(comparison: Comparison, colors: dict[str, str], names: Mapping[str, str] | None = None) -> "Figure":
    import matplotlib.pyplot as plt

    n = len(comparison.groups)
    figure, axes = plt.subplots(1, n, figsize=(max(6.4, 4.4 * n), 4.0), squeeze=False)
    for axis, (env_id, groups) in zip(axes[0], comparison.groups.items(), strict=True):
        # The reference last, so that it lies on top.
        for label in reversed([label for label in groups if label in colors]):
            rows = [row for row in comparison.curves if (row["env_id"], row["method"]) == (env_id, label)]
            steps, mean, low, high = (np.array([row[key] for row in rows]) for key in ("steps", "mean", "low", "high"))
            width = 2.4 if label == comparison.reference else 1.6
            # A single evaluation makes no line.
            axis.plot(steps, mean, "-o" if len(steps) == 1 else "-", color=colors[label], lw=width, label=label)
            axis.fill_between(steps, low, high, color=colors[label], alpha=0.18, lw=0)
        _show_possible(axis, next(iter(groups.values())))
        axis.set(title=env_id, xlabel="environment steps")
        axis.xaxis.set_major_formatter(_short_number)
        axis.locator_params(axis="x", nbins=5)
    axes[0, 0].set_ylabel("return")
    handles = {label: line for axis in axes[0] for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    # About 0.7 inches for an entry's line and 0.1 for each letter; what does not fit into one row takes several.
    shown = [(names or {}).get(label, label) for label in colors]
    per_row = int(figure.get_figwidth() / (0.7 + 0.1 * max(map(len, shown))))
    ncols = max(1, min(per_row, len(colors)))
    # Above the legend, the curves keep their height.
    figure.set_figheight(3.4 + 0.22 * -(-len(colors) // ncols))
    figure.legend([handles[label] for label in colors], shown, loc="outside lower center", ncols=ncols)
    return figure


def _show_possible(axis: "Axes", group: Group) -> None:
    """Cut intervals where returns end: Student's t knows of no bounds."""
    if group.high == 0:
        axis.set_ylim(group.low * 1.02, 1)


def _short_number(value: float, _: int = 0) -> str:
    for unit, name in ((1e6, " M"), (1e3, " k")):
        if abs(value) >= unit:
            return f"{value / unit:g}{name}"
    return f"{value:g}"


def _thresholds(comparison: Comparison, colors: dict[str, str]) -> "Figure | None":
    rows = [row for row in comparison.thresholds if np.isfinite(row["ratio"]) and row["baseline"] in colors]
    rows = [row for row in rows if row["baseline"] != comparison.reference]
    if not rows:
        return None
    import matplotlib.pyplot as plt

    env_ids = list(dict.fromkeys(row["env_id"] for row in rows))
    most = max(sum(row["env_id"] == env_id for row in rows) for env_id in env_ids)
    size = (max(6.4, 4.4 * len(env_ids)), 1.6 + 0.34 * most)
    figure, axes = plt.subplots(1, len(env_ids), figsize=size, squeeze=False)
    for axis, env_id in zip(axes[0], env_ids, strict=True):
        shown = [row for row in rows if row["env_id"] == env_id]
        for y, row in enumerate(shown):
            _interval(axis, y, row["ratio"], row["low"], row["high"], colors[row["baseline"]], row["bound"])
        axis.axvline(1, color=GRAY, lw=1)
        names = [f"{row['baseline']}, to {_short_threshold(row)}" for row in shown]
        axis.set_yticks(range(len(shown)), names)
        axis.set_xscale("log")
        axis.set_xlim(*_log_limits([row[key] for row in shown for key in ("ratio", "low", "high")]))
        axis.set_xticks(
            [tick for tick in (0.1, 0.2, 0.5, 1, 2, 5, 10) if axis.get_xlim()[0] <= tick <= axis.get_xlim()[1]]
        )
        axis.xaxis.set_major_formatter(_short_number)
        axis.xaxis.set_minor_formatter(lambda value, position: "")
        xlabel = f"steps of {comparison.reference} / steps of the baseline"
        axis.set(title=env_id, ylim=(len(shown) - 0.4, -0.6), xlabel=xlabel)
        axis.grid(axis="y", visible=False)
    return figure


def _short_threshold(row: Row) -> str:
    if row["threshold"] == row["baseline"]:
        return f"its final return ({level_text(row['return'])})"
    return threshold_text(row).replace(" normalized return", "")


def _log_limits(values: Sequence[float]) -> tuple[float, float]:
    finite = [value for value in values if np.isfinite(value) and value > 0]
    return min(0.45, 0.85 * min(finite)), max(2.2, 1.15 * max(finite))


def _interval(axis: "Axes", y: float, value: float, low: float, high: float, color: str, bound: str = "") -> None:
    if np.isfinite(low):
        axis.plot([low, high], [y, y], color=color, lw=3, alpha=0.35, solid_capstyle="round")
    # A hollow mark: a bound, not an estimate.
    axis.plot([value], [y], "o", color=color, ms=7, mfc="white" if bound else color, mew=2)


def _splits(comparison: Comparison, colors: dict[str, str]) -> "Figure | None":
    orders = {env_id: split_order(comparison, env_id) for env_id in comparison.groups}
    orders = {env_id: order for env_id, order in orders.items() if order}
    if not orders:
        return None
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(orders), figsize=(max(6.4, 5.6 * len(orders)), 4), squeeze=False)
    for axis, (env_id, order) in zip(axes[0], orders.items(), strict=True):
        rows = [row for row in comparison.final if row["env_id"] == env_id and row["mode"] == "deterministic"]
        rows = [row for row in rows if row["split"] in order]
        labels = [label for label in colors if any(row["method"] == label for row in rows)]
        for i, label in enumerate(labels):
            found = {row["split"]: row for row in rows if row["method"] == label}
            x = [order.index(split) + 0.7 * ((i + 0.5) / len(labels) - 0.5) for split in found]
            means, halves = ([row[key] for row in found.values()] for key in ("mean", "half_width"))
            axis.errorbar(x, means, yerr=np.nan_to_num(halves), fmt="o", ms=7, lw=2.5, color=colors[label], label=label)
        for k in range(1, len(order)):
            axis.axvline(k - 0.5, color="#e5e7eb", lw=1)
        axis.set_xticks(range(len(order)), order)
        axis.set(title=env_id, ylabel="return of the final model", xlim=(-0.5, len(order) - 0.5))
        _show_possible(axis, comparison.groups[env_id][labels[0]])
        axis.grid(axis="x", visible=False)
        axis.legend(loc="best")
    return figure


def _aggregates(comparison: Comparison, colors: dict[str, str]) -> "Figure | None":
    titles = {"final": "IQM of the final score", "area": "IQM of the score over all of training"}
    return _forest(comparison.aggregates, "score", titles, ("method", "iqm"), colors, "normalized return")


def _improvement(comparison: Comparison, colors: dict[str, str]) -> "Figure | None":
    rows = [{**row, "all": "all"} for row in comparison.improvement]
    title = {"all": f"Probability that {comparison.reference} ends higher than"}
    figure = _forest(rows, "all", title, ("baseline", "probability"), colors, "probability")
    if figure is not None:
        figure.axes[0].axvline(0.5, color=GRAY, lw=1)
    return figure


def _forest(
    rows: list[Row], panel_key: str, titles: dict[str, str], keys: tuple[str, str], colors: dict[str, str], unit: str
) -> "Figure | None":
    """Values with intervals below each other; a panel for each value of ``panel_key``."""
    if not rows:
        return None
    import matplotlib.pyplot as plt

    name, value = keys
    n = max(sum(row[panel_key] == panel for row in rows) for panel in titles)
    figure, axes = plt.subplots(1, len(titles), figsize=(5.2 * len(titles), 1.3 + 0.36 * n), squeeze=False)
    for axis, (panel, title) in zip(axes[0], titles.items(), strict=True):
        shown = [row for row in rows if row[panel_key] == panel]
        for y, row in enumerate(shown):
            _interval(axis, y, row[value], row["low"], row["high"], colors[row[name]])
        axis.set_yticks(range(len(shown)), [row[name] for row in shown])
        axis.set(title=title, xlim=(-0.02, 1.02), ylim=(len(shown) - 0.4, -0.6), xlabel=unit)
        axis.grid(axis="y", visible=False)
    return figure


def _profiles(comparison: Comparison, colors: dict[str, str]) -> "Figure | None":
    if not comparison.profiles:
        return None
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6.4, 4))
    for label, color in reversed(colors.items()):
        rows = [row for row in comparison.profiles if row["method"] == label]
        columns: list[Any] = [[row[key] for row in rows] for key in ("score", "share", "low", "high")]
        axis.plot(columns[0], columns[1], color=color, lw=2, label=label)
        axis.fill_between(columns[0], columns[2], columns[3], color=color, alpha=0.18, lw=0)
    axis.set(
        xlabel="normalized return of the final model", ylabel="share of runs above it", xlim=(0, 1), ylim=(-0.02, 1.02)
    )
    axis.legend(*(reversed(part) for part in axis.get_legend_handles_labels()), loc="upper right")
    return figure
