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
_TICKS_OF_A_PLAIN_WORLD = 4  # before the next world has its turn


def comparison(plan: BenchPlan, beams: int, flying: Flying, progress: Progress = lambda _: None) -> Results:
    """Measure the batched step and each plain one in turns; the plain ones go on from where worlds of the batch are.

    First episodes have different lengths, so worlds are in all stages of an episode, and some end in every tick.
    """
    worlds, drones = plan.compared_worlds, plan.compared_drones
    name = f"{beams}_beams" + ("_random" if flying == "random" else "")
    progress(f"{worlds} worlds of {drones} drones, {beams} beams, {flying}: flying up to the first measurement")
    batch = make_batch(plan, worlds, drones, beams, stagger=True)
    generator = np.random.default_rng(0)
    for _ in range(plan.episode_ticks if flying == "frontier" else min(plan.random_ticks, plan.episode_ticks)):
        batch.step(choose_actions(batch, flying, generator))
    plain = {variant: PlainExploration(batch.settings, 0, 0, variant, time.thread_time) for variant in PLAIN}
    for one in plain.values():
        one.reset()  # which works out where the level can be flown in, as the batch has
    laps = {"batched": Laps()} | {variant: Laps() for variant in PLAIN}
    budget_s = plan.seconds / plan.rounds
    stages = StageWatch(batch)
    plain_stages = {variant: StageWatch(one) for variant, one in plain.items()}
    for number in range(plan.rounds):
        progress(f"{worlds} worlds of {drones} drones, {beams} beams, {flying}: round {number + 1} of {plan.rounds}")
        order = generator.permutation(worlds).tolist()
        for variant in PLAIN:
            laps[variant].start_round()
            _fly_plain(plain[variant], batch, order, flying, laps[variant], budget_s, generator, plain_stages[variant])
        laps["batched"].start_round()
        while laps["batched"].wall_s[-1] < budget_s:
            actions = choose_actions(batch, flying, generator)
            with stages, laps["batched"].timed(worlds * drones):
                batch.step(actions)
    results = {f"{who}_{name}".replace("-", "_"): lap.told() for who, lap in laps.items()}
    for variant in PLAIN:
        results[f"batched_over_{variant}_{name}".replace("-", "_")] = ratio(laps["batched"], laps[variant])
    if flying == "frontier":
        results |= stages.told("batched", name, sum(laps["batched"].steps))
        for variant in PLAIN:
            results |= plain_stages[variant].told(variant, name, sum(laps[variant].steps))
    return results


def _fly_plain(
    plain: PlainExploration,
    batch: Exploration,
    order: Sequence[int],
    flying: Flying,
    laps: Laps,
    budget_s: float,
    generator: np.random.Generator,
    stages: StageWatch,
) -> None:
    """Fly a few ticks of one world after the other, until the time is up."""
    shape = plain.drones, plain.settings.action.size
    for world in order:
        plain.take_over(batch, world)
        for tick in range(1 + _TICKS_OF_A_PLAIN_WORLD):
            if flying == "frontier":
                actions = plain.planner_actions()
            else:
                actions = generator.uniform(-1.0, 1.0, shape).astype(np.float32)
            if tick == 0:  # in which pymunk sorts the new world's shapes
                plain.step(actions)
                continue
            with stages, laps.timed(plain.drones):
                plain.step(actions)
        if laps.wall_s[-1] >= budget_s:
            return
