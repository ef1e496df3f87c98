"""`imagine fly --sim`: a whole flight on one machine: the twin, a process per drone, and the ground station.

Nothing here knows how a drone flies: runners meet the twin over MAVLink, LiDAR datagrams and the radio, as they meet
a vehicle in the field.
"""

from __future__ import annotations

import os
import secrets
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from imagine.core.errors import InputError, WorkError
from imagine.flight_results import FlightLog, results
from imagine.gcs.fleet import Fleet
from imagine.gcs.server import GroundServer
from imagine.gcs.snapshot import FleetSnapshot
from imagine.gcs.station import obey
from imagine.mesh_comm.messages import GROUND
from imagine.mesh_comm.seal import KEY_BYTES, Sealer
from imagine.mesh_comm.settings import MeshSettings, Protocol
from imagine.onboard.settings import DEFAULT_POLICY, DroneSettings, LaunchPose
from imagine.runner_processes import RunnerProcesses
from imagine.sim.coverage import Coverage
from imagine.sim.flight_control import Mode
from imagine.sim.level import load_level
from imagine.sim.server import SitlServer, SitlSettings, TickRecord
from imagine.sim.twin import Twin

_CONNECT_S = 60.0
_LAND_TICKS = 150  # after Ctrl-C: what a landing takes
_MOTION_MPS = 0.1
_SNAPSHOT_TICKS = 2
_LOCKSTEP_REPLY_S = 10.0  # a runner that lives but is slow is waited for; a dead one is noticed at once


@dataclass(frozen=True)
class FlyOptions:
    """What `imagine fly --sim` is asked for. `port` is that of the page; ticks are tenths of a second."""

    level: str = "4"
    drones: int = 3
    policy: Path | None = DEFAULT_POLICY
    protocol: Protocol = "one-hop"
    ticks: int = 1000
    lockstep: bool = False
    speed: float = 1.0
    headless: bool = False
    seed: int = 0
    port: int = 8770
    map_image: Path | None = None


class Watcher:
    """What the flight tells those who watch; the command line overrides what it wants to show."""

    def started(self, url: str | None) -> None:
        """Runners and twin are up; `url` is the page's address, None when headless."""

    def tick(self, record: TickRecord, coverage: float, snapshot: FleetSnapshot | None) -> None:
        """One tick was flown; `snapshot` is the ground station's newest, None when headless."""


def fly_sim(options: FlyOptions, watcher: Watcher, began: float) -> dict[str, Any]:
    """Fly until the ticks are over or every drone is down; return the flight's JSON.

    `began` is `time.monotonic()` of the command's start. Raises InputError on bad input, before anything is started.
    """
    level = load_level(options.level)
    twin = Twin([level], options.drones, seed=options.seed)
    settings = _drone_settings(options, level.launch_poses(options.drones))
    _check_policy(settings[0])
    key = secrets.token_bytes(KEY_BYTES)
    with ExitStack() as stack:
        ground = None if options.headless else stack.enter_context(_Ground(settings[0].radio, key, options.port))
        _warm_kernels(settings[0])
        processes: RunnerProcesses | None = None
        sitl = SitlSettings(
            lockstep=options.lockstep,
            speed=options.speed,
            reply_timeout_s=_LOCKSTEP_REPLY_S if options.lockstep else 1.5,
        )
        server = stack.enter_context(
            SitlServer(twin, sitl, options.seed, lambda drone: processes is None or processes.is_running(drone))
        )
        wired = [
            drone.model_copy(update={"vehicle": link.vehicle, "lidar": link.lidar, "mesh": link.mesh})
            for drone, link in zip(settings, server.endpoints, strict=True)
        ]
        processes = stack.enter_context(RunnerProcesses(wired, key))
        stopping = stack.enter_context(_stop_signals())
        try:
            server.wait_connected(_CONNECT_S)
        except WorkError as error:
            raise _why_not_connected(error, processes, options.drones) from error
        watcher.started(ground.url if ground is not None else None)
        coverage = Coverage(level, options.drones, twin.lidar, settings[0].map.range_cap_m)
        flight = _Flight(options, server, processes, ground, coverage, watcher, began)
        flight.run(stopping)
        processes.request_end()
        processes.wait_end()
        found = flight.results()
        if options.map_image is not None:
            draw_flown_map(processes, options.drones, options.map_image)
        return found


