"""Is a drone getting anywhere? Watches where it went, whether its frontier came nearer, and what it saw anew."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from imagine.onboard.settings import LadderSettings


class _Sample(NamedTuple):
    stamp: float
    x: float
    y: float
    frontier_m: float
    seen_cells: int


class ProgressWatch:
    """Tells when a drone is stuck: not moving, or moving to no purpose."""

    def __init__(self, settings: LadderSettings) -> None:
        """Start with an empty memory."""
        self.settings = settings
        self._samples: deque[_Sample] = deque()
        self._seen_cells = 0

    def restart(self) -> None:
        """Forget: what follows is judged on its own."""
        self._samples.clear()

    def stuck(self, now: float, x: float, y: float, frontier_m: float, new_cells: int) -> str | None:
        """Take one tick's position (map frame), distance to the nearest frontier, and cells it made known.

        `new_cells` may be negative, where evidence cancels out. Returns why the drone counts as stuck, or None.
        """
        s = self.settings
        self._seen_cells += new_cells
        self._samples.append(_Sample(now, x, y, frontier_m, self._seen_cells))
        while self._samples and now - self._samples[0].stamp > max(s.stuck_still_s, s.stuck_aimless_s) + 1e-6:
            self._samples.popleft()
        first = self._samples[0]
        if now - first.stamp >= s.stuck_still_s - 1e-6:
            recent = [sample for sample in self._samples if now - sample.stamp <= s.stuck_still_s + 1e-6]
            moved = max(math.hypot(x - sample.x, y - sample.y) for sample in recent)
            if moved < s.stuck_still_m:
                return f"moved {moved:.2f} m in {s.stuck_still_s:.0f} s"
        if now - first.stamp >= s.stuck_aimless_s - 1e-6:
            nearer, seen = first.frontier_m - frontier_m, self._seen_cells - first.seen_cells
            if not nearer >= s.stuck_nearer_m and seen < s.stuck_new_cells:
                return f"no frontier nearer and nothing new seen in {s.stuck_aimless_s:.0f} s"
        return None
