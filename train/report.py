"""What a run tells about itself while it goes on."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from imagine.train.tracking.episodes import RecentEpisodes
from imagine.train.tracking.resources import memory_mb

__all__ = ["LiveReporter", "LogReporter", "RecentEpisodes", "Report", "Reporter", "one_line"]

logger = logging.getLogger(__name__)

_MOST_LEVELS = 10  # lines of a screen of 24 that are left beside progress and losses
_MOST_NUMBERS = 12
_FIRST_NUMBERS = (
    "policy_loss", "value_loss", "loss", "kl", "entropy", "clipped_share", "explained_variance", "actor_lr",
    "return", "reward",
)  # fmt: skip
"""Numbers that say most, shown first where there are too many for a screen."""


@dataclass(frozen=True)
class Report:
    """One update: numbers of the phase, the recent episodes by level and by drone, and where time and memory went.

    `numbers` are those of imitation or PPO by name; `levels` and `drones` what `RecentEpisodes.means` and
    `drone_means` return; `seconds` the time each stage of the update took, `memory` MB; `wall_s` the time since the
    run began, without the time between a stop and going on.
    """

    phase: str
    agent_steps: int
    phase_steps: int
    phase_total: int
    numbers: dict[str, float]
    levels: dict[str, dict[str, float]]
    steps_per_s: float
    seconds: dict[str, float]
    wall_s: float
    drones: dict[str, dict[str, float]] = field(default_factory=dict)
    paradigm: str = "ctde"
    memory: dict[str, float] = field(default_factory=memory_mb)

    @property
    def overall(self) -> dict[str, float]:
        """Every episode metric, mean over the levels; empty before the first episode ends."""
        names = next(iter(self.levels.values()), {})
        return {name: float(np.mean([level[name] for level in self.levels.values()])) for name in names}

    @property
    def coverage(self) -> float:
        """Mean recent coverage over the levels, nan before the first episode ends."""
        return self.overall.get("coverage", float("nan"))

    @property
    def left_s(self) -> float:
        """Time that the phase will take at the present speed, seconds."""
        return max(0, self.phase_total - self.phase_steps) / max(self.steps_per_s, 1e-9)

    def scalars(self) -> dict[str, float]:
        """Return everything by its name as trackers keep it; docs/tracking.md has the table of names."""
        scalars = {f"{self.phase}/{name}": value for name, value in self.numbers.items()}
        for level, numbers in self.levels.items():
            scalars.update({f"episode/{level}/{name}": value for name, value in numbers.items()})
        scalars.update({f"paradigm/{self.paradigm}/{name}": value for name, value in self.overall.items()})
        for drone, numbers in self.drones.items():
            scalars.update({f"drone/{drone}/{name}": value for name, value in numbers.items()})
        scalars["progress/phase_share"] = min(1.0, self.phase_steps / max(1, self.phase_total))
        scalars["time/wall_s"] = self.wall_s
        scalars["speed/agent_steps_per_s"] = self.steps_per_s
        scalars.update({f"speed/{name}_s": value for name, value in self.seconds.items()})
        scalars.update({f"memory/{name}": value for name, value in self.memory.items()})
        return scalars

    def row(self) -> dict[str, Any]:
        """Return the report as the line of `metrics.jsonl`: the agent-steps, and all scalars."""
        return {"agent_steps": self.agent_steps, **self.scalars()}


class Reporter(Protocol):
    """Whoever wants to follow a run."""

    def __call__(self, report: Report) -> None:
        """Take one report."""


@dataclass
class LogReporter:
    """Writes a line to the log every `every_s` seconds, for runs without a terminal."""

    every_s: float = 10.0
    _last: float = field(default=float("-inf"), init=False)

    def __call__(self, report: Report) -> None:
        """Log the report if the last line is old enough."""
        now = time.monotonic()
        if now - self._last >= self.every_s:
            self._last = now
            logger.info("%s", one_line(report))


class LiveReporter:
    """A live display of one screen: progress with the time left, losses, speed, and a row for each level."""

    def __init__(self, console: Console) -> None:
        self._progress = Progress(
            TextColumn("{task.description:>10}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
        )
        self._tasks: dict[str, Any] = {}
        self._live = Live(self._progress, console=console, refresh_per_second=4)

    def __enter__(self) -> LiveReporter:
        """Start drawing."""
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last state on the screen."""
        self._live.stop()

    def __call__(self, report: Report) -> None:
        """Show the report."""
        speed = f"{report.steps_per_s:.0f} steps/s"
        if report.phase not in self._tasks:
            self._tasks[report.phase] = self._progress.add_task(report.phase, total=report.phase_total, speed=speed)
        self._progress.update(self._tasks[report.phase], completed=report.phase_steps, speed=speed)
        self._live.update(Group(self._progress, *_tables(report)))


def _tables(report: Report) -> Iterator[Table]:
    """Yield what stands below the progress: the first numbers, where the time goes, and the levels, worst first."""
    numbers = Table.grid(padding=(0, 2))
    shown = [f"{name} [bold]{value:.4g}[/]" for name, value in _first_numbers(report.numbers)]
    for start in range(0, len(shown), 4):
        numbers.add_row(*shown[start : start + 4])
    yield numbers
    resources = Table.grid(padding=(0, 2))
    stages = [f"{name} {value:.1f} s" for name, value in report.seconds.items()]
    resources.add_row(
        *stages, f"memory {report.memory.get('resident_mb', 0.0):.0f} MB", f"{report.wall_s / 60:.0f} min"
    )
    yield resources
    if report.levels:
        levels = Table("level", "coverage", "ticks to 90 %", "contacts", box=None)
        everywhere = sorted(report.levels.items())
        if len(everywhere) > _MOST_LEVELS:  # the worst are those one must know of
            everywhere = sorted(everywhere, key=lambda item: item[1]["coverage"])[:_MOST_LEVELS]
        for level, row in everywhere:
            levels.add_row(level, f"{row['coverage']:.3f}", _time(row), f"{row['contacts']:.1f}")
        hidden = len(report.levels) - len(everywhere)
        row = report.overall
        name = f"all, {hidden} better not shown" if hidden else "all"
        levels.add_row(name, f"{row['coverage']:.3f}", _time(row), f"{row['contacts']:.1f}", style="bold")
        yield levels


def _time(numbers: dict[str, float]) -> str:
    """Return the ticks to 90 %, `-` where episodes end before that."""
    return f"{numbers['t90']:.0f}" if "t90" in numbers else "-"


def _first_numbers(numbers: dict[str, float]) -> list[tuple[str, float]]:
    """Return the numbers that say most, at most _MOST_NUMBERS of them."""
    rank = {name: place for place, name in enumerate(_FIRST_NUMBERS)}
    return sorted(numbers.items(), key=lambda item: rank.get(item[0], len(rank)))[:_MOST_NUMBERS]


def one_line(report: Report) -> str:
    """Return a report as one line of text."""
    levels = " ".join(f"{level}:{n['coverage']:.2f}/{_time(n)}" for level, n in report.levels.items())
    numbers = " ".join(f"{name}={value:.3g}" for name, value in _first_numbers(report.numbers))
    return (
        f"{report.phase} {report.phase_steps}/{report.phase_total} {report.steps_per_s:.0f} steps/s "
        f"{report.left_s / 60:.1f} min left | {numbers} | coverage/t90 by level {levels or '(no episode yet)'}"
    )
