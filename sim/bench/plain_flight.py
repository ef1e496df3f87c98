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
_TICKS_OF_A_WORLD = 4  # before the next one has its turn


class PlainFlight:
    """A plain exploration that visits the worlds of a batch, with its stop-watches."""

    def __init__(self, batch: Exploration, variant: Variant, flying: Flying) -> None:
        """Prepare to fly a variant of the plain step; stages are told by CPU time."""
        self.laps = Laps()
        self._plain = PlainExploration(batch.settings, 0, 0, variant, time.thread_time)
        self._plain.reset()  # which works out where the level can be flown in, as the batch has
        self.stages = StageWatch(self._plain)
        self._batch, self._flying = batch, flying
        self.worlds = batch.worlds

    def round(self, order: Sequence[int], budget_s: float, generator: np.random.Generator) -> None:
        """Fly a few ticks of one world after the other, in this order, until the time is up."""
        self.laps.start_round()
        shape = self._plain.drones, self._plain.settings.action.size
        for world in order:
            self._plain.take_over(self._batch, world)
            for tick in range(1 + _TICKS_OF_A_WORLD):
                if self._flying == "frontier":
                    actions = self._plain.planner_actions()
                else:
                    actions = generator.uniform(-1.0, 1.0, shape).astype(np.float32)
                if tick == 0:  # in which pymunk sorts the new world's shapes
                    self._plain.step(actions)
                    continue
                with self.stages, self.laps.timed(self._plain.drones):
                    self._plain.step(actions)
            if self.laps.wall_s[-1] >= budget_s:
                return
