"""The fleet as a table for the terminal."""

from __future__ import annotations

from typing import Literal, NamedTuple

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from imagine.gcs.snapshot import DroneView, FleetEvent, FleetSnapshot

_EVENTS_SHOWN = 5
_STATE_STYLE = {"policy": "green", "frontier": "cyan", "hold": "yellow", "land": "yellow"}


class _Column(NamedTuple):
    name: str
    justify: Literal["left", "right"]
    from_width: int


_COLUMNS = (
    _Column("drone", "left", 0),
    _Column("state", "left", 0),
    _Column("pose", "right", 110),
    _Column("height", "right", 0),
    _Column("battery", "right", 0),
    _Column("mode", "right", 90),
    _Column("own area", "right", 120),
    _Column("sent", "right", 120),
    _Column("rate", "right", 100),
    _Column("age", "right", 0),
    _Column("hears", "left", 100),
    _Column("why", "left", 0),
)
_UNPLACED = {"unknown": "not placed", "candidate": "being placed"}
_SEVERITY_STYLE = {"info": "dim", "warning": "yellow", "error": "bold red"}


def render(snapshot: FleetSnapshot, width: int = 140) -> RenderableType:
    """Return a snapshot as one line of figures, a row per drone, and the latest events, for rich to show.

    Where `width` characters are too few for all columns, those that a pilot needs least are left out.
    """
    shown = [column for column in _COLUMNS if width >= column.from_width]
    table = Table(box=None, header_style="dim", pad_edge=False, expand=False)
    for column in shown:
        if column.name == "why":
            table.add_column("why", overflow="fold", ratio=1)
        else:
            table.add_column(column.name, justify=column.justify, no_wrap=True)
    for drone in snapshot.drones:
        cells = dict(zip((c.name for c in _COLUMNS), _row(drone, snapshot.map.cell_m), strict=True))
        table.add_row(*(cells[column.name] for column in shown), style="red" if drone.stale else "")
    events = [_event(event) for event in snapshot.events[-_EVENTS_SHOWN:]]
    return Group(_headline(snapshot), table, *events)


def _headline(snapshot: FleetSnapshot) -> Text:
    explored = f"{snapshot.known_free_m2:.1f} m² explored"
    if snapshot.coverage is not None:
        explored = f"coverage {snapshot.coverage:.1%}, {explored}"
    minutes, seconds = divmod(int(snapshot.elapsed_s), 60)
    flying = f"{snapshot.flying} of {len(snapshot.drones)} flying"
    line = Text(f"{minutes}:{seconds:02d}  {explored}, {flying}", style="bold")
    if (order := snapshot.command) is not None:
        line.append(f"   pilot: {order.action}, {len(order.confirmed)} of {len(order.expected)} confirmed", "yellow")
    return line


def _row(drone: DroneView, cell_m: float) -> list[RenderableType]:
    state = "lost" if drone.lost else "no data" if drone.stale else drone.state
    return [
        f"D{drone.id}",
        Text(state, style="bold red" if drone.stale else _STATE_STYLE.get(drone.state, "")),
        f"{drone.x:.1f}, {drone.y:.1f}" if drone.located else _UNPLACED.get(drone.place, "unknown"),
        f"{drone.height_m:.1f} m",
        "unknown" if drone.battery is None else f"{drone.battery:.0%}",
        f"{drone.mode or 'unknown'}{'' if drone.armed else ' (disarmed)'}",
        f"{drone.own_cells * cell_m**2:.1f} m²",
        _bytes(sum(drone.bytes_sent.values())),
        f"{_bytes(0.0 if drone.stale else drone.rate_bps)}/s",
        f"{drone.age_s:.1f} s",
        " ".join(f"D{peer}" for peer in drone.hears) or "nobody",
        Text(drone.note or (f"silent; last {drone.state}" if drone.stale else drone.reason)),
    ]


def _event(event: FleetEvent) -> Text:
    minutes, seconds = divmod(int(event.time_s), 60)
    who = f"D{event.drone}" if event.drone else "all"
    return Text(f"{minutes}:{seconds:02d} {who} {event.text}", style=_SEVERITY_STYLE[event.severity])


def _bytes(count: float) -> str:
    if count < 1000:
        return f"{count:.0f} B"
    return f"{count / 1e3:.1f} kB" if count < 1e6 else f"{count / 1e6:.2f} MB"
