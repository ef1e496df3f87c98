"""What `imagine bench twin` reads from its flags, and the tables it shows."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from imagine.core.errors import InputError
from imagine.kernel_cache import announce_compiling
from imagine.outputs import check_outputs, write_json
from imagine.sim.bench import BenchPlan, Results, bench_twin
from imagine.sim.level import load_level

_QUICK = {
    "worlds": (1, 4, 16), "drones": (1, 3), "seconds": 0.15, "rounds": 3, "compared_worlds": 8, "worlds_for_drones": 4,
    "episode_ticks": 30, "random_ticks": 5, "growth_ticks": 5, "copies": 1,
}  # fmt: skip
_COMPARED = ("batched", "plain", "plain_scipy", "plain_kernels")


def bench_twin_and_show(
    level: str, beams: str, worlds: str | None, drones: str | None, seconds: float | None, quick: bool,
    json_file: Path | None, plot_file: Path | None,
) -> None:  # fmt: skip
    """Measure, print tables, and write what was asked for. Raises InputError naming the flag that is wrong."""
    plan = twin_plan(level, beams, worlds, drones, seconds, quick)
    if plot_file is not None:
        if plot_file.suffix.lower() != ".png":
            raise InputError(f"--plot {plot_file}: the plot is drawn as PNG: name a file that ends in .png")
        check_outputs(plot_file)
    announce_compiling(lambda text: print(text, file=sys.stderr))
    results = bench_twin(plan, progress=lambda text: print(text, file=sys.stderr))
    results["cores"] = {"value": len(os.sched_getaffinity(0)), "unit": "cores"}
    console = Console()
    console.print(comparison_table(plan, results))
    for what in ("worlds", "drones"):
        console.print(growth_table(plan, what, results))
    stages = stage_table(plan, results)
    if stages is not None:
        console.print(stages)
    write_json(json_file, results)
    if plot_file is not None:
        from imagine.bench_plot import plot_growth

        plot_growth(plot_file, plan, results)


def twin_plan(
    level: str, beams: str, worlds: str | None, drones: str | None, seconds: float | None, quick: bool
) -> BenchPlan:
    """Return the plan that flags ask for; None takes the default, or that of a quick run."""
    chosen: dict[str, Any] = dict(_QUICK) if quick else {}
    chosen |= {"level": level, "beams": numbers("--beams", beams, 4, 4096)}
    if worlds is not None:
        chosen["worlds"] = tuple(sorted(numbers("--worlds", worlds, 1, 4096)))
    if drones is not None:
        chosen["drones"] = tuple(sorted(numbers("--drones", drones, 1, 16)))
    if seconds is not None:
        if not (math.isfinite(seconds) and 0.05 <= seconds <= 600.0):
            raise InputError(f"--seconds {seconds:g}: give from 0.05 to 600 seconds")
        chosen["seconds"] = seconds
    plan = BenchPlan(**chosen)
    ground = load_level(level)
    if ground.people or ground.crates:
        raise InputError(f"--level {level}: has people or crates, which the plain step lacks: name a level without")
    ground.launch_poses(max(*plan.drones, plan.compared_drones))  # is there room for them all?
    return plan


def numbers(flag: str, text: str, least: int, most: int) -> tuple[int, ...]:
    """Return the whole numbers of a list such as 1,4,16. Raises InputError naming the flag."""
    try:
        found = tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{flag} {text}: expected whole numbers such as {least} or {least},{2 * least}") from error
    for number in found:
        if not least <= number <= most:
            raise InputError(f"{flag} {text}: {number} is not from {least} to {most}")
    if len(set(found)) < len(found):
        raise InputError(f"{flag} {text}: names a number twice")
    return found


def comparison_table(plan: BenchPlan, results: Results) -> Table:
    """Return rates of the batched and the plain steps, and how many times faster the batched one is."""
    table = _table(f"Level {plan.level}, {plan.compared_worlds} worlds of {plan.compared_drones} drones: agent-steps/s")
    for title in ("beams", "flown by", "step", "per second", "per CPU s", "batched: times", "per CPU s"):
        table.add_column(title, justify="left" if title in ("flown by", "step") else "right")
    for beams in plan.beams:
        for flying, ending in (("frontier", ""), ("random", "_random")):
            for who in _COMPARED:
                rate = results[f"{who}_{beams}_beams{ending}"]
                ratio = results.get(f"batched_over_{who}_{beams}_beams{ending}")
                first = who == _COMPARED[0]
                table.add_row(
                    str(beams) if first else "", flying if first else "", who.replace("_", "-"),
                    f"{rate['value']:,.0f}", f"{rate['per_cpu_s']:,.0f}",
                    *([f"{ratio['value']:.1f}", f"{ratio['per_cpu_s']:.1f}"] if ratio else ["", ""]),
                    end_section=who == _COMPARED[-1],
                )  # fmt: skip
    return table


def growth_table(plan: BenchPlan, what: str, results: Results) -> Table:
    """Return time and memory by the number of worlds or drones."""
    table = _table(f"Growth with {what}, {plan.beams[0]} beams: agent-steps/s")
    for title in ("worlds", "drones", "ms a tick", "per second", "per CPU s", "kB arrays a drone"):
        table.add_column(title, justify="right")
    if what == "worlds":
        table.add_column("kB resident a drone", justify="right")
    notes = []
    for size in plan.worlds if what == "worlds" else plan.drones:
        row = results[f"{what}_{size}"]
        if row["value"] is None:
            table.add_row(str(row["worlds"]), str(row["drones"]), "–")
            notes.append(f"{row['worlds']} worlds of {row['drones']} drones left out: {row['skipped']}")
            continue
        table.add_row(
            str(row["worlds"]), str(row["drones"]), f"{1e3 * row['tick_s']:.3g}", f"{row['value']:,.0f}",
            f"{row['per_cpu_s']:,.0f}", f"{row['array_bytes_a_drone'] / 1e3:,.0f}",
            *([f"{row['resident_bytes_a_drone'] / 1e3:,.0f}"] if what == "worlds" else []),
        )  # fmt: skip
    for name in ("time",) if what == "worlds" else ("time", "memory"):  # over worlds, a line says more of memory
        if (power := results.get(f"{name}_growth_{what}")) is not None:
            notes.append(f"{'CPU time' if name == 'time' else name} grows as {what}^{power['value']:.2f}")
    if what == "worlds":
        for name, of in (("memory_a_drone", "arrays"), ("resident_a_drone", "resident memory")):
            if (line := results.get(name)) is not None:
                each, whole = line["value"] / 1e6, line["fixed"] / 1e6
                notes.append(f"{of}: {each:.2f} MB a drone and {whole:.0f} MB for all, within {line['off']:.0%}")
    table.caption = "\n".join(notes)
    return table


def stage_table(plan: BenchPlan, results: Results) -> Table | None:
    """Return where an agent-step's time goes, by stage; None where nothing tells."""
    columns = [(who, beams) for beams in plan.beams for who in _COMPARED]
    found = {column: _stages(results, *column) for column in columns}
    found = {column: stages for column, stages in found.items() if stages}
    if not found:
        return None
    table = _table("Where the CPU time goes, µs an agent-step")
    table.add_column("stage")
    for who, beams in found:
        table.add_column("\n".join([*who.split("_"), f"{beams} beams"]), justify="right", vertical="bottom")
    for name in dict.fromkeys(name for stages in found.values() for name in stages):
        table.add_row(name, *(f"{stages[name]:,.1f}" if name in stages else "" for stages in found.values()))
    table.add_row("all", *(f"{sum(stages.values()):,.1f}" for stages in found.values()))
    critics = [results.get(f"{who}_critic_{beams}_beams") for who, beams in found]
    table.add_row("critic", *(f"{critic['value']:,.1f}" if critic else "" for critic in critics))
    table.caption = "rest: Python outside the stages. critic: on demand, not in the rates."
    return table


def _stages(results: Results, who: str, beams: int) -> dict[str, float]:
    start, end = f"{who}_stage_", f"_{beams}_beams"
    return {
        name.removeprefix(start).removesuffix(end): row["value"]
        for name, row in results.items()
        if name.startswith(start) and name.endswith(end)
    }


def _table(title: str) -> Table:
    return Table(
        title=title, title_justify="left", box=None, header_style="dim", pad_edge=False, caption_justify="left"
    )
