"""When a drone found out where its peers' frames lie in its own, and when it lost a place again."""

from __future__ import annotations

from dataclasses import dataclass

from imagine.mesh_comm.messages import GROUND
from imagine.mesh_comm.node import MeshNode
from imagine.mesh_comm.placement import Standing
from imagine.onboard.records import Event

PLACED: tuple[Standing, ...] = ("given", "trusted")
"""Standings in which a peer's map counts in the own."""


@dataclass(frozen=True)
class PeerPlace:
    """A peer's standing now; `placed_s`: since when its map counts without a break, None while it does not."""

    standing: Standing
    placed_s: float | None


class PeerPlaces:
    """Follows the standing of every peer that was heard; one record each, which the mesh's memory bounds."""

    def __init__(self) -> None:
        """Start with nobody heard."""
        self.by_peer: dict[int, PeerPlace] = {}

    def observe(self, mesh: MeshNode, now: float) -> list[Event]:
        """Look at the mesh at `now`, seconds; return what has changed since the last look, in words."""
        events = []
        for peer in mesh.peers(now):
            if peer == GROUND:  # it has no map to be placed
                continue
            before = self.by_peer.get(peer)
            place = mesh.place(peer)
            was_placed = before is not None and before.placed_s is not None
            is_placed = place.standing in PLACED
            since = before.placed_s if before is not None and was_placed else now
            self.by_peer[peer] = PeerPlace(place.standing, since if is_placed else None)
            if is_placed and not was_placed and place.pose is not None and mesh.settings.frame != "shared":
                x, y, yaw = place.pose
                text = f"drone {peer} placed ({place.standing}): x {x:.2f} m, y {y:.2f} m, yaw {yaw:.3f} rad"
                events.append(Event(now, "place", text))
            elif was_placed and not is_placed:
                events.append(Event(now, "place", f"drone {peer}: its place is not known any more"))
        return events
