"""A drone's process: sockets, clock and signals around `Runner.tick`, and nothing decided here.

Ports are opened and everything is compiled and loaded before the first setpoint. The loop is driven by scans alone, so
a stalled one goes silent and the autopilot's own failsafe takes over.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

from imagine.core.errors import InputError, WorkError
from imagine.core.lidar import Scan
from imagine.mesh_comm.links import MeshLink, open_link
from imagine.mesh_comm.namesake import ANSWER_S
from imagine.mesh_comm.udp_modem import UdpModemLink
from imagine.mesh_comm.udp_network import UdpNetworkLink
from imagine.onboard.autopilot import Autopilot
from imagine.onboard.build import build_runner, load_policy, mesh_sealer, warm_up
from imagine.onboard.lidar_source import LidarSource
from imagine.onboard.phases import FINAL, Phase
from imagine.onboard.records import TickInput, TickOutput
from imagine.onboard.report import FlightRecord, write_map, write_report
from imagine.onboard.runner import Runner
from imagine.onboard.settings import DroneSettings

_log = logging.getLogger(__name__)

LOCKSTEP_WAIT_S = 2.0
"""Wall-clock deadline for each thing that a lockstep tick waits for."""
_SCAN_WAIT_S = 0.1  # how long the loop sleeps at most: bounds the answer to a signal
_NO_SCAN_TICK_S = 0.25  # without scans the runner still ticks this often, to hold, land and tell
_ENDING_S = 20.0  # from the request to end until the process goes, landed or not
_ENDING_SILENT_S = 0.6  # and this long, if no scans come either: there is nothing left to fly by
_RELEASED_S = 60.0


class ScanClock:
    """The runner's clock: the newest scan's stamp, carried on by the wall clock between scans. It never runs back.

    Before the first scan it stands at zero: a sensor's stamps may begin anywhere.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        """Start at zero."""
        self._monotonic = monotonic
        self._stamp, self._set_at = 0.0, math.nan
        self._latest = 0.0

    def set(self, stamp: float) -> None:
        """Take a scan's stamp, seconds."""
        self._stamp, self._set_at = stamp, self._monotonic()

    def now(self) -> float:
        """Return the time, seconds; while it is ahead of a slow sensor's stamps it waits for them."""
        if not math.isnan(self._set_at):
            self._latest = max(self._latest, self._stamp + self._monotonic() - self._set_at)
        return self._latest


def run_drone(settings: DroneSettings) -> int:
    """Fly one drone until it has landed or is asked to end (SIGTERM, SIGINT); return the exit status, 0.

    Raises InputError for settings, models and ports that do not serve, WorkError when the flight failed.
    """
    from imagine.onboard.lidar_udp import UdpLidarSource
    from imagine.onboard.mavlink import MavlinkAutopilot

    clock = ScanClock()
    with ExitStack() as stack:
        lidar = UdpLidarSource(settings.lidar, settings.lidar_spec, latest=not settings.lockstep)
        stack.callback(lidar.close)
        autopilot = MavlinkAutopilot(settings.vehicle, settings.system, None if settings.lockstep else clock.now)
        stack.callback(autopilot.close)
        policy = load_policy(settings)
        sealer = mesh_sealer(settings, os.environ, time.time())
        warm_up(settings, policy)
        runner = build_runner(settings, policy, sealer)
        link: MeshLink | None = None
        if settings.mesh is not None:  # last: the radio's greeting says that this drone is ready
            link = open_link(settings.mesh)
            stack.callback(link.close)
        ending = stack.enter_context(_end_signals())
        loop = Loop(settings, runner, lidar, autopilot, link, clock)
        unwritten: InputError | WorkError | None = None
        try:
            loop.run(ending)
        finally:
            dropped = loop.record.dropped
            dropped.update(autopilot.dropped)
            dropped.update(lidar.dropped)
            dropped.update(mesh_lost=0, mesh_oversize=0)
            if isinstance(link, UdpModemLink | UdpNetworkLink):
                dropped.update(mesh_lost=link.lost, mesh_oversize=link.oversize)
            try:
                loop.leave_behind(settings.report, settings.map_out)
            except (InputError, WorkError) as error:  # what befell the flight itself is told first
                _log.error("drone %d: %s", settings.drone_id, error)
                unwritten = error
    _raise_failure(runner, loop.gave_up)
    if unwritten is not None:
        raise unwritten
    return 0


