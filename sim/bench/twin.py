"""All measurements of the batched step, in one run."""

from __future__ import annotations

import numpy as np

from imagine.sim.bench.comparison import comparison
from imagine.sim.bench.growth import growth
from imagine.sim.bench.plain_flight import PLAIN
from imagine.sim.bench.plan import BenchPlan, Flying, Progress, Results, choose_actions, make_batch
from imagine.sim.plain import PlainExploration


def bench_twin(plan: BenchPlan, progress: Progress = lambda _: None) -> Results:
    """Measure everything of the plan. Raises InputError for a level that the plain step cannot fly in."""
    progress("warming up")
    _warm_up(plan)
    results = growth(plan, "worlds", progress) | growth(plan, "drones", progress)
    flights: tuple[Flying, ...] = ("frontier", "random")
    for beams in plan.beams:
        for flying in flights:
            results |= comparison(plan, beams, flying, progress)
    return results


def _warm_up(plan: BenchPlan) -> None:
    """Compile all kernels, so that no measurement does, and find out whether the level can be flown in at all."""
    batch = make_batch(plan, 1, plan.compared_drones, plan.beams[0])
    batch.time_stages()
    batch.step(choose_actions(batch, "frontier", np.random.default_rng(0)))
    batch.critic_images()
    for variant in PLAIN:
        plain = PlainExploration(batch.settings, 0, variant=variant)
        plain.take_over(batch, 0)
        plain.step(plain.planner_actions())
