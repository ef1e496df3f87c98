"""Real-time pacing: when each tick is due, on a clock that is handed in."""

from __future__ import annotations

import math

from imagine.core.errors import InputError

_SLACK_TICKS = 3.0


class Schedule:
    """Due times, `period_s / speed` of wall time apart; after falling far behind it starts anew instead of racing.

    `late` counts the ticks that started behind the schedule.
    """

    def __init__(self, period_s: float, speed: float = 1.0) -> None:
        """Give the simulated period of a tick, and simulated seconds per wall second."""
        if not (math.isfinite(speed) and speed > 0.0):
            raise InputError(f"speed is {speed}, needs to be a positive number of simulated seconds per second")
        self.interval_s = period_s / speed
        self.late = 0
        self._due: float | None = None

    def next_due(self, now: float) -> float:
        """Return the wall time at which the tick after the one that starts `now` is due."""
        if self._due is None:
            self._due = now
        elif now > self._due + self.interval_s * 0.5:
            self.late += 1
            if now > self._due + self.interval_s * _SLACK_TICKS:
                self._due = now
        self._due += self.interval_s
        return self._due
