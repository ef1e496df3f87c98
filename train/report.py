"""What a run tells about itself while it goes on."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from imagine.sim.metrics import EpisodeMetrics

logger = logging.getLogger(__name__)

RECENT_EPISODES = 50


@dataclass(frozen=True)
class Report:
    """One update: numbers of the phase, the recent episodes by level, and where the time went (seconds)."""

    phase: str
    agent_steps: int
    phase_steps: int
    phase_total: int
    numbers: dict[str, float]
    levels: dict[str, dict[str, float]]
    steps_per_s: float
    seconds: dict[str, float]
    wall_s: float

    @property
    def coverage(self) -> float:
        """Mean recent coverage over the levels, nan before the first episode ends."""
        return float(np.mean([level["coverage"] for level in self.levels.values()])) if self.levels else float("nan")

    def scalars(self) -> dict[str, float]:
        """Return the report as TensorBoard names and values, by phase and by level."""
        scalars = {f"{self.phase}/{name}": value for name, value in self.numbers.items()}
        for level, numbers in self.levels.items():
            scalars.update({f"{name}/level_{level}": value for name, value in numbers.items()})
        scalars["speed/agent_steps_per_s"] = self.steps_per_s
        scalars.update({f"speed/{name}_s": value for name, value in self.seconds.items()})
        return scalars

    def row(self) -> dict[str, Any]:
        """Return the report as a line of `metrics.jsonl`."""
        return {
            "phase": self.phase,
            "agent_steps": self.agent_steps,
            "wall_s": round(self.wall_s, 1),
            "steps_per_s": round(self.steps_per_s, 1),
            "seconds": {name: round(value, 3) for name, value in self.seconds.items()},
            **{name: float(f"{value:.5g}") for name, value in self.numbers.items()},
            "levels": {
                level: {name: round(value, 4) for name, value in numbers.items()}
                for level, numbers in self.levels.items()
            },
        }


@dataclass
class RecentEpisodes:
    """The newest finished episodes of each level; those that never reach 90 % count with their full length."""

    episode_ticks: int
    by_level: dict[str, deque[tuple[float, float, float]]] = field(default_factory=dict)

    def add(self, episodes: Iterable[EpisodeMetrics]) -> None:
        """Take finished episodes."""
        for episode in episodes:
            kept = self.by_level.setdefault(str(episode.level), deque(maxlen=RECENT_EPISODES))
            t90 = self.episode_ticks if episode.t90 is None else episode.t90
            kept.append((float(episode.coverage), float(t90), float(episode.contacts)))

    def means(self) -> dict[str, dict[str, float]]:
        """Return mean coverage, ticks to 90 % and contacts by level."""
        means = {}
        for level, kept in sorted(self.by_level.items()):
            coverage, t90, contacts = np.mean(kept, axis=0)
            means[level] = {"coverage": float(coverage), "t90": float(t90), "contacts": float(contacts)}
        return means


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
    """A live display in the terminal: progress with the time left, losses, and a row for each level."""

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
    losses = Table.grid(padding=(0, 2))
    losses.add_row(*(f"{name} [bold]{value:.4g}[/]" for name, value in report.numbers.items()))
    yield losses
    if report.levels:
        levels = Table("level", "coverage", "ticks to 90 %", "contacts", box=None)
        for level, numbers in report.levels.items():
            levels.add_row(level, f"{numbers['coverage']:.3f}", f"{numbers['t90']:.0f}", f"{numbers['contacts']:.1f}")
        yield levels


def one_line(report: Report) -> str:
    """Return a report as one line of text."""
    eta_s = (report.phase_total - report.phase_steps) / max(report.steps_per_s, 1e-9)
    levels = " ".join(f"{level}:{n['coverage']:.2f}/{n['t90']:.0f}" for level, n in report.levels.items())
    numbers = " ".join(f"{name}={value:.3g}" for name, value in report.numbers.items())
    return (
        f"{report.phase} {report.phase_steps}/{report.phase_total} {report.steps_per_s:.0f} steps/s "
        f"{eta_s / 60:.1f} min left | {numbers} | coverage/t90 by level {levels or '(no episode yet)'}"
    )