class _Flight:
    """The loop of a flight: tick, listen, tell."""

    def __init__(
        self,
        options: FlyOptions,
        server: SitlServer,
        processes: RunnerProcesses,
        ground: _Ground | None,
        coverage: Coverage,
        watcher: Watcher,
        began: float,
    ) -> None:
        self.options, self.server, self.processes = options, server, processes
        self.ground, self.coverage, self.watcher, self.began = ground, coverage, watcher, began
        self.log = FlightLog()
        self.first_motion_s = 0.0
        self._flew_at = time.monotonic()
        self._has_flown = [False] * options.drones

    def run(self, stopping: threading.Event) -> None:
        ticks_left = self.options.ticks
        is_landing = False
        while ticks_left > 0 and not self._is_over():
            if stopping.is_set() and not is_landing:
                is_landing, ticks_left = True, min(ticks_left, _LAND_TICKS)
                self.processes.request_end()
            record = self.server.tick()
            ticks_left -= 1
            share = self.coverage.update(record.poses, self.server.last_scans)
            self.log.add(record, share)
            if not self.first_motion_s and abs(record.velocities[:, :2]).max() > _MOTION_MPS:
                self.first_motion_s = time.monotonic() - self.began
            self._has_flown = [f or v.armed for f, v in zip(self._has_flown, record.vehicles, strict=True)]
            snapshot = self.ground.listen(self.server, record, share, self.processes) if self.ground else None
            self.watcher.tick(record, share, snapshot)

    def _is_over(self) -> bool:
        """Every drone that flew is down again, or has nobody left to fly it."""
        record = self.log.last
        if record is None:
            return False
        down = all(flown and not v.armed for flown, v in zip(self._has_flown, record.vehicles, strict=True))
        return down or not (self.processes.any_running() or any(v.armed for v in record.vehicles))

    def results(self) -> dict[str, Any]:
        numbers = range(1, self.options.drones + 1)
        reports = {number: self.processes.report(number) for number in numbers}
        deaths = {number: self.processes.ended_badly(number) for number in numbers}
        return results(self.log, reports, deaths, time.monotonic() - self.began, self.first_motion_s)


class _Ground:
    """The ground station of a simulated flight: the fleet on the twin's radio and clock, the page in a thread."""

    def __init__(self, radio: MeshSettings, key: bytes, port: int) -> None:
        self.fleet = Fleet(radio, Sealer(key, GROUND, boot=1))
        self.server = GroundServer(port=port)
        self._noted: dict[int, str] = {}

    @property
    def url(self) -> str:
        return self.server.url

    def listen(
        self, server: SitlServer, record: TickRecord, coverage: float, processes: RunnerProcesses
    ) -> FleetSnapshot | None:
        """Hand this tick's radio traffic to the fleet, its answers to the radio; return a fresh snapshot at times."""
        now = record.time_s
        for datagram in record.ground_inbox:
            self.fleet.receive(datagram, now)
        obey(self.fleet, self.server, now)
        for datagram in self.fleet.poll(now):
            server.send_from_ground(datagram)
        self._note_failures(record, processes)
        if record.tick % _SNAPSHOT_TICKS:
            return None
        snapshot = self.fleet.snapshot(now, coverage)
        self.server.publish(snapshot)
        return snapshot

    def _note_failures(self, record: TickRecord, processes: RunnerProcesses) -> None:
        """Tell the pilot what only the twin can see: why a drone went silent and what its vehicle does about it."""
        for vehicle in record.vehicles:
            why = processes.ended_badly(vehicle.drone)
            if not why and vehicle.failsafes:
                why = "vehicle failsafe"
            if not why:
                continue
            causes = ", ".join(f.reason for f in vehicle.failsafes)
            doing = "landed" if not vehicle.armed else "landing" if vehicle.mode is Mode.LAND else vehicle.mode.name
            text = f"{why}; vehicle: {causes + ', ' if causes else ''}{doing.lower()}"
            if self._noted.get(vehicle.drone) != text:
                self._noted[vehicle.drone] = text
                self.fleet.note(vehicle.drone, text, lost=not processes.is_running(vehicle.drone))

    def __enter__(self) -> _Ground:
        self.server.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.server.stop()


