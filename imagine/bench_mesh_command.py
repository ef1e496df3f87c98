"""What `imagine bench mesh` reads from its flags, and the table it shows."""

from __future__ import annotations

import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from imagine.core.errors import InputError
from imagine.kernel_cache import announce_compiling
from imagine.outputs import write_json
from imagine.train.mesh_bench import MeshPlan, Results, bench_mesh

_QUICK = MeshPlan(
    drones=2, seconds=12.0, flights=1, crowd=3, crowd_seconds=3.0, minutes=0.2, rounds=1, hostile=2000
)  # fmt: skip


def bench_mesh_and_show(
    level: str | None, flights: int | None, minutes: float | None, hostile: int | None, quick: bool,
    json_file: Path | None,
) -> None:  # fmt: skip
    """Measure, print the table, and write what was asked for. Raises InputError naming the flag that is wrong."""
    plan = mesh_plan(level, flights, minutes, hostile, quick)
    announce_compiling(lambda text: print(text, file=sys.stderr))
    results = bench_mesh(plan, progress=lambda text: print(text, file=sys.stderr))
    Console().print(table_of(results))
    write_json(json_file, results)


def mesh_plan(
    level: str | None, flights: int | None, minutes: float | None, hostile: int | None, quick: bool
) -> MeshPlan:
    """Return the plan that flags ask for; None takes the default, or that of a quick run."""
    base = _QUICK if quick else MeshPlan()
    if flights is not None and not 1 <= flights <= 100:
        raise InputError(f"--flights {flights}: give from 1 to 100")
    if minutes is not None and not 0.0 <= minutes <= 600.0:
        raise InputError(f"--minutes {minutes:g}: give from 0 to 600")
    if hostile is not None and not 1000 <= hostile <= 10**8:
        raise InputError(f"--hostile {hostile}: give from 1000 to 100000000")
    return MeshPlan(
        level=level or base.level, drones=base.drones, seconds=base.seconds, flights=flights or base.flights,
        crowd=base.crowd, crowd_seconds=base.crowd_seconds, minutes=base.minutes if minutes is None else minutes,
        rounds=base.rounds, hostile=hostile or base.hostile,
    )  # fmt: skip


def table_of(results: Results) -> Table:
    """Return every row with what stands beside it."""
    table = Table(box=None, header_style="dim", pad_edge=False)
    for title in ("what", "value", "unit", "beside it"):
        table.add_column(title, justify="right" if title == "value" else "left")
    for name, row in results.items():
        beside = ", ".join(f"{key} {value}" for key, value in row.items() if key not in ("value", "unit"))
        value = "–" if row["value"] is None else f"{row['value']:,}"
        table.add_row(name.replace("_", " "), value, row["unit"], beside)
    return table
