"""A world of a batch, taken over by plain maps and mesh nodes in the middle of an episode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import TileKey
from imagine.core.frames import Pose
from imagine.core.raster import TILE
from imagine.mesh_comm.codec import pack_tile
from imagine.mesh_comm.digest import Held, digests
from imagine.mesh_comm.messages import MAX_DATAGRAM, Tile, Tiles
from imagine.mesh_comm.seal import OVERHEAD
from imagine.sim.air_receive import is_live
from imagine.sim.exploration import Exploration
from imagine.sim.mesh_flight import BOOT
from imagine.sim.plain.maps import PlainMaps
from imagine.sim.plain.mesh import PlainMesh, exploring

_TILES_A_MESSAGE = 4  # tiles that fit a datagram whatever they hold
_LONG_AGO_S = -1e3


def hand_over_maps(batch: Exploration, world: int, maps: PlainMaps) -> None:
    """Write a world's layers, versions, clocks and coverage into plain maps of the same level."""
    arrays = batch.maps.arrays
    notes = np.asarray(batch.air.state.notes["provisional"][world], np.bool_)
    provisional = notes.reshape(arrays.versions.shape[1:])
    rows, columns = maps.tiles
    for drone, own in enumerate(maps.evidence):
        for source in range(batch.drones):
            cells = maps.layer(drone, source)
            cells[...] = arrays.layers[world, drone, source, : cells.shape[0], : cells.shape[1]]
            versions = maps.versions(drone, source)
            versions[...] = arrays.versions[world, drone, source, :rows, :columns]
            for row, column in np.argwhere(provisional[drone, source, :rows, :columns]).tolist():
                at = row + maps.corner.row - own.corner.row, column + maps.corner.column - own.corner.column
                own.layers[source + 1].provisional[at] = True
            own.layers[source + 1].clock = int(versions.max())
    maps.seen[...] = arrays.seen[world, : rows * TILE, : columns * TILE]
    maps.discovered[...] = arrays.discovered[world]
    maps.derive()


def hand_over_mesh(batch: Exploration, world: int, maps: PlainMaps, mesh: PlainMesh) -> None:
    """Let nodes have heard of each other what the drones of a world have: poses, digests, and tiles to pass on.

    Call it before the maps are handed over. What is in flight at that moment is lost, and nobody remembers when it
    sent what: within a second, after which tiles may be sent again, a flight is as if it had never changed hands.
    """
    air, tick_s = batch.air.state, batch.dt
    for receiver, sender in np.ndindex(batch.drones, batch.drones):
        peer = air.peers[world, receiver, sender]
        if receiver == sender or peer["pose_tick"] < 0:
            continue
        if air.rules.relays:
            for tiles in _confirmed(batch, world, receiver, sender, maps):
                mesh.tell(sender, receiver, tiles, _LONG_AGO_S)
        pose = Pose(float(peer["x"]), float(peer["y"]), float(peer["yaw"]))
        velocity = float(peer["vx"]), float(peer["vy"])
        heard = {other + 1: 0.0 for other in range(batch.drones) if int(peer["hears"]) >> other & 1}
        at = int(peer["pose_tick"]) * tick_s
        mesh.tell(sender, receiver, exploring(sender + 1, at, pose, velocity, heard), at)
        if peer["digest_tick"] >= 0 and is_live(peer, int(batch.ticks[world]), air.rules):
            held = {
                source + 1: Held(BOOT, _listed(air.holdings[world, receiver, sender, source], batch, maps))
                for source in range(batch.drones)
                if source != sender
            }
            at = int(peer["digest_tick"]) * tick_s
            for digest in digests(at, held, MAX_DATAGRAM - OVERHEAD):
                mesh.tell(sender, receiver, digest, at)


def _listed(versions: NDArray[np.uint32], batch: Exploration, maps: PlainMaps) -> dict[TileKey, int]:
    """Return the held ones of a batch's tiles, by their place."""
    columns = batch.maps.versions.shape[4]
    return {
        TileKey(tile % columns + maps.corner.column, tile // columns + maps.corner.row): int(versions[tile])
        for tile in np.flatnonzero(versions).tolist()
    }


def _confirmed(batch: Exploration, world: int, holder: int, source: int, maps: PlainMaps) -> list[Tiles]:
    """Return, as messages, the tiles of a source that a drone may pass on."""
    held = batch.maps.versions[world, holder, source]
    cells = batch.air.state.confirmed[world, holder, source]
    tiles = [
        Tile(
            column + maps.corner.column, row + maps.corner.row, int(held[row, column]),
            pack_tile(cells[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]),
        )
        for row, column in np.argwhere(held > 0).tolist()
    ]  # fmt: skip
    return [Tiles(source + 1, tiles[k : k + _TILES_A_MESSAGE], BOOT) for k in range(0, len(tiles), _TILES_A_MESSAGE)]
