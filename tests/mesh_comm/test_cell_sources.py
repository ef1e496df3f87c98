"""Provenance: for a cell, which drone saw it, when, and by which way that came."""

from __future__ import annotations

import numpy as np
from radio_room import ROOM, Drone, exchange, make_drone

from imagine.core.frames import Pose
from imagine.mesh_comm.provenance import Sighting


def sightings(drone: Drone, x: float, y: float) -> dict[int, Sighting]:
    return {sighting.source: sighting for sighting in drone.node.provenance(x, y).sightings}


def test_own_scans_peers_scans_and_their_tiles_are_told_apart() -> None:
    one, two = make_drone(1), make_drone(2)
    exchange([one, two], np.array([0.0]))
    one.fly(Pose(0.0, 0.0, 0.0), 1.0)
    exchange([one, two], np.array([1.0]))
    two.fly(Pose(3.0, 0.0, 0.0), 1.1)
    exchange([one, two], np.array([1.1]))
    at = one.node.provenance(2.55, 0.05)
    assert [(s.source, s.way) for s in at.sightings] == [(1, "own scan"), (2, "scan")]
    assert at.belief == sum(s.units for s in at.sightings) == -2
    assert sightings(one, 2.55, 0.05)[2].stamp == 1.1
    exchange([one, two], np.arange(1.2, 4.0, 0.1))
    later = sightings(one, 2.55, 0.05)
    assert (later[2].way, later[2].via, later[2].provisional) == ("tile", 2, False)
    assert later[2].version == two.evidence.versions(2)[next(iter(two.evidence.versions(2)))]
    assert later[2].heard_at is not None
    assert later[2].heard_at > 1.1
    assert later[1].stamp == 1.0


def test_a_relayed_tile_names_who_passed_it_on() -> None:
    drones = [make_drone(i, protocol="multi-hop") for i in (1, 2, 3)]
    for now in np.arange(0.0, 4.0, 0.1):
        drones[2].fly(Pose(2.0, -1.0, 0.0), float(now))
        exchange(drones, np.array([now]), lambda a, b: abs(a - b) == 1)
    seen = sightings(drones[0], 2.5, -1.0)
    assert (seen[3].way, seen[3].via) == ("relay", 2)


def test_what_nobody_saw_comes_from_nobody() -> None:
    drone = make_drone(1)
    drone.fly(Pose(0.0, 0.0, 0.0), 0.0)
    for x, y in ((ROOM[2] + 3.0, 0.0), (400.0, 400.0)):
        assert drone.node.provenance(x, y).sightings == ()
        assert drone.node.provenance(x, y).belief == 0
