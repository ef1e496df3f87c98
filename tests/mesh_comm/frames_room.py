"""Drones that start anywhere in a flat with rooms of different shapes, each mapping in a frame of its own."""

from __future__ import annotations

import math

import numpy as np
from flat_rooms import look
from numpy.typing import NDArray
from radio_room import CAP_M, LIDAR, Drone

from imagine.core.frames import Pose, compose, inverse
from imagine.mesh_comm.messages import Status

FLAT = np.array([
    [0, 0, 11, 0], [11, 0, 11, 7], [11, 7, 0, 7], [0, 7, 0, 0],
    [4, 0, 4, 2.2], [4, 3.4, 4, 7], [7.5, 3, 11, 3], [7.5, 3, 7.5, 1.2], [6, 5.2, 6, 7], [1.2, 4.6, 2.6, 4.6],
    [2.6, 4.6, 2.6, 5.4], [9.0, 5.0, 9.8, 5.6],
])  # fmt: skip
"""Walls of the flat, `[n, 4]` (x0, y0, x1, y1), metres."""
SQUARE = np.array([[0, 0, 6, 0], [6, 0, 6, 6], [6, 6, 0, 6], [0, 6, 0, 0]], float)
"""A square room: it looks the same from four sides."""
WAY = [(1.0, 1.2), (2.0, 2.8), (3.2, 2.8), (5.0, 2.8), (5.2, 1.2), (6.6, 1.0), (8.5, 1.0), (6.6, 1.0), (6.5, 3.6),
       (7.5, 4.6), (9.9, 4.2), (7.5, 4.6), (7.0, 6.2), (5.2, 4.4), (5.0, 6.0), (5.0, 2.8), (1.0, 3.4), (0.8, 5.8),
       (3.3, 6.2)]  # fmt: skip
"""A way through all of the flat, metres."""


def along(way: list[tuple[float, float]], metres: float) -> tuple[float, float]:
    """Return the point so far along a way; it is flown to and fro."""
    points = np.array(way + way[-2:0:-1], float)
    points = np.vstack((points, points[:1]))
    lengths = np.hypot(*np.diff(points, axis=0).T)
    metres %= lengths.sum()
    for start, end, length in zip(points[:-1], points[1:], lengths, strict=True):
        if metres <= length:
            x, y = start + (end - start) * metres / length
            return float(x), float(y)
        metres -= length
    return way[0]


class Stranger:
    """A drone on its way through the flat, that knows where it is only in the frame it began in."""

    def __init__(self, drone: Drone, frame: Pose, begun_m: float, walls: NDArray[np.float64] = FLAT) -> None:
        """Begin so far along the way; `frame` is the drone's map frame in the flat's."""
        self.drone, self.frame, self._at, self._walls = drone, frame, begun_m, walls
        self.true = Pose(*along(WAY, begun_m), 0.0)

    def fly(self, now: float, speed_mps: float = 0.8, dt: float = 0.1, way: list[tuple[float, float]] = WAY) -> None:
        """Fly on, scan, map, and offer scan and status to the mesh."""
        self._at += speed_mps * dt
        self.true = Pose(*along(way, self._at), 0.3 * math.sin(0.2 * now))
        pose, node = compose(inverse(self.frame), self.true), self.drone.node
        scan = look(self._walls, self.true, LIDAR, now)
        self.drone.evidence.integrate(pose, scan, LIDAR, CAP_M)
        node.set_status(Status(node.id, now, pose, velocity=(0.1, 0.0), ladder="policy"))
        node.offer_scan(scan, pose, now)


def share(strangers: list[Stranger], first: float, last: float, way: list[tuple[float, float]] = WAY) -> None:
    """Let all fly and hear each other from one time to another, ten times a second."""
    for now in np.arange(first, last, 0.1):
        for stranger in strangers:
            stranger.fly(float(now), way=way)
        heard = [(stranger, stranger.drone.poll(float(now))) for stranger in strangers]
        for sender, datagrams in heard:
            for other in strangers:
                if other is not sender:
                    for datagram in datagrams:
                        other.drone.node.receive(datagram, float(now))
