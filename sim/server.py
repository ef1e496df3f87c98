"""The twin, served: vehicles, LiDARs and radio modems on UDP, in lockstep with their runners or in real time.

One call of `tick` is one turn of the LiDAR: sense and send, take the answers, fly. In lockstep the twin waits for
every live drone's answer, so a flight is the same each time and as fast as the machine; in real time it waits for
the clock.
"""

from __future__ import annotations

import logging
import selectors
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings
from imagine.core.errors import InputError, WorkError
from imagine.core.frames import wrap_angle
from imagine.sim.drone_edge import DroneEdge, Endpoint
from imagine.sim.flight_control import Failsafe, Mode, VehicleSettings
from imagine.sim.modem import Modem
from imagine.sim.pacing import Schedule
from imagine.sim.radio import GROUND, Delivery, RadioMedium, RadioSettings, StationCounters
from imagine.sim.twin import Twin
from imagine.sim.vehicle import Vehicle

logger = logging.getLogger(__name__)

_POLL_S = 0.05
_GREETING_S = 0.25


class SitlSettings(Settings):
    """How the twin is served: pacing, addresses, and the settings of vehicles and radio."""

    lockstep: bool = Field(default=True, description="wait for every runner's setpoint; otherwise follow the clock")
    speed: float = Field(default=1.0, gt=0.0, le=100.0, description="simulated seconds per second, without lockstep")
    mesh: bool = Field(default=True, description="give each drone a radio modem")
    reply_timeout_s: float = Field(default=1.5, gt=0.0, le=60.0, description="wall time until a runner is silent")
    first_reply_timeout_s: float = Field(default=20.0, gt=0.0, le=600.0, description="the same, before its first reply")
    host: str = Field(default="127.0.0.1", description="address the twin listens on")
    runner_host: str = Field(default="127.0.0.1", description="address of the runners")
    port_base: int | None = Field(
        default=None, ge=1024, le=60000, description="14540: PX4's companion ports from 14541; none: any free ports"
    )
    ground_modem: bool = Field(default=False, description="give the ground station a radio modem on UDP")
    vehicle: VehicleSettings = VehicleSettings()
    radio: RadioSettings = RadioSettings()


@dataclass(frozen=True)
class VehicleRecord:
    """One vehicle at a tick; `silent`: its runner does not answer; `malformed` and `rejected` count its bad input."""

    drone: int
    mode: Mode
    armed: bool
    height_m: float
    battery: float
    failsafes: tuple[Failsafe, ...]
    silent: bool
    malformed: int
    rejected: int


@dataclass(frozen=True)
class TickRecord:
    """One tick: poses and velocities `[drones, 3]` are the truth at `time_s`, when the scans were taken.

    `links` are the (sender, receiver) stations that heard each other this tick, 0 the ground; `ground_inbox` what the
    ground station heard; `contacts` counts each drone's collisions so far.
    """

    tick: int
    time_s: float
    poses: NDArray[np.float64]
    velocities: NDArray[np.float64]
    vehicles: tuple[VehicleRecord, ...]
    contacts: NDArray[np.int64]
    links: tuple[tuple[int, int], ...]
    sent: tuple[StationCounters, ...]
    ground_inbox: tuple[bytes, ...] = field(repr=False)

    @property
    def silent(self) -> tuple[int, ...]:
        """Numbers of the drones whose runners do not answer."""
        return tuple(v.drone for v in self.vehicles if v.silent)


