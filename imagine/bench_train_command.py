"""What `imagine bench train` reads from its flags, and the table it shows."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from imagine.core.errors import InputError
from imagine.kernel_cache import announce_compiling
from imagine.outputs import write_json
from imagine.sim.exploration_tick import STAGES
from imagine.train.bench import Results, bench_training
from imagine.train.settings import TrainSettings, load_train_settings

_ROWS = {
    "rollout": "rollout", "env": "  the twin", "level_images": "  images of levels", "acting": "  the actor",
    "update": "update", "values": "  the critic's values",
}  # fmt: skip


def bench_train_and_show(
    config: Path | None, worlds: int | None, drones: int | None, rounds: int | None, quick: bool,
    overrides: tuple[str, ...], json_file: Path | None,
) -> None:  # fmt: skip
    """Measure, print the table, and write what was asked for. Raises InputError naming the flag that is wrong."""
    settings = bench_settings(config, worlds, drones, quick, overrides)
    if rounds is not None and not 1 <= rounds <= 1000:
        raise InputError(f"--rounds {rounds}: give from 1 to 1000")
    announce_compiling(lambda text: print(text, file=sys.stderr))
    count = rounds or (1 if quick else 5)
    results = bench_training(settings, count, progress=lambda text: print(text, file=sys.stderr))
    results["cores"] = {"value": len(os.sched_getaffinity(0)), "unit": "cores"}
    Console().print(table_of(results))
    write_json(json_file, results)


def bench_settings(
    config: Path | None, worlds: int | None, drones: int | None, quick: bool, overrides: tuple[str, ...]
) -> TrainSettings:
    """Return the training configuration that flags ask for: of the given one, or the default, with 64 worlds of 3."""
    for flag, count, most in (("--worlds", worlds, 4096), ("--drones", drones, 16)):
        if count is not None and not 1 <= count <= most:
            raise InputError(f"{flag} {count}: give from 1 to {most}")
    size = [f"env.worlds={worlds or (4 if quick else 64)}", f"env.drones={drones or 3}"]
    if quick:
        size.append("ppo.rollout_steps=8")
    return load_train_settings(config, (*size, *overrides))


def table_of(results: Results) -> Table:
    """Return agent-steps a second, and the parts of an agent-step."""
    told = results["training"]
    table = Table(
        title=f"{told['worlds']} worlds of {told['drones']} drones, {told['precision']} on {told['device']}: "
        f"{told['value']:,.0f} agent-steps/s",
        title_justify="left", box=None, header_style="dim", pad_edge=False, caption_justify="left",
    )  # fmt: skip
    for title in ("stage", "µs an agent-step", "CPU µs", "agent-steps/s"):
        table.add_column(title, justify="left" if title == "stage" else "right")
    for name, shown in _ROWS.items():
        row = results[name]
        cpu = f"{row['cpu']:,.1f}" if "cpu" in row else ""
        table.add_row(shown, f"{row['value']:,.1f}", cpu, f"{1e6 / max(row['value'], 1e-9):,.0f}")
        if name == "env":
            for stage in STAGES:
                table.add_row(f"    {stage}", "", f"{results[f'env_{stage}']['value']:,.1f}", "")
    table.add_row("all", f"{1e6 / told['value']:,.1f}", f"{1e6 / told['per_cpu_s']:,.1f}", f"{told['value']:,.0f}")
    table.caption = (
        f"Medians of {told['rounds']} rounds, {told['low']:,.0f} to {told['high']:,.0f} agent-steps/s. "
        f"Actor and critic: {results['parameters']['value']:,} and {results['parameters']['critic']:,} weights."
    )
    return table
