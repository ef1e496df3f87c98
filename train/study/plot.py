"""Draws a study's conditions against each other: a bar each, with its interval over repeats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from imagine.train.atomic_file import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TITLES = {"coverage": "coverage", "t90": "T90, ticks", "contacts": "contacts an episode"}
_BAR, _BEST, _DOT = "#9db8cf", "#1b6ca8", "#333333"
_MOST = 60  # bars in one picture
_LABEL = 44  # characters


def plot_summary(path: Path, data: dict[str, Any]) -> None:
    """Write a PNG of `results.study_data`: conditions from best to worst, a panel for each metric.

    Bars are means over repeats, whiskers their 95 % intervals, dots the repeats. Draws nothing where no trial has
    numbers; of very many conditions the best. Raises WorkError where the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    conditions = [row for row in data["conditions"] if row[data["metric"]] is not None]
    shown = conditions[:_MOST]
    if not shown:
        return
    figure = Figure(figsize=(12.5, 1.6 + 0.3 * len(shown)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    best = "" if len(shown) == len(conditions) else f", the best {len(shown)} of {len(conditions)}"
    repeats = max(row["trials"] for row in shown)
    told = f"means over {repeats} seeds with 95% intervals" if repeats > 1 else "one seed each"
    figure.suptitle(f"Study {data['study']}: {told}{best}", x=0.01, ha="left", fontsize=12)
    panels = figure.subplots(1, len(_TITLES), sharey=True)
    for axes, (metric, title) in zip(panels, _TITLES.items(), strict=True):
        _bars(axes, metric, shown, data)
        way = f", {'more' if data['mode'] == 'max' else 'less'} is better" if metric == data["metric"] else ""
        axes.set_title(title + way, loc="left", fontsize=10)
    labels = [_cut(row["condition"]) for row in shown]
    panels[0].set_yticks(range(len(shown)), labels, fontsize=8.5)
    panels[0].invert_yaxis()
    write_atomically(path, lambda file: figure.savefig(file, format="png"))


def _bars(axes: Axes, metric: str, shown: list[dict[str, Any]], data: dict[str, Any]) -> None:
    for place, row in enumerate(shown):
        if row[metric] is None:
            continue
        axes.barh(place, row[metric], height=0.66, color=_BEST if place == 0 else _BAR)
        values = [
            trial[metric]
            for trial in data["trials"]
            if trial["condition"] == row["condition"] and trial[metric] is not None
        ]
        if len(values) > 1:
            axes.plot(values, [place] * len(values), "o", ms=3.2, color=_DOT, alpha=0.6)
        interval = row[f"{metric}_ci95"]
        if interval is not None:
            axes.hlines(place, *interval, color=_DOT, lw=1.3)
            axes.vlines(interval, place - 0.16, place + 0.16, color=_DOT, lw=1.3)
    # An interval may reach beyond what there can be: there it is cut.
    nothing = all(not row[metric] for row in shown)
    axes.set_xlim(0.0, 1.02 if metric == "coverage" else 1.0 if nothing else axes.get_xlim()[1])
    axes.grid(True, axis="x", color="#e6e6e6", lw=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(axis="y", length=0)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _cut(text: str) -> str:
    return text if len(text) <= _LABEL else text[: _LABEL - 1] + "…"
