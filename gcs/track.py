"""What the ground remembers of one drone between its messages: trail, byte rate, and what has changed."""

from __future__ import annotations

import math
from collections import deque
from types import MappingProxyType

from imagine.core.frames import Pose
from imagine.gcs.snapshot import DroneView, Severity, Trail
from imagine.mesh_comm.messages import GROUND, Status
from imagine.mesh_comm.node import Peer
from imagine.mesh_comm.placement import Standing

TRAIL_POINTS = 400
TRAIL_STEP_M = 0.15
"""A trail keeps a point every so far, and so many of them: the last 60 m."""
STALE_S = 1.5
"""A drone not heard for longer is shown as stale."""
_RATE_WINDOW_S = 4.0
_LOW_BATTERY = 0.2
_AIRBORNE_M = 0.15
_LINK_FRESH_S = 2.0
_EXPLORING = ("policy", "frontier")
_PLACED: tuple[Standing, ...] = ("given", "trusted")
_UNTOLD = Status(0, 0.0, Pose(0.0, 0.0, 0.0))

News = tuple[Severity, str]


class Track:
    """Follows one drone through what the mesh node knows of it. Times are the caller's, seconds."""

    def __init__(self, drone: int, now: float) -> None:
        """Start following drone `drone`, of which nothing is known yet."""
        self.drone = drone
        self.note = ""
        self.lost = False
        self._since = now
        self._trail: deque[tuple[float, float]] = deque(maxlen=TRAIL_POINTS)
        self._trail_end = 0
        self._sent: deque[tuple[float, int]] = deque()
        self._last: DroneView | None = None

    def observe(self, peer: Peer | None, place: Standing, now: float) -> tuple[DroneView, list[News]]:
        """Return the drone as it is now, and what is new since the last look.

        `peer` None: never heard; `place` is what the ground knows of the drone's frame.
        """
        view = self._view(peer, place, now)
        news = _news(self._last, view)
        self._last = view
        return view, news

    def _view(self, peer: Peer | None, place: Standing, now: float) -> DroneView:
        told = (peer.status if peer else None) or _UNTOLD
        pose = peer.pose if peer else None
        age = max(0.0, peer.age_s) if peer else max(0.0, now - self._since)
        stale = self.lost or age > STALE_S
        if pose is not None and not stale:
            self._extend_trail(pose.x, pose.y)
        x, y, yaw = pose or (0.0, 0.0, 0.0)
        vx, vy = peer.velocity if peer else (0.0, 0.0)
        return DroneView(
            id=self.drone,
            located=pose is not None,
            x=x,
            y=y,
            yaw=yaw,
            vx=vx,
            vy=vy,
            height_m=told.height_m,
            battery=told.battery,
            mode=told.mode,
            armed=told.armed,
            flying=told.armed and told.height_m > _AIRBORNE_M,
            state=told.ladder or "idle",
            reason=told.reason,
            own_cells=told.own_cells,
            scan_cells=told.scan_cells,
            map_cells=told.map_cells,
            bytes_sent=MappingProxyType(dict(told.bytes_sent)),
            taught=MappingProxyType(dict(told.taught)),
            place=place,
            rate_bps=self._rate(sum(told.bytes_sent.values()), now),
            age_s=age,
            stale=stale,
            lost=self.lost,
            note=self.note,
            hears=tuple(
                sorted(
                    i for i, silence in told.links.items() if i not in (GROUND, self.drone) and silence <= _LINK_FRESH_S
                )
            ),
            trail=Trail(tuple(self._trail), self._trail_end),
        )

    def _extend_trail(self, x: float, y: float) -> None:
        if not self._trail or math.dist(self._trail[-1], (x, y)) >= TRAIL_STEP_M:
            self._trail.append((x, y))
            self._trail_end += 1

    def _rate(self, total: int, now: float) -> float:
        """Return bytes a second over the last seconds; a total that falls is a restart, and counts from there."""
        if self._sent and (total < self._sent[-1][1] or now < self._sent[-1][0]):
            self._sent.clear()
        self._sent.append((now, total))
        while len(self._sent) > 2 and self._sent[1][0] <= now - _RATE_WINDOW_S:
            self._sent.popleft()
        (start, first), span = self._sent[0], now - self._sent[0][0]
        # a status tells the total only now and then: shorter spans would show steps
        return (total - first) / span if span >= 1.0 and start < now else 0.0


def _news(old: DroneView | None, new: DroneView) -> list[News]:
    """Return what the pilot should be able to read back about the change from one view to the next."""
    news: list[News] = []
    if old is None:
        return [("info", "joined the swarm")] if new.located or new.place not in _PLACED else []
    if new.place in _PLACED and old.place not in _PLACED:
        news.append(("info", "its place in the map is known"))
    if old.place in _PLACED and new.place not in _PLACED:
        news.append(("warning", "its place in the map is not known any more: the maps contradict it"))
    if new.stale and not old.stale and not new.lost:
        news.append(("error", f"not heard for {STALE_S} s; last in {new.mode or 'unknown mode'}, {new.state}"))
    if old.stale and not new.stale:
        news.append(("info", "heard again"))
    if new.armed != old.armed:
        news.append(("info", "armed" if new.armed else "disarmed"))
    if new.mode != old.mode and new.mode:
        news.append(("info", f"mode {new.mode}"))
    if new.state != old.state:
        # policy and rescue take turns many times a flight: to the pilot both are exploring
        if new.state not in _EXPLORING:
            severity: Severity = "warning" if new.state in ("hold", "land") else "info"
            news.append((severity, f"{new.state}: {new.reason}" if new.reason else new.state))
        elif old.state not in _EXPLORING:
            news.append(("info", "exploring"))
    if new.battery is not None and new.battery <= _LOW_BATTERY and (old.battery is None or old.battery > _LOW_BATTERY):
        news.append(("warning", f"battery low, {new.battery:.0%}"))
    return news