class Loop:
    """Carries scans, telemetry and datagrams to the runner, and its outputs away, until the flight is over."""

    def __init__(
        self,
        settings: DroneSettings,
        runner: Runner,
        lidar: LidarSource,
        autopilot: Autopilot,
        link: MeshLink | None,
        clock: ScanClock,
    ) -> None:
        """Wire the ports to the runner; `run` does the work."""
        self.settings = settings
        self.runner = runner
        self.lidar = lidar
        self.autopilot = autopilot
        self.link = link
        self.clock = clock
        self.record = FlightRecord(settings.drone_id)
        self.gave_up: str | None = None
        self._ticked_at = math.inf  # the flight begins with the first scan, and so does its time
        self._fed_at = time.monotonic()
        self._final_at: float | None = None

    def run(self, ending: threading.Event) -> None:
        """Loop until the flight is over, `ending` is set and heeded, or scans stay away for too long."""
        ending_at: float | None = None
        self._fed_at = time.monotonic()
        while not self._over(ending_at):
            if ending.is_set() and ending_at is None:
                ending_at = time.monotonic()
            self.autopilot.beat()
            scan = self.lidar.read(_SCAN_WAIT_S)
            if scan is not None or time.monotonic() - self._ticked_at >= _NO_SCAN_TICK_S:
                self._step(scan, ending.is_set())

    def leave_behind(self, report: Path | None, map_out: Path | None) -> None:
        """Write the report and the map, where they are wanted."""
        if report is not None:
            write_report(report, self.record.as_json(self.runner.evidence, self.runner.mesh, self.runner.places))
        if map_out is not None:
            write_map(map_out, self.runner.evidence)

    def _step(self, scan: Scan | None, is_ending: bool) -> None:
        if self.settings.lockstep:
            if scan is None:
                return  # simulated time stands still
            inputs = self._gather_lockstep(scan, is_ending)
        else:
            inputs = self._gather(scan, is_ending)
        started = time.perf_counter()
        output = self.runner.tick(inputs)
        tick_ms = (time.perf_counter() - started) * 1e3
        self._send(inputs, output)
        self.record.add(output, tick_ms)
        for event in output.events:
            _log.info("drone %d: %.1f s: %s: %s", self.settings.drone_id, event.stamp, event.kind, event.text)
        self._ticked_at = time.monotonic()
        if scan is not None:
            self._fed_at = self._ticked_at

    def _gather(self, scan: Scan | None, is_ending: bool) -> TickInput:
        if scan is not None:
            self.clock.set(scan.stamp)
        telemetry = self.autopilot.telemetry()
        datagrams = tuple(self.link.receive()) if self.link is not None else ()
        return TickInput(self.clock.now(), scan, telemetry, datagrams, is_ending)

    def _gather_lockstep(self, scan: Scan, is_ending: bool) -> TickInput:
        self.clock.set(scan.stamp)
        telemetry = self.autopilot.wait_telemetry(scan.stamp, LOCKSTEP_WAIT_S)
        if telemetry is None:
            _log.warning("drone %d: no telemetry of %.1f s came in time", self.settings.drone_id, scan.stamp)
            telemetry = self.autopilot.telemetry()
        if isinstance(self.link, UdpModemLink) and not self.link.wait_marker(scan.stamp, LOCKSTEP_WAIT_S):
            _log.warning("drone %d: the radio's marker of %.1f s did not come", self.settings.drone_id, scan.stamp)
        datagrams = tuple(self.link.receive()) if self.link is not None else ()
        return TickInput(scan.stamp, scan, telemetry, datagrams, is_ending)

    def _send(self, inputs: TickInput, output: TickOutput) -> None:
        """Send everything of a tick; the setpoint goes last, for lockstep ends with it."""
        for command in output.commands:
            self.autopilot.send_command(command)
        for event in output.events:
            if event.kind in ("phase", "decision", "failsafe"):
                self.autopilot.send_text(event.text)
        if output.odometry is not None:
            self.autopilot.send_odometry(output.odometry)
        if self.link is not None:
            for datagram in output.datagrams:
                self.link.send(datagram)
            if self.settings.lockstep and isinstance(self.link, UdpModemLink):
                self.link.send_marker(inputs.now)
        if output.setpoint is not None:
            self.autopilot.send_setpoint(output.setpoint, inputs.now)

    def _over(self, ending_at: float | None) -> bool:
        now, phase = time.monotonic(), self.runner.flight.phase
        unfed_s = now - self._fed_at
        if phase in FINAL and self._final_at is None:
            self._final_at = now
        if ending_at is not None:
            waited = now - ending_at
            on_ground = phase in FINAL or (phase is Phase.PREPARE)
            return on_ground or waited > _ENDING_S or min(waited, unfed_s) > _ENDING_SILENT_S
        if unfed_s > self.settings.silence_s:
            self.gave_up = f"no LiDAR scan came for {self.settings.silence_s:.0f} s"
            return True
        if self._final_at is None or self.settings.stay:
            return False
        if self.runner.mesh is not None and self.runner.mesh.has_namesake and now - self._final_at < ANSWER_S:
            return False  # the other one must hear of it
        down = phase is not Phase.RELEASED or self.runner.is_disarmed
        return down or now - self._final_at > _RELEASED_S


def _raise_failure(runner: Runner, gave_up: str | None) -> None:
    flight = runner.flight
    if runner.mesh is not None and runner.mesh.has_namesake:
        number = runner.settings.drone_id
        raise WorkError(f"drone {number} did not go on: another node is on the air as {number}; set another drone_id")
    if flight.phase is Phase.FAILED:
        raise WorkError(f"drone {runner.settings.drone_id} did not fly: {flight.reason}")
    if flight.phase is Phase.RELEASED:
        raise WorkError(f"drone {runner.settings.drone_id} lost its flight: {flight.reason}")
    if gave_up is not None:
        raise WorkError(f"drone {runner.settings.drone_id} gave up in phase {flight.phase.value}: {gave_up}")


@contextmanager
def _end_signals() -> Iterator[threading.Event]:
    """Turn SIGTERM and SIGINT into an event, for as long as the context lasts; only a main thread gets signals."""
    ending = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield ending
        return

    def end(number: int, frame: FrameType | None) -> None:
        ending.set()

    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield ending
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
