"""What `imagine level floor` shows: how soon levels could be explored by drones that know them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from imagine.kernel_cache import announce_compiling
from imagine.outputs import write_json
from imagine.sim.clairvoyant import Clairvoyant, Floor
from imagine.sim.level import load_level


def show_floors(names: list[str], drones: int, launches: int, share: float, seed: int, json_file: Path | None) -> None:
    """Print, for each level, ticks of 0.1 s from its launch point, and the mean of so many random launches.

    Raises InputError where a level is wrong, or too small for the team.
    """
    levels = [load_level(name) for name in names]
    starts = [level.launch_poses(drones) for level in levels]  # all are checked before any is worked on
    announce_compiling(lambda text: print(text, file=sys.stderr))
    table = Table(
        "level", "launch", "bound", "plan", box=None, title=f"{drones} drones, {share:.0%} seen", title_justify="left"
    )
    rows: list[dict[str, Any]] = []
    for level, start in zip(levels, starts, strict=True):
        known = Clairvoyant(level)
        generator = np.random.default_rng(seed)
        found = {"point": [known.floor(start, share=share, seed=seed)]}
        anywhere = [level.launch_poses(drones, generator) for _ in range(launches)]
        found["random"] = [known.floor(launch, share=share, seed=seed) for launch in anywhere]
        for launch, floors in found.items():
            if floors:
                rows.append(_row(level.name, launch, drones, share, floors))
                table.add_row(level.name, launch, f"{rows[-1]['bound']:.0f}", f"{rows[-1]['plan']:.0f}")
    console = Console()
    console.print(table)
    console.print("ticks of 0.1 s: nobody is below the bound; a team that knows the level has done it by the plan")
    write_json(json_file, rows)


def _row(level: str, launch: str, drones: int, share: float, floors: list[Floor]) -> dict[str, Any]:
    return {
        "level": level, "launch": launch, "drones": drones, "share": share, "launches": len(floors),
        "bound": float(np.mean([floor.bound for floor in floors])),
        "plan": float(np.mean([floor.plan for floor in floors])),
    }  # fmt: skip
