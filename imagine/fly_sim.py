"""`imagine fly --sim`: a whole flight on one machine: the twin, a process per drone, and the ground station.

Nothing here knows how a drone flies: runners meet the twin over MAVLink, LiDAR datagrams and the radio, as they meet
a vehicle in the field.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from imagine.core.errors import ImagineError, InputError, WorkError
from imagine.core.frames import IDENTITY, Pose
from imagine.first_start import compile_kernels, warm_twin
from imagine.flight_ground import FlightGround
from imagine.flight_results import FlightLog, results
from imagine.flown_map import draw_flown_map
from imagine.gcs.snapshot import FleetSnapshot
from imagine.mesh_comm.settings import Frame, MeshSettings, Protocol
from imagine.onboard.build import load_policy
from imagine.onboard.odometry_settings import OdometrySettings
from imagine.onboard.settings import DEFAULT_POLICY, DroneSettings, LaunchPose
from imagine.runner_processes import RunnerProcesses
from imagine.sim.coverage import Coverage
from imagine.sim.level import load_level
from imagine.sim.server import SitlServer, SitlSettings, TickRecord
from imagine.sim.twin import Twin
from imagine.sim.twin_settings import TwinSettings
from imagine.stop_signals import StopSignals

_CONNECT_S = 60.0
_LAND_TICKS = 150  # after Ctrl-C: what a landing takes
_TICKS_AFTER = 3  # after the last touchdown, so that its runner hears of it
_MOTION_MPS, _LIFTED_M = 0.1, 0.05
_LOCKSTEP_REPLY_S = 10.0  # a runner that lives but is slow is waited for; a dead one is noticed at once


@dataclass(frozen=True)
class FlyOptions:
    """What `imagine fly --sim` is asked for. `port` is that of the page; ticks are tenths of a second.

    `frame`: whether the drones know how they stand to each other (`MeshSettings.frame`); where they share no frame each
    maps in its own, begun where it stands, and under `layout` is told where all of them stand.
    """

    level: str = "4"
    drones: int = 3
    policy: Path | None = DEFAULT_POLICY
    protocol: Protocol = "one-hop"
    frame: Frame = "shared"
    ticks: int = 1000
    lockstep: bool = False
    speed: float = 1.0
    headless: bool = False
    seed: int = 0
    port: int = 8770
    map_image: Path | None = None
    twin: TwinSettings = field(default_factory=TwinSettings)


class Watcher:
    """What the flight tells those who watch; the command line overrides what it wants to show."""

    def compiling(self) -> None:
        """The first start after an installation compiles; it takes a while."""

    def serving(self, url: str) -> None:
        """The ground station's page is up at `url`."""

    def landing(self) -> None:
        """The flight was asked to end: its drones land."""

    def tick(self, record: TickRecord, coverage: float, snapshot: FleetSnapshot | None) -> None:
        """One tick was flown; `snapshot` is the ground station's newest, None when headless."""


def fly_sim(options: FlyOptions, processes: RunnerProcesses, watcher: Watcher, began: float) -> dict[str, Any]:
    """Fly until the ticks are over or every drone is down; return the flight's JSON.

    `processes` have been started and not yet told to fly; `began` is `time.monotonic()` of the command's start.
    Raises InputError on bad input, before anything connects.
    """
    with ExitStack() as stack:
        stopping = stack.enter_context(StopSignals())
        level = load_level(options.level)
        launches = level.launch_poses(options.drones)
        twin = Twin(
            [level], options.drones, seed=options.seed, dynamics=options.twin.dynamics, sensing=options.twin.sensing
        )
        settings = drone_settings(options, launches)
        load_policy(settings[0])  # refuses a model that does not fit
        ground: FlightGround | None = None
        if not options.headless:
            ground = stack.enter_context(FlightGround(settings[0].radio, processes.key, options.port))
            watcher.serving(ground.url)
        compile_kernels(settings[0], watcher.compiling)
        sitl = SitlSettings(
            lockstep=options.lockstep,
            speed=options.speed,
            reply_timeout_s=_LOCKSTEP_REPLY_S if options.lockstep else 1.5,
            radio=options.twin.radio,
        )
        server = stack.enter_context(SitlServer(twin, sitl, options.seed, processes.is_running))
        processes.fly(
            [
                drone.model_copy(update={"vehicle": link.vehicle, "lidar": link.lidar, "mesh": link.mesh})
                for drone, link in zip(settings, server.endpoints, strict=True)
            ]
        )
        warm_twin()  # while the runners load theirs
        coverage = Coverage(level, options.drones, twin.lidar, settings[0].map.range_cap_m)
        try:
            server.wait_connected(_CONNECT_S)
        except WorkError as error:
            raise _why_not_connected(error, processes, options.drones) from error
        stopping.flying = True
        flight = _Flight(options, launches, server, processes, ground, coverage, watcher, began)
        flight.run(stopping)
        processes.request_end()
        processes.wait_end()
        found = flight.results()
        if ground is not None and flight.log.last is not None:
            last = flight.log.last
            down = sum(not vehicle.armed for vehicle in last.vehicles)
            ending = f"Flight over: coverage {found['coverage']:.1%}, {down} of {options.drones} drones are down."
            ground.finish(last.time_s, found["coverage"], ending)
        if options.map_image is not None:
            draw_flown_map(processes, flight.log.frames, options.map_image)
        return found


