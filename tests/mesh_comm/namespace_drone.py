"""A node on a real network interface, for test_link_namespaces.py: `python namespace_drone.py ID URL...`, one line out.

It speaks and listens on the last URL, and listens on the others, until it holds tiles of a peer's map or for 20 s.
"""

from __future__ import annotations

import json
import select
import sys
import time

from radio_room import make_drone

from imagine.core.frames import Pose
from imagine.mesh_comm.links import open_link

_DEADLINE_S = 20.0
_LINGER_S = 2.0  # the other one may not have everything yet


def main() -> None:
    """Fly in the room and share the map; print who was heard, and by which link datagrams came."""
    own, urls = int(sys.argv[1]), sys.argv[2:]
    links = [open_link(url) for url in urls]
    heard = [0] * len(links)
    drone = make_drone(own)
    started = time.monotonic()
    until, next_scan = started + _DEADLINE_S, started
    while (now := time.monotonic()) < until:
        if now >= next_scan:
            next_scan = now + 0.1
            drone.fly(Pose(0.2 * own, 0.0, 0.1 * own), now)
        for datagram in drone.poll(now):
            links[-1].send(datagram)
        select.select(links, [], [], 0.02)
        for index, link in enumerate(links):
            for datagram in link.receive():
                heard[index] += datagram[4] != own
                drone.node.receive(datagram, now)
        if any(drone.evidence.versions(peer) for peer in drone.node.peers(now)):  # tiles of its map have come
            until = min(until, now + _LINGER_S)
    for link in links:
        link.close()
    tiles = {peer: len(drone.evidence.versions(peer)) for peer in drone.node.peers(now)}
    told = json.dumps({"id": own, "tiles": tiles, "heard": heard, "stats": drone.node.stats})
    sys.stdout.write(told + "\n")  # in one piece: both drones write to one pipe


main()
