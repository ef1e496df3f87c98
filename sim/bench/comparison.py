"""The batched step against the plain ones, in turns, in the same worlds."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from imagine.sim.bench.laps import Laps, StageWatch, ratio
from imagine.sim.bench.plan import BenchPlan, Flying, Progress, Results, choose_actions, make_batch
from imagine.sim.exploration import Exploration
from imagine.sim.plain import PlainExploration
from imagine.sim.plain.exploration import Variant

PLAIN: tuple[Variant, ...] = ("plain", "plain-scipy", "plain-kernels")
_TICKS_OF_A_WORLD = 4  # before the next one has its turn


class _PlainFlight:
    """A plain exploration that visits the worlds of a batch, with its stop-watches."""

    def __init__(self, batch: Exploration, variant: Variant, flying: Flying) -> None:
        self.laps = Laps()
        self._plain = PlainExploration(batch.settings, 0, 0, variant, time.thread_time)
        self._plain.reset()  # which works out where the level can be flown in, as the batch has
        self.stages = StageWatch(self._plain)
        self._batch, self._flying = batch, flying

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


def comparison(plan: BenchPlan, beams: int, flying: Flying, progress: Progress = lambda _: None) -> Results:
    """Measure the batched step and each plain one in turns; the plain ones go on from where worlds of the batch are.

    First episodes have different lengths, so worlds are in all stages of an episode, and end one after the other.
    """
    worlds, drones = plan.compared_worlds, plan.compared_drones
    title = f"{worlds} worlds of {drones} drones, {beams} beams, {flying}"
    progress(f"{title}: flying up to the first measurement")
    batch = make_batch(plan, worlds, drones, beams, stagger=True)
    generator = np.random.default_rng(0)
    for _ in range(plan.episode_ticks if flying == "frontier" else min(plan.random_ticks, plan.episode_ticks)):
        batch.step(choose_actions(batch, flying, generator))
    plain = {variant: _PlainFlight(batch, variant, flying) for variant in PLAIN}
    laps, stages = Laps(), StageWatch(batch)
    budget_s = plan.seconds / plan.rounds
    for number in range(plan.rounds):
        progress(f"{title}: round {number + 1} of {plan.rounds}")
        order = generator.permutation(worlds).tolist()
        for flight in plain.values():
            flight.round(order, budget_s, generator)
        laps.start_round()
        while laps.wall_s[-1] < budget_s:
            actions = choose_actions(batch, flying, generator)
            with stages, laps.timed(worlds * drones):
                batch.step(actions)

    name = f"{beams}_beams" + ("_random" if flying == "random" else "")
    results = {f"batched_{name}": laps.told()}
    for variant, flight in plain.items():
        who = variant.replace("-", "_")
        results[f"{who}_{name}"] = flight.laps.told()
        results[f"batched_over_{who}_{name}"] = ratio(laps, flight.laps)
        if flying == "frontier":
            results |= flight.stages.told(who, name, sum(flight.laps.steps))
    return results | (stages.told("batched", name, sum(laps.steps)) if flying == "frontier" else {})
