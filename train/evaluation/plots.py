"""Pictures of an evaluation: coverage over time, times to 90 %, and a radar of what else counts."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.sim.twin import TICK_S
from imagine.train.atomic_file import write_atomically
from imagine.train.evaluation.comparison import Comparison
from imagine.train.evaluation.plan import ALL_LEVELS, Group
from imagine.train.evaluation.radar import AXES, radar_of
from imagine.train.evaluation.rows import held_curves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_PANELS = 12  # more levels than this are drawn as one: nobody reads forty small panels
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, told apart by colour-blind eyes, the strongest on white first."""
_REFERENCE = "#7A7A7A"
_DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)))
_LETTERS_AN_INCH = 13.5  # of the line under a title
_RESAMPLES = 400  # of whole curves, for bands: enough for what a pixel shows


def check_plots(folder: Path) -> None:
    """Raise InputError where no pictures can be drawn into this folder, which need not be there yet."""
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError("--plots needs matplotlib: pip install matplotlib")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--plots {folder}: is a file; name a folder")
    there = folder if folder.exists() else folder.absolute().parent
    if not there.is_dir():
        raise InputError(f"--plots {folder}: the folder it would lie in does not exist")
    if not os.access(there, os.W_OK):
        raise InputError(f"--plots {folder}: cannot be written: no permission")


def write_plots(comparison: Comparison, folder: Path) -> list[Path]:
    """Draw a finished comparison, each team size and protocol by itself; return the files, PNGs, that were written.

    Raises WorkError where one cannot be written.
    """
    groups = list(comparison.plan.groups())
    written = []
    for group in groups:
        suffix = f"-{group.drones}-{group.protocol}" if len(groups) > 1 else ""
        drawings = {
            "coverage": coverage_figure(comparison, group),
            "t90": t90_figure(comparison, group),
            "radar": radar_figure(comparison, group),
        }
        for name, figure in drawings.items():
            path = folder / f"{name}{suffix}.png"
            _save(figure, path)
            written.append(path)
    return written


def coverage_figure(comparison: Comparison, group: Group) -> Figure:
    """Return mean coverage over time, a panel a level and a line a policy, with 95 % bootstrap bands of the mean."""
    levels = panels_of(comparison)
    columns = min(4, len(levels))
    rows = math.ceil(len(levels) / columns)
    size = (3.1 * columns + 0.6, 2.7 * rows + 1.0) if len(levels) > 1 else (6.0, 4.4)
    figure = _figure(*size, "Coverage over time", comparison, group, "mean and its 95 % interval")
    panels = np.atleast_1d(figure.subplots(rows, columns, sharey=True, squeeze=False)).ravel()
    for panel, level in zip(panels, levels, strict=False):
        flown = [comparison.by_level(who, group, level) for who in range(len(comparison.contenders))]
        longest = max(episode.ticks for levels_flown in flown for episodes in levels_flown for episode in episodes)
        drawn = [[held_curves(episodes, longest) for episodes in levels_flown] for levels_flown in flown]
        means = []
        for who, curves in enumerate(drawn):
            mean, low, high = curve_band(curves, comparison.plan.seed)
            means.append(mean)
            seconds = np.arange(1, longest + 1) * TICK_S
            colour, dash = _style(comparison, who)
            panel.fill_between(seconds, low, high, color=colour, alpha=0.18, lw=0)
            panel.plot(seconds, mean, color=colour, ls=dash, lw=1.8, label=comparison.contenders[who].name)
        panel.axhline(0.9, color="#bbbbbb", lw=0.8, zorder=0)
        panel.set_xlim(0, telling_ticks(means) * TICK_S)
        panel.set_ylim(0, 1.02)
        panel.set_title(_level_title(comparison, level), fontsize=10, loc="left")
        _plain(panel)
    for number, panel in enumerate(panels):
        if number >= len(levels):
            panel.set_axis_off()
        elif number + columns >= len(levels):
            panel.set_xlabel("time, s")
        if number % columns == 0:
            panel.set_ylabel("coverage")
    _legend(figure, panels[0])
    return figure


