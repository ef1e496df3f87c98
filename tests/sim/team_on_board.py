"""What a team of drones has on board, fed with the poses and scans of a batched world and with the messages of its air.

Every message that the batch puts on its air is written out as the real one, sealed, carried for as long as the batch
carries it, and given to the real mesh nodes of those that the batch lets hear it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.core.frontier import FrontierField, frontier_field
from imagine.core.lidar import TEAMMATE_RADIUS_M, Scan, mask_near
from imagine.core.observation import observe
from imagine.core.planner import plan_velocity
from imagine.core.raster import CELL, TILE
from imagine.core.visits import VisitMap
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import pack_tile
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.scan_exchange import scan_message
from imagine.mesh_comm.seal import KEY_BYTES, OVERHEAD, Sealer
from imagine.onboard.teammates import peer_poses
from imagine.sim.air import DIGEST, LOSS, SCAN, STATUS, TILES
from imagine.sim.air_receive import _chance
from imagine.sim.exploration import Exploration

KEY = bytes(KEY_BYTES)


class InFlight(NamedTuple):
    """A sealed message on its way, in the order in which a radio medium delivers."""

    arrival: float
    sender: int
    sequence: int
    datagram: bytes


class OnBoard:
    """One drone: its evidence map and mesh node, and what it last saw. Numbered from 1 on the mesh."""

    def __init__(self, env: Exploration, world: int, drone: int) -> None:
        self.env, self.at, self.id = env, (world, drone), drone + 1
        self.evidence, self.visits = EvidenceMap(self.id), VisitMap()
        # as the batched air, the node draws peers' scans as they come, without leaving out whom it alone knows of
        mesh = MeshSettings(protocol=env.settings.protocol, mask_radius_m=0.0)
        self.cap_m = env.settings.map.range_cap_m
        self.node = MeshNode(self.evidence, env.lidar, self.cap_m, mesh, Sealer(KEY, self.id, 1))
        self.pose, self.scan, self.kept = Pose(0, 0, 0), Scan(0.0, np.empty(0, np.float32)), Scan(0.0, np.empty(0))
        self.now = 0.0

    def look(self, now: float) -> None:
        """Take the newest scan at the pose the drone takes for its own, map it, and count the visits."""
        x, y, yaw = (float(number) for number in self.env.estimates[self.at])
        self.now, self.pose = now, Pose(x, y, yaw)
        self.scan = Scan(now, self.env.ranges[self.at].copy())
        mates = self.node.teammates(now)
        self.kept = Scan(now, mask_near(self.scan.ranges, self.env.lidar, self.pose, mates, TEAMMATE_RADIUS_M))
        self.evidence.integrate(self.pose, self.kept, self.env.lidar, self.cap_m)
        if self.env.settings.observation.visits != "off" and self.env.alive[self.at]:
            self.visits.fit(self.evidence.origin_cells, self.evidence.shape)
            self.visits.count(x, y, peer_poses(self.node, now)[1])

    def field(self) -> FrontierField:
        return frontier_field(self.evidence.belief())

    def observation(self, field: FrontierField) -> dict[str, NDArray[np.float32]]:
        vx, vy, rate = (float(number) for number in self.env.twin.velocity[self.at])
        spec, origin = self.env.settings.observation, self.evidence.origin_cells
        if spec.visits != "off":
            self.visits.fit(origin, self.evidence.shape)
        return observe(
            spec, self.evidence.belief(), field, origin, self.pose, (vx, vy), rate, self.scan, self.env.lidar,
            peer_poses(self.node, self.now)[0], self.visits,
        )  # fmt: skip

    def planned(self, field: FrontierField) -> tuple[float, float] | None:
        return plan_velocity(field, self.evidence.origin_cells, self.pose, self.scan, self.env.lidar, 1.0)

    def window(self, array: NDArray[Any], cells: int) -> NDArray[Any]:
        """Return the part of an array of the map (a value for each `cells` by `cells`) that the batch's grid covers."""
        (column, row), (column0, row0) = self.env.maps.origins[self.at[0]], self.evidence.origin_cells
        rows, columns = (size // cells for size in self.env.maps.belief.shape[2:])
        first_row, first_column = (row - row0) // cells, (column - column0) // cells
        return array[first_row : first_row + rows, first_column : first_column + columns]


class TeamOnBoard:
    """The drones of a world of a batch, as they would know it on board; call `tick` after every step."""

    def __init__(self, env: Exploration, world: int = 0) -> None:
        self.env, self.world, self.rules = env, world, env.air.rules
        self.drones = [OnBoard(env, world, drone) for drone in range(env.drones)]
        self.delivered = np.zeros((env.drones, env.drones), np.int64)
        self.lost = self.relayed = self.sketched = 0
        self.said = np.zeros(4, np.int64)
        self._sealers = [Sealer(KEY, own.id, 1) for own in self.drones]
        self._in_flight: list[InFlight] = []
        self._offered: list[messages.Scan | None] = [None] * env.drones
        self._packed: dict[tuple[int, TileKey, int], bytes] = {}
        self._said_until = np.full(env.drones, -1)
        self._nodes = env.air.state.nodes[self.world].copy()
        self._nodes["next_scan"], self._nodes["scan_clock"] = -np.inf, 0  # as before the launch
        column, row = (int(number) * CELL for number in env.maps.origins[self.world])
        rows, columns = env.maps.belief.shape[2:]
        for own in self.drones:
            own.evidence.cover(column, row, column + columns * CELL - 0.05, row + rows * CELL - 0.05)

    def tick(self) -> None:
        """Hear, look and speak as the batch did in the tick that it has just flown."""
        now = int(self.env.ticks[self.world]) / self.rules.ticks_per_s
        if now == 0.0:
            self._meet()
        self._hear(now)
        for own in self.drones:
            own.look(now)
            if self.env.alive[own.at]:
                self._keep_tiles(own)
                self._offer(own, now)
        for own in self.drones:
            self._speak(own, now)
        self._nodes = self.env.air.state.nodes[self.world].copy()

    def _meet(self) -> None:
        """Let those in reach of each other at the launch have told, on their way up, where they are."""
        for sender in self.drones:
            x, y, yaw = (float(number) for number in self.env.estimates[sender.at])
            status = messages.Status(sender.id, 0.0, Pose(x, y, yaw), ladder="climb")
            datagram = self._sealers[sender.at[1]].seal(messages.encode(status), 0.0)
            for own in self.drones:
                if self.env.air.state.reach[self.world, sender.at[1], own.at[1]]:
                    own.node.receive(datagram, 0.0)

    def _hear(self, now: float) -> None:
        due = sorted(message for message in self._in_flight if message.arrival <= now + 1e-9)
        self._in_flight = [message for message in self._in_flight if message.arrival > now + 1e-9]
        reach, tick, key = (
            self.env.air.state.reach[self.world],
            int(self.env.ticks[self.world]),
            self.env._keys[self.world],
        )
        for message in due:
            for own in self.drones:
                if not reach[message.sender, own.at[1]]:
                    continue
                if (
                    _chance(key, tick, message.sender, own.at[1], message.sequence)
                    < self.env.air.state.media[self.world, LOSS]
                ):
                    self.lost += 1
                    continue
                own.node.receive(message.datagram, now)
                self.delivered[message.sender, own.at[1]] += 1

    def _keep_tiles(self, own: OnBoard) -> None:
        """Keep what the tiles of a drone's own layer hold at their versions: whoever passes them on says just that."""
        for key, version in own.evidence.versions(own.id).items():
            if (own.id, key, version) not in self._packed:
                self._packed[own.id, key, version] = pack_tile(own.evidence.tile(own.id, key))

    def _offer(self, own: OnBoard, now: float) -> None:
        """Offer a scan for sending where `MeshNode.offer_scan` would, going by when the batch last sent one."""
        clock = own.evidence.layers[own.id].clock
        before = self._nodes[own.at[1]]
        is_heard = any(peer.is_live for peer in own.node.peers(now).values())
        if self.rules.shares and is_heard and now >= before["next_scan"] - 1e-6 and clock != before["scan_clock"]:
            scan = scan_message(
                own.id, clock, own.pose, own.kept, self.env.lidar, own.cap_m, MAX_DATAGRAM - OVERHEAD
            )  # fmt: skip
            assert scan.beams == self.env.lidar.beams
            self._offered[own.at[1]] = scan

    def _speak(self, own: OnBoard, now: float) -> None:
        """Write out what the batch has put on air in this tick."""
        air = self.env.air.state
        node, ring, keys = air.nodes[own.at], air.messages[own.at], air.tile_keys[own.at]
        tile = int(node["first_tile"])
        for place in range(int(node["messages"])):
            record = ring[(int(node["first_message"]) + place) % len(ring)]
            kind, count = int(record["kind"]), int(record["count"]) if record["kind"] == TILES else 0
            told = [(tile + k) % len(keys) for k in range(count)]
            tile += count
            if record["sequence"] <= self._said_until[own.at[1]]:
                continue
            self._said_until[own.at[1]] = record["sequence"]
            self.said[kind] += 1
            message = self._message(own, record, told, keys, now)
            datagram = self._sealers[own.at[1]].seal(messages.encode(message), now)
            self._in_flight.append(InFlight(float(record["arrival"]), own.at[1], int(record["sequence"]), datagram))

    def _message(
        self, own: OnBoard, record: Any, told: list[int], keys: NDArray[np.int64], now: float
    ) -> messages.Message:
        """Return the message of a record; `told` are the slots of its tiles, whose places and versions are `keys`."""
        pose = Pose(*(float(record[name]) for name in ("x", "y", "yaw")))
        if record["kind"] == SCAN:
            scan, self._offered[own.at[1]] = self._offered[own.at[1]], None
            assert scan is not None
            assert scan.pose == pose
            return scan
        if record["kind"] == TILES:
            source = int(record["source"]) + 1
            self.relayed += source != own.id
            tiles = [keys[slot].tolist() for slot in told]
            if record["slot"] == 0:
                packed = [self._packed[source, self._key(place), version] for place, version in tiles]
                return messages.Tiles(source, self._tiles(tiles, packed), 1)
            self.sketched += 1
            cells = self.env.air.state.tile_cells[own.at]
            return messages.Sketch(source, self._tiles(tiles, [pack_tile(cells[slot]) for slot in told]), 1)
        if record["kind"] == DIGEST:  # what it tells decides only what is sent, and that is the batch's affair here
            return messages.Digest(now, [])
        assert record["kind"] == STATUS
        velocity = float(record["vx"]), float(record["vy"])
        if record["slot"] == 1:
            return messages.Here(own.id, now, pose, velocity)
        return messages.Status(own.id, now, pose, velocity, ladder="policy")

    def _tiles(self, tiles: list[list[int]], packed: list[bytes]) -> list[messages.Tile]:
        keys = [self._key(place) for place, _ in tiles]
        return [
            messages.Tile(key.column, key.row, version, cells)
            for key, (_, version), cells in zip(keys, tiles, packed, strict=True)
        ]

    def _key(self, place: int) -> TileKey:
        column, row = self.env.maps.origins[self.world] // TILE
        tile_columns = self.env.maps.versions.shape[4]
        return TileKey(int(column) + place % tile_columns, int(row) + place // tile_columns)