class _Flight:
    """The loop of a flight: tick, listen, tell."""

    def __init__(
        self,
        options: FlyOptions,
        launches: Sequence[Pose],
        server: SitlServer,
        processes: RunnerProcesses,
        ground: FlightGround | None,
        coverage: Coverage,
        watcher: Watcher,
        began: float,
    ) -> None:
        self.options, self.server, self.processes = options, server, processes
        self.ground, self.coverage, self.watcher, self.began = ground, coverage, watcher, began
        begun = [IDENTITY] * options.drones if options.frame == "shared" else launches
        self.log = FlightLog(options.frame, dict(enumerate(begun, start=1)))
        self.first_motion_s = 0.0
        self._has_flown = [False] * options.drones

    def run(self, stopping: StopSignals) -> None:
        """Fly until it is over, or until all have landed after `stopping` asked for it."""
        ticks_left = self.options.ticks
        is_landing = False
        ticks_after = _TICKS_AFTER
        while ticks_left > 0 and ticks_after > 0 and (self.log.last is None or self._anybody_left(self.log.last)):
            if stopping.requested and not is_landing:
                is_landing, ticks_left = True, _LAND_TICKS
                self.watcher.landing()
                self.processes.request_end()
            record = self.server.tick()
            ticks_left -= 1
            ticks_after = ticks_after - 1 if self._all_down(record) else _TICKS_AFTER
            share = self.coverage.update(record.poses, self.server.last_scans)
            self.log.add(record, share)
            if not self.first_motion_s and _moves(record):
                self.first_motion_s = time.monotonic() - self.began
            snapshot = self.ground.listen(self.server, record, share, self.processes) if self.ground else None
            self.watcher.tick(record, share, snapshot)

    def _all_down(self, record: TickRecord) -> bool:
        """Every drone has flown and is down again."""
        self._has_flown = [f or v.armed for f, v in zip(self._has_flown, record.vehicles, strict=True)]
        return all(flown and not v.armed for flown, v in zip(self._has_flown, record.vehicles, strict=True))

    def _anybody_left(self, record: TickRecord) -> bool:
        """Some drone has a runner, or is in the air without one."""
        return self.processes.any_running() or any(v.armed for v in record.vehicles)

    def results(self) -> dict[str, Any]:
        """Return the flight's JSON, once the processes have ended."""
        numbers = range(1, self.options.drones + 1)
        reports = {number: self.processes.report(number) for number in numbers}
        deaths = {number: self.processes.ended_badly(number) for number in numbers}
        return results(self.log, reports, deaths, time.monotonic() - self.began, self.first_motion_s)


def _moves(record: TickRecord) -> bool:
    """Tell whether a drone has left the ground or flies along."""
    lifted = any(vehicle.height_m > _LIFTED_M for vehicle in record.vehicles)
    return lifted or bool(abs(record.velocities[:, :2]).max() > _MOTION_MPS)


def drone_settings(options: FlyOptions, poses: Sequence[Pose]) -> list[DroneSettings]:
    """Return what each drone of the flight is given, from number 1 on, before it is wired."""
    layout = {number: tuple(pose) for number, pose in enumerate(poses, start=1)} if options.frame == "layout" else {}
    radio = MeshSettings.model_validate({"protocol": options.protocol, "frame": options.frame, "layout": layout})
    starts = poses if options.frame == "shared" else [IDENTITY] * len(poses)
    odometry = OdometrySettings(deskew=options.twin.sensing.skew)
    return [
        DroneSettings(
            drone_id=number,
            policy=options.policy,
            launch=LaunchPose(x=pose.x, y=pose.y, yaw=pose.yaw),
            radio=radio,
            odometry=odometry,
            lockstep=options.lockstep,
            stay=True,
        )
        for number, pose in enumerate(starts, start=1)
    ]


def _why_not_connected(error: WorkError, processes: RunnerProcesses, drones: int) -> ImagineError:
    """Return what the runner that ended has said, as bad input if that is what it was."""
    for number in range(1, drones + 1):
        status = processes.exit_status(number)
        if status not in (None, 0):
            what = f"drone {number}: {processes.last_words(number)}"
            return InputError(what) if status == 2 else WorkError(f"drone {number}: {processes.ended_badly(number)}")
    return error