def t90_figure(comparison: Comparison, group: Group) -> Figure:
    """Return mean times to 90 % coverage as bars, levels side by side, with 95 % bootstrap intervals of the mean."""
    levels = panels_of(comparison)
    if len(comparison.plan.levels) > 1 and levels != [ALL_LEVELS]:
        levels = [*levels, ALL_LEVELS]
    count = len(comparison.contenders)
    figure = _figure(
        max(4.5, 1.2 + len(levels) * (0.35 + 0.32 * count)),
        4.2,
        "Time to 90 % coverage, less is better",
        comparison,
        group,
    )
    axes = figure.subplots()
    width = 0.8 / count
    rows = {(row["policy"], row["level"]): row for row in comparison.rows if _belongs(row, group)}
    for who, contender in enumerate(comparison.contenders):
        told = [rows[contender.name, level] for level in levels]
        heights = np.array([row["t90_mean"] for row in told]) * TICK_S
        ends = np.array([row["t90_ci95"] for row in told]).T * TICK_S
        places = np.arange(len(levels)) + (who - (count - 1) / 2) * width
        colour, _ = _style(comparison, who)
        errors = np.maximum(0.0, np.stack((heights - ends[0], ends[1] - heights)))
        axes.bar(places, heights, 0.92 * width, color=colour, label=contender.name)
        axes.errorbar(places, heights, errors, fmt="none", ecolor="#222222", elinewidth=1.1, capsize=2.5)
        for place, top, row in zip(places, ends[1], told, strict=True):
            if row["paired"] is not None:
                ratio = f"×{row['paired']['t90_ratio']:.2f}"
                axes.annotate(
                    ratio, (place, top), (0, 3), textcoords="offset points", ha="center", fontsize=7.5, color="#333333"
                )
    axes.set_xticks(range(len(levels)), [_level_title(comparison, level).removeprefix("level ") for level in levels])
    axes.set_xlabel("level")
    axes.set_ylabel("mean time, s")
    axes.margins(y=0.1)
    _plain(axes)
    axes.grid(axis="x", visible=False)
    if comparison.reference is not None:
        name = comparison.contenders[comparison.reference].name
        axes.text(
            1.0, 1.01, f"×: mean time relative to {name} in the same episodes", transform=axes.transAxes, ha="right",
            fontsize=8, color="#555555",
        )  # fmt: skip
    _legend(figure, axes)
    return figure


def radar_figure(comparison: Comparison, group: Group) -> Figure:
    """Return a radar of six qualities over all levels, 0 at the centre and 1 outside; see `radar.radar_of`."""
    level = ALL_LEVELS if len(comparison.plan.levels) > 1 else comparison.plan.levels[0]
    rows = [row for row in comparison.rows if _belongs(row, group) and row["level"] == level]
    figure = _figure(
        6.0, 6.2, "Six qualities, outside is better", comparison, group, "speed and bytes relative to the best shown"
    )
    axes = figure.add_subplot(polar=True)
    angles = np.linspace(0.0, 2.0 * np.pi, len(AXES), endpoint=False)
    for who, values in enumerate(radar_of(rows)):
        colour, dash = _style(comparison, who)
        loop = np.append(values, values[0])
        axes.plot([*angles, angles[0]], loop, color=colour, ls=dash, lw=1.8, label=rows[who]["policy"])
        axes.fill([*angles, angles[0]], loop, color=colour, alpha=0.05)
    set_up: Any = axes
    set_up.set_theta_offset(np.pi / 2)
    set_up.set_theta_direction(-1)
    set_up.set_rlabel_position(30)
    axes.set_xticks(angles, AXES, fontsize=9)
    for angle, text in zip(angles, axes.get_xticklabels(), strict=True):  # outwards from the ring, clear of it
        text.set_horizontalalignment(
            "center" if np.isclose(np.sin(angle), 0.0) else "left" if angle < np.pi else "right"
        )
    axes.set_ylim(0, 1)
    axes.set_yticks([0.25, 0.5, 0.75, 1.0], ["", "0.5", "", "1"], fontsize=7, color="#777777")
    axes.grid(color="#dddddd")
    axes.spines["polar"].set_color("#bbbbbb")
    _legend(figure, axes)
    return figure


