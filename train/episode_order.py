"""Finished episodes in the order in which they began.

Worlds fly side by side, and a good episode ends early. Taken as they end, good ones would come first: a policy that
fails every other time would seem to pass dozens in a row. In the order of beginnings an episode is not told apart by
how it went.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from typing import Any

from imagine.sim.metrics import EpisodeMetrics

Stream = tuple[int, int]
"""A world of a batch by what names it in EpisodeMetrics: the batch's seed, and the world."""


@dataclass(frozen=True, order=True)
class Outcome:
    """An episode that has ended: the tick it began at, counted in its own world; its world; level and coverage."""

    began: int
    stream: Stream
    level: str
    coverage: float


@dataclass
class EpisodeOrder:
    """Takes episodes as they end, `worlds` at a time; gives them back once all that began earlier have ended.

    Worlds fly in step, so that an episode that began more than two longest episodes ago has ended; a world that would
    hold up the others for longer (of a worker that is gone) is not waited for.
    """

    worlds: int
    episode_ticks: int
    _clocks: dict[Stream, int] = field(default_factory=dict)
    _waiting: list[Outcome] = field(default_factory=list)

    def add(self, episode: EpisodeMetrics) -> None:
        """Take an episode, each world's in their order."""
        stream = (int(episode.seed), int(episode.world))
        began = self._clocks.get(stream, 0)
        heapq.heappush(self._waiting, Outcome(began, stream, str(episode.level), float(episode.coverage)))
        self._clocks[stream] = began + int(episode.ticks)

    def ready(self) -> list[Outcome]:
        """Return, and forget, the episodes before which none is still flown, by their beginnings."""
        if not self._clocks:
            return []
        oldest = max(self._clocks.values()) - 2 * self.episode_ticks
        if len(self._clocks) < self.worlds and oldest <= 0:
            return []  # a world that has not told of any episode yet flies its first
        running = min((clock, stream) for stream, clock in self._clocks.items() if clock >= oldest)
        ready = []
        while self._waiting and (self._waiting[0].began, self._waiting[0].stream) < running:
            ready.append(heapq.heappop(self._waiting))
        return ready

    def state_dict(self) -> dict[str, Any]:
        """Return all that decides what `ready` will give, in plain containers."""
        return {
            "clocks": [[seed, world, clock] for (seed, world), clock in self._clocks.items()],
            "waiting": [[o.began, *o.stream, o.level, o.coverage] for o in sorted(self._waiting)],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state."""
        self._clocks = {(seed, world): clock for seed, world, clock in state["clocks"]}
        self._waiting = [
            Outcome(began, (seed, world), level, coverage) for began, seed, world, level, coverage in state["waiting"]
        ]  # sorted, and so a heap
