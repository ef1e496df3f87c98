"""Draws how the cost of batched exploration grows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from imagine.core.errors import InputError
from imagine.sim.bench import BenchPlan, Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BATCHED, _PLAIN, _GUIDE = "#1b6ca8", "#c8553d", "#9a9a9a"


def plot_growth(path: Path, plan: BenchPlan, results: Results) -> None:
    """Write a PNG of CPU time over worlds, time over drones, and memory over worlds, log-log.

    Raises InputError where matplotlib is missing or the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError("--plot needs matplotlib: pip install matplotlib") from error
    by_worlds = [row for size in plan.worlds if (row := results[f"worlds_{size}"])["value"] is not None]
    by_drones = [row for size in plan.drones if (row := results[f"drones_{size}"])["value"] is not None]
    figure = Figure(figsize=(13.0, 4.6), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(
        f"What a tick of batched exploration costs: level {plan.level}, {plan.beams[0]} beams",
        x=0.01, ha="left", fontsize=13,
    )  # fmt: skip
    time_worlds, time_drones, memory = figure.subplots(1, 3)

    ticks_ms = [1e3 * row["tick_cpu_s"] for row in by_worlds]
    _curve(time_worlds, plan.worlds, [row["worlds"] for row in by_worlds], ticks_ms, _BATCHED, "batched")
    for who, style in (("plain", "-"), ("plain_kernels", "--")):
        if not by_worlds:
            break
        rate = results[f"worlds_{who}"]["per_cpu_s"]
        plain_ms = [1e3 * row["worlds"] * row["drones"] / rate for row in by_worlds]
        time_worlds.plot(
            [row["worlds"] for row in by_worlds], plain_ms, style, color=_PLAIN, lw=1.4,
            label=f"{who.replace('_', '-')}, world after world",
        )  # fmt: skip
    _finish(time_worlds, f"worlds of {plan.compared_drones} drones", "CPU time of a tick, ms")

    _curve(
        time_drones, plan.drones, [row["drones"] for row in by_drones], [1e3 * row["tick_cpu_s"] for row in by_drones],
        _BATCHED, "batched",
    )  # fmt: skip
    _finish(time_drones, f"drones in each of {plan.worlds_for_drones} worlds", "CPU time of a tick, ms")

    sizes = [row["worlds"] for row in by_worlds]
    whole = [row["array_bytes_a_drone"] * row["worlds"] * row["drones"] / 1e6 for row in by_worlds]
    _curve(memory, plan.worlds, sizes, whole, _BATCHED, "arrays")
    resident = [row["resident_bytes_a_drone"] * row["worlds"] * row["drones"] / 1e6 for row in by_worlds]
    memory.plot(sizes, resident, "--", color=_BATCHED, lw=1.2, label="resident")
    _finish(memory, f"worlds of {plan.compared_drones} drones", "memory of the batch, MB")
    try:
        figure.savefig(path)
    except OSError as error:
        raise InputError(f"{path}: the plot cannot be written: {error.strerror}") from error


def _curve(axes: Axes, ticks: tuple[int, ...], x: list[Any], y: list[float], colour: str, label: str) -> None:
    """Draw a measured curve, and through its last point the line of growth in proportion."""
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.tick_params(axis="x", which="minor", bottom=False)
    if x:
        axes.plot(x, [y[-1] * size / x[-1] for size in x], ":", color=_GUIDE, lw=1.4, label="in proportion")
        axes.plot(x, y, "o-", color=colour, lw=2.0, ms=5.5, label=label)
        for size, value in zip(x, y, strict=True):
            axes.annotate(
                f"{value:.3g}" if value < 1000.0 else f"{value:,.0f}",
                (size, value),
                textcoords="offset points",
                xytext=(5, -11),
                fontsize=8,
                color=colour,
            )


def _finish(axes: Axes, x_label: str, y_label: str) -> None:
    axes.set_xlabel(x_label)
    axes.set_title(y_label, loc="left", fontsize=10)
    axes.grid(True, which="major", color="#e6e6e6", lw=0.8)
    axes.set_axisbelow(True)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}" if value >= 1.0 else f"{value:g}")
    low, high = axes.get_ylim()
    if high < 100.0 * low:  # where minor ticks are told at all, in the same plain numbers
        axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "235" else "")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8.5, loc="upper left")