def panels_of(comparison: Comparison) -> list[str]:
    """Return the levels that get a panel each; all together where they are too many."""
    levels = list(comparison.plan.levels)
    return levels if len(levels) <= _MOST_PANELS else [ALL_LEVELS]


def telling_ticks(means: Sequence[NDArray[np.float64]]) -> int:
    """Return how many ticks of everyone's mean curves, each `[ticks]`, are worth showing.

    That is until the last of those who see nearly all has done so; those who never do would leave the others a margin.
    """
    settled = [int(np.argmax(mean >= mean[-1] - 0.003)) + 1 for mean in means if mean[-1] >= 0.9]
    longest = len(means[0])
    return min(longest, round(1.15 * max(settled)) + 1) if settled else longest


def curve_band(levels: Sequence[NDArray[np.float32]], seed: int) -> tuple[NDArray[np.float64], ...]:
    """Return the mean of curves, and the ends of its 95 % bootstrap interval, `[ticks]` each.

    Curves come level by level, `[episodes, ticks]` each; levels count alike, and each is resampled for itself, as in
    `rows.bootstrap_interval`.
    """
    rng = np.random.default_rng(seed)
    means = np.zeros((_RESAMPLES, levels[0].shape[1]))
    for curves in levels:
        count = len(curves)
        # how often each episode is drawn, as weights: a matrix product instead of gathering curves again and again
        weights = rng.multinomial(count, np.full(count, 1.0 / count), _RESAMPLES) / count
        means += weights @ curves / len(levels)
    low, high = np.percentile(means, [2.5, 97.5], axis=0)
    return np.mean([curves.mean(axis=0, dtype=np.float64) for curves in levels], axis=0), low, high


def _belongs(row: dict[str, Any], group: Group) -> bool:
    return bool(row["drones"] == group.drones and row["protocol"] == group.protocol)


def _level_title(comparison: Comparison, level: str) -> str:
    if level == ALL_LEVELS:
        return f"all {len(comparison.plan.levels)} levels"
    name = Path(level).stem if "/" in level else level
    return f"level {name if len(name) <= 14 else name[:8] + '..' + name[-4:]}"


def _style(comparison: Comparison, who: int) -> tuple[str, Any]:
    """Return a contender's colour and dashes; the reference is grey."""
    if who == comparison.reference:
        return _REFERENCE, "-"
    others = [number for number in range(len(comparison.contenders)) if number != comparison.reference]
    place = others.index(who)
    return _COLOURS[place % len(_COLOURS)], _DASHES[place % len(_DASHES)]


def _figure(width: float, height: float, title: str, comparison: Comparison, group: Group, note: str = "") -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    plan = comparison.plan
    team = "1 drone" if group.drones == 1 else f"{group.drones} drones"
    launch = ", random launches" if plan.launch == "random" else ""
    words = [f"{team}, {group.protocol}, {plan.episodes} episodes a level{launch}", *([note] if note else [])]
    joined = "; ".join(words)
    lines = [joined] if len(joined) <= _LETTERS_AN_INCH * width else words
    figure.suptitle(title + "\n" * len(lines), x=0.01, ha="left", fontsize=12, fontweight="bold")
    for number, line in enumerate(lines):
        figure.text(
            0.01, 1.0 - (0.42 + 0.18 * number) / height, line, ha="left", va="center", fontsize=9, color="#555555"
        )
    return figure


def _plain(axes: Axes) -> None:
    axes.grid(color="#e6e6e6", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    columns = min(4, len(labels))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def _save(figure: Figure, path: Path) -> None:
    write_atomically(path, lambda temporary: figure.savefig(temporary, format="png"))
