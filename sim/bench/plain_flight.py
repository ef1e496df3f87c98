"""The plain steps, timed in the worlds of a batch."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from imagine.sim.bench.laps import Laps, StageWatch
from imagine.sim.bench.plan import Flying
from imagine.sim.exploration import Exploration
from imagine.sim.plain import PlainExploration
from imagine.sim.plain.exploration import Variant

PLAIN: tuple[Variant, ...] = ("plain", "plain-scipy", "plain-kernels")
_SETTLING_TICKS = 10
"""After a second in which nobody remembers when it sent what, radio traffic is what it was before the take-over."""
_COUNTED_TICKS: dict[Variant, int] = {"plain": 2, "plain-scipy": 3, "plain-kernels": 10}
"""In a world, before the next one has its turn: many worlds tell more than many ticks."""


class PlainFlight:
    """A plain exploration that visits the worlds of a batch, with its stop-watches."""

    def __init__(self, batch: Exploration, variant: Variant, flying: Flying) -> None:
        """Prepare to fly a variant of the plain step; stages are told by CPU time."""
        self.laps = Laps()
        self._variant: Variant = variant
        self._plain = PlainExploration(batch.settings, 0, 0, variant, time.thread_time)
        self._plain.reset()  # which works out where the level can be flown in, as the batch has
        self.stages = StageWatch(self._plain)
        self._batch, self._flying = batch, flying
        self.worlds = batch.worlds

    def round(self, order: Sequence[int], budget_s: float, generator: np.random.Generator) -> None:
        """Fly a few ticks of one world after the other, in this order, until the time that counts is up."""
        self.laps.start_round()
        for world in order:
            self._plain.take_over(self._batch, world)
            self._plain.use("plain-kernels")  # until it counts, by the fastest means
            # as many more as traffic takes to repeat itself, so that what is sent now and then counts as often
            for _ in range(_SETTLING_TICKS + int(generator.integers(_SETTLING_TICKS))):
                self._step(generator)
            self._plain.use(self._variant)
            for _ in range(_COUNTED_TICKS[self._variant]):
                self._step(generator, counts=True)
            if self.laps.wall_s[-1] >= budget_s:
                return

    def _step(self, generator: np.random.Generator, counts: bool = False) -> None:
        plain = self._plain
        if self._flying == "frontier":
            actions = plain.planner_actions()
        else:
            actions = generator.uniform(-1.0, 1.0, (plain.drones, plain.settings.action.size)).astype(np.float32)
        if not counts:
            plain.step(actions)
            return
        with self.stages, self.laps.timed(plain.drones):
            plain.step(actions)

    def critic_s(self) -> float:
        """Return the CPU seconds that the critic's images take for every drone, once."""
        before = time.thread_time()
        self._plain.critic_images()
        return (time.thread_time() - before) / self._plain.drones
