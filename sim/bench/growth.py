"""How time and memory of the batched step grow with worlds and drones."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from imagine.sim.bench.laps import Laps
from imagine.sim.bench.memory import array_bytes, free_bytes, resident_bytes
from imagine.sim.bench.plain_flight import PLAIN, PlainFlight
from imagine.sim.bench.plan import BenchPlan, Progress, Results, choose_actions, make_batch
from imagine.sim.exploration import Exploration
from imagine.sim.level import load_level
from imagine.sim.plain.exploration import Variant

_TICKS_A_ROUND = 3
_MEMORY_SHARE = 0.5  # of what is free
_FIRST_GUESS = 2.0  # bytes a cell, drone and source; later sizes go by what earlier ones took


@dataclass
class _Size:
    """One size that is tried: its batches, or why there are none."""

    name: str
    worlds: int
    drones: int
    skipped: str = ""
    batches: list[Exploration] = field(default_factory=list)
    arrays_bytes: int = 0
    resident_bytes: int = 0
    laps: Laps = field(default_factory=Laps)

    @property
    def agents(self) -> int:
        """Drones in all batches."""
        return len(self.batches) * self.worlds * self.drones

    def told(self) -> dict[str, Any]:
        row: dict[str, Any] = {"worlds": self.worlds, "drones": self.drones}
        if self.skipped:
            return {"value": None, "unit": "agent-steps/s", "skipped": self.skipped} | row
        ticks = len(self.batches) * _TICKS_A_ROUND
        return self.laps.told() | row | {
            "tick_s": statistics.median(self.laps.wall_s) / ticks,
            "tick_cpu_s": statistics.median(self.laps.cpu_s) / ticks,
            "array_bytes_a_drone": self.arrays_bytes / self.agents,
            "resident_bytes_a_drone": self.resident_bytes / self.agents,
        }  # fmt: skip


def growth(plan: BenchPlan, what: Literal["worlds", "drones"], progress: Progress) -> Results:
    """Measure the batched step at several sizes in turns, all at the same time of their episodes.

    A size that would take too much memory is left out, and says why.
    """
    if what == "worlds":
        sizes = [_Size(f"worlds_{worlds}", worlds, plan.compared_drones) for worlds in plan.worlds]
    else:
        sizes = [_Size(f"drones_{drones}", plan.worlds_for_drones, drones) for drones in plan.drones]
    generator = np.random.default_rng(0)
    bytes_of_one = _FIRST_GUESS * math.prod(load_level(plan.level).grid[2:])
    for size in sizes:
        bytes_of_one = _launch(plan, size, bytes_of_one, generator, progress)
    flying = [size for size in sizes if not size.skipped]
    plain = _plain_beside(plan, flying) if what == "worlds" else {}
    for number in range(plan.rounds):
        progress(f"growth over {what}: round {number + 1} of {plan.rounds}")
        for size in flying:
            size.laps.start_round()
            for batch in size.batches * _TICKS_A_ROUND:
                actions = choose_actions(batch, "frontier", generator)
                with size.laps.timed(size.worlds * size.drones):
                    batch.step(actions)
        for flight in plain.values():
            order = generator.permutation(flight.worlds).tolist()
            flight.round(order, plan.seconds / plan.rounds / 2.0, generator)
    rows = {size.name: size.told() for size in sizes}
    beside = {f"worlds_{variant.replace('-', '_')}": flight.laps.told() for variant, flight in plain.items()}
    return rows | beside | _exponents(what, [row for row in rows.values() if row["value"] is not None])


def _plain_beside(plan: BenchPlan, flying: list[_Size]) -> dict[Variant, PlainFlight]:
    """Return plain flights in the worlds of a batch that grows: what they take, they take for every world alike."""
    some = [size for size in flying if size.worlds <= plan.compared_worlds] or flying
    return {variant: PlainFlight(some[-1].batches[0], variant, "frontier") for variant in PLAIN if some}


def _launch(
    plan: BenchPlan, size: _Size, bytes_of_one: float, generator: np.random.Generator, progress: Progress
) -> float:
    """Make a size's batches and fly them up to the first measurement, unless they would take too much memory.

    Takes and returns the bytes that a drone needs for a source: a drone keeps a layer of each, and a few more.
    """
    beams, copies = plan.beams[0], max(1, plan.copies // size.worlds)
    layers = size.drones + 4
    wanted = bytes_of_one * size.worlds * copies * size.drones * layers
    room = _MEMORY_SHARE * free_bytes() if plan.memory_limit_bytes is None else plan.memory_limit_bytes
    title = f"{size.worlds} worlds of {size.drones} drones"
    if wanted > room:
        size.skipped = f"would take about {wanted / 1e9:.2g} GB, with {room / 1e9:.2g} GB to be had"
        progress(f"{title}: left out: {size.skipped}")
        return bytes_of_one
    progress(f"{title}, {beams} beams: flying up to the first measurement")
    before = resident_bytes()
    size.batches = [make_batch(plan, size.worlds, size.drones, beams, seed) for seed in range(copies)]
    for batch in size.batches:
        for _ in range(plan.growth_ticks):
            step = batch.step(choose_actions(batch, "frontier", generator))
        size.arrays_bytes += array_bytes([batch, step])
    size.resident_bytes = max(0, resident_bytes() - before)
    return max(size.arrays_bytes, size.resident_bytes) / (size.agents * layers)


def _exponents(what: str, measured: list[dict[str, Any]]) -> Results:
    """Return the powers of the size by which the CPU time of a tick and the memory grow: 1 is in proportion."""
    if len(measured) < 2:
        return {}
    size = np.log([row[what] for row in measured])
    memory = [row["array_bytes_a_drone"] * row["worlds"] * row["drones"] for row in measured]
    powers = {"time": [row["tick_cpu_s"] for row in measured], "memory": memory}
    told: Results = {
        f"{name}_growth_{what}": {"value": float(np.polyfit(size, np.log(values), 1)[0]), "unit": "power"}
        for name, values in powers.items()
    }
    if what == "worlds":
        worlds = [row["worlds"] for row in measured]
        resident = [row["resident_bytes_a_drone"] * row["worlds"] * row["drones"] for row in measured]
        drones = measured[-1]["drones"]
        told["memory_a_drone"] = _line(worlds, memory, drones) | {"drones": drones}
        told["resident_a_drone"] = _line(worlds, resident, drones) | {"drones": drones}
    return told


def _line(worlds: list[int], measured: list[float], drones: int) -> dict[str, Any]:
    """Return the bytes of a further world, a drone, by a straight line through the bytes of all sizes.

    `fixed` is what even no world would take, `off` how far the worst size lies from the line, as a share of its bytes.
    """
    slope, fixed = np.polyfit(worlds, measured, 1, w=1.0 / np.maximum(measured, 1.0))
    off = np.abs((fixed + slope * np.array(worlds)) / np.maximum(measured, 1.0) - 1.0).max()
    return {"value": float(slope) / drones, "unit": "bytes", "fixed": float(fixed), "off": float(off)}
