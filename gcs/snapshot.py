"""What the ground station knows at one moment: immutable records that any thread may read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from imagine.core.evidence import TileKey
from imagine.core.raster import CELL, TILE
from imagine.mesh_comm.placement import Standing

Severity = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Trail:
    """Where a drone has been: its latest `points` (x, y) in metres, oldest first; `end` counts all points ever added.

    A reader that knows `end` at its last look needs only the points after it.
    """

    points: tuple[tuple[float, float], ...] = ()
    end: int = 0

    def since(self, end: int) -> tuple[tuple[float, float], ...]:
        """Return the points added after the trail had `end` points, as far back as the trail reaches."""
        new = max(0, min(self.end - end, len(self.points)))
        return self.points[len(self.points) - new :]


@dataclass(frozen=True)
class DroneView:
    """One drone as the ground sees it. Metres, radians, seconds, map frame; bytes are of its radio."""

    id: int
    located: bool
    """Whether its position is known; else x, y and yaw are zero."""
    x: float
    y: float
    yaw: float
    vx: float
    vy: float
    height_m: float
    battery: float | None
    """Share of the charge left, 0-1; None where the vehicle does not tell."""
    mode: str
    armed: bool
    flying: bool
    state: str
    """Rung of the decision ladder: policy, frontier, hold, land, disarm; or idle before takeoff."""
    reason: str
    own_cells: int
    scan_cells: int
    map_cells: int
    bytes_sent: Mapping[str, int]
    """Bytes the drone has sent, by kind of message."""
    taught: Mapping[str, int]
    """Cells that peers learned by the drone's scans and tiles, as it says itself."""
    place: Standing
    """Whether the ground knows where the drone's frame lies in the one shown; where not, its map is not shown."""
    rate_bps: float
    """Bytes a second the drone sent lately."""
    age_s: float
    stale: bool
    lost: bool
    """Someone who knows (the twin, a supervisor) said that this drone is gone, whatever its data's age."""
    note: str
    hears: tuple[int, ...]
    """Ids of the drones it hears by radio."""
    trail: Trail = field(default_factory=Trail)


@dataclass(frozen=True)
class MapTile:
    """One tile of the merged belief: int8 `TILE` x `TILE`, row-major from the south-west; `version` only grows."""

    version: int
    cells: bytes


@dataclass(frozen=True)
class MapView:
    """The merged belief, by tile. `version` is that of its newest tile."""

    version: int = 0
    known_cells: int = 0
    free_cells: int = 0
    tiles: Mapping[TileKey, MapTile] = field(default_factory=lambda: MappingProxyType({}))
    cell_m: float = CELL
    tile_cells: int = TILE

    def since(self, version: int) -> list[tuple[TileKey, MapTile]]:
        """Return the tiles that changed after the map had `version`."""
        return [(key, tile) for key, tile in self.tiles.items() if tile.version > version]


@dataclass(frozen=True)
class FleetEvent:
    """Something the pilot should be able to read back: when (seconds since start), which drone (0: all), what."""

    serial: int
    time_s: float
    drone: int
    severity: Severity
    text: str


@dataclass(frozen=True)
class CommandView:
    """The pilot's last command: how many of the drones it is meant for have taken it up."""

    action: str
    target: int
    age_s: float
    expected: tuple[int, ...]
    confirmed: tuple[int, ...]


@dataclass(frozen=True)
class FleetSnapshot:
    """Everything a display shows, at one moment. Never changes once made."""

    time_s: float
    elapsed_s: float
    drones: tuple[DroneView, ...]
    map: MapView
    links: tuple[tuple[int, int], ...]
    """Pairs of drones (lower id first) of which at least one hears the other."""
    coverage: float | None
    """Share of the reachable free cells seen, where someone knows the whole space; None in the field."""
    events: tuple[FleetEvent, ...] = ()
    command: CommandView | None = None
    dropped_datagrams: int = 0
    over: str = ""
    """How the flight ended, once it has; what is shown then is final."""

    @property
    def known_free_m2(self) -> float:
        """Area known to be free, square metres."""
        return self.map.free_cells * self.map.cell_m**2

    @property
    def flying(self) -> int:
        """How many drones fly and are heard."""
        return sum(drone.flying and not drone.stale for drone in self.drones)
