"""What `imagine fly --sim` shows: the page's address, a live table, and the outcome."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from imagine.core.errors import InputError, WorkError
from imagine.fly_sim import FlyOptions, Watcher, fly_sim
from imagine.gcs.snapshot import FleetSnapshot
from imagine.gcs.table import render
from imagine.mesh_comm.settings import Protocol
from imagine.onboard.settings import DEFAULT_POLICY
from imagine.sim.server import TickRecord

_LINE_TICKS = 100


class _Screen(Watcher):
    """A live table on a terminal; plain lines elsewhere."""

    def __init__(self, console: Console, live: Live | None) -> None:
        self._console, self._live = console, live

    def started(self, url: str | None) -> None:
        if url is not None:
            self._console.print(f"ground station: {url}", highlight=False)

    def tick(self, record: TickRecord, coverage: float, snapshot: FleetSnapshot | None) -> None:
        if self._live is not None:
            if snapshot is not None:
                self._live.update(render(snapshot), refresh=True)
        elif record.tick % _LINE_TICKS == _LINE_TICKS - 1:
            states = "  ".join(f"D{v.drone} {v.mode.name.lower()} {v.height_m:.1f} m" for v in record.vehicles)
            self._console.print(f"{record.time_s:6.1f} s  coverage {coverage:6.1%}  {states}", highlight=False)


def fly_in_twin(
    began: float,
    *,
    level: str,
    drones: int,
    policy: str | None,
    protocol: Protocol,
    ticks: int,
    lockstep: bool,
    speed: float,
    headless: bool,
    seed: int,
    port: int,
    map_file: Path | None,
    json_file: Path | None,
) -> None:
    """Fly, show and write the outcome. Raises WorkError, after all is shown, where a drone failed."""
    for out in (map_file, json_file):
        if out is not None and not out.absolute().parent.is_dir():
            raise InputError(f"{out}: its folder does not exist")
    options = FlyOptions(
        level=level,
        drones=drones,
        policy=None if policy == "frontier" else Path(policy) if policy is not None else DEFAULT_POLICY,
        protocol=protocol,
        ticks=ticks,
        lockstep=lockstep,
        speed=speed,
        headless=headless,
        seed=seed,
        port=port,
        map_image=map_file,
    )
    console = Console()
    if console.is_terminal and not headless:
        with Live(console=console, auto_refresh=False) as live:
            found = fly_sim(options, _Screen(console, live), began)
    else:
        found = fly_sim(options, _Screen(console, None), began)
    if json_file is not None:
        try:
            json_file.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{json_file}: the results cannot be written: {error.strerror}") from error
    _show(console, found)
    sys.stdout.flush()
    failed = [f"drone {drone['id']}: {drone['error']}" for drone in found["drones"] if drone["error"]]
    if failed:
        raise WorkError("; ".join(failed))


def _show(console: Console, found: dict[str, Any]) -> None:
    decided = found["decided_by"]
    total = max(1, sum(decided.values()))
    shares = ", ".join(f"{name} {count / total:.0%}" for name, count in decided.items() if count)
    console.print(
        f"coverage {found['coverage']:.1%} after {found['ticks']} ticks "
        f"(90% at {found['t90'] or 'no'} tick, 95% at {found['t95'] or 'no'} tick), "
        f"{found['collisions']} collisions, {found['wall_s']:.0f} s; decided by {shares or 'nobody'}",
        highlight=False,
    )
    table = Table(box=None, header_style="dim", pad_edge=False)
    for name in ("drone", "flown", "own cells", "by scans", "by maps", "sent", "pose error", "tick p99", "ended"):
        table.add_column(name, justify="left" if name in ("drone", "ended") else "right", overflow="fold")
    for drone in found["drones"]:
        error, tick_ms = drone["pose_rmse_m"], drone["tick_ms"]
        table.add_row(
            f"D{drone['id']}",
            f"{drone['distance_m']:.1f} m",
            str(drone["own_cells"]),
            str(drone["scan_cells"]),
            str(drone["map_cells"]),
            f"{sum(drone['bytes_sent'].values()) / 1000:.0f} kB",
            "unknown" if error is None else f"{error:.3f} m",
            "unknown" if tick_ms is None else f"{tick_ms['p99']:.0f} ms",
            drone["error"] or "; ".join(f["text"] for f in drone["failsafes"]) or drone["reason"] or drone["phase"],
        )
    console.print(table, highlight=False)
