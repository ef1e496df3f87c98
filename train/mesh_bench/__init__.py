"""What `imagine bench mesh` measures: real nodes and sealed bytes on explorations that were flown once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from imagine.train.mesh_bench.endurance import crowd, hostile, throughput
from imagine.train.mesh_bench.exchange import (
    SLOW_BYTES_PER_S,
    Results,
    against_whole_maps,
    handover,
    reunion,
    schedulers,
)
from imagine.train.mesh_bench.flights import Flight, fly

__all__ = ["MeshPlan", "Results", "bench_mesh"]


@dataclass(frozen=True)
class MeshPlan:
    """What is measured, how long and how often."""

    level: str = "6"
    drones: int = 3
    seconds: float = 180.0
    flights: int = 4
    crowd: int = 16
    crowd_seconds: float = 30.0
    minutes: float = 60.0
    rounds: int = 3
    hostile: int = 1_000_000
    slow_bytes_per_s: float = SLOW_BYTES_PER_S
    seed: int = 0


def bench_mesh(plan: MeshPlan, progress: Callable[[str], None]) -> Results:
    """Fly, tell it over the radio, and measure; rows by name, each with value and unit."""
    flights: list[Flight] = []
    for number in range(plan.flights):
        progress(f"flight {number + 1} of {plan.flights}")
        flights.append(fly(plan.level, plan.drones, plan.seed + number, plan.seconds))
    first = flights[0]
    results: Results = {}
    progress("the radio comes back after a partition")
    results |= reunion(first)
    results |= against_whole_maps(flights, progress)
    progress("handing over layers")
    results |= handover(first)
    progress("throughput")
    results |= throughput(first, plan.rounds)
    results |= schedulers(flights, plan.slow_bytes_per_s, progress)
    progress(f"{plan.hostile} hostile datagrams")
    results |= hostile(first, plan.hostile, plan.seed)
    progress(f"a flight of {plan.crowd} drones")
    results |= crowd(fly(plan.level, plan.crowd, plan.seed, plan.crowd_seconds), plan.minutes, progress)
    return results
