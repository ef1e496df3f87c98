"""The curves of a run, drawn from its metrics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.train.tracking.json_lines import read_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Curves = Mapping[str, NDArray[np.float64]]

_COLOURS = ("#1b6ca8", "#c8553d", "#3a7d44", "#8e5aa8", "#c28f1c", "#4aa3a2", "#a83f6a", "#6b6b6b")
_TITLE_ROOM = 75  # letters above a panel
_SMOOTH_SHARE = 0.02  # of the run's updates; the raw numbers stay visible behind


def plot_run(run_folder: Path, png: Path) -> None:
    """Write a PNG of a run's training: coverage and T90 by level, losses, divergence, explained variance, speed.

    The horizontal axis is agent-steps; imitation has a grey ground. Raises InputError where the run has no metrics,
    matplotlib is missing, or the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError("drawing curves needs matplotlib: pip install matplotlib") from error
    steps, curves = read_curves(run_folder)
    figure = Figure(figsize=(14.0, 7.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"Training of {run_folder.resolve().name}", x=0.01, ha="left", fontsize=13)
    panels = figure.subplots(2, 3)
    unit, unit_name = (1e6, "millions") if steps[-1] >= 100_000 else (1e3, "thousands")
    x = steps / unit
    for axes in panels.flat:
        axes.axvspan(0.0, _end_of_imitation(steps, curves) / unit, color="#f0f0f0", lw=0, zorder=0)
    coverage, t90, losses, divergence, explained, speed = panels.flat

    levels = levels_of(curves)
    _draw(coverage, x, {level: curves[f"episode/{level}/coverage"] for level in levels}, smooth=False)
    _finish(coverage, "coverage by level", legend=True)
    times = _named(curves, {f"episode/{level}/t90": level for level in levels})
    _draw(t90, x, times, smooth=False)
    middles = [np.nanmedian(values) for values in times.values()]
    if middles and np.isfinite(middles).any():
        t90.set_ylim(0.0, 1.4 * np.nanmax(middles))  # whoever has just begun is far above, and hides what comes of it
    _finish(t90, "ticks to 90 % by level", legend=False)
    _draw(losses, x, _named(curves, {"imitation/loss": "imitation", "ppo/value_loss": "value"}))
    _positive_log(losses)
    policy = _right_of(losses)
    _draw(policy, x, _named(curves, {"ppo/policy_loss": "policy (right)"}), first=2)
    _finish(losses, "losses", also=policy)
    _draw(divergence, x, _named(curves, {"ppo/kl": "KL divergence"}))
    clipped = _right_of(divergence)
    _draw(clipped, x, _named(curves, {"ppo/clipped_share": "clipped share (right)"}), first=1)
    for side in (divergence, clipped):
        side.set_ylim(bottom=0.0)
    _finish(divergence, "moves of the policy", also=clipped)
    _draw(explained, x, _named(curves, {"ppo/explained_variance": "explained variance"}))
    explained.axhline(1.0, color="#cccccc", lw=0.8, zorder=0)
    values = curves.get("ppo/explained_variance", np.empty(0))
    if np.isfinite(values).any():  # the first values of a fresh critic would flatten all that follow
        explained.set_ylim(max(-1.0, float(np.nanmin(values))) - 0.05, 1.05)
    _finish(explained, "foresight of the values")
    _draw(speed, x, _named(curves, {"speed/agent_steps_per_s": "agent-steps a second"}))
    speed.set_ylim(bottom=0.0)
    _finish(speed, "speed")
    for axes in panels[1]:
        axes.set_xlabel(f"agent-steps, {unit_name}")
    for axes in panels.flat:
        axes.set_xlim(0.0, float(x[-1]))
    try:
        figure.savefig(png)
    except OSError as error:
        raise InputError(f"{png}: the plot cannot be written: {error.strerror}") from error


def read_curves(run_folder: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Return a run's agent-steps `[updates]` and every scalar by name `[updates]`, nan where it was not told.

    Raises InputError where the folder has no metrics.
    """
    path = run_folder / "metrics.jsonl"
    try:
        rows = read_rows(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}; give the folder of a run") from error
    if not rows:
        raise InputError(f"{path}: no update is in it yet")
    names = dict.fromkeys(name for row in rows for name, value in row.items() if isinstance(value, int | float))
    curves = {name: np.array([_number(row.get(name)) for row in rows]) for name in names}
    return curves.pop("agent_steps"), curves


def levels_of(curves: Curves) -> list[str]:
    """Return the levels that a run has curves of, in order."""
    return sorted({name.split("/")[1] for name in curves if name.startswith("episode/") and name.endswith("/coverage")})


def smoothed(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return the mean of the last `width` values at each place `[n]`, of those there are; nan values do not count."""
    there = np.isfinite(values)
    sums = np.concatenate(([0.0], np.cumsum(np.where(there, values, 0.0))))
    counts = np.concatenate(([0], np.cumsum(there)))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - width)
    means = (sums[ends] - sums[starts]) / np.maximum(1, counts[ends] - counts[starts])
    return np.where(there, means, np.nan)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def _end_of_imitation(steps: NDArray[np.float64], curves: Curves) -> float:
    """Return the agent-steps at which imitation ended, 0 where there was none."""
    if "imitation/loss" not in curves:
        return 0.0
    return float(steps[np.isfinite(curves["imitation/loss"])].max(initial=0.0))


def _named(curves: Curves, labels: Mapping[str, str]) -> dict[str, NDArray[np.float64]]:
    return {label: curves[name] for name, label in labels.items() if name in curves}


def _draw(
    axes: Axes, x: NDArray[np.float64], curves: Mapping[str, NDArray[np.float64]], smooth: bool = True, first: int = 0
) -> None:
    """Draw curves; smoothed ones in front of what they were."""
    for place, (label, values) in enumerate(curves.items(), start=first):
        colour = _COLOURS[place % len(_COLOURS)]
        style = "-" if place < len(_COLOURS) else "--"
        width = max(1, round(_SMOOTH_SHARE * len(values))) if smooth else 1
        if width > 1:
            axes.plot(x, values, style, color=colour, lw=0.6, alpha=0.3)
        axes.plot(x, smoothed(values, width), style, color=colour, lw=1.6, label=label)


def _positive_log(axes: Axes) -> None:
    """Make the vertical axis logarithmic where all that is drawn allows it."""
    drawn: Sequence[Any] = [line.get_ydata() for line in axes.lines]
    if drawn and all(np.nanmin(values) > 0.0 for values in drawn if np.isfinite(values).any()):
        axes.set_yscale("log")


def _finish(axes: Axes, title: str, legend: bool = True, also: Axes | None = None) -> None:
    axes.set_title(title, loc="left", fontsize=10)
    axes.grid(True, which="major", color="#e6e6e6", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"] if also is None else ["top"]].set_visible(False)
    handles, labels = axes.get_legend_handles_labels()
    if also is not None:
        more_handles, more_labels = also.get_legend_handles_labels()
        handles, labels = handles + more_handles, labels + more_labels
    if not handles:
        axes.text(0.5, 0.5, "nothing yet", transform=axes.transAxes, ha="center", color="#999999")
    elif legend and sum(len(label) + 8 for label in labels) < _TITLE_ROOM - len(title):
        axes.legend(  # beside the title, where it hides nothing
            handles, labels, frameon=False, fontsize=8, ncols=len(handles), loc="lower right",
            bbox_to_anchor=(1.02, 0.985), borderpad=0.1, handlelength=1.2, columnspacing=1.0, handletextpad=0.4,
        )  # fmt: skip
    elif legend:
        axes.legend(handles, labels, fontsize=8, ncols=1 + len(handles) // 7, framealpha=0.7, edgecolor="none")


def _right_of(axes: Axes) -> Axes:
    """Return axes of their own scale, on the right, over the same horizontal one."""
    right = axes.twinx()
    right.spines[["top", "left"]].set_visible(False)
    return right
