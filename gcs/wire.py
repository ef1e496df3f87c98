"""Snapshots as JSON for the page: whole records for what is small, differences for the map, trails and events."""

from __future__ import annotations

import base64
from dataclasses import asdict, dataclass, field
from typing import Any

import msgspec

from imagine.core.errors import InputError
from imagine.gcs.snapshot import DroneView, FleetSnapshot
from imagine.mesh_comm.messages import ACTIONS

_LARGEST_REQUEST = 512


class CommandRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a client asks for: hold, land or resume, and the drone it is meant for (0: all)."""

    command: str
    target: int = 0


@dataclass
class ClientView:
    """What one client has been sent so far."""

    map_version: int = 0
    event_serial: int = 0
    trail_ends: dict[int, int] = field(default_factory=dict)


def state_since(snapshot: FleetSnapshot, client: ClientView) -> dict[str, Any]:
    """Return what a client needs to catch up with a snapshot, as plain JSON values, and note that it has it.

    Map tiles, trail points and events are only those the client lacks. Tile cells are base64 of int8.
    """
    view = snapshot.map
    state: dict[str, Any] = {
        "time_s": round(snapshot.time_s, 3),
        "elapsed_s": round(snapshot.elapsed_s, 1),
        "coverage": None if snapshot.coverage is None else round(snapshot.coverage, 4),
        "known_free_m2": round(snapshot.known_free_m2, 2),
        "flying": snapshot.flying,
        "links": snapshot.links,
        "command": None if snapshot.command is None else asdict(snapshot.command),
        "dropped_datagrams": snapshot.dropped_datagrams,
        "over": snapshot.over,
        "events": [asdict(event) for event in snapshot.events if event.serial > client.event_serial],
        "map": {
            "version": view.version,
            "known_cells": view.known_cells,
            "cell_m": view.cell_m,
            "tile_cells": view.tile_cells,
            "tiles": [
                [key.column, key.row, base64.b64encode(tile.cells).decode("ascii")]
                for key, tile in view.since(client.map_version)
            ],
        },
        "drones": [_drone(drone, client.trail_ends.get(drone.id, 0)) for drone in snapshot.drones],
    }
    client.map_version = view.version
    client.event_serial = max([client.event_serial, *(event.serial for event in snapshot.events)])
    client.trail_ends = {drone.id: drone.trail.end for drone in snapshot.drones}
    return state


def _drone(drone: DroneView, trail_end: int) -> dict[str, Any]:
    return {
        "id": drone.id,
        "located": drone.located,
        "x": round(drone.x, 3),
        "y": round(drone.y, 3),
        "yaw": round(drone.yaw, 4),
        "vx": round(drone.vx, 3),
        "vy": round(drone.vy, 3),
        "height_m": round(drone.height_m, 2),
        "battery": None if drone.battery is None else round(drone.battery, 3),
        "mode": drone.mode,
        "armed": drone.armed,
        "flying": drone.flying,
        "state": drone.state,
        "reason": drone.reason,
        "own_cells": drone.own_cells,
        "scan_cells": drone.scan_cells,
        "map_cells": drone.map_cells,
        "bytes_sent": dict(drone.bytes_sent),
        "taught": dict(drone.taught),
        "place": drone.place,
        "rate_bps": round(drone.rate_bps, 1),
        "age_s": round(drone.age_s, 2),
        "stale": drone.stale,
        "lost": drone.lost,
        "note": drone.note,
        "hears": drone.hears,
        "trail": [(round(x, 2), round(y, 2)) for x, y in drone.trail.since(trail_end)],
    }


def decode_request(text: str | bytes) -> CommandRequest:
    """Read a client's command. Raises InputError on anything that is not one of the known commands."""
    if len(text) > _LARGEST_REQUEST:
        raise InputError(f"a command of {len(text)} bytes is longer than {_LARGEST_REQUEST}")
    try:
        request = msgspec.json.decode(text, type=CommandRequest)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(f"not a command: {error}") from error
    if request.command not in ACTIONS or not 0 <= request.target <= 254:
        raise InputError(
            f"unknown command {request.command!r:.40} for drone {request.target}; known: {', '.join(ACTIONS)}"
        )
    return request