class SitlServer:
    """World 0 of a twin with a vehicle, a LiDAR and a radio modem on UDP for each of its drones.

    `is_running(drone)`, where given, tells whether a runner's process lives, so that a dead one is not waited for.
    """

    def __init__(
        self,
        twin: Twin,
        settings: SitlSettings | None = None,
        seed: int = 0,
        is_running: Callable[[int], bool] | None = None,
    ) -> None:
        """Open all ports. Raises InputError naming a port in use."""
        self.twin = twin
        self.settings = settings or SitlSettings()
        self.last_scans: NDArray[np.float32] = np.empty((0, twin.lidar.beams), np.float32)
        self.ticks = 0
        self._is_running = is_running
        self._schedule = Schedule(twin.dt, self.settings.speed)
        *vehicle_seeds, radio_seed = np.random.SeedSequence(seed).spawn(twin.drones + 1)
        self.radio = RadioMedium(
            twin.drones, self.settings.radio, np.random.default_rng(radio_seed), twin.levels[0].segments
        )
        self._yaw = twin.poses[0, :, 2].copy()
        self._selector = selectors.DefaultSelector()
        self.edges: list[DroneEdge] = []
        self.ground: Modem | None = None
        try:
            self._open([np.random.default_rng(s) for s in vehicle_seeds])
        except InputError:
            self.close()
            raise

    def _open(self, rngs: list[np.random.Generator]) -> None:
        s = self.settings
        for number, rng in enumerate(rngs, start=1):
            vehicle = Vehicle(number, s.vehicle, rng, yaw=float(self._yaw[number - 1]))
            edge = DroneEdge(number, vehicle, s.mesh, s.host, s.runner_host, s.port_base)
            self.edges.append(edge)
            self._selector.register(edge.link.socket, selectors.EVENT_READ)
            if edge.modem is not None:
                self._selector.register(edge.modem.socket, selectors.EVENT_READ)
        if s.ground_modem:
            self.ground = Modem("the ground station", s.host, 0 if s.port_base is None else s.port_base + 2000)
            self._selector.register(self.ground.socket, selectors.EVENT_READ)

    @property
    def endpoints(self) -> list[Endpoint]:
        """The links of each drone, for its runner."""
        return [edge.endpoint for edge in self.edges]

    @property
    def ground_endpoint(self) -> str | None:
        """The ground station's radio modem, where the settings ask for one."""
        return f"udpout://{self.settings.host}:{self.ground.port}" if self.ground is not None else None

    @property
    def now(self) -> float:
        """Simulated seconds: the stamp of the tick that comes next."""
        return round((self.ticks + 1) * self.twin.dt, 9)

    def send_from_ground(self, datagram: bytes) -> None:
        """Broadcast a mesh datagram from the ground station."""
        self.radio.send(GROUND, datagram, self.now)

    def wait_connected(self, timeout_s: float) -> None:
        """Send heartbeats until every runner has been heard; simulated time stands still.

        Raises WorkError naming the drones that were not heard within `timeout_s`, or whose process has ended.
        """
        deadline = time.monotonic() + timeout_s
        greet_at = 0.0
        while missing := [edge for edge in self.edges if not edge.connected]:
            now = time.monotonic()
            if now >= greet_at:
                greet_at = now + _GREETING_S
                for edge in self.edges:
                    edge.link.send([edge.vehicle.heartbeat()])
            self._receive(_POLL_S)
            for edge in self.edges:
                self._obey(edge, 0.0)
            names = ", ".join(str(edge.number) for edge in missing)
            if any(self._has_ended(edge) for edge in missing):
                raise WorkError(f"the runner of drone {names} ended before it connected")
            if time.monotonic() > deadline and not all(edge.connected for edge in self.edges):
                where = "; ".join(edge.endpoint.vehicle for edge in missing)
                raise WorkError(f"drone {names} did not connect within {timeout_s:g} s: no runner heard for {where}")

    def tick(self) -> TickRecord:
        """Sense and send, take the answers, fly one tick; return the truth that was sensed."""
        started, stamp, twin = time.monotonic(), self.now, self.twin
        poses, velocities = twin.poses[0].copy(), twin.velocity[0].copy()
        self.last_scans = twin.scan()[0]
        deliveries = self.radio.deliver(stamp, poses[:, :2])
        self._send(deliveries, poses, stamp)
        if self.settings.lockstep:
            self._await_answers(stamp)
        else:
            self._follow_clock(self._schedule.next_due(started), stamp)
        record = self._record(stamp, poses, velocities, deliveries)
        twin.step(np.array([[edge.vehicle.velocity_setpoint(stamp) for edge in self.edges]]))
        self.ticks += 1
        return record

    def _send(self, deliveries: list[Delivery], poses: NDArray[np.float64], stamp: float) -> None:
        dt = self.twin.dt
        for edge, pose, ranges in zip(self.edges, poses, self.last_scans, strict=True):
            index = edge.number - 1
            yaw_rate = wrap_angle(float(pose[2] - self._yaw[index])) / dt
            self._yaw[index] = pose[2]
            telemetry = edge.vehicle.step(stamp, dt, yaw_rate)
            mesh = [d.datagram for d in deliveries if d.receiver == edge.number]
            edge.send_tick(telemetry, mesh, ranges, self.twin.lidar, stamp)
        if self.ground is not None:
            self.ground.send(d.datagram for d in deliveries if d.receiver == GROUND)

    def _await_answers(self, stamp: float) -> None:
        """Wait for every live drone's setpoint and marker, then obey them, drone by drone."""
        started = time.monotonic()
        self._receive(0.0)
        while waiting := [edge for edge in self.edges if not (edge.silent or edge.has_answered(stamp))]:
            elapsed_s = time.monotonic() - started
            for edge in waiting:
                first = edge.heard_setpoint_s < 0.0
                limit_s = self.settings.first_reply_timeout_s if first else self.settings.reply_timeout_s
                if self._has_ended(edge):
                    edge.silent = True
                    logger.warning("drone %d: its runner has ended", edge.number)
                elif elapsed_s > limit_s:
                    edge.silent = True
                    logger.warning("drone %d: no setpoint within %.1f s, going on without it", edge.number, limit_s)
            self._receive(_POLL_S)
        for edge in self.edges:
            self._obey(edge, stamp, upto=None if edge.silent else stamp)

    def _follow_clock(self, due: float, stamp: float) -> None:
        """Answer messages as they come until the next tick is due."""
        while True:
            self._receive(max(0.0, min(_POLL_S, due - time.monotonic())))
            for edge in self.edges:
                self._obey(edge, stamp)
            if time.monotonic() >= due:
                break
        silence_s = self.settings.reply_timeout_s * self.settings.speed
        for edge in self.edges:
            overdue = edge.heard_setpoint_s > 0.0 and stamp - edge.heard_setpoint_s > silence_s
            edge.silent = overdue or self._has_ended(edge)

    def _has_ended(self, edge: DroneEdge) -> bool:
        return self._is_running is not None and not self._is_running(edge.number)

    def _receive(self, timeout_s: float) -> None:
        self._selector.select(timeout_s)
        for edge in self.edges:
            edge.collect()
        if self.ground is not None:
            for datagram in self.ground.receive():
                self.send_from_ground(datagram)

    def _obey(self, edge: DroneEdge, now: float, upto: float | None = None) -> None:
        """Give the vehicle its messages and the radio its datagrams: up to those of the tick `upto`, or all."""
        for message in edge.take_messages(upto):
            edge.link.send(edge.vehicle.receive(message, now))
            if edge.is_setpoint(message):
                edge.heard_setpoint_s = now
        for datagram in edge.take_datagrams(upto):
            self.radio.send(edge.number, datagram, now)

    def _record(
        self, stamp: float, poses: NDArray[np.float64], velocities: NDArray[np.float64], deliveries: list[Delivery]
    ) -> TickRecord:
        vehicles = tuple(
            VehicleRecord(
                drone=edge.number,
                mode=edge.vehicle.mode,
                armed=edge.vehicle.armed,
                height_m=edge.vehicle.height_m,
                battery=edge.vehicle.battery,
                failsafes=edge.vehicle.failsafes,
                silent=edge.silent,
                malformed=edge.link.malformed,
                rejected=edge.vehicle.rejected.total(),
            )
            for edge in self.edges
        )
        return TickRecord(
            tick=self.ticks,
            time_s=stamp,
            poses=poses,
            velocities=velocities,
            vehicles=vehicles,
            contacts=self.twin.contacts[0].copy(),
            links=tuple(sorted({(d.sender, d.receiver) for d in deliveries})),
            sent=tuple(StationCounters(c.sent, c.sent_bytes, c.dropped) for c in self.radio.sent),
            ground_inbox=tuple(d.datagram for d in deliveries if d.receiver == GROUND),
        )

    def close(self) -> None:
        """Release all ports."""
        self._selector.close()
        for edge in self.edges:
            edge.close()
        if self.ground is not None:
            self.ground.close()

    def __enter__(self) -> SitlServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
