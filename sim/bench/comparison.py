"""The batched step against the plain ones, in turns, in the same worlds."""

from __future__ import annotations

import statistics
import time

import numpy as np

from imagine.sim.bench.laps import Laps, StageWatch, ratio
from imagine.sim.bench.plain_flight import PLAIN, PlainFlight
from imagine.sim.bench.plan import BenchPlan, Flying, Progress, Results, choose_actions, make_batch
from imagine.sim.exploration import Exploration


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
    plain = {variant: PlainFlight(batch, variant, flying) for variant in PLAIN}
    batch.time_stages()
    laps, stages, critics = Laps(), StageWatch(batch), []
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
        critics.append((_critic_s(batch), plain["plain"].critic_s()))

    name = f"{beams}_beams" + ("_random" if flying == "random" else "")
    results = {f"batched_{name}": laps.told()}
    for variant, flight in plain.items():
        who = variant.replace("-", "_")
        results[f"{who}_{name}"] = flight.laps.told()
        results[f"batched_over_{who}_{name}"] = ratio(laps, flight.laps)
        if flying == "frontier":
            results |= flight.stages.told(who, name, sum(flight.laps.steps))
    if flying == "frontier":
        results |= stages.told("batched", name, sum(laps.steps), sum(laps.cpu_s))
        for who, seconds in zip(("batched", "plain"), zip(*critics, strict=True), strict=True):
            results[f"{who}_critic_{name}"] = {"value": 1e6 * statistics.median(seconds), "unit": "us/agent-step"}
    return results


def _critic_s(batch: Exploration) -> float:
    """Return the CPU seconds that the critic's images take for every drone, once: only who asks for them pays."""
    before = time.process_time()
    batch.critic_images()
    return (time.process_time() - before) / (batch.worlds * batch.drones)