def _drone_settings(options: FlyOptions, poses: list[Any]) -> list[DroneSettings]:
    radio = MeshSettings(protocol=options.protocol)
    return [
        DroneSettings(
            drone_id=number,
            policy=options.policy,
            launch=LaunchPose(x=pose.x, y=pose.y, yaw=pose.yaw),
            radio=radio,
            lockstep=options.lockstep,
            stay=True,
        )
        for number, pose in enumerate(poses, start=1)
    ]


def _check_policy(settings: DroneSettings) -> None:
    """Refuse a model that does not fit before anything is started."""
    from imagine.onboard.build import load_policy

    load_policy(settings)


def _warm_kernels(settings: DroneSettings) -> None:
    """Compile the runners' kernels once, before several processes would each do so; later starts find them cached."""
    marker = Path(os.environ["NUMBA_CACHE_DIR"]) / "runner-kernels"
    if marker.exists():
        return
    from imagine.onboard.build import warm_up

    warm_up(settings, None)
    try:
        marker.touch()
    except OSError:
        return  # without a cache the runners compile for themselves


def _why_not_connected(error: WorkError, processes: RunnerProcesses, drones: int) -> ImagineFailure:
    """Return what the runner that ended has said, as bad input if that is what it was."""
    for number in range(1, drones + 1):
        status = processes.exit_status(number)
        if status not in (None, 0):
            kind: ImagineFailure = InputError(f"drone {number}: {processes.last_words(number)}")
            return kind if status == 2 else WorkError(f"drone {number}: {processes.ended_badly(number)}")
    return error


ImagineFailure = InputError | WorkError


@contextmanager
def _stop_signals() -> Iterator[threading.Event]:
    """Turn the first SIGINT or SIGTERM into a wish to land; the second ends the command at once."""
    stopping = threading.Event()

    def ask(number: int, frame: FrameType | None) -> None:
        if stopping.is_set():
            raise KeyboardInterrupt
        stopping.set()

    if threading.current_thread() is not threading.main_thread():
        yield stopping
        return
    before: dict[signal.Signals, Callable[..., Any] | int | None] = {
        number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stopping
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def draw_flown_map(processes: RunnerProcesses, drones: int, path: Path) -> None:
    """Draw the team's map, the sum of what each drone saw itself, with the drones' tracks."""
    import numpy as np

    from imagine.core.raster import LIMIT
    from imagine.onboard.map_image import draw_map

    layers = [np.load(file) for number in range(1, drones + 1) if (file := processes.map_file(number)) is not None]
    if not layers:
        raise WorkError("no drone left a map to draw")
    corners = np.array([layer["origin"] for layer in layers])
    ends = np.array([layer["origin"] + np.array(layer["own"].shape[::-1]) for layer in layers])
    low, high = corners.min(axis=0), ends.max(axis=0)
    total = np.zeros((high[1] - low[1], high[0] - low[0]), np.int16)
    for layer, corner in zip(layers, corners, strict=True):
        rows, columns = layer["own"].shape
        row, column = corner[1] - low[1], corner[0] - low[0]
        total[row : row + rows, column : column + columns] += layer["own"]
    belief = np.clip(total, -LIMIT, LIMIT).astype(np.int8)
    reports = [processes.report(number) for number in range(1, drones + 1)]
    tracks = [[(x, y) for _, x, y, _ in report["trajectory"]] for report in reports if report is not None]
    image = draw_map(belief, (int(low[0]), int(low[1])), tracks)
    try:
        image.save(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: the map cannot be written: {error}") from error
