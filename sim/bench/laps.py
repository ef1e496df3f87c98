"""Stop-watches: agent-steps a second, round by round, and where the time went."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from imagine.sim.bench.plan import Results


@dataclass
class Laps:
    """Agent-steps of one thing measured, and the seconds they took, round by round."""

    steps: list[int] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    def start_round(self) -> None:
        """Count into a new round from now on."""
        self.steps.append(0)
        self.wall_s.append(0.0)
        self.cpu_s.append(0.0)

    @contextmanager
    def timed(self, steps: int) -> Iterator[None]:
        """Count what happens within as `steps` agent-steps."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.steps[-1] += steps
        self.wall_s[-1] += time.perf_counter() - wall
        self.cpu_s[-1] += time.process_time() - cpu

    def rates(self, of: Literal["wall", "cpu"] = "wall") -> list[float]:
        """Return agent-steps a second, by round."""
        seconds = self.wall_s if of == "wall" else self.cpu_s
        return [steps / max(s, 1e-9) for steps, s in zip(self.steps, seconds, strict=True)]

    def told(self) -> dict[str, Any]:
        """Return the median rate, and the slowest and fastest rounds."""
        rates = self.rates()
        return {
            "value": statistics.median(rates), "unit": "agent-steps/s",
            "per_cpu_s": statistics.median(self.rates("cpu")),
            "low": min(rates), "high": max(rates), "rounds": len(rates),
        }  # fmt: skip


def ratio(fast: Laps, slow: Laps) -> dict[str, Any]:
    """Return how many times as many agent-steps a second `fast` makes: the median over rounds of the ratio in each."""
    wall = [a / b for a, b in zip(fast.rates(), slow.rates(), strict=True)]
    cpu = [a / b for a, b in zip(fast.rates("cpu"), slow.rates("cpu"), strict=True)]
    return {
        "value": statistics.median(wall), "unit": "times", "per_cpu_s": statistics.median(cpu),
        "low": min(wall), "high": max(wall),
    }  # fmt: skip


class StageWatch:
    """Sums up what an exploration's `stage_seconds` grew by while watched; nothing where it keeps none."""

    def __init__(self, watched: object) -> None:
        self._watched = watched
        self._seconds: dict[str, float] = {}
        self._before: dict[str, float] = {}

    def _now(self) -> dict[str, float]:
        return dict(getattr(self._watched, "stage_seconds", None) or {})

    def __enter__(self) -> None:
        self._before = self._now()

    def __exit__(self, *_: object) -> None:
        for stage, seconds in self._now().items():
            grown = seconds - self._before.get(stage, 0.0)
            self._seconds[stage] = self._seconds.get(stage, 0.0) + grown

    def told(self, who: str, name: str, steps: int, cpu_s: float | None = None) -> Results:
        """Return each stage's time an agent-step, and its share of the whole.

        With `cpu_s`, the whole, what is left of it beside the stages is told as the stage `rest`.
        """
        told = dict(self._seconds)
        if told and cpu_s is not None:
            told["rest"] = max(0.0, cpu_s - sum(told.values()))
        total = sum(told.values()) or 1.0
        return {
            f"{who}_stage_{stage}_{name}": {
                "value": 1e6 * seconds / max(1, steps), "unit": "us/agent-step", "share": seconds / total,
            }
            for stage, seconds in told.items()
        }  # fmt: skip
