"""What `imagine fly --sim` shows: the page's address, a live table, and the outcome."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from imagine.core.config import load_settings
from imagine.core.errors import WorkError
from imagine.fly_sim import FlyOptions, Watcher, fly_sim
from imagine.gcs.snapshot import FleetSnapshot
from imagine.gcs.table import render
from imagine.mesh_comm.settings import Frame, Protocol
from imagine.onboard.settings import DEFAULT_POLICY
from imagine.outputs import write_json
from imagine.runner_processes import RunnerProcesses
from imagine.sim.server import TickRecord
from imagine.sim.twin_settings import TwinSettings

_LINE_TICKS = 100


class _Screen(Watcher):
    """A live table on a terminal; plain lines elsewhere."""

    def __init__(self, console: Console, live: Live | None) -> None:
        self._console, self._live = console, live

    def compiling(self) -> None:
        self._console.print("first start: compiling the kernels, which takes about 20 s once", highlight=False)

    def serving(self, url: str) -> None:
        self._console.print(f"ground station: {url}", highlight=False)

    def landing(self) -> None:
        self._console.print("landing all drones; once more ends the command at once", highlight=False)

    def tick(self, record: TickRecord, coverage: float, snapshot: FleetSnapshot | None) -> None:
        if self._live is not None:
            if snapshot is not None:
                self._live.update(render(snapshot, self._console.width), refresh=True)
        elif record.tick % _LINE_TICKS == _LINE_TICKS - 1:
            states = "  ".join(f"D{v.drone} {v.mode.name.lower()} {v.height_m:.1f} m" for v in record.vehicles)
            self._console.print(f"{record.time_s:6.1f} s  coverage {coverage:6.1%}  {states}", highlight=False)


def fly_in_twin(
    processes: RunnerProcesses,
    began: float,
    *,
    level: str,
    drones: int,
    policy: str | None,
    protocol: Protocol,
    frame: Frame,
    ticks: int,
    lockstep: bool,
    speed: float,
    headless: bool,
    seed: int,
    port: int,
    map_file: Path | None,
    json_file: Path | None,
    twin_file: Path | None,
    overrides: Sequence[str],
) -> None:
    """Fly, show and write the outcome. Raises WorkError, after all is shown, where a drone failed."""
    options = FlyOptions(
        level=level,
        drones=drones,
        policy=None if policy == "frontier" else Path(policy) if policy is not None else DEFAULT_POLICY,
        protocol=protocol,
        frame=frame,
        ticks=ticks,
        lockstep=lockstep,
        speed=speed,
        headless=headless,
        seed=seed,
        port=port,
        map_image=map_file,
        twin=load_settings(TwinSettings, twin_file, overrides),
    )
    console = Console(soft_wrap=not sys.stdout.isatty())  # a file or a pipe has no width
    if console.is_terminal and not headless:
        with Live(console=console, auto_refresh=False) as live:
            found = fly_sim(options, processes, _Screen(console, live), began)
    else:
        found = fly_sim(options, processes, _Screen(console, None), began)
    _show(console, found)
    write_json(json_file, found)
    sys.stdout.flush()
    if failed := failures(found["drones"]):
        raise WorkError("; ".join(failed))


def failures(drones: list[dict[str, Any]]) -> list[str]:
    """Return in words why each of the flight's drones failed: its process died, or its runner's failsafe ended it."""
    found = []
    for drone in drones:
        failsafe = "; ".join(f"failsafe: {f['text']}" for f in drone["failsafes"] if f["kind"] == "runner")
        if why := drone["error"] or failsafe:
            found.append(f"drone {drone['id']}: {why}")
    return found


def _show(console: Console, found: dict[str, Any]) -> None:
    decided = found["decided_by"]
    total = max(1, sum(decided.values()))
    shares = ", ".join(f"{name} {count / total:.0%}" for name, count in decided.items() if count)
    console.print(
        f"coverage {found['coverage']:.1%} after {found['ticks']} ticks "
        f"(90% {_reached(found['t90'])}, 95% {_reached(found['t95'])}), {found['collisions']} collisions, "
        f"{found['wall_s']:.0f} s; decided by {shares or 'nobody'}",
        highlight=False,
    )
    table = Table(box=None, header_style="dim", pad_edge=False)
    for name in (
        "drone",
        "flown",
        "own cells",
        "by scans",
        "by maps",
        "sent",
        "pose error",
        "tick p99",
    ):
        table.add_column(name, justify="left" if name == "drone" else "right", no_wrap=True)
    endings: dict[str, list[str]] = {}
    for drone in found["drones"]:
        error, tick_ms = drone["pose_rmse_m"], drone["tick_ms"]
        table.add_row(
            f"D{drone['id']}",
            *_known(drone),
            "unknown" if error is None else f"{error:.3f} m",
            "unknown" if tick_ms is None else f"{tick_ms['p99']:.0f} ms",
        )
        failsafes = "; ".join(f"{f['kind']} failsafe: {f['text']}" for f in drone["failsafes"])
        ending = "; ".join(filter(None, (drone["error"], failsafes))) or drone["reason"] or drone["phase"]
        endings.setdefault(ending, []).append(f"D{drone['id']}")
    console.print(table, highlight=False)
    for line in filter(None, (_taught(found), *_placed(found))):
        console.print(line, highlight=False, markup=False)
    for ending, names in endings.items():
        console.print(f"{', '.join(names)}: {ending}", highlight=False, markup=False)


def _known(drone: dict[str, Any]) -> tuple[str, ...]:
    """Return distance, cells and bytes in words; a drone that was killed left none."""
    if drone["distance_m"] is None:
        return ("lost",) + ("",) * 4
    sent = sum(drone["bytes_sent"].values()) / 1000
    cells = (str(drone[kind]) for kind in ("own_cells", "scan_cells", "map_cells"))
    return (f"{drone['distance_m']:.1f} m", *cells, f"{sent:.0f} kB")


def _taught(found: dict[str, Any]) -> str:
    """Return what the drones' scans and tiles told their peers, in a line; empty where nothing was told."""
    told = []
    for drone in found["drones"]:
        bought = (drone["receipts"] or {}).values()
        cells, spent = sum(r["cells"] for r in bought), sum(r["bytes"] for r in bought)
        if spent:
            told.append(f"D{drone['id']} {cells} cells ({cells / spent:.2f} a byte)")
    return f"taught their peers: {', '.join(told)}" if told else ""


def _placed(found: dict[str, Any]) -> list[str]:
    """Return, for flights whose drones share no frame, a line for each drone: when it knew its peers' places."""
    if found["frame"] == "shared":
        return []
    lines = []
    for drone in found["drones"]:
        told = [
            f"D{peer['id']} {peer['standing'] if peer['placed_s'] is None else _since(peer)}"
            for peer in drone["peers"] or ()
        ]
        lines.append(f"D{drone['id']} places its peers: {', '.join(told) or 'none heard'}")
    return lines


def _since(peer: dict[str, Any]) -> str:
    return f"{peer['standing']} since {peer['placed_s']:.1f} s"


def _reached(tick: int | None) -> str:
    return "not reached" if tick is None else f"at tick {tick}"
